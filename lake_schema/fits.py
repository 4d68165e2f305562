"""FITS files: the one module that touches astropy.io.fits.

Image           an image with its header cards
write_images    images -> one file: checksums, the same bytes for the same input; whole numbers packed where wanted
read_images     a file -> images; checksums are demanded and verified, sizes checked before data
read_numbers    somebody's binary table -> its columns of numbers
number_batches  the same, some columns and a bounded piece at a time
read_table      the same as an astropy table
read_map        somebody's HEALPix map -> its pixels and header
read_planes     somebody's image of two or three axes -> its samples and header
table_to_fits   an Arrow table -> a binary table, units and UCDs from the table's declaration
fits_unit       a unit as FITS spells it
"""

from __future__ import annotations

import contextlib
import gzip
import io
import math
import os
import re
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from astropy import units
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from lake_schema import user_files
from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput, Damaged, LakeError

Card = tuple[str, str | int | float | bool, str]

# What fits into the card of a column's name.
_LONGEST_NAME = 68
# A header that promises more than this is a mistake or an attack; the largest product is far below.
MOST_BYTES = 8 << 30
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
_STRUCTURE = {
    "SIMPLE",
    "XTENSION",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "NAXIS3",
    "EXTEND",
    "PCOUNT",
    "GCOUNT",
}
_STRUCTURE |= {"BZERO", "BSCALE", "EXTNAME", "CHECKSUM", "DATASUM"}
_TABLE_FORMATS = {
    "int64": "K",
    "int32": "J",
    "int16": "I",
    "int8": "I",
    "float64": "D",
    "float32": "E",
    "bool": "L",
}


@dataclass(frozen=True, slots=True)
class Image:
    """One header-data unit.

    data  : [ny, nx] uint8, int16, uint16, int32, float32 or float64; None = a header alone
    cards : (keyword, value, comment), in order, structural keywords left out
    """

    data: npt.NDArray[Any] | None
    cards: tuple[Card, ...] = ()
    name: str = ""


def write_images(path: Path, images: Sequence[Image], rice: bool = False) -> None:
    """Write a file of images, the first as the primary one; replaces `path` in one rename.

    rice : whole numbers are packed, row by row, without loss (FITS standard 4.0, section 10: RICE_1). A packed image
           is an extension: before a first one that has pixels there is then a primary unit without any
    """
    if not images:
        raise BadInput(f"{path}: a FITS file wants at least one image")
    make = [_packed if rice and _is_whole(image) else _extension for image in images]
    if make[0] is _packed:
        first, rest = [fits.PrimaryHDU()], zip(make, images, strict=True)
    else:
        first, rest = [_primary(images[0])], zip(make[1:], images[1:], strict=True)
    _write(path, fits.HDUList([*first, *(function(image) for function, image in rest)]))


def read_images(path: Path, most_bytes: int = MOST_BYTES) -> list[Image]:
    """Read every image of a file that `write_images` wrote.

    What is checked is what the file says of itself, CHECKSUM and DATASUM of each unit: any one changed byte is found,
    bytes that changed places may not be. Of a file of a lake, Version.file compares the sha256.

    most_bytes : refuse a file whose headers promise more data
    Errors     : Damaged for a bad or missing checksum and for a file that is cut short; BadInput for one too
                 large
    """
    with _refusing(path):
        # Of the arithmetic of astropy's unpacking.
        warnings.simplefilter("error", RuntimeWarning)
        with fits.open(path, memmap=False, lazy_load_hdus=True, disable_image_compression=True) as units:
            _check_size(path, units, most_bytes)
        with fits.open(path, memmap=False, checksum=True, disable_image_compression=True) as units:
            missing = [unit.name or "primary" for unit in units if "CHECKSUM" not in unit.header]
            if missing:
                raise Damaged(f"{path}: no checksum in {', '.join(missing)}")
            if not any(_is_packed(unit) for unit in units):
                return [_image(unit) for unit in units]
            hollow = _is_packed(units[1]) and _is_hollow(units[0])
        with fits.open(path, memmap=False) as units:
            return [_image(unit) for unit in units[hollow:]]


def read_numbers(path: Path, kind: str) -> dict[str, npt.NDArray[np.float64]]:
    """Columns of numbers of a file's first table, title -> float64[n]; NaN where TNULL says that there is none.

    kind   : of file, as user_files has it
    Errors : BadInput for a file that is cut short or is none, and where there is no table
    """
    with _foreign(path, kind) as units:
        return _numbers_of(_first_table(path, units))


