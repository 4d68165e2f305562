"""Read HDF5 files of other programs in OpenCosmo's layout, in a separate process and with limits on everything.

A column is a dataset with one axis in a group `data`; its attribute `unit` gives the unit. The group is either at the
top, or in one group per slice of a light-cone; slices are read in the order of their names. If a group `header/file`
gives a type of data, it must be galaxies. As for Parquet, a process with little memory and time reads the file::

    python -m lake_schema.external.hdf5 FILE NUMBER COLUMN ... >stream
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import pyarrow as pa

from lake_schema.errors import BadInput
from lake_schema.external import files

MAGIC = b"\x89HDF\r\n\x1a\n"
_TYPES = ("diffsky_fits", "synthetic_galaxies")
_ROWS_PER_BATCH = 65_536
# Largest number of groups in a file (each slice of a light cone is a group), of characters in a unit, and of bytes in
# an unpacked chunk.
_MAX_GROUPS, _MAX_UNIT_LENGTH, _MAX_CHUNK_BYTES = 4096, 64, 64 << 20


def read_batches(path: Path, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield the rows of some columns of numbers in the order of the file; the metadata of a field contain its unit.

    Raises
    ------
    BadInput
        If the file is damaged, has no rows or exceeds the limits. The message names a faulty dataset.
    """
    yield from files.read_in_subprocess(__name__, path, columns)


# ----------------------------------------------------------------------------------------- in the separate process


def send_batches(path: Path, columns: Sequence[str], text_columns: Sequence[str], out: IO[bytes]) -> None:
    """Write the batches of a file as an Arrow stream.

    Parameters
    ----------
    path : Path
        An HDF5 file of another program.
    columns : sequence of str
        Names of columns of numbers.
    text_columns : sequence of str
        Not used; `files.main` requires this parameter.
    out : binary file
        File for the stream.

    Raises
    ------
    BadInput
        If the file exceeds the limits, or h5py cannot read it.
    """
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            slice_columns = [_column_datasets(path, group, columns) for group in _data_groups(path, file)]
            if not sum(_row_count(columns_of_slice) for columns_of_slice in slice_columns):
                raise BadInput(f"{path}: dataset {slice_columns[0][0].name} has no rows")
            _send(path, slice_columns, columns, out)
    except BadInput:
        raise
    except Exception as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())[:300] or type(error).__name__}") from None


def _data_groups(path: Path, file: Any) -> list[Any]:
    """Return the groups `data` of a file, after checking the types of data in its headers."""
    import h5py

    if len(file) > _MAX_GROUPS:
        raise BadInput(f"{path}: has {len(file)} groups: too many, at most {_MAX_GROUPS} are allowed")
    names = [name for name in sorted(file, key=_numeric_sort_key) if name not in ("data", "index")]
    slice_groups = [file, *(_hard_linked_item(path, file, name) for name in names)]
    data_groups = []
    for group in slice_groups:
        if not isinstance(group, h5py.Group):
            continue
        if "header" in group and "file" in group["header"]:
            kind = _decode_text(group["header"]["file"].attrs.get("data_type", _TYPES[0]))
            if kind not in _TYPES:
                raise BadInput(f"{path}: {group.name} holds {kind[:40]}, but must hold {' or '.join(_TYPES)}")
        if "data" in group and isinstance(data_group := _hard_linked_item(path, group, "data"), h5py.Group):
            data_groups.append(data_group)
    if not data_groups:
        raise BadInput(f"{path}: has no group data with columns")
    return data_groups


def _numeric_sort_key(name: str) -> tuple[int, str]:
    return (int(name), "") if name.isascii() and name.isdigit() and len(name) < 10 else (1 << 31, name)


def _hard_linked_item(path: Path, group: Any, name: str) -> Any:
    """Return an item that is stored in the file itself; links to other places are refused."""
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise BadInput(f"{path}: {group.name}/{name} must not be a link".replace("//", "/"))
    return group[name]


def _column_datasets(path: Path, group: Any, columns: Sequence[str]) -> list[Any]:
    import h5py

    column_names = list(group)
    if len(column_names) > _MAX_GROUPS:
        raise BadInput(f"{path}: {group.name} has {len(column_names)} columns: too many, at most {_MAX_GROUPS}")
    files.check_column_names(path, column_names, columns)
    datasets = [_hard_linked_item(path, group, name) for name in columns]
    for column in datasets:
        if not isinstance(column, h5py.Dataset) or len(column.shape or ()) != 1 or column.dtype.kind not in "fiub":
            raise BadInput(f"{path}: dataset {column.name} is not a column of numbers")
        if column.is_virtual or column.external:
            raise BadInput(f"{path}: dataset {column.name} must be stored in the file itself")
        if column.chunks and column.chunks[0] * column.dtype.itemsize > _MAX_CHUNK_BYTES:
            raise BadInput(f"{path}: dataset {column.name} has chunks of {column.chunks[0]} rows: too large")
        if len(column) != len(datasets[0]):
            lengths = f"has {len(column)} rows, but {datasets[0].name} has {len(datasets[0])}"
            raise BadInput(f"{path}: dataset {column.name} {lengths}")
    return datasets


def _row_count(columns: Sequence[Any]) -> int:
    return len(columns[0])


def _send(path: Path, slice_columns: Sequence[Sequence[Any]], columns: Sequence[str], out: IO[bytes]) -> None:
    fields = zip(columns, slice_columns[0], strict=True)
    schema = pa.schema(
        [pa.field(name, pa.from_numpy_dtype(column.dtype), metadata=_unit_metadata(column)) for name, column in fields]
    )
    with pa.ipc.new_stream(out, schema) as stream:
        for columns_of_slice in slice_columns:
            for name, column in zip(columns, columns_of_slice, strict=True):
                _check_same_type(path, schema.field(name), column)
            for first in range(0, _row_count(columns_of_slice), _ROWS_PER_BATCH):
                arrays = [pa.array(column[first : first + _ROWS_PER_BATCH]) for column in columns_of_slice]
                stream.write_batch(pa.record_batch(arrays, schema=schema))


def _check_same_type(path: Path, field: pa.Field, column: Any) -> None:
    if pa.from_numpy_dtype(column.dtype) != field.type or _unit_metadata(column) != (field.metadata or {}):
        raise BadInput(f"{path}: dataset {column.name} has another type or unit than in the first slice")


def _unit_metadata(column: Any) -> dict[bytes, bytes]:
    unit = _decode_text(column.attrs.get("unit", ""))
    return {} if unit in ("", "None") else {b"unit": unit[:_MAX_UNIT_LENGTH].encode()}


def _decode_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


if __name__ == "__main__":
    sys.exit(files.main(sys.argv[1:], send_batches))
