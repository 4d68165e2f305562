"""Read catalogues of other programs in batches of limited size, from Parquet, FITS, CSV and HDF5 files.

Parquet and HDF5 files are read in a separate process, because a hostile file could crash it. The ending of a file
determines its format, or its first bytes if the ending is unknown.
"""

from __future__ import annotations

import gzip
import os
import re
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
from lake_schema.external import csv_headers, hdf5
from lake_schema.external import files as external_files
from lake_schema.external.mistakes import TableMistakes
from lake_schema.fits import external
from lake_schema.texts import spelling

# Number of bytes of a CSV file that Arrow parses at a time.
_BLOCK_BYTES = 8 << 20
# Number of bytes at the start of a file that are checked; the line of titles of a CSV file must fit into them.
_HEADER_BYTES = 1 << 16
# Largest number of characters of an entry in a column of texts.
_MAX_TEXT_LENGTH = 64
# Entries of a CSV file that stand for a missing value.
_NULL_VALUES = ["", "NaN", "nan", "null", "NULL", "\\N"]
# Patterns of the numbers that Arrow reads from a CSV file.
_INTEGER = r"^-?[0-9]+$"
_NUMBER = r"(?i)^[-+]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?|inf(inity)?|nan)$"
# Start of an angle in hours or degrees, minutes and seconds.
_SEXAGESIMAL = re.compile(r"[-+]?\d+\s*[:hd°\s]\s*\d")
# Largest number of columns of a CSV file.
_MAX_COLUMNS = 4096
# Endings of the files of each format, in lower case.
_CSV, _FITS, _PARQUET, _HDF5 = (".csv",), (".fits", ".fit"), (".parquet", ".parq"), (".hdf5", ".h5")
_ENDINGS = (*_PARQUET, *_FITS, *_CSV, *_HDF5)


@dataclass(frozen=True, slots=True)
class RowBatch:
    """Consecutive rows of one file of another program.

    Attributes
    ----------
    file : Path
        The file.
    first_row : int
        Number of the first row of the batch in the file; the first row of the file is 1.
    columns : mapping of str to array, shape (n,)
        Values by name of the column: numbers, with NaN for missing ones, or texts (type object), with "" for missing
        ones.
    units : mapping of str to str
        Units that the file gives, by name of the column.
    """

    file: Path
    first_row: int
    columns: Mapping[str, Array]
    units: Mapping[str, str]


def find_files(path: Path) -> list[Path]:
    """Return the files of a catalogue: the file at a path, or all Parquet files in a folder, sorted.

    If a folder contains no Parquet files, its HDF5 files are returned, and without these its FITS files. Subfolders are
    searched, too.

    Raises
    ------
    BadInput
        If the file does not exist, its ending is unknown, its contents have another format, or the folder contains no
        such files.
    """
    if _is_folder(path):
        paths = _files_of_folder(path)
        if not paths:
            raise BadInput(f"{path}: no Parquet, HDF5 or FITS file in this folder")
        return paths
    if path.suffix.lower() not in _ENDINGS:
        endings = spelling.join_words(_ENDINGS)
        raise BadInput(f"{user_files.format_path(path)}: the name of the file must end in {endings}")
    return [check_format(path)]


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def check_format(file: Path, kind: str = "catalogue") -> Path:
    """Check that the first bytes of a file fit its format (Parquet, FITS, CSV or HDF5), and return its path.

    The ending of the file determines the format. `kind` is the type of file, a key of `user_files.MAX_BYTES`, which
    limits its size. BadInput is raised if the first bytes are different, or the file does not exist or is too large.
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
    """Raise BadInput if a CSV file has more than 4096 columns, or a line of titles of at least 65,536 bytes.

    Arrow would allocate at least 4 kB for each column, even if it is not read.
    """
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
    """Yield the rows of one Parquet, FITS, CSV or HDF5 file in batches.

    Parameters
    ----------
    file : Path
        The file.
    columns : sequence of str
        Names of columns of numbers, at least one.
    integer_columns : sequence of str, optional
        Those of `columns` that must keep 64-bit integers. Except in FITS files, a missing value in them is an error,
        because a column with missing values becomes float64, which cannot store all integers.
    text_columns : sequence of str, optional
        Further columns with texts, or with integers that become texts. Columns that do not exist are left out. They are
        not read from HDF5 files.
    kind : str, optional
        Type of file, a key of `user_files.MAX_BYTES`, which limits its size.

    Yields
    ------
    RowBatch
        Rows of the file, in its order.

    Raises
    ------
    BadInput
        If the file cannot be read, a column of `columns` is missing or has no numbers, or a text is longer than 64
        characters. The message names the file, and the column and row if it is known.
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
        batches = _csv_batches(file, columns, integer_columns, text_columns, kind)
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


