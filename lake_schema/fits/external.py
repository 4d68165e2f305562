"""Read FITS files of users and other programs: tables, HEALPix maps, and images of two or three axes.

The files may be damaged or hostile, so their sizes are limited and all errors become BadInput.
"""

from __future__ import annotations

import gzip
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput, LakeError
from lake_schema.fits import headers, write
from lake_schema.texts import spelling

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes half a second.
    from astropy.io import fits

# Default number of rows in a batch.
_ROWS_PER_BATCH = 65_536
# Largest number of bytes of a file that is packed by gzip, after unpacking.
_MAX_UNPACKED_BYTES = 512 << 20
# Largest number of pixels of a HEALPix map (order 12).
_MAX_PIXELS = 12 << 24
# Largest number of pixels of an image or cube.
_MAX_SAMPLES = 64 << 20
# Largest number of bytes per row in a column of texts.
_MAX_TEXT_BYTES = 256


def read_numbers(path: Path, kind: str) -> dict[str, Float]:
    """Return the numeric columns of the first binary table in a FITS file, as float64 arrays by name of the column.

    Columns with texts, arrays or lists are left out. Integers that equal TNULL become NaN. `kind` is the type of file,
    a key of `user_files.MAX_BYTES`, which limits its size.

    Raises
    ------
    BadInput
        If the file is cut short, too large or not FITS, or has no table.
    """
    with _open_hdus(path, kind) as hdus:
        return _number_columns(_first_table(path, hdus))


def column_names(path: Path, kind: str) -> list[str]:
    """Return the names of the columns of the first binary table in a FITS file.

    `kind` is the type of file, a key of `user_files.MAX_BYTES`. Raise BadInput if the file is cut short, too large or
    not FITS, or has no table.
    """
    with _open_hdus(path, kind) as hdus:
        return [str(name) for name in _first_table(path, hdus).columns.names]


def read_batches(
    path: Path,
    columns: Sequence[str],
    text_columns: Sequence[str] = (),
    rows_per_batch: int = _ROWS_PER_BATCH,
    kind: str = "catalogue",
) -> Iterator[tuple[dict[str, Array], dict[str, str]]]:
    """Yield the rows of some columns of the first binary table in a FITS file, in batches.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str
        Names of columns with one number or boolean per row.
    text_columns : sequence of str, optional
        Names of columns with texts or whole numbers; columns that do not exist are left out.
    rows_per_batch : int, optional
        Largest number of rows in a batch.
    kind : str, optional
        Type of file, a key of `user_files.MAX_BYTES`, which limits its size.

    Yields
    ------
    arrays : dict of str to array, shape (n,)
        Values by column. Integers keep their type. If some in a batch equal TNULL (missing values), they become
        NaN, and the column is float64 in this batch. Booleans become int8.
    units : dict of str to str
        Units (TUNIT) by column, for columns of numbers that have one.

    Raises
    ------
    BadInput
        If the file is cut short, too large or not FITS, has no table, or a column of `columns` is missing or has lists
        or texts.
    """
    with _open_hdus(path, kind) as hdus:
        hdu = _first_table(path, hdus)
        columns_by_name = {column.name: column for column in hdu.columns}
        if missing := [name for name in dict.fromkeys(columns) if name not in columns_by_name]:
            has = ", ".join(map(str, columns_by_name))[:300]
            absent = ", ".join(f"{name}{spelling.suggestion(name, columns_by_name)}" for name in missing)
            raise BadInput(f"{path} has no column {absent}; it has {has}")
        for name in columns:
            _refuse_no_numbers(path, hdu, columns_by_name, name)
        column_units = {name: str(columns_by_name[name].unit) for name in columns if columns_by_name[name].unit}
        text_values = {name: _text_column(path, hdu, name) for name in text_columns if name in columns_by_name}
        for first in range(0, len(hdu.data), rows_per_batch):
            batch = slice(first, first + rows_per_batch)
            numbers = {name: _native_numbers(hdu, columns_by_name[name], batch) for name in columns}
            texts = {
                name: _decode_texts(stored[batch], columns_by_name[name].null) for name, stored in text_values.items()
            }
            yield {**numbers, **texts}, column_units


