"""How a table gets into the lake: never half, and never mistaken for another.

plan      what is to be made: table, everything that goes into it, its parts.  Its hash names the version.
stage     LAKE/<table>/.stage-<key>; a part's file is written under a temporary name, synced, hashed, renamed; its receipt
          last, in the same way.  A part is done when its receipt is there and its files are what the receipt says.
publish   all parts there -> HATS metadata -> manifest -> one rename of the folder -> `current` is swapped by one rename.

State after a death at any point             what a reader sees        what the next run does
before the first receipt                     the last version          everything
between receipts                             the last version          what has no receipt
after the last receipt, before the rename    the last version          the metadata and the rename
after the rename, before the link            the last version          the link
after the link                               the new version           nothing
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema import layout, parquet
from lake_schema.columns import Table
from lake_schema.errors import BadInput, LakeError, PartsFailed, Superseded
from lake_schema.provenance import digest, file_sha256
from lake_schema.validate import check

MANIFEST = "manifest.json"

Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Part:
    """One file of a table and what its maker needs to know.

    name  : file below dataset/ for a plain table, the HATS path for a catalogue's cell
    facts : JSON values; they go into the plan's key
    """

    name: str
    facts: Json


@dataclass(frozen=True, slots=True)
class Plan:
    """A version of a table that is to be made.

    facts : JSON values of everything that goes into it (seed, request, inputs' keys, mission, code version)
    """

    table: Table
    facts: Json
    parts: tuple[Part, ...]

    def __post_init__(self) -> None:
        if len({part.name for part in self.parts}) != len(self.parts):
            raise BadInput(f"table {self.table.name}: the plan names a part twice")

    @property
    def key(self) -> str:
        """16 hexadecimal digits that stand for all of it."""
        schema = [[f.name, str(f.type), f.nullable, _text(f.metadata)] for f in self.table.arrow()]
        parts = [[part.name, dict(part.facts)] for part in self.parts]
        about = {"table": self.table.name, "version": self.table.version, "schema": schema}
        return digest({**about, "facts": dict(self.facts), "parts": parts})[:16]


@dataclass(frozen=True, slots=True)
class Output:
    """What a part's maker returns: its rows, and files that belong to them (relative name -> writer of a path)."""

    rows: pa.Table
    files: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)


Work = Callable[[Path, Json], Output]


def _text(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(): v.decode() for k, v in sorted((metadata or {}).items())}


# ---------------------------------------------------------------------------------------------------- in a task


def data_path(table: Table, part: str) -> str:
    """Path of a part's Parquet file in a version."""
    return f"{table.name}/dataset/{part}" if table.is_catalogue else f"dataset/{part}"


def write_part(stage: Path, table: Table, part: Part, output: Output) -> Json:
    """Write one part into the stage, its receipt last; returns the receipt.

    Errors: BadInput where the rows are not what the table declares; OSError where the disk refuses
    """
    check(output.rows, table)
    if table.is_catalogue:
        _check_order(output.rows, table)
    path = data_path(table, part.name)
    writers = {path: lambda target: parquet.write(target, output.rows, table), **output.files}
    files = [_write_file(stage, relative, writer) for relative, writer in writers.items()]
    receipt = {"part": part.name, "rows": output.rows.num_rows, "files": files}
    _write_json(_receipt_path(stage, part.name), receipt)
    return receipt


def _check_order(rows: pa.Table, table: Table) -> None:
    index = rows["_healpix_29"].to_numpy()
    if (index[1:] < index[:-1]).any():
        raise BadInput(f"table {table.name}: rows are not sorted by _healpix_29")


def _write_file(stage: Path, relative: str, writer: Callable[[Path], None]) -> Json:
    target = layout.within(stage, stage / relative)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        writer(temporary)
        _sync(temporary)
        facts = {"path": relative, "bytes": temporary.stat().st_size, "sha256": file_sha256(temporary)}
        os.replace(temporary, target)
        _sync(target.parent)
    finally:
        temporary.unlink(missing_ok=True)
    return facts


def receipts(stage: Path) -> Path:
    """Folder of a stage's receipts, one JSON file a part that is done."""
    return stage.with_name(stage.name.replace(".stage-", ".receipts-"))


def _receipt_path(stage: Path, part: str) -> Path:
    return receipts(stage) / (part.replace("/", "+") + ".json")


def _write_json(path: Path, value: Json) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w") as stream:
            json.dump(value, stream, indent=1, sort_keys=True, allow_nan=False)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def attempt(root: Path, key: str, table: Table, facts: Json, work: Work, part: Part) -> Json:
    """Make and write one part, if it is not done yet; a failure comes back as {"part", "error", "traceback", "final"}.

    final : the same input will fail again
    """
    stage = layout.stage(root, table.name, key)
    if _is_done(stage, part):
        return _read_receipt(stage, part.name) or {}
    try:
        return write_part(stage, table, part, work(root, {**facts, **part.facts}))
    except Exception as error:
        refused = isinstance(error, LakeError)
        line = str(error) if refused else f"{type(error).__name__}: {error}"
        return {"part": part.name, "error": line, "traceback": traceback.format_exc(), "final": refused}


# --------------------------------------------------------------------------------------------------- on the driver

Mapper = Callable[[Callable[[Part], Json], Sequence[Part]], Iterable[Json]]


