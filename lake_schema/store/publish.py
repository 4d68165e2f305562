"""How a table gets into the lake: never half, and never mistaken for another.

plan      what is to be made: table, everything that goes into it, its parts.  Its hash names the version.
stage     LAKE/<table>/.stage-<key>; a part's file is written under a temporary name, synced, hashed, renamed; its
          receipt last, in the same way.
publish   all parts there -> HATS metadata -> manifest -> one rename of the folder -> `current` swapped by one rename.

State after a death at any point             what a reader sees        what the next run does
before the first receipt                     the last version          everything
between receipts                             the last version          what has no receipt, or not its sha256
after the last receipt, before the rename    the last version          the metadata and the rename
after the rename, before the link            the last version          the link
after the link                               the new version           nothing
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from lake_schema import __version__
from lake_schema.errors import BadInput, Damaged, PartsFailed, Superseded
from lake_schema.store import hats_files, layout, manifest, reuse
from lake_schema.store.layout import current_key
from lake_schema.store.manifest import sync
from lake_schema.store.plan import Json, Output, Part, Plan, Work, data_path
from lake_schema.store.stage import attempt, forget_damaged, is_done, missing, receipt_of, receipts, write_part
from lake_schema.store.uniqueness import refuse_duplicates

__all__ = [
    "Json", "Mapper", "Output", "Part", "Plan", "Work", "attempt", "current_key", "data_path", "gc", "is_done", "make",
    "missing", "receipts", "write_part",
]  # fmt: skip

# A table's own lock is held for a few renames; how long to wait for another holder, and how often to look, s.
_PATIENCE, _POLL = 10.0, 0.02

# What stands in a table's folder by a version's key.
_KEYED = re.compile(r"(?:v|\.stage|\.receipts|\.lock)-([0-9a-f]{16})", re.ASCII)

Mapper = Callable[[Callable[[Part], Json], Sequence[Part]], Iterable[Json]]


def make(root: Path, plan: Plan, work: Work, mapper: Mapper = map, base: str | None = "") -> Path:
    """Make what is missing of a plan's version and publish it; returns the version's folder.

    work   : (lake, facts of the plan and the part) -> its Output; runs wherever `mapper` runs it
    mapper : like map: (function, parts) -> results in any order.  Results are only reported on; the receipts decide
    base   : key of the version that this one replaces, "" = whatever is current when the call begins
    root   : folder of the lake;  plan : table, facts and parts
    Errors : PartsFailed lists the parts that could not be made (the others are kept); Superseded where another run
             holds the same plan, or has published another version since; Damaged where it is there and not whole
    """
    name, key = plan.table.name, plan.key
    now = current_key(root, name)
    base = now if base == "" else base
    target = layout.version(root, name, key)
    folder = layout.table(root, name)
    lock = folder / f".lock-{key}"
    if now == key and target.exists() and not lock.exists():
        # Nothing is left to do: said without a lock, also where nothing can be written.
        _refuse_damaged(target, name)
        return target
    folder.mkdir(parents=True, exist_ok=True)
    with _lock(lock, f"table {name}: another run is making version {key}"):
        if target.exists():
            _refuse_damaged(target, name)
        else:
            stage = layout.stage(root, name, key)
            stage.mkdir(exist_ok=True)
            _make_parts(root, plan, work, mapper)
            _finish(stage, plan)
        _publish(root, plan, base)
    return target


def _refuse_damaged(target: Path, name: str) -> None:
    if found := manifest.faults(target, manifest.load(target, name)):
        raise Damaged(f"{found[0]}; remove {target} to have it made again")


def _make_parts(root: Path, plan: Plan, work: Work, mapper: Mapper) -> None:
    table, stage = plan.table, layout.stage(root, plan.table.name, plan.key)
    forget_damaged(stage, plan)
    reuse.take(stage, layout.current(root, table.name), table.name, missing(stage, plan))
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


def _finish(stage: Path, plan: Plan) -> None:
    """Metadata and manifest: after this the stage is the version, all but its name."""
    made = [receipt for part in plan.parts if (receipt := receipt_of(stage, part.name)) is not None]
    refuse_duplicates(stage, plan, made)
    listed = {f["path"]: f for receipt in made for f in receipt["files"]}
    _sweep(stage, set(listed))
    if plan.table.is_catalogue:
        hats_files.write(stage, plan.table, made, receipts(stage))
    rows = {data_path(plan.table, r["part"]): r["rows"] for r in made}
    files = []
    for path in sorted(stage.rglob("*")):
        relative = path.relative_to(stage).as_posix()
        if path.is_file():
            entry = listed.pop(relative, None) or manifest.file_facts(path, relative)
            files.append({**entry, **({"rows": rows[relative]} if relative in rows else {})})
        sync(path)
    if listed:
        raise Damaged(f"{stage / min(listed)} is missing")
    deflections = (
        {"deflection_deg": max(r["deflection_deg"] for r in made)} if made and "deflection_deg" in made[0] else {}
    )
    manifest.write(
        stage,
        {
            "truesky": __version__,
            "table": plan.table.name,
            "version": plan.table.version,
            "key": plan.key,
            "facts": dict(plan.facts),
            "parts": [
                {"name": part.name, "facts": dict(part.facts), **reuse.files_of(part, receipt)}
                for part, receipt in zip(plan.parts, made, strict=True)
            ],
            "rows": sum(rows.values()),
            # Whoever reads it can tell which last bits may differ where it is made again.
            "machines": sorted({str(r["machine"]) for r in made if r.get("machine")}),
            "files": files,
            **deflections,
        },
    )


def _sweep(stage: Path, wanted: set[str]) -> None:
    """Remove what no receipt names: temporary files of dead tasks, metadata of an interrupted finish."""
    for path in sorted(stage.rglob("*"), reverse=True):
        if path.is_file() and path.relative_to(stage).as_posix() not in wanted:
            path.unlink()


def _publish(root: Path, plan: Plan, base: str | None) -> None:
    name, key = plan.table.name, plan.key
    folder = layout.table(root, name)
    with _lock(folder / ".lock", f"table {name}: another run is publishing", _PATIENCE):
        now = current_key(root, name)
        if now not in (base, key):
            raise Superseded(
                f"table {name}: version {now} was published since this run began from {base}; run again to replace it"
            )
        stage, target = layout.stage(root, name, key), layout.version(root, name, key)
        if not target.exists():
            os.rename(stage, target)
            sync(folder)
        if now != key:
            link = folder / f".current.{os.getpid()}.tmp"
            link.unlink(missing_ok=True)
            link.symlink_to(target.name)
            os.replace(link, layout.current(root, name))
            sync(folder)
    shutil.rmtree(receipts(stage), ignore_errors=True)
    (folder / f".lock-{key}").unlink(missing_ok=True)


@contextlib.contextmanager
def _lock(path: Path, refusal: str, patience: float = 0.0) -> Iterator[None]:
    """Hold a lock file, or raise Superseded; the kernel lets go of it when the process dies, however it dies.

    patience : how long to wait for another holder, s
    """
    give_up = time.monotonic() + patience
    while True:
        with path.open("a") as stream:
            if _take(path, stream.fileno()):
                yield
                return
        if time.monotonic() >= give_up:
            raise Superseded(refusal)
        time.sleep(_POLL)


def _take(path: Path, descriptor: int) -> bool:
    """Lock the open file, if nobody holds it, and if it is still the one of that name: holders remove it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return path.stat().st_ino == os.fstat(descriptor).st_ino
    except (BlockingIOError, FileNotFoundError):
        return False


