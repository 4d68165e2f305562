"""Write rows of tables as FITS binary tables, with the units and UCDs that the tables declare."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from astropy import units
from astropy.io import fits

from lake_schema.arrays import Array
from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput
from lake_schema.fits import write

# Largest number of characters of a column's name, which must fit into one header card.
_MAX_NAME_LENGTH = 68
_TABLE_FORMATS = {
    "int64": "K",
    "int32": "J",
    "int16": "I",
    "int8": "I",
    "float64": "D",
    "float32": "E",
    "bool": "L",
}


def table_to_fits(path: Path, table: pa.Table, declared: Table) -> None:
    """Write rows of a declared table to a file with a FITS binary table; lists become arrays of variable length.

    Parameters
    ----------
    path : Path
        The file, which is replaced in one rename.
    table : pyarrow.Table
        Rows with all or some of the declared columns. A null becomes NaN for floats, an unused integer (TNULL) for
        integers, the byte 0 for booleans, "" for texts, and an empty array for lists.
    declared : Table
        Declaration of the table, with units and UCDs.

    Raises
    ------
    BadInput
        If a column is not declared, or has a name that FITS cannot store: it must be ASCII with 1 to 68 characters.
    ValueError, TypeError
        If a column has values that FITS cannot store: texts that are not ASCII, nulls in a column in which every
        integer of its type occurs, or nulls in a list of integers.
    """
    columns = [declared.column(name) for name in table.column_names]
    for column in columns:
        _check_column_name(column.name, f"{path}: ")
    hdu = fits.BinTableHDU.from_columns(
        [_fits_column(c, table.column(c.name)) for c in columns], name=declared.name.upper()
    )
    stored = hdu.data.view(np.ndarray)
    for column in columns:
        if column.type == "bool":
            stored[column.name][table.column(column.name).is_null().to_numpy()] = 0
            # Discard astropy's converted copy of the column. astropy 7.2 would write it, and nulls are False in it.
            hdu.data._converted.pop(column.name, None)
    for number, column in enumerate(columns, start=1):
        if column.ucd:
            hdu.header[f"TUCD{number}"] = (column.ucd, "IVOA UCD")
    hdu.header["TABLEVER"] = (declared.version, "version of the table's declaration")
    write.write_atomically(path, fits.HDUList([fits.PrimaryHDU(), hdu]))


def described_table(
    name: str, columns: Sequence[tuple[str, Array, str, str]], cards: Sequence[tuple[str, Any, str]]
) -> fits.BinTableHDU:
    """Return columns in memory as a FITS binary table.

    Parameters
    ----------
    name : str
        Name of the extension.
    columns : sequence of (str, array of shape (n,), str, str)
        Name, values (integers, floating-point numbers, booleans or texts), unit ("" for none) and meaning of each
        column.
    cards : sequence of (str, object, str)
        Keyword, value and comment of further header cards.

    Returns
    -------
    astropy.io.fits.BinTableHDU
        The table.
    """
    fits_columns = []
    for title, values, unit, _ in columns:
        texts = values.astype(str).astype("S") if values.dtype.kind in "OU" else values
        width = max(texts.dtype.itemsize, 1)
        form = {"i": "K", "b": "L", "f": "D"}.get(texts.dtype.kind, f"{width}A")
        fits_columns.append(fits.Column(title, form, unit=unit or None, array=texts))
    table = fits.BinTableHDU.from_columns(fits_columns, name=name)
    for number, (_, _, _, meaning) in enumerate(columns, start=1):
        table.header.comments[f"TTYPE{number}"] = meaning
    for keyword, value, comment in cards:
        table.header[keyword] = (value, comment)
    return table


def write_partial_map(path: Path, pixels: Array, weights: Array, cards: Sequence[tuple[str, Any, str]]) -> None:
    """Write a map of a part of the sky as FITS table with the columns PIXEL (int64) and WEIGHT (float32).

    Parameters
    ----------
    path : Path
        File to write. An existing file is replaced when the new one is complete.
    pixels : int array, shape (n,)
        Numbers of the HEALPix pixels.
    weights : array, shape (n,)
        Values of the pixels.
    cards : sequence of (str, object, str)
        Keyword, value and comment of header cards of the table.
    """
    columns = fits.Column("PIXEL", "K", array=pixels), fits.Column("WEIGHT", "E", array=np.asarray(weights, np.float32))
    table = fits.BinTableHDU.from_columns(columns)
    for keyword, value, comment in cards:
        table.header[keyword] = (value, comment)
    write.write_atomically(path, fits.HDUList([fits.PrimaryHDU(), table]))


def _check_column_name(name: str, where: str = "") -> None:
    if not (name.isascii() and name.isprintable() and 0 < len(name) <= _MAX_NAME_LENGTH):
        raise BadInput(f"{where}column {name!r} has a name that FITS cannot hold; give it another with AS")


def _fits_column(column: Column, values: pa.ChunkedArray) -> fits.Column:
    unit_option = {"unit": fits_unit(column.unit)} if column.unit else {}
    if column.type.startswith("list"):
        return _fits_lists(column, values, unit_option)
    if column.type == "string":
        texts = [value or "" for value in values.to_pylist()]
        width = max([1, *(len(text.encode()) for text in texts)])
        return fits.Column(column.name, f"{width}A", array=np.array(texts, dtype=f"U{width}"), **unit_option)
    code = _TABLE_FORMATS[column.type]
    if values.null_count == 0 or code in "DEL":
        filled = values.fill_null(False if code == "L" else float("nan")) if values.null_count else values
        return fits.Column(column.name, code, array=filled.to_numpy(), **unit_option)
    # Write int8 columns as 16-bit integers, because FITS has no signed bytes.
    widened = values.cast(pa.int16()) if column.type == "int8" else values
    null_value = _lowest_unused_value(widened.drop_null().to_numpy())
    return fits.Column(
        column.name, code, array=widened.fill_null(null_value).to_numpy(), null=null_value, **unit_option
    )


def _lowest_unused_value(values: Array) -> int:
    """Return the lowest integer of the array's type that is not in the array; raise ValueError if all are."""
    limits, unique_values = np.iinfo(values.dtype), np.unique(values)
    gaps = np.flatnonzero(unique_values != limits.min + np.arange(unique_values.size))
    lowest = int(limits.min) + int(gaps[0] if gaps.size else unique_values.size)
    if lowest > limits.max:
        raise ValueError(f"every number of {values.dtype} occurs, so none is left to represent null")
    return lowest