def number_batches(
    path: Path, columns: Sequence[str], texts: Sequence[str] = (), rows: int = _ROWS_A_BATCH, kind: str = "catalogue"
) -> Iterator[tuple[dict[str, npt.NDArray[Any]], dict[str, str]]]:
    """Columns of numbers of a file's first table: (title -> numbers[n], whole numbers as they are; title -> TUNIT).

    texts  : more columns, of texts or whole numbers; left out where there are none
    Errors : BadInput for a file that is cut short or is none, and names a column that is missing or no number
    """
    with _foreign(path, kind) as units:
        unit = _first_table(path, units)
        known = {column.name: column for column in unit.columns}
        for name in columns:
            _refuse_no_numbers(path, unit, known, name)
        said = {name: str(known[name].unit) for name in columns if known[name].unit}
        named = {name: _texts_of(path, unit, name) for name in texts if name in known}
        for first in range(0, len(unit.data), rows):
            part = slice(first, first + rows)
            numbers = {name: _native(unit.data[name][part], known[name].null) for name in columns}
            yield {**numbers, **{name: _decoded(stored[part]) for name, stored in named.items()}}, said


def read_table(path: Path, kind: str) -> Any:
    """Somebody's first table as an astropy QTable, units and all; errors as of read_numbers."""
    # Slow to import, and seldom needed.
    from astropy.table import QTable

    with _foreign(path, kind) as units:
        unit = _first_table(path, units)
        for column in unit.columns:
            _refuse_lists(path, column)
        return QTable.read(unit)


def _refuse_no_numbers(path: Path, unit: Any, known: Mapping[str, Any], name: str) -> None:
    if name not in known:
        raise BadInput(f"{path}: has no column {name}; it has {', '.join(map(str, known))}"[:500])
    _refuse_lists(path, known[name])
    if unit.data[name].dtype.kind not in "fiub" or unit.data[name].ndim != 1:
        raise BadInput(f"{path}: column {name} is {unit.data[name].dtype}, wanted a number a row")


def _refuse_lists(path: Path, column: Any) -> None:
    # Of variable length: each row says where its values are, and what it says is only known when it is read.
    if any(letter in str(column.format) for letter in "PQ"):
        raise BadInput(f"{path}: column {column.name} holds lists")


def _texts_of(path: Path, unit: Any, name: str) -> npt.NDArray[Any]:
    """A column of texts as it is stored, bytes, or of whole numbers; astropy would decode all rows at once."""
    stored = unit.data.view(np.ndarray)[name]
    if stored.dtype.kind in "iu":
        stored = unit.data[name]
    if stored.dtype.kind not in "iuS" or stored.ndim != 1 or stored.dtype.itemsize > _LONGEST_TEXT:
        raise BadInput(f"{path}: column {name} is {stored.dtype}, wanted a text of at most {_LONGEST_TEXT} bytes a row")
    return np.asarray(stored)