def gc(root: Path, name: str) -> list[Path]:
    """Remove every version but the current one, and every stage that no run is working on; returns what was removed.

    A folder is renamed before it is emptied, so that a death in between leaves no half version that looks whole.
    Errors : BadInput where there is no such table; Damaged where none of its versions is known to be the current one
    """
    folder = layout.table(root, name)
    if not any(folder.glob(".lock*")):
        raise BadInput(f"lake {root} has no table {name}")
    removed: list[Path] = []
    _empty(folder)
    with _lock(folder / ".lock", f"table {name}: another run is publishing", _PATIENCE):
        keep = current_key(root, name)
        if keep is not None and not layout.version(root, name, keep).exists():
            raise Damaged(f"{layout.current(root, name)} leads to v-{keep}, which is missing: nothing is removed")
        for key in sorted({found[1] for path in folder.iterdir() if (found := _KEYED.fullmatch(path.name))}):
            lock = folder / f".lock-{key}"
            with contextlib.suppress(Superseded), _lock(lock, "in use"):
                stage = layout.stage(root, name, key)
                folders = [stage, receipts(stage)] + ([] if key == keep else [layout.version(root, name, key)])
                for path in folders:
                    if path.exists():
                        os.rename(path, folder / f".gone{path.name}")
                        removed.append(path)
                lock.unlink()
    _empty(folder)
    return removed


def _empty(folder: Path) -> None:
    for path in folder.glob(".gone*"):
        shutil.rmtree(path, ignore_errors=True)
