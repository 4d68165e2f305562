"""Check the headers of FITS files, which may be damaged or hostile, before astropy reads the files."""

from __future__ import annotations

import io
import math
import re
from typing import IO

from lake_schema.errors import BadInput

# Number of bytes of a block of a FITS file; headers and data end at a multiple of it.
_BLOCK = 2880
# Number of bytes of a header card.
_CARD = 80
# Largest number of axes of an image.
_MAX_AXES = 9
# Largest number of header-data units of a file.
_MAX_HDUS = 10_000
# Largest number of bytes of a header.
_MAX_HEADER_BYTES = 64 * _BLOCK
# Largest number of columns of a table (limit of the FITS standard).
_MAX_COLUMNS = 999
# Pattern of a header card that determines the size of the data: keyword and integer.
_SIZE_CARD = re.compile(rb"(?:HIERARCH +)?(BITPIX|NAXIS\d{0,3}|PCOUNT|GCOUNT|TFIELDS) *= *([+-]?\d+)")


def check(name: str, stream: IO[bytes]) -> None:
    """Check the sizes in all headers of a FITS file, before astropy reads it.

    Without this check, astropy would map the file into memory beyond its end, or count up to a NAXIS of 4e9.

    Parameters
    ----------
    name : str
        Name of the file, for error messages.
    stream : binary file
        The file. Afterwards, its position is the beginning.

    Raises
    ------
    BadInput
        If the file is not a FITS file, or a header has no end, too many columns or axes, or gives more data than the
        file contains.
    """
    if stream.read(6) != b"SIMPLE":
        raise BadInput(f"{name}: is not a FITS file")
    size, hdu_start = stream.seek(0, io.SEEK_END), 0
    for _ in range(_MAX_HDUS):
        stream.seek(hdu_start)
        header = _header(name, stream)
        if not header:
            break
        size_cards: dict[bytes, int] = {}
        for start in range(0, len(header), _CARD):
            if card := _SIZE_CARD.match(header, start, start + _CARD):
                size_cards.setdefault(card[1], int(card[2]))
        if not 0 <= size_cards.get(b"TFIELDS", 0) <= _MAX_COLUMNS:
            raise BadInput(f"{name}: has {size_cards[b'TFIELDS']} columns, but must have 0 to {_MAX_COLUMNS}")
        if not 0 <= (count := size_cards.get(b"NAXIS", 0)) <= _MAX_AXES:
            raise BadInput(f"{name}: has {count} axes, but must have 0 to {_MAX_AXES}")
        axes = [size_cards.get(b"NAXIS%d" % i, 0) for i in range(1, count + 1)]
        if min([*axes, 0]) < 0:
            raise BadInput(f"{name}: has axes of {axes} pixels, which must not be negative")
        value_count = math.prod(axes) + size_cards.get(b"PCOUNT", 0) if axes else 0
        length = value_count * size_cards.get(b"GCOUNT", 1) * abs(size_cards.get(b"BITPIX", 8)) // 8
        if length < 0 or hdu_start + len(header) + length > size:
            end = hdu_start + len(header) + length
            raise BadInput(f"{name}: is cut short: its headers promise {end} bytes, but it has {size}")
        hdu_start += len(header) + -(-length // _BLOCK) * _BLOCK
    else:
        raise BadInput(f"{name}: has more than {_MAX_HDUS} header-data units")
    stream.seek(0)


def _header(name: str, stream: IO[bytes]) -> bytes:
    """Return the bytes of the header at the current position, b"" at the end of the file.

    Raise BadInput if the header is cut short or has no END card within 64 blocks of 2880 bytes.
    """
    header = b""
    while len(header) < _MAX_HEADER_BYTES:
        block = stream.read(_BLOCK)
        if len(block) < _BLOCK:
            if header:
                raise BadInput(f"{name}: is cut short in a header")
            return b""
        header += block
        if any(block[i : i + 8] == b"END     " for i in range(0, _BLOCK, _CARD)):
            return header
    raise BadInput(f"{name}: has a header of more than {_MAX_HEADER_BYTES} bytes")