def make(root: Path, plan: Plan, work: Work, mapper: Mapper = map, base: str | None = "") -> Path:
    """Make what is missing of a plan's version and publish it; returns the version's folder.

    work   : (lake, facts of the plan and the part) -> its Output; runs wherever `mapper` runs it
    mapper : like map: (function, parts) -> results in any order.  Results are only reported on; the receipts decide
    base   : key of the version that this one replaces, "" = whatever is current when the call begins
    Errors : PartsFailed lists the parts that could not be made (the others are kept); Superseded where another run holds
             the same plan, or has published another version since
    """
    name, key = plan.table.name, plan.key
    base = current_key(root, name) if base == "" else base
    target = layout.version(root, name, key)
    layout.table(root, name).mkdir(parents=True, exist_ok=True)
    with _lock(layout.table(root, name) / f".lock-{key}", f"table {name}: another run is making version {key}"):
        if not target.exists():
            stage = layout.stage(root, name, key)
            stage.mkdir(exist_ok=True)
            _make_parts(root, plan, work, mapper)
            _finish(stage, plan)
        _publish(root, plan, base)
    return target


def _make_parts(root: Path, plan: Plan, work: Work, mapper: Mapper) -> None:
    table, stage = plan.table, layout.stage(root, plan.table.name, plan.key)
    todo = missing(stage, plan)
    failures: dict[str, str] = {}
    function = partial(attempt, root, plan.key, table, plan.facts, work)
    for result in mapper(function, todo) if todo else ():
        if "error" in result:
            failures[result["part"]] = result["error"]
    left = missing(stage, plan)
    if left:
        lines = [f"{part.name}: {failures.get(part.name, 'ended without a receipt')}" for part in left]
        raise PartsFailed(f"table {table.name}: {len(left)} of {len(plan.parts)} parts failed: " + "; ".join(lines))


def missing(stage: Path, plan: Plan) -> list[Part]:
    """Parts of the plan that have no receipt, or whose files are not there at the size that it says."""
    return [part for part in plan.parts if not _is_done(stage, part)]


def _is_done(stage: Path, part: Part) -> bool:
    receipt = _read_receipt(stage, part.name)
    if receipt is None:
        return False
    sizes = ((stage / f["path"], f["bytes"]) for f in receipt["files"])
    return all(path.is_file() and path.stat().st_size == size for path, size in sizes)


def _read_receipt(stage: Path, part: str) -> Json | None:
    path = _receipt_path(stage, part)
    try:
        receipt: Json = json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return None
    return receipt


def _finish(stage: Path, plan: Plan) -> None:
    """Metadata and manifest: after this the stage is the version, all but its name."""
    from lake_schema import hats_files

    made = [receipt for part in plan.parts if (receipt := _read_receipt(stage, part.name)) is not None]
    _sweep(stage, {f["path"] for receipt in made for f in receipt["files"]})
    if plan.table.is_catalogue:
        hats_files.write(stage, plan.table, [(r["part"], r["rows"]) for r in made])
    listed = {f["path"]: f for receipt in made for f in receipt["files"]}
    rows = {data_path(plan.table, r["part"]): r["rows"] for r in made}
    files = []
    for path in sorted(p for p in stage.rglob("*") if p.is_file()):
        relative = path.relative_to(stage).as_posix()
        if relative == MANIFEST:
            continue
        entry = listed.get(relative) or {"path": relative, "bytes": path.stat().st_size, "sha256": file_sha256(path)}
        files.append({**entry, **({"rows": rows[relative]} if relative in rows else {})})
        _sync(path)
    manifest = {
        "table": plan.table.name,
        "version": plan.table.version,
        "key": plan.key,
        "facts": dict(plan.facts),
        "parts": [{"name": part.name, "facts": dict(part.facts)} for part in plan.parts],
        "rows": sum(rows.values()),
        "files": files,
    }
    _write_json(stage / MANIFEST, manifest)


def _sweep(stage: Path, wanted: set[str]) -> None:
    """Remove what no receipt names: temporary files of dead tasks, metadata of an interrupted finish."""
    for path in sorted(stage.rglob("*"), reverse=True):
        relative = path.relative_to(stage)
        if path.is_file() and relative.as_posix() not in wanted:
            path.unlink()


def _publish(root: Path, plan: Plan, base: str | None) -> None:
    name, key = plan.table.name, plan.key
    folder = layout.table(root, name)
    with _lock(folder / ".lock", f"table {name}: another run is publishing"):
        now = current_key(root, name)
        if now not in (base, key):
            raise Superseded(f"table {name}: version {now} was published since this run began from {base}")
        stage, target = layout.stage(root, name, key), layout.version(root, name, key)
        if not target.exists():
            os.rename(stage, target)
            _sync(folder)
        if now != key:
            link = folder / f".current.{os.getpid()}.tmp"
            link.unlink(missing_ok=True)
            link.symlink_to(target.name)
            os.replace(link, layout.current(root, name))
            _sync(folder)
    shutil.rmtree(receipts(stage), ignore_errors=True)
    (folder / f".lock-{key}").unlink(missing_ok=True)


@contextlib.contextmanager
def _lock(path: Path, refusal: str) -> Iterator[None]:
    """Hold a lock file, or raise Superseded; the kernel lets go of it when the process dies, however it dies."""
    with path.open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Superseded(refusal) from None
        yield


def current_key(root: Path, name: str) -> str | None:
    """Key of the published version, None where there is none."""
    try:
        return os.readlink(layout.current(root, name)).removeprefix("v-")
    except FileNotFoundError:
        return None


def gc(root: Path, name: str) -> list[Path]:
    """Remove every version but the current one, and every stage; returns what was removed."""
    folder, keep = layout.table(root, name), current_key(root, name)
    with _lock(folder / ".lock", f"table {name}: another run is publishing"):
        removed = [p for p in sorted(folder.glob("v-*")) if p.name != f"v-{keep}"]
        removed += sorted([*folder.glob(".stage-*"), *folder.glob(".receipts-*")])
        for path in removed:
            shutil.rmtree(path)
    return removed
