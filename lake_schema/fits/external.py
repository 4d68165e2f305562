"""Read FITS files of users and other programs, with limits on their size: tables, HEALPix maps and planes of images."""

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

_ROWS_PER_BATCH = 65_536
# Largest number of bytes of an unpacked gzip file, of pixels of a map, and of samples of planes.
_MAX_UNPACKED_BYTES, _MAX_PIXELS, _MAX_SAMPLES = 512 << 20, 12 << 24, 64 << 20
# Sizes of blocks and cards in bytes, and limits: axes of a unit, units of a file, bytes of a header.
_BLOCK, _CARD = 2880, 80
_MAX_AXES, _MAX_HDUS, _MAX_HEADER_BYTES = 9, 1000, 64 * _BLOCK
_MAX_COLUMNS = 999
_SIZE_CARD = re.compile(rb"(?:HIERARCH +)?(BITPIX|NAXIS\d{0,3}|PCOUNT|GCOUNT|TFIELDS) *= *([+-]?\d+)")
# Largest width of a column of texts, in bytes.
_MAX_TEXT_BYTES = 256


def read_numbers(path: Path, kind: str) -> dict[str, Float]:
    """Return the numeric columns of a file's first table as float64 arrays by title; TNULL becomes NaN.

    Raises
    ------
    BadInput
        If the file is cut short or is not FITS, or has no table.
    """
    with _open_hdus(path, kind) as hdus:
        return _number_columns(_first_table(path, hdus))


def read_batches(
    path: Path,
    columns: Sequence[str],
    text_columns: Sequence[str] = (),
    rows_per_batch: int = _ROWS_PER_BATCH,
    kind: str = "catalogue",
) -> Iterator[tuple[dict[str, Array], dict[str, str]]]:
    """Yield the rows of some columns of a file's first table in batches.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str
        Columns of numbers.
    text_columns : sequence of str, optional
        Columns of texts or whole numbers; columns that do not exist are left out.
    rows_per_batch : int, optional
        Number of rows in a batch.
    kind : str, optional
        Kind of file, a key of `user_files.MAX_BYTES`, which limits its size.

    Yields
    ------
    arrays : dict of str to array, shape (n,)
        Values by column; integers keep their type unless some are missing.
    units : dict of str to str
        Units (TUNIT) by column, if the file gives them.

    Raises
    ------
    BadInput
        If the file is cut short or is not FITS, or a column is missing or not numeric.
    """
    with _open_hdus(path, kind) as hdus:
        hdu = _first_table(path, hdus)
        columns_by_name = {column.name: column for column in hdu.columns}
        if missing := [name for name in dict.fromkeys(columns) if name not in columns_by_name]:
            has = ", ".join(map(str, columns_by_name))[:300]
            raise BadInput(f"{path}: has no column {', '.join(missing)}; it has {has}")
        for name in columns:
            _refuse_no_numbers(path, hdu, columns_by_name, name)
        column_units = {name: str(columns_by_name[name].unit) for name in columns if columns_by_name[name].unit}
        text_values = {name: _text_column(path, hdu, name) for name in text_columns if name in columns_by_name}
        for first in range(0, len(hdu.data), rows_per_batch):
            batch = slice(first, first + rows_per_batch)
            numbers = {name: _native_numbers(hdu.data[name][batch], columns_by_name[name].null) for name in columns}
            yield (
                {**numbers, **{name: _decode_texts(stored[batch]) for name, stored in text_values.items()}},
                column_units,
            )


def read_table(path: Path, kind: str) -> Any:
    """Return the first table of a file as an astropy QTable with units; it raises the errors of `read_numbers`."""
    # This import is slow and seldom needed.
    from astropy.table import QTable

    with _open_hdus(path, kind) as hdus:
        hdu = _first_table(path, hdus)
        for column in hdu.columns:
            _refuse_lists(path, column)
        return QTable.read(hdu)


def _refuse_no_numbers(path: Path, hdu: Any, columns_by_name: Mapping[str, Any], name: str) -> None:
    _refuse_lists(path, columns_by_name[name])
    if hdu.data[name].dtype.kind not in "fiub" or hdu.data[name].ndim != 1:
        raise BadInput(f"{path}: column {name} is {hdu.data[name].dtype}, but must be one number per row")


def _refuse_lists(path: Path, column: Any) -> None:
    # Rows of variable length contain offsets, which cannot be checked before they are read.
    if any(letter in str(column.format) for letter in "PQ"):
        raise BadInput(f"{path}: column {column.name} holds lists")


def _text_column(path: Path, hdu: Any, name: str) -> Array:
    """Return a column as stored bytes, or as integers; astropy would decode the texts of all rows at once."""
    stored = hdu.data.view(np.ndarray)[name]
    if stored.dtype.kind in "iu":
        stored = hdu.data[name]
    if stored.dtype.kind not in "iuS" or stored.ndim != 1 or stored.dtype.itemsize > _MAX_TEXT_BYTES:
        raise BadInput(
            f"{path}: column {name} is {stored.dtype}, but must be a text of at most {_MAX_TEXT_BYTES} bytes per row"
        )
    return np.asarray(stored)


def _decode_texts(values: Array) -> Array:
    if values.dtype.kind == "S":
        return np.asarray(np.char.decode(values, "ascii"))
    return values.astype(values.dtype.newbyteorder("="))


def _native_numbers(values: Any, null: int | None) -> Array:
    numbers = np.array(values)
    numbers = numbers.astype(np.int8 if numbers.dtype.kind == "b" else numbers.dtype.newbyteorder("="))
    if numbers.dtype.kind in "iu" and null is not None and (numbers == null).any():
        return np.where(numbers == null, np.nan, numbers.astype(np.float64))
    return numbers


