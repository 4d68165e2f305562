"""External FITS files, read with bounds: columns of numbers, HEALPix maps, cubes of planes.

read_numbers    an external binary table -> its columns of numbers
number_batches  the same, some columns and a bounded piece at a time
read_table      the same as an astropy table
read_map        an external HEALPix map -> its pixels and header
read_planes     an external image of two or three axes -> its samples and header
"""

from __future__ import annotations

import gzip
import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from lake_schema import user_files
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput, LakeError

_ROWS_A_BATCH = 65_536
# Of a file that is packed as a whole; of a map, pixels; of planes, samples.
_MOST_UNPACKED, _MOST_PIXELS, _MOST_SAMPLES = 512 << 20, 12 << 24, 64 << 20
# How a file is built, and how much of it there may be: axes of a unit, units, bytes of a header.
_BLOCK, _CARD = 2880, 80
_MOST_AXES, _MOST_UNITS, _MOST_HEADER = 9, 1000, 64 * _BLOCK
_MOST_COLUMNS = 999
_SIZES = re.compile(rb"(?:HIERARCH +)?(BITPIX|NAXIS\d{0,3}|PCOUNT|GCOUNT|TFIELDS) *= *([+-]?\d+)")
# Of a column of texts, bytes.
_LONGEST_TEXT = 256


def read_numbers(path: Path, kind: str) -> dict[str, Float]:
    """Columns of numbers of a file's first table, title -> float64[n]; NaN where TNULL says that there is none.

    kind   : of file, as user_files has it
    Errors : BadInput for a file that is cut short or is none, and where there is no table
    """
    with _opened(path, kind) as units:
        return _numbers_of(_first_table(path, units))


def number_batches(
    path: Path, columns: Sequence[str], texts: Sequence[str] = (), rows: int = _ROWS_A_BATCH, kind: str = "catalogue"
) -> Iterator[tuple[dict[str, Array], dict[str, str]]]:
    """Columns of numbers of a file's first table: (title -> numbers[n], whole numbers as they are; title -> TUNIT).

    texts  : more columns, of texts or whole numbers; left out where there are none
    path   : the file;  rows : of a batch;  kind : of user_files, whose largest size holds
    Errors : BadInput for a file that is cut short or is none, and names a column that is missing or no number
    """
    with _opened(path, kind) as units:
        unit = _first_table(path, units)
        known = {column.name: column for column in unit.columns}
        if missing := [name for name in dict.fromkeys(columns) if name not in known]:
            has = ", ".join(map(str, known))[:300]
            raise BadInput(f"{path}: has no column {', '.join(missing)}; it has {has}")
        for name in columns:
            _refuse_no_numbers(path, unit, known, name)
        said = {name: str(known[name].unit) for name in columns if known[name].unit}
        named = {name: _texts_of(path, unit, name) for name in texts if name in known}
        for first in range(0, len(unit.data), rows):
            part = slice(first, first + rows)
            numbers = {name: _native(unit.data[name][part], known[name].null) for name in columns}
            yield {**numbers, **{name: _decoded(stored[part]) for name, stored in named.items()}}, said


def read_table(path: Path, kind: str) -> Any:
    """An external file's first table as an astropy QTable, units and all; errors as of read_numbers."""
    # Slow to import, and seldom needed.
    from astropy.table import QTable

    with _opened(path, kind) as units:
        unit = _first_table(path, units)
        for column in unit.columns:
            _refuse_lists(path, column)
        return QTable.read(unit)


def _refuse_no_numbers(path: Path, unit: Any, known: Mapping[str, Any], name: str) -> None:
    _refuse_lists(path, known[name])
    if unit.data[name].dtype.kind not in "fiub" or unit.data[name].ndim != 1:
        raise BadInput(f"{path}: column {name} is {unit.data[name].dtype}, wanted a number a row")


