"""Read tables of numbers of other programs in bounded batches: Parquet, FITS, CSV and HDF5.

Parquet and HDF5 files are read in a separate process, FITS and CSV files in pieces. The ending of a file determines its
format, or its first bytes if the ending is unknown.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from lake_schema import user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput
from lake_schema.external import files as external_files
from lake_schema.external import hdf5
from lake_schema.fits import external

_BLOCK_BYTES, _HEADER_BYTES = 8 << 20, 1 << 16
# Largest number of characters of a text, and of columns of a CSV file.
_MAX_TEXT_LENGTH, _MAX_COLUMNS = 64, 4096
_CSV, _FITS, _PARQUET, _HDF5 = (".csv",), (".fits", ".fit"), (".parquet", ".parq"), (".hdf5", ".h5")
_ENDINGS = (*_PARQUET, *_FITS, *_CSV, *_HDF5)


@dataclass(frozen=True, slots=True)
class RowBatch:
    """Rows of one file.

    Attributes
    ----------
    file : Path
        The file.
    first_row : int
        Number of the first row in the file, from 1.
    columns : mapping of str to array, shape (n,)
        Values by title: numbers, NaN for missing floats; or texts (type object), "" for missing ones.
    units : mapping of str to str
        Units that the file gives, by title.
    """

    file: Path
    first_row: int
    columns: Mapping[str, Array]
    units: Mapping[str, str]


def find_files(path: Path) -> list[Path]:
    """Return the files for a path: the file itself, or the Parquet files, else the HDF5 files, of a folder.

    Raises
    ------
    BadInput
        If there is no such file, the folder contains no such files, or the ending is unknown.
    """
    if _is_folder(path):
        paths = _files_of_folder(path)
        if not paths:
            raise BadInput(f"{path}: no Parquet or HDF5 file in this folder")
        return paths
    if path.suffix.lower() not in _ENDINGS:
        raise BadInput(f"{user_files.format_path(path)}: the ending is not one of {', '.join(_ENDINGS)}")
    return [check_format(path)]


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def check_format(file: Path, kind: str = "catalogue") -> Path:
    """Return the path of a file if its first bytes fit its format; this quick check precedes reading it.

    `kind` is a key of `user_files.MAX_BYTES`.
    """
    form = _endings_of_format(file, kind)
    with user_files.open_file(file, kind) as stream:
        start = stream.read(_HEADER_BYTES)
    is_valid = start.startswith(b"PAR1") if form == _PARQUET else start.startswith((b"SIMPLE", b"\x1f\x8b"))
    if form == _HDF5:
        is_valid = start.startswith(hdf5.MAGIC)
    if form == _CSV:
        is_valid = b"\0" not in start
        _refuse_wide(file, start)
    if not is_valid:
        raise BadInput(f"{user_files.format_path(file)}: is not a {form[0].removeprefix('.')} file")
    return file


def _refuse_wide(file: Path, start: bytes) -> None:
    """Refuse a CSV file with too many columns; Arrow allocates at least 4 kB for each column, even if unread."""
    header_line = (start.splitlines() or [b""])[0]
    if len(header_line) == _HEADER_BYTES or header_line.count(b",") >= _MAX_COLUMNS:
        raise BadInput(
            f"{user_files.format_path(file)}: has more than {_MAX_COLUMNS} columns, or titles that are too long"
        )


def read_batches(
    file: Path,
    columns: Sequence[str],
    integer_columns: Sequence[str] = (),
    text_columns: Sequence[str] = (),
    kind: str = "catalogue",
) -> Iterator[RowBatch]:
    """Yield the rows of one file in batches.

    Parameters
    ----------
    file : Path
        The file.
    columns : sequence of str
        Columns of numbers.
    integer_columns : sequence of str, optional
        Those of `columns` with integers, in which missing values are refused, because float64 cannot store 64-bit
        integers.
    text_columns : sequence of str, optional
        Further columns with texts, or with integers that become texts; columns that do not exist are left out.
    kind : str, optional
        Kind of file, a key of `user_files.MAX_BYTES`.

    Yields
    ------
    RowBatch
        Rows.

    Raises
    ------
    BadInput, Damaged
        If the file cannot be read. The message names the file, and a faulty column and row.
    """
    first_row = 1
    endings = _endings_of_format(check_format(file, kind), kind)
    if endings == _FITS:
        for arrays, units in external.read_batches(file, columns, text_columns, kind=kind):
            text_values = {
                name: _to_texts(file, first_row, name, pa.array(arrays[name]))
                for name in text_columns
                if name in arrays
            }
            yield RowBatch(file, first_row, {**arrays, **text_values}, units)
            first_row += len(arrays[columns[0]])
        return
    if endings == _HDF5:
        batches = hdf5.read_batches(file, columns)
    elif endings == _PARQUET:
        batches = external_files.read_batches(file, columns, text_columns)
    else:
        batches = _csv_batches(file, columns, integer_columns, text_columns)
    for batch in batches:
        arrays = {name: _to_numbers(file, first_row, name, batch.column(name), integer_columns) for name in columns}
        text_values = {
            name: _to_texts(file, first_row, name, batch.column(name))
            for name in text_columns
            if name in batch.schema.names
        }
        units = {field.name: unit for field in batch.schema if (unit := _unit(field))}
        yield RowBatch(file, first_row, {**arrays, **text_values}, units)
        first_row += batch.num_rows


def csv_column_names(file: Path, kind: str = "catalogue") -> list[str]:
    """Return the titles of a CSV file's columns; raise BadInput if one occurs twice."""
    try:
        with user_files.open_file(check_format(file, kind), kind) as stream, csv.open_csv(stream) as table:
            names = list(table.schema.names)
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is not CSV in UTF-8") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None
    external_files.check_column_names(file, names, names)
    return names