def _decoded(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if values.dtype.kind == "S":
        return np.asarray(np.char.decode(values, "ascii"))
    return values.astype(values.dtype.newbyteorder("="))


def _native(values: Any, null: int | None) -> npt.NDArray[Any]:
    numbers = np.array(values)
    numbers = numbers.astype(np.int8 if numbers.dtype.kind == "b" else numbers.dtype.newbyteorder("="))
    if numbers.dtype.kind in "iu" and null is not None and (numbers == null).any():
        return np.where(numbers == null, np.nan, numbers.astype(np.float64))
    return numbers


def read_map(path: Path, column: str) -> tuple[npt.NDArray[np.float64], dict[str, Any]]:
    """A column of a HEALPix map, float64[pixels] in its file's order, and the cards of its header.

    Errors : BadInput for a file that is cut short or is none, and where there is no table or column
    """
    with _foreign(path, "map of dust") as units:
        unit = _first_table(path, units)
        known = {found.name: found for found in unit.columns}
        if column not in known:
            raise BadInput(f"{path}: has no column {column}; it has {', '.join(map(str, known))}"[:500])
        _refuse_lists(path, known[column])
        values = unit.data[column]
        if values.dtype.kind not in "fiu" or not values.size <= _MOST_PIXELS:
            raise BadInput(f"{path}: column {column} is {values.size} of {values.dtype}, wanted numbers of a map")
        return np.asarray(values, np.float64).ravel(), dict(unit.header.items())


def read_planes(path: Path, column: str, kind: str = "PSF") -> tuple[npt.NDArray[np.float64], dict[str, Any]]:
    """Somebody's planes, float64[ny, nx] or [n, ny, nx], with the cards of their header.

    The first image of two or three axes, or the array that the first row of a table has in `column`.

    Errors : BadInput for a file that is cut short or is none, and where it holds neither, or packed images
    """
    with _foreign(path, kind) as units:
        for unit in units:
            found = None
            if isinstance(unit, fits.BinTableHDU):
                if column in unit.columns.names and len(unit.data):
                    _refuse_lists(path, unit.columns[column])
                    found = unit.data[column][0]
            elif unit.is_image and unit.header["NAXIS"] in (2, 3):
                found = unit.data
            if found is not None and np.ndim(found) in (2, 3) and found.size and found.dtype.kind in "fiu":
                if found.size > _MOST_SAMPLES:
                    raise BadInput(f"{path}: holds {found.size} samples, a {kind} has at most {_MOST_SAMPLES}")
                return np.array(found, np.float64), dict(unit.header.items())
    raise BadInput(f"{path}: holds no image of two or three axes and no table with a column {column}")


def _numbers_of(unit: Any) -> dict[str, npt.NDArray[np.float64]]:
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


def table_to_fits(path: Path, table: pa.Table, declared: Table) -> None:
    """Export rows of a declared table as a binary table extension; lists become arrays of variable length.

    table  : Arrow table with (some of) the declared columns; null becomes NaN, TNULL for integers, the byte 0 for
             booleans, "" for texts, an empty array for lists
    Errors : BadInput names a column whose name FITS cannot hold; ValueError or TypeError for such values
    """
    columns = [declared.column(name) for name in table.column_names]
    for column in columns:
        if not (column.name.isascii() and column.name.isprintable() and 0 < len(column.name) <= _LONGEST_NAME):
            raise BadInput(f"{path}: column {column.name!r} has a name that FITS cannot hold; give it another with AS")
    unit = fits.BinTableHDU.from_columns(
        [_fits_column(c, table.column(c.name)) for c in columns], name=declared.name.upper()
    )
    stored = unit.data.view(np.ndarray)
    for column in columns:
        if column.type == "bool":
            stored[column.name][table.column(column.name).is_null().to_numpy()] = 0
    for number, column in enumerate(columns, start=1):
        if column.ucd:
            unit.header[f"TUCD{number}"] = (column.ucd, "IVOA UCD")
    unit.header["TABLEVER"] = (declared.version, "version of the table's declaration")
    _write(path, fits.HDUList([fits.PrimaryHDU(), unit]))


# ------------------------------------------------------------------------------------------------ writing


def _primary(image: Image) -> fits.PrimaryHDU:
    unit = fits.PrimaryHDU(data=None if image.data is None else _big_enough(image.data))
    return _dressed(unit, image)


def _extension(image: Image) -> fits.ImageHDU:
    return _dressed(fits.ImageHDU(data=None if image.data is None else _big_enough(image.data)), image)


def _packed(image: Image) -> fits.BinTableHDU:
    unit = _dressed(fits.CompImageHDU(data=_big_enough(np.asarray(image.data)), compression_type="RICE_1"), image)
    # Taken as the table that it is stored as, whose bytes the checksums are of.
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), unit]).writeto(stream)
    # Left open: its rows are copied from there when it is written.
    return fits.open(io.BytesIO(stream.getvalue()), disable_image_compression=True)[1]


def _is_whole(image: Image) -> bool:
    return image.data is not None and image.data.dtype.kind in "iu" and image.data.size > 0


def _is_packed(unit: Any) -> bool:
    return bool(unit.header.get("ZIMAGE", False))


def _is_hollow(unit: Any) -> bool:
    """Whether a primary unit stands there only because a file must begin with one."""
    return unit.header["NAXIS"] == 0 and all(card.keyword in _STRUCTURE for card in unit.header.cards)


def _dressed(unit: Any, image: Image) -> Any:
    for keyword, value, comment in image.cards:
        if keyword.upper() in _STRUCTURE:
            raise BadInput(f"FITS card {keyword} is set by the writer")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", AstropyUserWarning)
                card = fits.Card(keyword, value, comment)
                # A card is judged when it is formatted; astropy would cut a long comment and go on.
                str(card)
        except (ValueError, AstropyUserWarning) as error:
            raise BadInput(f"FITS card {keyword}: {' '.join(str(error).split())}") from None
        unit.header.append(card, end=True)
    if image.name:
        unit.header["EXTNAME"] = image.name
    return unit