def _fits_lists(column: Column, values: pa.ChunkedArray, unit_option: dict[str, str]) -> fits.Column:
    code = _TABLE_FORMATS[column.type.removeprefix("list<").removesuffix(">")]
    arrays = np.empty(len(values), object)
    for i, value in enumerate(values.to_pylist()):
        arrays[i] = np.array(value or [], fits.column.FITS2NUMPY[code])
    return fits.Column(column.name, f"P{code}()", array=arrays, **unit_option)


def fits_unit(text: str) -> str:
    """Return an astropy unit string in the spelling of the FITS standard.

    Units that FITS does not have, such as the electron, and strings that are not units are returned unchanged.
    """
    try:
        units.Unit(text, format="fits")
    except ValueError:
        with contextlib.suppress(ValueError):
            return str(units.Unit(text).to_string("fits"))
    return text


# ------------------------------------- writing a table that may be larger than the memory

# Number of bytes of rows that are formatted at a time.
_CHUNK_BYTES = 8 << 20
# Number of bytes of a block of a FITS file; headers and data end at a multiple of it.
_BLOCK = 2880
# Number of lowest values of a column's integer type among which one that does not occur is searched, to represent null.
_SEARCHED_VALUES = 1 << 16


@dataclass(slots=True)
class _ColumnScan:
    """Properties of all values of a column, which determine its format in the header of a FITS table.

    Attributes
    ----------
    column : Column
        Declaration of the column.
    max_width : int
        Largest number of bytes of a text, or largest length of a list, in the column.
    has_missing : bool
        True if a value is null.
    is_used : bool array, shape (_SEARCHED_VALUES,)
        For an integer column: element i is True if the lowest value of the type plus i occurs.
    """

    column: Column
    max_width: int = 0
    has_missing: bool = False
    is_used: Array = field(default_factory=lambda: np.zeros(_SEARCHED_VALUES, bool))

    @property
    def is_list(self) -> bool:
        return self.column.type.startswith("list")

    @property
    def dtype(self) -> np.dtype[Any]:
        """NumPy type of the column in a row of the file. For a list, it is the length and the offset of the values."""
        if self.is_list:
            return np.dtype((">i8", (2,)))
        if self.column.type == "string":
            return np.dtype(f"S{max(self.max_width, 1)}")
        return np.dtype("u1") if self.column.type == "bool" else np.dtype(_fits_byte_type(self.column.type))

    @property
    def fits_format(self) -> str:
        if self.is_list:
            return f"Q{_TABLE_FORMATS[_element_type(self.column.type)]}({self.max_width})"
        return f"{max(self.max_width, 1)}A" if self.column.type == "string" else _TABLE_FORMATS[self.column.type]

    @property
    def null_value(self) -> int | None:
        """Integer that represents null, or None if no value is null or the column is not one of integers.

        BadInput is raised if all of the lowest 65,536 values of the type occur.
        """
        if not (self.has_missing and self.dtype.kind == "i" and not self.is_list):
            return None
        if self.is_used.all():
            raise BadInput(f"column {self.column.name}: no integer is left to stand for null; cast it to DOUBLE")
        return int(np.iinfo(self.dtype).min) + int(np.argmin(self.is_used))

    def scan(self, values: pa.Array) -> None:
        """Update the properties of the column with the values of one more batch of rows."""
        self.has_missing |= values.null_count > 0
        if self.is_list or self.column.type == "string":
            lengths = pc.list_value_length(values) if self.is_list else pc.binary_length(values)
            self.max_width = max(self.max_width, pc.max(lengths).as_py() or 0)
        elif self.dtype.kind == "i":
            present_values = values.drop_null().to_numpy()
            # Select the low values before subtracting the minimum: for large values, the difference would overflow.
            low_values = present_values[present_values < np.iinfo(self.dtype).min + _SEARCHED_VALUES].astype(np.int64)
            self.is_used[low_values - np.iinfo(self.dtype).min] = True