def check_bounds(file: Path, column: str, values: Array, bounds: tuple[float, float]) -> Array:
    """Return the values of a column unchanged if all are within bounds.

    Parameters
    ----------
    file : Path
        The file, for the message.
    column : str
        Name of the column, for the message.
    values : array, shape (n,)
        Values of all rows of the file.
    bounds : tuple of (float, float)
        Smallest and largest value that is allowed.

    Returns
    -------
    array, shape (n,)
        The same values.

    Raises
    ------
    BadInput
        If a value is out of bounds or NaN. The message names the first such row.
    """
    low, high = bounds
    outside = ~((values >= low) & (values <= high))
    if outside.any():
        row = int(outside.argmax())
        message = f"{column} of row {row + 1} is {values[row]:g}, not in [{low:g}, {high:g}]"
        raise BadInput(f"{file}: {message} ({outside.sum()} of {outside.size} rows like it)")
    return values


def _files_of_folder(folder: Path) -> list[Path]:
    """Return the Parquet files, else the HDF5 files, of a folder.

    For a collection of HATS catalogues, only the dataset of the primary catalogue is used. It contains each row once.
    """
    properties = folder / "collection.properties"
    if properties.is_file():
        lines = (line.partition("=") for line in user_files.read_text(properties, "request").splitlines())
        primary = {key.strip(): value.strip() for key, _, value in lines}.get("hats_primary_table_url", "")
        folder = folder / primary
    data_folder = folder / "dataset" if (folder / "dataset").is_dir() else folder
    all_files = sorted(path for path in data_folder.rglob("*") if path.is_file())
    matching = [path for path in all_files if path.suffix.lower() in _PARQUET]
    matching = matching or [path for path in all_files if path.suffix.lower() in _HDF5]
    return [path for path in matching if not path.name.startswith(("_", ".")) and path.stem != "data_thumbnail"]


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode(errors="replace"))


def _endings_of_format(file: Path, kind: str) -> tuple[str, ...]:
    """Return the endings of the format of a file."""
    for endings in (_PARQUET, _FITS, _CSV, _HDF5):
        if file.suffix.lower() in endings:
            return endings
    try:
        with user_files.open_file(file, kind) as stream:
            start = stream.read(6)
            if start.startswith(b"\x1f\x8b"):
                stream.seek(0)
                with gzip.open(stream) as packed:
                    start = packed.read(6)
    except (OSError, EOFError, zlib.error) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None
    return _PARQUET if start.startswith(b"PAR1") else _FITS if start == b"SIMPLE" else _CSV


def _csv_batches(
    file: Path, columns: Sequence[str], integer_columns: Sequence[str], text_columns: Sequence[str]
) -> Iterator[pa.RecordBatch]:
    read_options = csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
    try:
        with csv.open_csv(file, read_options=read_options) as stream:
            names = stream.schema.names
        included = [*columns, *(name for name in text_columns if name in names)]
        external_files.check_column_names(file, names, included)
        types = {name: pa.int64() if name in integer_columns else pa.float64() for name in columns}
        convert_options = csv.ConvertOptions(
            column_types={**types, **dict.fromkeys(text_columns, pa.string())},
            include_columns=included,
            null_values=["", "NaN", "nan", "null", "NULL", "\\N"],
        )
        with csv.open_csv(file, read_options=read_options, convert_options=convert_options) as stream:
            yield from stream
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is not CSV in UTF-8") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None


def _to_numbers(file: Path, first_row: int, name: str, values: pa.Array, integer_columns: Sequence[str]) -> Array:
    where = f"{file}: column {name}"
    if pa.types.is_dictionary(values.type) or pa.types.is_string(values.type):
        raise BadInput(f"{where} holds texts, but must hold numbers")
    if pa.types.is_boolean(values.type):
        values = values.cast(pa.int8())
    if values.null_count and (name in integer_columns or not pa.types.is_floating(values.type)):
        if name in integer_columns:
            raise BadInput(f"{where} is missing in row {first_row + pc.index(values.is_null(), True).as_py()}")
        values = values.cast(pa.float64(), safe=False)
    return np.asarray(values.to_numpy(zero_copy_only=False))


def _to_texts(file: Path, first_row: int, name: str, values: pa.Array) -> Array:
    kind = values.type.value_type if pa.types.is_dictionary(values.type) else values.type
    if not (pa.types.is_integer(kind) or pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise BadInput(f"{file}: column {name} holds {kind}, but must hold texts or whole numbers")
    texts = pc.fill_null(pc.utf8_trim_whitespace(values.cast(pa.string())), "")
    long = pc.greater(pc.utf8_length(texts), _MAX_TEXT_LENGTH)
    if (row := pc.index(long, True).as_py()) >= 0:
        raise BadInput(f"{file}: column {name} of row {first_row + row} is longer than {_MAX_TEXT_LENGTH} characters")
    return np.asarray(texts.to_numpy(zero_copy_only=False))