def read_table(path: Path, kind: str) -> Any:
    """Return the first binary table in a FITS file as an astropy QTable with units.

    Raise BadInput if the file is cut short, too large or not FITS, has no table, or a column contains lists. `kind` is
    the type of file, a key of `user_files.MAX_BYTES`.
    """
    # Import here, because the import is slow and this function is seldom called.
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
    # Refuse arrays of variable length (formats P and Q): their offsets may lead outside the file, which astropy does
    # not check.
    if any(letter in str(column.format) for letter in "PQ"):
        raise BadInput(f"{path}: column {column.name} holds lists")


def _text_column(path: Path, hdu: Any, name: str) -> Array:
    """Return a column of texts as stored bytes, or a column of integers as integers.

    The bytes are decoded later in batches, because astropy would decode the texts of all rows at once. Raise BadInput
    for other types, or texts of more than 256 bytes per row.
    """
    stored = hdu.data.view(np.ndarray)[name]
    if stored.dtype.kind in "iu":
        stored = hdu.data[name]
    if stored.dtype.kind not in "iuS" or stored.ndim != 1 or stored.dtype.itemsize > _MAX_TEXT_BYTES:
        raise BadInput(
            f"{path}: column {name} is {stored.dtype}, but must be a text of at most {_MAX_TEXT_BYTES} bytes per row"
        )
    return np.asarray(stored)


def _decode_texts(values: Array, null: int | None) -> Array:
    """Return texts, or whole numbers in which TNULL (`null`) is masked."""
    if values.dtype.kind == "S":
        return np.asarray(np.char.decode(values, "ascii"))
    numbers = values.astype(values.dtype.newbyteorder("="))
    return numbers if null is None else np.ma.masked_equal(numbers, null)


def _native_numbers(hdu: Any, column: Any, batch: slice) -> Array:
    """Return the rows `batch` of a column of numbers, with NaN for missing values (stored integers that are TNULL)."""
    numbers = np.array(hdu.data[column.name][batch])
    missing = _missing_rows(hdu, column, numbers, batch)
    numbers = numbers.astype(np.int8 if numbers.dtype.kind == "b" else numbers.dtype.newbyteorder("="))
    return np.where(missing, np.nan, numbers.astype(np.float64)) if missing.any() else numbers


def _missing_rows(hdu: Any, column: Any, numbers: Array, batch: slice) -> Array:
    """Return True for the rows `batch` of a column whose value is missing (TNULL).

    `numbers` are the values of the column in these rows after scaling.
    """
    if column.null is None:
        return np.zeros(len(numbers), bool)
    # TNULL is a stored value. Only unsigned integers (TZERO without TSCAL) are compared after the shift by TZERO,
    # because astropy writes TNULL in this way.
    stored = numbers if numbers.dtype.kind in "iu" else hdu.data.view(np.ndarray)[column.name][batch]
    return np.asarray(stored == column.null)


def read_map(path: Path, column: str) -> tuple[Float, dict[str, Any]]:
    """Return a column of a HEALPix map, which is stored in the first binary table of a FITS file.

    Parameters
    ----------
    path : Path
        The file.
    column : str
        Name of the column.

    Returns
    -------
    values : float64 array, shape (n,)
        Values of the pixels in the order of the file (RING or NESTED, see the card ORDERING).
    cards : dict
        Header of the table: values by keyword.

    Raises
    ------
    BadInput
        If the file is cut short, too large or not FITS, has no table or no such column, or the column has lists, texts
        or more than 12 * 4^12 pixels.
    """
    with _open_hdus(path, "map of dust") as hdus:
        hdu = _first_table(path, hdus)
        columns_by_name = {item.name: item for item in hdu.columns}
        if column not in columns_by_name:
            raise BadInput(f"{path} has no column {column}; it has {', '.join(map(str, columns_by_name))}"[:500])
        _refuse_lists(path, columns_by_name[column])
        values = hdu.data[column]
        if values.dtype.kind not in "fiu" or not values.size <= _MAX_PIXELS:
            contents = f"{values.size} values of {values.dtype}"
            raise BadInput(f"{path}: column {column} has {contents}, but must have at most {_MAX_PIXELS} numbers")
        return np.asarray(values, np.float64).ravel(), dict(hdu.header.items())