def _refuse_lists(path: Path, column: Any) -> None:
    # Of variable length: each row says where its values are, and what it says is only known when it is read.
    if any(letter in str(column.format) for letter in "PQ"):
        raise BadInput(f"{path}: column {column.name} holds lists")


def _texts_of(path: Path, unit: Any, name: str) -> Array:
    """A column of texts as it is stored, bytes, or of whole numbers; astropy would decode all rows at once."""
    stored = unit.data.view(np.ndarray)[name]
    if stored.dtype.kind in "iu":
        stored = unit.data[name]
    if stored.dtype.kind not in "iuS" or stored.ndim != 1 or stored.dtype.itemsize > _LONGEST_TEXT:
        raise BadInput(f"{path}: column {name} is {stored.dtype}, wanted a text of at most {_LONGEST_TEXT} bytes a row")
    return np.asarray(stored)


def _decoded(values: Array) -> Array:
    if values.dtype.kind == "S":
        return np.asarray(np.char.decode(values, "ascii"))
    return values.astype(values.dtype.newbyteorder("="))


def _native(values: Any, null: int | None) -> Array:
    numbers = np.array(values)
    numbers = numbers.astype(np.int8 if numbers.dtype.kind == "b" else numbers.dtype.newbyteorder("="))
    if numbers.dtype.kind in "iu" and null is not None and (numbers == null).any():
        return np.where(numbers == null, np.nan, numbers.astype(np.float64))
    return numbers


def read_map(path: Path, column: str) -> tuple[Float, dict[str, Any]]:
    """A column of a HEALPix map, float64[pixels] in its file's order, and the cards of its header.

    Errors : BadInput for a file that is cut short or is none, and where there is no table or column
    """
    with _opened(path, "map of dust") as units:
        unit = _first_table(path, units)
        known = {found.name: found for found in unit.columns}
        if column not in known:
            raise BadInput(f"{path}: has no column {column}; it has {', '.join(map(str, known))}"[:500])
        _refuse_lists(path, known[column])
        values = unit.data[column]
        if values.dtype.kind not in "fiu" or not values.size <= _MOST_PIXELS:
            raise BadInput(f"{path}: column {column} is {values.size} of {values.dtype}, wanted numbers of a map")
        return np.asarray(values, np.float64).ravel(), dict(unit.header.items())


def read_planes(path: Path, column: str, kind: str = "PSF", most: int = _MOST_SAMPLES) -> tuple[Float, dict[str, Any]]:
    """An external file's planes, float64[ny, nx] or [n, ny, nx], with the cards of their header.

    The first image of two or three axes, or the array that the first row of a table has in `column`.

    path   : the file;  kind : of user_files;  most : numbers that one holds
    Errors : BadInput for a file that is cut short or is none, and where it holds neither, or packed images
    """
    with _opened(path, kind) as units:
        for unit in units:
            found = None
            if isinstance(unit, fits.BinTableHDU):
                if column in unit.columns.names and len(unit.data):
                    _refuse_lists(path, unit.columns[column])
                    found = unit.data[column][0]
            elif unit.is_image and unit.header["NAXIS"] in (2, 3):
                found = unit.data
            if found is not None and np.ndim(found) in (2, 3) and found.size and found.dtype.kind in "fiu":
                if found.size > most:
                    raise BadInput(f"{path}: holds {found.size} samples, a {kind} has at most {most}")
                return np.array(found, np.float64), dict(unit.header.items())
    raise BadInput(f"{path}: holds no image of two or three axes and no table with a column {column}")


