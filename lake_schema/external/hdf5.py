"""Read galaxy catalogues in HDF5 files with OpenCosmo's layout, in a separate process with limited memory and time.

A column is a dataset with one axis in a group `data`; its attribute `unit` gives the unit. The group `data` is at the
top of the file, or in one group per slice (redshift shell) of a light-cone. Slices are read in the order of their
names. If a group `header/file` gives the type of the data, it must be galaxies. The separate process reads the file and
sends its rows as a stream of Arrow batches, because a hostile file could crash its reader::

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

# First bytes of an HDF5 file.
MAGIC = b"\x89HDF\r\n\x1a\n"
# Values of the attribute `data_type` in OpenCosmo's headers that stand for catalogues of galaxies.
_TYPES = ("diffsky_fits", "synthetic_galaxies")
# Largest number of rows in a batch.
_ROWS_PER_BATCH = 65_536
# Largest number of groups at the top of a file, and of columns in a group `data`.
_MAX_GROUPS = 4096
# Largest number of characters of a unit; the rest of a longer unit is cut off.
_MAX_UNIT_LENGTH = 64
# Largest number of bytes of a chunk of a dataset after decompression.
_MAX_CHUNK_BYTES = 64 << 20


def read_batches(path: Path, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield the rows of some columns of numbers of an HDF5 file as Arrow batches, in the order of the file.

    The metadata of the Arrow field of a column contain its unit, if the file gives it.

    Raises
    ------
    BadInput
        If the file is damaged, has no rows, lacks a column, or exceeds the limits of size, memory or time. The message
        names the dataset if it is known.
    """
    yield from files.read_in_subprocess(__name__, path, columns)


def column_names(path: Path) -> list[str]:
    """Return the names of the columns of an HDF5 file; raise BadInput if it cannot be read."""
    return files.column_names_from_subprocess(__name__, path)


# ------------------------------------- functions that run in the separate process


def send_batches(path: Path, columns: Sequence[str], text_columns: Sequence[str], out: IO[bytes]) -> None:
    """Read some columns of an HDF5 file, and write their rows as a stream of Arrow batches.

    Parameters
    ----------
    path : Path
        An HDF5 file of another program.
    columns : sequence of str
        Names of columns of numbers; () to write the names of all columns instead of rows.
    text_columns : sequence of str
        Not used; `files.main` requires this parameter.
    out : binary file
        File to which the stream is written.

    Raises
    ------
    BadInput
        If the file has no rows, lacks a column, exceeds a limit, or cannot be read by h5py.
    """
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            if not columns:
                files.send_names(list(_data_groups(path, file)[0])[:_MAX_GROUPS], out)
                return
            slice_columns = [_column_datasets(path, group, columns) for group in _data_groups(path, file)]
            if not sum(_row_count(columns_of_slice) for columns_of_slice in slice_columns):
                raise BadInput(f"{path}: dataset {slice_columns[0][0].name} has no rows")
            _send(path, slice_columns, columns, out)
    except BadInput:
        raise
    except Exception as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())[:300] or type(error).__name__}") from None


def _data_groups(path: Path, file: Any) -> list[Any]:
    """Return the groups `data` of a file: one for the whole file, or one per slice (redshift shell).

    Each group contains columns. Raise BadInput if the file has no group `data`, or if a header gives a type of data
    other than galaxies.
    """
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
    """Return a group or dataset by its name; raise BadInput if it is a soft or external link, or is missing.

    An external link could lead to any file of the user.
    """
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