def read_planes(
    path: Path, column: str, kind: str = "PSF", max_samples: int = _MAX_SAMPLES
) -> tuple[Float, dict[str, Any]]:
    """Return the first image or cube of a FITS file, or an array of two or three axes in the first row of a table.

    Parameters
    ----------
    path : Path
        The file.
    column : str
        Name of the column that contains the array, if the file stores it in a table.
    kind : str, optional
        Type of file, a key of `user_files.MAX_BYTES`, which limits its size.
    max_samples : int, optional
        Largest number of pixels of all planes together.

    Returns
    -------
    planes : float64 array, shape (ny, nx) or (n, ny, nx)
        The image, or the n planes of the cube.
    cards : dict
        Header of the unit that contains the array: values by keyword.

    Raises
    ------
    BadInput
        If the file is cut short, too large or not FITS, has no such array or one with too many pixels, or contains
        compressed images only.
    """
    from astropy.io import fits

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


def read_frame(path: Path, extension: int | str | None = None) -> tuple[Array, fits.Header, fits.Header, int]:
    """Return a two-dimensional image of a FITS file, with its headers.

    Parameters
    ----------
    path : Path
        The file, plain or packed by gzip.
    extension : int or str, optional
        Number of the extension, 0 for the primary unit, or its name (EXTNAME). By default the first unit that contains
        an image.

    Returns
    -------
    pixels : array, shape (ny, nx)
        Pixels in the type of the file and the byte order of this machine. Integers become floating-point numbers if
        some are missing (BLANK); these are NaN.
    cards, primary_cards : astropy.io.fits.Header
        Header of the image, and that of the primary unit. The value of a card that violates the standard is its text.
    number : int
        Number of the extension.

    Raises
    ------
    BadInput
        If the file does not exist, is cut short, too large or not FITS, has no such extension, or the extension is
        compressed or not an image with two axes.
    """
    with _open_hdus(path, "calibrated image", is_mapped=False) as hdus:
        number = _frame_number(path, hdus, extension)
        hdu = hdus[number]
        if hdu.header.get("ZIMAGE", False):
            raise BadInput(f"{path}: extension {number} is compressed: unpack the file with funpack")
        if not hdu.is_image or hdu.header["NAXIS"] != 2 or not hdu.size:
            has = f"an image of {hdu.header['NAXIS']} axes" if hdu.is_image else "a table"
            raise BadInput(f"{path}: extension {number} is {has}, but must be an image of 2 axes")
        pixels = np.array(hdu.data)
        blank = hdu.header.get("BLANK")
        if blank is not None and pixels.dtype.kind in "iu":
            missing = pixels == blank * hdu.header.get("BSCALE", 1) + hdu.header.get("BZERO", 0)
            if missing.any():
                pixels = np.where(missing, np.nan, pixels)
        pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
        return pixels, _with_values(hdu.header), _with_values(hdus[0].header), number


def _with_values(header: fits.Header) -> fits.Header:
    """Return a copy of a header in which a card that violates the standard has its text as its value."""
    from astropy.io import fits

    cards = []
    for card in header.copy().cards:
        try:
            card.value  # noqa: B018  (astropy parses the card here, and may fail)
        except fits.VerifyError:
            card = fits.Card(card.keyword, card.image[10:].strip())
        cards.append(card)
    return fits.Header(cards)


def _frame_number(path: Path, hdus: fits.HDUList, extension: int | str | None) -> int:
    """Return the number of an extension with the given number or name, or of the first extension with an image."""
    names = [str(hdu.header.get("EXTNAME", "")).strip() for hdu in hdus]
    if isinstance(extension, str):
        matches = [i for i, name in enumerate(names) if name and name.upper() == extension.strip().upper()]
        if not matches:
            listed = ", ".join(name for name in names if name) or "no names"
            raise BadInput(f"{path}: has no extension {extension!r}; it has {listed}"[:500])
        return matches[0]
    if extension is not None:
        if not 0 <= extension < len(hdus):
            raise BadInput(f"{path}: has no extension {extension}; it has 0 to {len(hdus) - 1}")
        return extension
    for i, hdu in enumerate(hdus):
        if hdu.header.get("ZIMAGE", False) or (hdu.is_image and hdu.header["NAXIS"]):
            return i
    raise BadInput(f"{path}: holds no image")


