"""Tables of numbers from strangers, whatever they are kept in: a bounded piece at a time, in the order of the files.

files    a path -> the files that it stands for: itself, or the Parquet files of a folder such as a HATS catalogue
pieces   the rows of some columns of a Parquet, FITS or CSV file

Parquet is read by a process of its own (lake_schema.foreign), FITS and CSV in pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from lake_schema import fits, foreign
from lake_schema.errors import BadInput

Array = npt.NDArray[Any]

_BLOCK_BYTES = 8 << 20
_CSV, _FITS, _PARQUET = (".csv",), (".fits", ".fit"), (".parquet", ".parq")
_ENDINGS = (*_PARQUET, *_FITS, *_CSV)


@dataclass(frozen=True, slots=True)
class Piece:
    """Rows of one file.

    first   : number of the first row in the file, from 1
    columns : title -> numbers[n], NaN where a float is missing
    units   : title -> what the file itself says of its unit, where it says anything
    """

    file: Path
    first: int
    columns: Mapping[str, Array]
    units: Mapping[str, str]


def files(path: Path) -> list[Path]:
    """Errors: BadInput where there is no such file, or none in the folder, or its ending tells nothing"""
    if path.is_dir():
        found = _of_folder(path)
        if not found:
            raise BadInput(f"{path}: no Parquet file in this folder")
        return found
    if not path.is_file():
        raise BadInput(f"{path}: no such file")
    if path.suffix.lower() not in _ENDINGS:
        raise BadInput(f"{path}: the ending is none of {', '.join(_ENDINGS)}")
    return [path]


def pieces(file: Path, columns: Sequence[str], whole: Sequence[str] = ()) -> Iterator[Piece]:
    """The rows of one file.

    whole  : columns of whole numbers, where an empty place is refused: no float holds 64 bits
    Errors : BadInput or Damaged, one line: the file, and the column and row where one is wrong
    """
    suffix = file.suffix.lower()
    if suffix in _FITS:
        first = 1
        for arrays, units in fits.number_batches(file, columns):
            yield Piece(file, first, arrays, units)
            first += len(next(iter(arrays.values())))
        return
    batches = foreign.batches(file, columns) if suffix in _PARQUET else _csv_batches(file, columns, whole)
    first = 1
    for batch in batches:
        arrays = {name: _numbers(file, first, name, batch.column(name), whole) for name in columns}
        units = {field.name: unit for field in batch.schema if (unit := _unit(field))}
        yield Piece(file, first, arrays, units)
        first += batch.num_rows


def _of_folder(folder: Path) -> list[Path]:
    """A collection of HATS catalogues names the one with the rows; only its dataset holds rows once each."""
    about = folder / "collection.properties"
    if about.is_file():
        lines = (line.partition("=") for line in about.read_text(encoding="utf-8", errors="replace").splitlines())
        primary = {key.strip(): value.strip() for key, _, value in lines}.get("hats_primary_table_url", "")
        folder = folder / primary
    inside = folder / "dataset" if (folder / "dataset").is_dir() else folder
    found = sorted(path for path in inside.rglob("*") if path.suffix.lower() in _PARQUET and path.is_file())
    return [path for path in found if not path.name.startswith(("_", ".")) and path.stem != "data_thumbnail"]


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode(errors="replace"))


def _csv_batches(file: Path, columns: Sequence[str], whole: Sequence[str]) -> Iterator[pa.RecordBatch]:
    types = {name: pa.int64() if name in whole else pa.float64() for name in columns}
    convert = csv.ConvertOptions(
        column_types=types, include_columns=list(columns), null_values=["", "NaN", "nan", "null", "NULL", "\\N"]
    )
    read = csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
    try:
        with csv.open_csv(file, read_options=read, convert_options=convert) as stream:
            yield from stream
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
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
