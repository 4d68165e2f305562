"""Tables of numbers from other programs, whatever their form: a bounded piece at a time, in the order of the files.

files    a path -> the files that it stands for: itself, or the Parquet or else HDF5 files of a folder
titles   of a CSV file
pieces   the rows of some columns of a Parquet, FITS, CSV or HDF5 file
within   a column whose values have to lie between bounds

Parquet is read by a process of its own (lake_schema.external.files), FITS and CSV in pieces. What a file is, its
ending says,
or where that says nothing its first bytes.
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

_BLOCK_BYTES, _FIRST_LOOK = 8 << 20, 1 << 16
# Of a name, characters; of a CSV file.
_LONGEST_TEXT, _MOST_COLUMNS = 64, 4096
_CSV, _FITS, _PARQUET, _HDF5 = (".csv",), (".fits", ".fit"), (".parquet", ".parq"), (".hdf5", ".h5")
_ENDINGS = (*_PARQUET, *_FITS, *_CSV, *_HDF5)


@dataclass(frozen=True, slots=True)
class Piece:
    """Rows of one file.

    first   : number of the first row in the file, from 1
    columns : title -> numbers[n], NaN where a float is missing; texts[n] (object), "" where one is missing
    units   : title -> what the file itself says of its unit, where it says anything
    """

    file: Path
    first: int
    columns: Mapping[str, Array]
    units: Mapping[str, str]


def files(path: Path) -> list[Path]:
    """Errors: BadInput where there is no such file, or none in the folder, or its ending tells nothing"""
    if _is_folder(path):
        found = _of_folder(path)
        if not found:
            raise BadInput(f"{path}: no Parquet or HDF5 file in this folder")
        return found
    if path.suffix.lower() not in _ENDINGS:
        raise BadInput(f"{user_files.shown(path)}: the ending is none of {', '.join(_ENDINGS)}")
    return [looked_at(path)]


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def looked_at(file: Path, kind: str = "catalogue") -> Path:
    """The path of a file whose first bytes are those of its format: a first look, before all of it is read.

    kind : of file, as user_files has it
    """
    form = _format(file, kind)
    with user_files.opened(file, kind) as stream:
        start = stream.read(_FIRST_LOOK)
    good = start.startswith(b"PAR1") if form == _PARQUET else start.startswith((b"SIMPLE", b"\x1f\x8b"))
    if form == _HDF5:
        good = start.startswith(hdf5.MAGIC)
    if form == _CSV:
        good = b"\0" not in start
        _refuse_wide(file, start)
    if not good:
        raise BadInput(f"{user_files.shown(file)}: is not a {form[0].removeprefix('.')} file")
    return file


def _refuse_wide(file: Path, start: bytes) -> None:
    """Arrow makes room for every column that a file has, 4 kB each and more, whichever are asked for."""
    titles = (start.splitlines() or [b""])[0]
    if len(titles) == _FIRST_LOOK or titles.count(b",") >= _MOST_COLUMNS:
        raise BadInput(f"{user_files.shown(file)}: has more than {_MOST_COLUMNS} columns, or titles of any length")


def pieces(
    file: Path, columns: Sequence[str], whole: Sequence[str] = (), texts: Sequence[str] = (), kind: str = "catalogue"
) -> Iterator[Piece]:
    """The rows of one file.

    kind   : of file, as user_files has it
    whole  : columns of whole numbers, where an empty place is refused: no float holds 64 bits
    texts  : more columns, of texts or of whole numbers as texts, each left out where the file has none
    Errors : BadInput or Damaged, one line: the file, and the column and row where one is wrong
    """
    first = 1
    form = _format(looked_at(file, kind), kind)
    if form == _FITS:
        for arrays, units in external.number_batches(file, columns, texts, kind=kind):
            named = {name: _texts(file, first, name, pa.array(arrays[name])) for name in texts if name in arrays}
            yield Piece(file, first, {**arrays, **named}, units)
            first += len(arrays[columns[0]])
        return
    if form == _HDF5:
        batches = hdf5.batches(file, columns)
    elif form == _PARQUET:
        batches = external_files.batches(file, columns, texts)
    else:
        batches = _csv_batches(file, columns, whole, texts)
    for batch in batches:
        arrays = {name: _numbers(file, first, name, batch.column(name), whole) for name in columns}
        named = {name: _texts(file, first, name, batch.column(name)) for name in texts if name in batch.schema.names}
        units = {field.name: unit for field in batch.schema if (unit := _unit(field))}
        yield Piece(file, first, {**arrays, **named}, units)
        first += batch.num_rows


def titles(file: Path, kind: str = "catalogue") -> list[str]:
    """The titles of a CSV file's columns; BadInput where one stands twice."""
    try:
        with user_files.opened(looked_at(file, kind), kind) as stream, csv.open_csv(stream) as table:
            found = list(table.schema.names)
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is no CSV in UTF-8") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None
    external_files.check_titles(file, found, found)
    return found