def copy_with_frames(source: Path, target: Path, frames: Mapping[int, Array], tables: Sequence[Any] = ()) -> None:
    """Write a copy of a FITS file in which the pixels of some images are replaced.

    Parameters
    ----------
    source : Path
        The original file, plain or packed by gzip.
    target : Path
        The file to write, without packing; it is replaced in one rename and may be the original file.
    frames : mapping of int to array, shape (ny, nx)
        New pixels by number of the extension. Their type may differ from that of the original.
    tables : sequence of astropy.io.fits.BinTableHDU, optional
        Tables that are appended as extensions. An extension of the original with the same name is left out.

    Raises
    ------
    BadInput
        If the original cannot be read, or an image has another number of pixels than its replacement.
    OSError
        If the file cannot be written.
    """
    from astropy.io import fits

    failure: OSError | None = None
    with _open_hdus(source, "calibrated image", is_mapped=False) as hdus:
        names = {table.name for table in tables}
        copied = []
        for number, hdu in enumerate(hdus):
            if number in frames and (not hdu.is_image or hdu.shape != frames[number].shape):
                raise BadInput(f"{source}: extension {number} has changed: it must be an image of the same size")
            if number in frames and frames[number].dtype.kind == "f":
                header = hdu.header.copy()
                # Without these cards, astropy does not scale the new pixels.
                for keyword in ("BSCALE", "BZERO", "BLANK"):
                    header.remove(keyword, ignore_missing=True)
                hdu = (fits.PrimaryHDU if number == 0 else fits.ImageHDU)(frames[number], header)
            elif number in frames:
                hdu.data = frames[number]
            if number in frames or hdu.name not in names:
                copied.append(hdu)
        try:
            write.write_atomically(target, fits.HDUList([*copied, *tables]))
        except OSError as error:
            # Raise it after the block, which would report that the original cannot be read.
            failure = error
    if failure is not None:
        raise failure


def _number_columns(hdu: Any) -> dict[str, Float]:
    columns, every_row = {}, slice(None)
    for column in hdu.columns:
        if any(letter in str(column.format) for letter in "PQA"):
            continue
        values = np.asarray(hdu.data[column.name])
        if values.dtype.kind not in "fiu" or values.ndim != 1:
            continue
        numbers = values.astype(np.float64)
        numbers[_missing_rows(hdu, column, values, every_row)] = np.nan
        columns[str(column.name)] = numbers
    return columns


@contextmanager
def _open_hdus(path: Path, kind: str, is_mapped: bool = True) -> Iterator[fits.HDUList]:
    """Open a FITS file, plain or packed by gzip, for the body of a `with` statement, after checking its headers.

    Data of plain files are mapped into memory if `is_mapped` is True. Scaled integers (BZERO) cannot be mapped.

    BadInput is raised in place of every exception in the body that is not a LakeError, because astropy raises many
    types of exceptions for damaged files.
    """
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyUserWarning

    with user_files.open_file(path, kind) as stream:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", AstropyUserWarning)
                # Ignore warnings about names of columns such as "RA(ICRS)", which are against the standard but common.
                warnings.simplefilter("ignore", fits.verify.VerifyWarning)
                unpacked = _unpack(path, stream)
                headers.check(user_files.format_path(path), unpacked)
                # Do not decompress images: astropy's code for it does not check its input. Compressed images then
                # appear as tables.
                with fits.open(
                    unpacked, memmap=is_mapped and unpacked is stream, disable_image_compression=True
                ) as hdus:
                    yield hdus
        except LakeError:
            raise
        except Exception as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise BadInput(f"{user_files.format_path(path)}: cannot be read as FITS: {text[:300]}") from None


def _first_table(path: Path, hdus: fits.HDUList) -> Any:
    from astropy.io import fits

    for hdu in hdus:
        if isinstance(hdu, fits.BinTableHDU):
            if not hdu.header["NAXIS1"]:
                raise BadInput(f"{path}: the rows of its table are empty")
            return hdu
    contents = "only images" if any(hdu.header.get("NAXIS", 0) for hdu in hdus) else "no data"
    raise BadInput(f"{path}: contains {contents}, but a catalogue must be a binary table")


def _unpack(path: Path, stream: IO[bytes]) -> IO[bytes]:
    start = stream.read(2)
    stream.seek(0)
    if start != b"\x1f\x8b":
        return stream
    with gzip.open(stream) as packed:
        data = packed.read(_MAX_UNPACKED_BYTES + 1)
    if len(data) > _MAX_UNPACKED_BYTES:
        raise BadInput(f"{user_files.format_path(path)}: unpacks to more than {_MAX_UNPACKED_BYTES} bytes")
    return io.BytesIO(data)
