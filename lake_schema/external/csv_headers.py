"""Check the first line of a CSV file, which must have the names of the columns, separated by commas."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput

# Separators that are not allowed, with their names for error messages.
_SEPARATORS = ((";", "semicolons"), ("\t", "tabs"), ("|", "vertical bars"), (" ", "blanks"))
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def check_header(file: Path, names: Sequence[str]) -> None:
    """Check the line with the names of the columns of a CSV file.

    Parameters
    ----------
    file : Path
        The file, for the message.
    names : sequence of str
        Texts between the commas of the line.

    Raises
    ------
    BadInput
        If another separator than a comma is used, or the line begins with # or has numbers.
    """
    where = user_files.format_path(file)
    first = names[0].strip() if names else ""
    if len(names) == 1:
        for separator, description in _SEPARATORS:
            if separator in first.strip("# "):
                raise BadInput(f"{where}: the columns are separated by {description}, but must be separated by commas")
    if first.startswith("#"):
        raise BadInput(f"{where}: the first line begins with #, but must have only the names of the columns")
    if first and all(_NUMBER.fullmatch(name.strip()) for name in names):
        raise BadInput(f"{where}: the first line has numbers, but must have the names of the columns")