def read_map(path: Path, column: str) -> tuple[Float, dict[str, Any]]:
    """Return a column of a HEALPix map.

    Parameters
    ----------
    path : Path
        The file.
    column : str
        Name of the column.

    Returns
    -------
    values : float64 array, shape (n,)
        Values of the pixels in the order of the file.
    cards : dict
        Cards of its header.

    Raises
    ------
    BadInput
        If the file is cut short or is not FITS, or has no table or no such column.
    """
    with _open_hdus(path, "map of dust") as hdus:
        hdu = _first_table(path, hdus)
        columns_by_name = {item.name: item for item in hdu.columns}
        if column not in columns_by_name:
            raise BadInput(f"{path}: has no column {column}; it has {', '.join(map(str, columns_by_name))}"[:500])
        _refuse_lists(path, columns_by_name[column])
        values = hdu.data[column]
        if values.dtype.kind not in "fiu" or not values.size <= _MAX_PIXELS:
            contents = f"{values.size} values of {values.dtype}"
            raise BadInput(f"{path}: column {column} has {contents}, but must have at most {_MAX_PIXELS} numbers")
        return np.asarray(values, np.float64).ravel(), dict(hdu.header.items())


def read_planes(
    path: Path, column: str, kind: str = "PSF", max_samples: int = _MAX_SAMPLES
) -> tuple[Float, dict[str, Any]]:
    """Return the planes of a file: its first image with two or three axes, or an array in the first row of a table.

    Parameters
    ----------
    path : Path
        The file.
    column : str
        Column of the table that contains the array.
    kind : str, optional
        Kind of file, a key of `user_files.MAX_BYTES`, which limits its size.
    max_samples : int, optional
        Largest number of samples.

    Returns
    -------
    planes : float64 array, shape (ny, nx) or (n, ny, nx)
        The planes.
    cards : dict
        Cards of their header.

    Raises
    ------
    BadInput
        If the file is cut short or is not FITS, has no planes or too many samples, or contains compressed images only.
    """
    with _open_hdus(path, kind) as hdus:
        for hdu in hdus:
            planes = None
            if isinstance(hdu, fits.BinTableHDU):
                if column in hdu.columns.names and len(hdu.data):
                    _refuse_lists(path, hdu.columns[column])
                    planes = hdu.data[column][0]
            elif hdu.is_image and hdu.header["NAXIS"] in (2, 3):
                planes = hdu.data
            if planes is not None and np.ndim(planes) in (2, 3) and planes.size and planes.dtype.kind in "fiu":
                if planes.size > max_samples:
                    raise BadInput(f"{path}: holds {planes.size} samples, but a {kind} may have at most {max_samples}")
                return np.array(planes, np.float64), dict(hdu.header.items())
    raise BadInput(f"{path}: holds no image of two or three axes and no table with a column {column}")


def _number_columns(hdu: Any) -> dict[str, Float]:
    columns = {}
    for column in hdu.columns:
        if any(letter in str(column.format) for letter in "PQA"):
            continue
        values = np.asarray(hdu.data[column.name])
        if values.dtype.kind not in "fiu" or values.ndim != 1:
            continue
        numbers = values.astype(np.float64)
        if values.dtype.kind in "iu" and column.null is not None:
            numbers[values == column.null] = np.nan
        columns[str(column.name)] = numbers
    return columns


@contextmanager
def _open_hdus(path: Path, kind: str) -> Iterator[fits.HDUList]:
    """Open a FITS file, plain or packed by gzip, after its headers have been checked.

    All errors of astropy become BadInput, because its readers raise many types of exceptions for damaged files.
    """
    with user_files.open_file(path, kind) as stream:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", AstropyUserWarning)
                # Titles such as "RA(ICRS)" are common.
                warnings.simplefilter("ignore", fits.verify.VerifyWarning)
                unpacked = _unpack(path, stream)
                _check_headers(path, unpacked)
                # Compressed images appear as tables and are not decompressed, because that code trusts its input.
                with fits.open(unpacked, memmap=unpacked is stream, disable_image_compression=True) as hdus:
                    yield hdus
        except LakeError:
            raise
        except Exception as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise BadInput(f"{user_files.format_path(path)}: cannot be read as FITS: {text[:300]}") from None


def _first_table(path: Path, hdus: fits.HDUList) -> Any:
    for hdu in hdus:
        if isinstance(hdu, fits.BinTableHDU):
            if not hdu.header["NAXIS1"]:
                raise BadInput(f"{path}: the rows of its table are empty")
            return hdu
    raise BadInput(f"{path}: holds no table")


def _unpack(path: Path, stream: IO[bytes]) -> IO[bytes]:
    start = stream.read(6)
    stream.seek(0)
    if start == b"SIMPLE":
        return stream
    if not start.startswith(b"\x1f\x8b"):
        raise BadInput(f"{user_files.format_path(path)}: is not a FITS file")
    with gzip.open(stream) as packed:
        data = packed.read(_MAX_UNPACKED_BYTES + 1)
    if len(data) > _MAX_UNPACKED_BYTES:
        raise BadInput(f"{user_files.format_path(path)}: unpacks to more than {_MAX_UNPACKED_BYTES} bytes")
    return io.BytesIO(data)


def _check_headers(path: Path, stream: IO[bytes]) -> None:
    """Refuse headers without an end and data that exceed the file, which would be mapped beyond its end."""
    name, size, hdu_start = user_files.format_path(path), stream.seek(0, io.SEEK_END), 0
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
    """Return the blocks of a header, b"" at the end of the file."""
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
