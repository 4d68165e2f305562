"""What an external table in text may have, counted before astropy makes room for any of it.

Words of a column get as much room each as the longest of them, a header is read as YAML, which is slow and can name
types of any size, and words in quotes may go over lines.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import takewhile

import yaml

# Characters of a line, of a header, and of all words, were each as long as the longest line.
_MAX_LINE_LENGTH, _MAX_HEADER_LENGTH, _MAX_CHARACTERS = 4096, 64 << 10, 64 << 20
# What ECSV names, and no type of numpy's besides: 9999999D is one, of 80 MB a row.
_DATATYPES = {"bool", "string"} | {
    f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64, 128)
}
# What astropy writes of a column with a unit; of its other tags some make arrays of any shape.
_TAGS = ("tag:yaml.org,2002:", "!astropy.units.", "!astropy.table.SerializedColumn")


def refuse_large(lines: Sequence[str], has_header: bool) -> None:
    """Errors : ValueError says what the lines have that no curve needs; yaml.YAMLError where a header is none.

    has_header : in YAML, as ECSV has it
    """
    if max(map(len, lines), default=0) > _MAX_LINE_LENGTH:
        raise ValueError(f"a line has more than {_MAX_LINE_LENGTH} characters")
    header = list(takewhile(_is_header, lines)) if has_header else []
    _refuse_header([line.strip()[1:] for line in header])
    rows = lines[len(header) :]
    if any(line.count('"') % 2 for line in rows):
        raise ValueError("a text in quotes goes over more than one line")
    columns = 1 + max((line.count(",") + line.count(" ") + line.count("\t") for line in rows), default=0)
    if len(rows) * columns * max(map(len, rows), default=0) > _MAX_CHARACTERS:
        raise ValueError(f"{len(rows)} rows of {columns} words are too many where one is as long as its longest line")


def _is_header(line: str) -> bool:
    return line.strip()[:1] in ("", "#")


def _refuse_header(lines: Sequence[str]) -> None:
    if sum(map(len, lines)) > _MAX_HEADER_LENGTH:
        raise ValueError(f"its header has more than {_MAX_HEADER_LENGTH} characters")
    previous = None
    for event in yaml.parse(textwrap.dedent("\n".join(lines)), Loader=yaml.SafeLoader):
        if getattr(event, "anchor", None) is not None:
            raise ValueError(f"{event.anchor[:40]!r} in its header refers to another place of it")
        if not (getattr(event, "tag", None) or _TAGS[0]).startswith(_TAGS):
            raise ValueError(f"{event.tag[:40]!r} in its header is no type of a curve's")
        word = getattr(event, "value", None)
        if word == "subtype":
            raise ValueError("a curve's columns are numbers, none has a subtype")
        if previous == "datatype" and word is not None and word not in _DATATYPES:
            raise ValueError(f"{word[:40]!r} is no datatype of ECSV")
        previous = word
