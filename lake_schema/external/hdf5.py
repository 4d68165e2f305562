"""HDF5 files of other programs in OpenCosmo's layout: nothing in them is believed, a bounded piece is read at a time.

batches     the rows of some columns

A column is a dataset of one axis in a group `data`, its unit in the attribute `unit`. The group stands alone, or in a
group of each slice of a light-cone; slices follow one another by name. What the group `header/file` says of the type,
where there is one, must be galaxies. As Parquet, the file is read by a process of its own, which has little memory and
time:
python -m lake_schema.external.hdf5 FILE NEEDED COLUMN ... >stream
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
_ROWS_A_BATCH = 65_536
# Groups of a file, slices among them; characters of a unit; bytes of a chunk, unpacked.
_MOST_GROUPS, _LONGEST_UNIT, _MOST_CHUNK = 4096, 64, 64 << 20


def batches(path: Path, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Rows of some columns of numbers, in the order of the file; the unit of each in its field's metadata.

    Errors : BadInput, one line, where the file is damaged, has no rows, or asks for more than is reasonable; it names
             the dataset where one is wrong
    """
    yield from files.read_apart(__name__, path, columns)


# ----------------------------------------------------------------------------------------- in a process of its own


def send(path: Path, columns: Sequence[str], texts: Sequence[str], out: IO[bytes]) -> None:
    """Write the batches of a file as an Arrow stream; BadInput, whatever the library trips over.

    path : of the file;  columns : wanted, of numbers;  texts : none, as other forms have them;  out : open to write
    """
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            slices = [_columns(path, group, columns) for group in _slices(path, file)]
            if not sum(_rows(one) for one in slices):
                raise BadInput(f"{path}: dataset {slices[0][0].name} has no rows")
            _send(path, slices, columns, out)
    except BadInput:
        raise
    except Exception as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())[:300] or type(error).__name__}") from None


def _slices(path: Path, file: Any) -> list[Any]:
    """The groups `data` of a file, and what its headers say."""
    import h5py

    if len(file) > _MOST_GROUPS:
        raise BadInput(f"{path}: has {len(file)} groups: too many")
    names = [name for name in sorted(file, key=_by_number) if name not in ("data", "index")]
    inside = [file, *(_held(path, file, name) for name in names)]
    found = []
    for group in inside:
        if not isinstance(group, h5py.Group):
            continue
        if "header" in group and "file" in group["header"]:
            kind = _text(group["header"]["file"].attrs.get("data_type", _TYPES[0]))
            if kind not in _TYPES:
                raise BadInput(f"{path}: {group.name} holds {kind[:40]}, wanted {' or '.join(_TYPES)}")
        if "data" in group and isinstance(held := _held(path, group, "data"), h5py.Group):
            found.append(held)
    if not found:
        raise BadInput(f"{path}: has no group data with columns")
    return found


def _by_number(name: str) -> tuple[int, str]:
    return (int(name), "") if name.isascii() and name.isdigit() and len(name) < 10 else (1 << 31, name)


def _held(path: Path, group: Any, name: str) -> Any:
    """What a file itself holds, not what it leads to."""
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise BadInput(f"{path}: {group.name}/{name} leads elsewhere".replace("//", "/"))
    return group[name]


def _columns(path: Path, group: Any, columns: Sequence[str]) -> list[Any]:
    import h5py

    titles = list(group)
    if len(titles) > _MOST_GROUPS:
        raise BadInput(f"{path}: {group.name} has {len(titles)} columns: too many")
    files.check_titles(path, titles, columns)
    found = [_held(path, group, name) for name in columns]
    for column in found:
        if not isinstance(column, h5py.Dataset) or len(column.shape or ()) != 1 or column.dtype.kind not in "fiub":
            raise BadInput(f"{path}: dataset {column.name} is no column of numbers")
        if column.is_virtual or column.external:
            raise BadInput(f"{path}: dataset {column.name} leads elsewhere")
        if column.chunks and column.chunks[0] * column.dtype.itemsize > _MOST_CHUNK:
            raise BadInput(f"{path}: dataset {column.name} has chunks of {column.chunks[0]} rows: too large")
        if len(column) != len(found[0]):
            said = f"has {len(column)} rows, {found[0].name} {len(found[0])}"
            raise BadInput(f"{path}: dataset {column.name} {said}")
    return found


def _rows(columns: Sequence[Any]) -> int:
    return len(columns[0])


def _send(path: Path, slices: Sequence[Sequence[Any]], columns: Sequence[str], out: IO[bytes]) -> None:
    fields = zip(columns, slices[0], strict=True)
    schema = pa.schema([pa.field(name, pa.from_numpy_dtype(one.dtype), metadata=_about(one)) for name, one in fields])
    with pa.ipc.new_stream(out, schema) as stream:
        for here in slices:
            for name, one in zip(columns, here, strict=True):
                _check_alike(path, schema.field(name), one)
            for first in range(0, _rows(here), _ROWS_A_BATCH):
                arrays = [pa.array(one[first : first + _ROWS_A_BATCH]) for one in here]
                stream.write_batch(pa.record_batch(arrays, schema=schema))


def _check_alike(path: Path, field: pa.Field, column: Any) -> None:
    if pa.from_numpy_dtype(column.dtype) != field.type or _about(column) != (field.metadata or {}):
        raise BadInput(f"{path}: dataset {column.name} has another type or unit than in the first slice")


def _about(column: Any) -> dict[bytes, bytes]:
    said = _text(column.attrs.get("unit", ""))
    return {} if said in ("", "None") else {b"unit": said[:_LONGEST_UNIT].encode()}


def _text(said: Any) -> str:
    return said.decode(errors="replace") if isinstance(said, bytes) else str(said)


if __name__ == "__main__":
    sys.exit(files.main(sys.argv[1:], send))