def _numbers_of(unit: Any) -> dict[str, Float]:
    found = {}
    for column in unit.columns:
        if any(letter in str(column.format) for letter in "PQA"):
            continue
        values = np.asarray(unit.data[column.name])
        if values.dtype.kind not in "fiu" or values.ndim != 1:
            continue
        numbers = values.astype(np.float64)
        if values.dtype.kind in "iu" and column.null is not None:
            numbers[values == column.null] = np.nan
        found[str(column.name)] = numbers
    return found


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[fits.HDUList]:
    """An external file, plain or packed by gzip, its headers looked through before astropy is given it.

    Errors : BadInput, whatever it is that astropy trips over: what its readers raise has no end
    """
    with user_files.opened(path, kind) as stream:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", AstropyUserWarning)
                # Titles such as "RA(ICRS)" are usual.
                warnings.simplefilter("ignore", fits.verify.VerifyWarning)
                plain = _unpacked(path, stream)
                _look_through(path, plain)
                # What an image is packed in is a table then, and is not unpacked: that code trusts what it is given.
                with fits.open(plain, memmap=plain is stream, disable_image_compression=True) as units:
                    yield units
        except LakeError:
            raise
        except Exception as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise BadInput(f"{user_files.shown(path)}: cannot be read as FITS: {text[:300]}") from None


def _first_table(path: Path, units: fits.HDUList) -> Any:
    for unit in units:
        if isinstance(unit, fits.BinTableHDU):
            if not unit.header["NAXIS1"]:
                raise BadInput(f"{path}: the rows of its table have no bytes")
            return unit
    raise BadInput(f"{path}: holds no table")


def _unpacked(path: Path, stream: IO[bytes]) -> IO[bytes]:
    start = stream.read(6)
    stream.seek(0)
    if start == b"SIMPLE":
        return stream
    if not start.startswith(b"\x1f\x8b"):
        raise BadInput(f"{user_files.shown(path)}: is no FITS file")
    with gzip.open(stream) as packed:
        data = packed.read(_MOST_UNPACKED + 1)
    if len(data) > _MOST_UNPACKED:
        raise BadInput(f"{user_files.shown(path)}: unpacks to more than {_MOST_UNPACKED} bytes")
    return io.BytesIO(data)


def _look_through(path: Path, stream: IO[bytes]) -> None:
    """Refuse headers without end, and data that are not there: they would be mapped beyond the end of the file."""
    name, size, at = user_files.shown(path), stream.seek(0, io.SEEK_END), 0
    for _ in range(_MOST_UNITS):
        stream.seek(at)
        header = _header(name, stream)
        if not header:
            break
        said: dict[bytes, int] = {}
        for start in range(0, len(header), _CARD):
            if card := _SIZES.match(header, start, start + _CARD):
                said.setdefault(card[1], int(card[2]))
        if not 0 <= said.get(b"TFIELDS", 0) <= _MOST_COLUMNS:
            raise BadInput(f"{name}: has {said[b'TFIELDS']} columns")
        if not 0 <= (count := said.get(b"NAXIS", 0)) <= _MOST_AXES:
            raise BadInput(f"{name}: has {count} axes")
        axes = [said.get(b"NAXIS%d" % i, 0) for i in range(1, count + 1)]
        if min([*axes, 0]) < 0:
            raise BadInput(f"{name}: axes of {axes} pixels")
        values = math.prod(axes) + said.get(b"PCOUNT", 0) if axes else 0
        length = values * said.get(b"GCOUNT", 1) * abs(said.get(b"BITPIX", 8)) // 8
        if length < 0 or at + len(header) + length > size:
            raise BadInput(f"{name}: is cut short, {at + len(header) + length} bytes promised, {size} there")
        at += len(header) + -(-length // _BLOCK) * _BLOCK
    else:
        raise BadInput(f"{name}: has more than {_MOST_UNITS} units")
    stream.seek(0)


def _header(name: str, stream: IO[bytes]) -> bytes:
    """The blocks of a header; nothing where the file has ended."""
    header = b""
    while len(header) < _MOST_HEADER:
        block = stream.read(_BLOCK)
        if len(block) < _BLOCK:
            if header:
                raise BadInput(f"{name}: is cut short in a header")
            return b""
        header += block
        if any(block[i : i + 8] == b"END     " for i in range(0, _BLOCK, _CARD)):
            return header
    raise BadInput(f"{name}: has a header of more than {_MOST_HEADER} bytes")