def _big_enough(data: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if data.ndim != 2 or data.dtype.kind not in "fiu" or data.dtype.itemsize > 8:
        raise BadInput(f"a FITS image wants numbers in two dimensions, got {data.dtype}{list(data.shape)}")
    return np.ascontiguousarray(data)


def _write(path: Path, units: fits.HDUList) -> None:
    # The comments that astropy would add hold the time of day.
    for unit in units:
        unit.add_datasum(when="checksum of the data")
        unit.add_checksum(when="checksum of header and data", override_datasum=True)
    handle, temporary = tempfile.mkstemp(suffix=".part", prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            _write_units(stream, units, path)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files private; a product is as readable as anything else that is written here.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _write_units(stream: IO[bytes], units: fits.HDUList, path: Path) -> None:
    try:
        units.writeto(stream, output_verify="exception")
    except AttributeError as error:
        # astropy (to 8.0) trips over its own check of the free space; what it was called for is the context.
        raise OSError(f"{path}: {error.__context__}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _fits_column(column: Column, values: pa.ChunkedArray) -> fits.Column:
    unit = {"unit": fits_unit(column.unit)} if column.unit else {}
    if column.type.startswith("list"):
        return _fits_lists(column, values, unit)
    if column.type == "string":
        texts = [value or "" for value in values.to_pylist()]
        width = max([1, *(len(text.encode()) for text in texts)])
        return fits.Column(column.name, f"{width}A", array=np.array(texts, dtype=f"U{width}"), **unit)
    code = _TABLE_FORMATS[column.type]
    if values.null_count == 0 or code in "DEL":
        filled = values.fill_null(False if code == "L" else float("nan")) if values.null_count else values
        return fits.Column(column.name, code, array=filled.to_numpy(), **unit)
    # FITS has no signed bytes: they are written as 16 bits.
    wide = values.cast(pa.int16()) if column.type == "int8" else values
    missing = _unused(wide.drop_null().to_numpy())
    return fits.Column(column.name, code, array=wide.fill_null(missing).to_numpy(), null=missing, **unit)


def _unused(values: npt.NDArray[Any]) -> int:
    """The lowest number of an integer type that does not occur."""
    limits, seen = np.iinfo(values.dtype), np.unique(values)
    taken = np.flatnonzero(seen != limits.min + np.arange(seen.size))
    lowest = int(limits.min) + int(taken[0] if taken.size else seen.size)
    if lowest > limits.max:
        raise ValueError(f"every number of {values.dtype} occurs: none is left for what is missing")
    return lowest


def _fits_lists(column: Column, values: pa.ChunkedArray, unit: dict[str, str]) -> fits.Column:
    code = _TABLE_FORMATS[column.type.removeprefix("list<").removesuffix(">")]
    arrays = np.empty(len(values), object)
    for i, value in enumerate(values.to_pylist()):
        arrays[i] = np.array(value or [], fits.column.FITS2NUMPY[code])
    return fits.Column(column.name, f"P{code}()", array=arrays, **unit)


def fits_unit(text: str) -> str:
    """A unit as FITS spells it; one that it does not know, such as the electron, as it is."""
    try:
        units.Unit(text, format="fits")
    except ValueError:
        with contextlib.suppress(ValueError):
            return str(units.Unit(text).to_string("fits"))
    return text


# ------------------------------------------------------------------------------------------------ reading


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Whatever astropy trips over in a file of ours is damage of the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyUserWarning)
            yield
    except LakeError:
        raise
    except Exception as error:
        raise Damaged(f"{path}: {' '.join(str(error).split())}") from None


@contextmanager
def _foreign(path: Path, kind: str) -> Iterator[fits.HDUList]:
    """Somebody's file, plain or packed by gzip, its headers looked through before astropy is given it.

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


def _check_size(path: Path, units: fits.HDUList, most_bytes: int) -> None:
    stored, unpacked = 0, 0
    for unit in units:
        here = _promised(path, unit.header, "") + max(int(unit.header.get("PCOUNT", 0)), 0)
        stored += here
        unpacked += _promised(path, unit.header, "Z") if _is_packed(unit) else here
        if max(stored, unpacked) > most_bytes:
            raise BadInput(f"{path}: holds more than {most_bytes} bytes")
    if stored > path.stat().st_size:
        raise Damaged(f"{path}: is cut short, {stored} bytes promised, {path.stat().st_size} there")


def _promised(path: Path, header: Any, prefix: str) -> int:
    """Bytes of a unit's data, or with the prefix Z of what is packed in it."""
    axes = [int(header[f"{prefix}NAXIS{i}"]) for i in range(1, int(header[f"{prefix}NAXIS"]) + 1)]
    if any(axis < 0 for axis in axes):
        raise Damaged(f"{path}: a negative NAXIS")
    pixels = 1
    for axis in axes:
        pixels *= axis
    return (pixels if axes else 0) * abs(int(header[f"{prefix}BITPIX"])) // 8


def _image(unit: Any) -> Image:
    data = None if unit.data is None else np.asarray(unit.data)
    if data is not None:
        data = data.astype(data.dtype.newbyteorder("="), copy=False)
    cards = tuple(
        (card.keyword, card.value, card.comment) for card in unit.header.cards if card.keyword not in _STRUCTURE
    )
    return Image(data, cards, unit.header.get("EXTNAME", ""))