def stream_to_fits(
    file: IO[bytes], batches: Callable[[], Iterable[pa.RecordBatch]], declared: Table, max_bytes: int | None = None
) -> None:
    """Write rows, which may be larger than the memory, as a FITS binary table without checksums.

    Nulls and lists are written as by `table_to_fits`, but the lengths and offsets of lists have 64 bits.

    Parameters
    ----------
    file : binary file
        File that is open for writing and supports seek.
    batches : callable
        Function without arguments that returns an iterable of all rows, as batches with all declared columns. It is
        called twice and must return the same rows.
    declared : Table
        Declaration of the table, with units and UCDs.
    max_bytes : int, optional
        Largest number of bytes of the rows, without the values of lists; by default any number is allowed.

    Raises
    ------
    BadInput
        If FITS cannot store the name or a value of a column, or the rows exceed `max_bytes`.
    """
    scans, rows = [_ColumnScan(column) for column in declared.columns], 0
    for column in declared.columns:
        _check_column_name(column.name)
    for batch in batches():
        rows += batch.num_rows
        for scan, values in zip(scans, batch.columns, strict=True):
            scan.scan(values)
    record_type = np.dtype([(f"f{number}", scan.dtype) for number, scan in enumerate(scans)])
    if max_bytes is not None and rows * record_type.itemsize > max_bytes:
        raise BadInput(
            f"a FITS file of the result has more than {max_bytes / 1e9:.3g} GB: ask for less, or another format"
        )
    with tempfile.TemporaryFile() as lists:
        # Write a provisional header. At the end it is written again with the total size of the values of lists, which
        # is known only after all rows have been written.
        start = file.tell()
        file.write(_header(declared, scans, record_type.itemsize, rows, 0))
        for batch in batches():
            rows_per_chunk = max(_CHUNK_BYTES // max(record_type.itemsize, 1), 1)
            for first in range(0, batch.num_rows, rows_per_chunk):
                file.write(_records(batch.slice(first, rows_per_chunk), scans, record_type, lists))
        list_bytes = lists.tell()
        lists.seek(0)
        shutil.copyfileobj(lists, file, _CHUNK_BYTES)
        file.write(bytes(-(rows * record_type.itemsize + list_bytes) % _BLOCK))
        file.seek(start)
        file.write(_header(declared, scans, record_type.itemsize, rows, list_bytes))


def _header(declared: Table, scans: list[_ColumnScan], width: int, rows: int, list_bytes: int) -> bytes:
    """Return the bytes of an empty primary unit and of the header of a table.

    `width` is the number of bytes of a row, `list_bytes` the number of bytes of the values of lists after the rows. The
    length of the result does not depend on `rows` and `list_bytes`.
    """
    columns = []
    for scan in scans:
        unit_option = {"unit": fits_unit(scan.column.unit)} if scan.column.unit else {}
        columns.append(fits.Column(scan.column.name, scan.fits_format, null=scan.null_value, **unit_option))
    header = fits.BinTableHDU.from_columns(columns, name=declared.name.upper()).header
    header["NAXIS1"], header["NAXIS2"], header["PCOUNT"] = width, rows, list_bytes
    for number, scan in enumerate(scans, start=1):
        header[f"TFORM{number}"] = scan.fits_format
        if scan.column.ucd:
            header[f"TUCD{number}"] = (scan.column.ucd, "IVOA UCD")
    header["TABLEVER"] = (declared.version, "version of the table's declaration")
    text: str = fits.PrimaryHDU().header.tostring() + header.tostring()
    return text.encode("ascii")


def _records(batch: pa.RecordBatch, scans: list[_ColumnScan], record_type: np.dtype[Any], lists: IO[bytes]) -> bytes:
    """Return the bytes of a batch of rows in a FITS table, and append the values of its lists to the file `lists`.

    Raise BadInput for a text that is not ASCII, or a null in a list of integers.
    """
    out = np.zeros(batch.num_rows, record_type)
    _write_lists(out, [(f"f{k}", scan, batch.column(k)) for k, scan in enumerate(scans) if scan.is_list], lists)
    for name, scan, values in zip(record_type.names or (), scans, batch.columns, strict=True):
        if scan.is_list:
            continue
        if scan.column.type == "string":
            try:
                out[name] = [(value or "").encode("ascii") for value in values.to_pylist()]
            except UnicodeEncodeError as error:
                letter = error.object[error.start]
                raise BadInput(f"column {scan.column.name}: FITS cannot hold the character {letter!r}") from None
        elif scan.column.type == "bool":
            flags = pc.if_else(values, ord("T"), ord("F")).cast(pa.uint8())
            out[name] = flags.fill_null(0).to_numpy(zero_copy_only=False)
        else:
            null_value = scan.null_value if scan.dtype.kind == "i" else float("nan")
            filled = values if null_value is None else values.cast(_fits_arrow_type(values.type)).fill_null(null_value)
            out[name] = filled.to_numpy(zero_copy_only=False)
    return out.tobytes()


def _write_lists(out: Array, columns: list[tuple[str, _ColumnScan, pa.Array]], lists: IO[bytes]) -> None:
    """Append the values of lists to the file `lists`, and write their lengths and offsets into the records `out`.

    The values are written row by row, so that the file does not depend on the division of the rows into batches.
    """
    element_types = [np.dtype(_fits_byte_type(_element_type(scan.column.type))) for _, scan, _ in columns]
    for k, row in enumerate(zip(*(values.to_pylist() for *_, values in columns), strict=True)):
        for (name, scan, _), element_type, value in zip(columns, element_types, row, strict=True):
            if value:
                out[name][k] = len(value), lists.tell()
                try:
                    lists.write(np.array(value, element_type).tobytes())
                except (TypeError, ValueError):
                    raise BadInput(f"column {scan.column.name}: FITS has no missing value in a list") from None


def _element_type(list_type: str) -> str:
    return list_type.removeprefix("list<").removesuffix(">")


def _fits_byte_type(kind: str) -> str:
    """Return the big-endian NumPy type with which a FITS file stores a declared type, such as ">f4" for "float32".

    int8 is stored as a 16-bit integer, because FITS has no signed bytes.
    """
    return ">i2" if kind == "int8" else np.dtype(kind).newbyteorder(">").str


def _fits_arrow_type(kind: pa.DataType) -> pa.DataType:
    return pa.int16() if kind == pa.int8() else kind