def within(file: Path, column: str, values: Array, bounds: tuple[float, float]) -> Array:
    """The values of all rows of a file, as they are; BadInput names the column and the first row out of bounds."""
    low, high = bounds
    bad = ~((values >= low) & (values <= high))
    if bad.any():
        row = int(bad.argmax())
        where = f"{column} of row {row + 1} is {values[row]:g}, not in [{low:g}, {high:g}]"
        raise BadInput(f"{file}: {where} ({bad.sum()} of {bad.size} rows like it)")
    return values


def _of_folder(folder: Path) -> list[Path]:
    """A collection of HATS catalogues names the one with the rows; only its dataset holds rows once each."""
    about = folder / "collection.properties"
    if about.is_file():
        lines = (line.partition("=") for line in user_files.text(about, "request").splitlines())
        primary = {key.strip(): value.strip() for key, _, value in lines}.get("hats_primary_table_url", "")
        folder = folder / primary
    inside = folder / "dataset" if (folder / "dataset").is_dir() else folder
    every = sorted(path for path in inside.rglob("*") if path.is_file())
    found = [path for path in every if path.suffix.lower() in _PARQUET]
    found = found or [path for path in every if path.suffix.lower() in _HDF5]
    return [path for path in found if not path.name.startswith(("_", ".")) and path.stem != "data_thumbnail"]


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode(errors="replace"))


def _format(file: Path, kind: str) -> tuple[str, ...]:
    """Its endings."""
    for endings in (_PARQUET, _FITS, _CSV, _HDF5):
        if file.suffix.lower() in endings:
            return endings
    try:
        with user_files.opened(file, kind) as stream:
            start = stream.read(6)
            if start.startswith(b"\x1f\x8b"):
                stream.seek(0)
                with gzip.open(stream) as packed:
                    start = packed.read(6)
    except (OSError, EOFError, zlib.error) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None
    return _PARQUET if start.startswith(b"PAR1") else _FITS if start == b"SIMPLE" else _CSV


def _csv_batches(
    file: Path, columns: Sequence[str], whole: Sequence[str], texts: Sequence[str]
) -> Iterator[pa.RecordBatch]:
    read = csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
    try:
        with csv.open_csv(file, read_options=read) as stream:
            titles = stream.schema.names
        found = [*columns, *(name for name in texts if name in titles)]
        external_files.check_titles(file, titles, found)
        types = {name: pa.int64() if name in whole else pa.float64() for name in columns}
        convert = csv.ConvertOptions(
            column_types={**types, **dict.fromkeys(texts, pa.string())},
            include_columns=found,
            null_values=["", "NaN", "nan", "null", "NULL", "\\N"],
        )
        with csv.open_csv(file, read_options=read, convert_options=convert) as stream:
            yield from stream
    except UnicodeDecodeError:
        raise BadInput(f"{file}: is no CSV in UTF-8") from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:300]}") from None


def _numbers(file: Path, first: int, name: str, values: pa.Array, whole: Sequence[str]) -> Array:
    where = f"{file}: column {name}"
    if pa.types.is_dictionary(values.type) or pa.types.is_string(values.type):
        raise BadInput(f"{where} holds texts, wanted numbers")
    if pa.types.is_boolean(values.type):
        values = values.cast(pa.int8())
    if values.null_count and (name in whole or not pa.types.is_floating(values.type)):
        if name in whole:
            raise BadInput(f"{where} is missing in row {first + pc.index(values.is_null(), True).as_py()}")
        values = values.cast(pa.float64(), safe=False)
    return np.asarray(values.to_numpy(zero_copy_only=False))


def _texts(file: Path, first: int, name: str, values: pa.Array) -> Array:
    kind = values.type.value_type if pa.types.is_dictionary(values.type) else values.type
    if not (pa.types.is_integer(kind) or pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise BadInput(f"{file}: column {name} holds {kind}, wanted texts or whole numbers")
    texts = pc.fill_null(pc.utf8_trim_whitespace(values.cast(pa.string())), "")
    long = pc.greater(pc.utf8_length(texts), _LONGEST_TEXT)
    if (row := pc.index(long, True).as_py()) >= 0:
        raise BadInput(f"{file}: column {name} of row {first + row} is longer than {_LONGEST_TEXT} characters")
    return np.asarray(texts.to_numpy(zero_copy_only=False))
