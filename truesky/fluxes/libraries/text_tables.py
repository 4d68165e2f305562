"""Check the size of a user's text table before astropy reads it, because a small file may need much time or memory.

For each word of a column, astropy allocates as much memory as for the longest word, which may span several lines if it
is in quotes. Astropy reads the header of an ECSV file as YAML, which is slow and can define data types of any size.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import takewhile

import yaml

# Largest number of characters in a line.
_MAX_LINE_LENGTH = 4096
# Largest number of characters in a header.
_MAX_HEADER_LENGTH = 64 << 10
# Largest number of characters in all words of a table, if each word were as long as the longest line.
_MAX_CHARACTERS = 64 << 20
# Data types that a header may declare. Other types are refused, since NumPy also accepts types such as 9999999D, with
# 80 MB per row.
_DATATYPES = {"bool", "string"} | {
    f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64, 128)
}
# Prefixes of the YAML tags that astropy writes for columns with units. Other tags are refused, because they can define
# arrays of any shape.
_TAGS = ("tag:yaml.org,2002:", "!astropy.units.", "!astropy.table.SerializedColumn")


def refuse_large(lines: Sequence[str], has_header: bool) -> None:
    """Check that a text table contains no more than a spectrum, extinction curve or passband needs.

    Parameters
    ----------
    lines : sequence of str
        Lines of the file.
    has_header : bool
        True if the file has a YAML header, as in ECSV.

    Raises
    ------
    ValueError
        If a line, the header or the table is too large, a text in quotes spans several lines, or the header contains
        references, subtypes, or data types other than booleans, real numbers and strings.
    yaml.YAMLError
        If the header is not valid YAML.
    """
    if max(map(len, lines), default=0) > _MAX_LINE_LENGTH:
        raise ValueError(f"a line has more than {_MAX_LINE_LENGTH} characters")
    header = list(takewhile(_is_header, lines)) if has_header else []
    _refuse_header([line.strip()[1:] for line in header])
    rows = lines[len(header) :]
    if any(line.count('"') % 2 for line in rows):
        raise ValueError("a text in quotes must not span more than one line")
    columns = 1 + max((line.count(",") + line.count(" ") + line.count("\t") for line in rows), default=0)
    if len(rows) * columns * max(map(len, rows), default=0) > _MAX_CHARACTERS:
        raise ValueError(f"{len(rows)} rows of {columns} words are too many for the length of the longest line")


def _is_header(line: str) -> bool:
    return line.strip()[:1] in ("", "#")


def _refuse_header(lines: Sequence[str]) -> None:
    if sum(map(len, lines)) > _MAX_HEADER_LENGTH:
        raise ValueError(f"its header has more than {_MAX_HEADER_LENGTH} characters")
    previous = None
    for event in yaml.parse(textwrap.dedent("\n".join(lines)), Loader=yaml.SafeLoader):
        if getattr(event, "anchor", None) is not None:
            raise ValueError(f"{event.anchor[:40]!r} in its header must not be a reference")
        if not (getattr(event, "tag", None) or _TAGS[0]).startswith(_TAGS):
            raise ValueError(f"{event.tag[:40]!r} in its header is not an allowed type of a curve")
        word = getattr(event, "value", None)
        if word == "subtype":
            raise ValueError("columns of a curve must be numbers without subtype")
        if previous == "datatype" and word is not None and word not in _DATATYPES:
            raise ValueError(f"{word[:40]!r} is not a datatype of ECSV")
        previous = word