def column_names(file: Path, kind: str = "catalogue") -> list[str]:
    """Return the names of the columns of a Parquet, FITS, CSV or HDF5 file, in its order.

    BadInput is raised if the file cannot be read, or is too large for its type `kind` (a key of
    `user_files.MAX_BYTES`).
    """
    endings = _endings_of_format(check_format(file, kind), kind)
    if endings == _FITS:
        return external.column_names(file, kind)
    if endings == _HDF5:
        return hdf5.column_names(file)
    if endings == _PARQUET:
        return external_files.column_names(file)
    try:
        with user_files.open_file(file, kind) as stream, csv.open_csv(stream) as table:
            names = list(table.schema.names)
        _check_first_line(file, kind)
        return names
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is not CSV in UTF-8") from None
    except pa.ArrowInvalid as error:
        _check_first_line(file, kind)
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None


def _check_first_line(file: Path, kind: str) -> None:
    with user_files.open_file(file, kind) as stream:
        line = stream.readline(_HEADER_BYTES).decode("utf-8-sig", errors="replace")
    csv_headers.check_header(file, line.rstrip("\r\n").split(","))


def _files_of_folder(folder: Path) -> list[Path]:
    """Return the Parquet files in a folder and its subfolders, or else its HDF5 files, or else its FITS files, sorted.

    A HATS collection also contains copies of rows near the edges of its cells (margin catalogue), so only the files of
    its primary catalogue are returned.
    """
    properties = folder / "collection.properties"
    if properties.is_file():
        lines = (line.partition("=") for line in user_files.read_text(properties, "request").splitlines())
        primary = {key.strip(): value.strip() for key, _, value in lines}.get("hats_primary_table_url", "")
        # All files of a disc might be read through an absolute path or "..". A name may also be too long for a file.
        if Path(primary).is_absolute() or ".." in Path(primary).parts or not os.path.isdir(folder / primary):
            raise BadInput(f"{properties}: hats_primary_table_url = {primary[:80]!r} is not a folder of the collection")
        folder = folder / primary
    data_folder = folder / "dataset" if (folder / "dataset").is_dir() else folder
    all_files = sorted(path for path in data_folder.rglob("*") if path.is_file())
    by_format = ([path for path in all_files if path.suffix.lower() in form] for form in (_PARQUET, _HDF5, _FITS))
    matching = next(filter(None, by_format), [])
    return [path for path in matching if not path.name.startswith(("_", ".")) and path.stem != "data_thumbnail"]


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode(errors="replace"))


def _endings_of_format(file: Path, kind: str) -> tuple[str, ...]:
    """Return the tuple of endings that stands for the format of a file, such as `_FITS` for a FITS file.

    If the file has another ending, its first bytes decide; a file that is neither Parquet nor FITS counts as CSV.
    """
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
    file: Path, columns: Sequence[str], integer_columns: Sequence[str], text_columns: Sequence[str], kind: str
) -> Iterator[pa.RecordBatch]:
    read_options = csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
    try:
        with csv.open_csv(file, read_options=read_options) as stream:
            names = stream.schema.names
        if not set(columns) <= set(names):
            _check_first_line(file, kind)
        included = [*columns, *(name for name in text_columns if name in names)]
        external_files.check_column_names(file, names, included)
        types = {name: pa.int64() if name in integer_columns else pa.float64() for name in columns}
        convert_options = csv.ConvertOptions(
            column_types={**types, **dict.fromkeys(text_columns, pa.string())},
            include_columns=included,
            null_values=_NULL_VALUES,
        )
        with csv.open_csv(file, read_options=read_options, convert_options=convert_options) as stream:
            yield from stream
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is not CSV in UTF-8") from None
    except pa.ArrowInvalid as error:
        _check_first_line(file, kind)
        _find_texts(file, columns, integer_columns).refuse()
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None


def _find_texts(file: Path, columns: Sequence[str], integer_columns: Sequence[str]) -> TableMistakes:
    """Find the entries in columns of numbers of a CSV file that are not numbers."""
    mistakes, first_row = TableMistakes(), 1
    convert_options = csv.ConvertOptions(
        column_types=dict.fromkeys(columns, pa.string()),
        include_columns=list(columns),
        null_values=_NULL_VALUES,
        strings_can_be_null=True,
    )
    read_options = csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
    try:
        with csv.open_csv(file, read_options=read_options, convert_options=convert_options) as stream:
            for batch in stream:
                for name in columns:
                    is_integer = name in integer_columns
                    texts = pc.fill_null(pc.utf8_trim_whitespace(batch.column(name)), "0")
                    wrong = pc.invert(pc.match_substring_regex(texts, _INTEGER if is_integer else _NUMBER))
                    if (row := pc.index(wrong, True).as_py()) >= 0:
                        text = texts[row].as_py()[:40]
                        problem = f"is {text!r}"
                        unit = " in degrees" if _SEXAGESIMAL.match(text) else ""
                        allowed = f"must be {'an integer' if is_integer else f'a number{unit}'}"
                        mistakes.add_rows(file, first_row, name, wrong.to_numpy(zero_copy_only=False), problem, allowed)
                first_row += batch.num_rows
    except (pa.ArrowException, UnicodeDecodeError):
        # The file cannot be read as texts either, for example because a line has another number of fields.
        return TableMistakes()
    return mistakes


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
