"""How a table gets into the lake: never half, and never mistaken for another.

plan      what is to be made: table, everything that goes into it, its parts.  Its hash names the version.
stage     LAKE/<table>/.stage-<key>; a part's file is written under a temporary name, synced, hashed, renamed; its
          receipt last, in the same way.
publish   all parts there -> HATS metadata -> manifest -> one rename of the folder -> the link of the request that it is
          made for and `current` swapped, each by one rename.

State after a death at any point             what a reader sees        what the next run does
before the first receipt                     the last version          everything
between receipts                             the last version          what has no receipt, or not its sha256
after the last receipt, before the rename    the last version          the metadata and the rename
after the rename, before the request's link  the last version          both links
between the two links                        the request's: the new    `current`
after both                                   the new version           nothing
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from lake_schema import __version__
from lake_schema.errors import Damaged, PartsFailed, Superseded
from lake_schema.store import hats_files, layout, locks, manifest, names, reuse
from lake_schema.store.layout import current_key
from lake_schema.store.manifest import sync
from lake_schema.store.plan import Json, Output, Part, Plan, Work, data_path
from lake_schema.store.stage import attempt, done, forget_damaged, is_done, missing, receipts, write_part
from lake_schema.store.uniqueness import refuse_duplicates

__all__ = [
    "Json", "Mapper", "Output", "Part", "Plan", "Work", "attempt", "current_key", "data_path", "is_done", "make",
    "missing", "receipts", "write_part",
]  # fmt: skip

Mapper = Callable[[Callable[[Part], Json], Sequence[Part]], Iterable[Json]]


def make(
    root: Path, plan: Plan, work: Work, mapper: Mapper = map, base: str | None = "", name: str | None = None
) -> Path:
    """Make what is missing of a plan's version and publish it; returns the version's folder.

    work   : (lake, facts of the plan and the part) -> its Output; runs wherever `mapper` runs it
    mapper : like map: (function, parts) -> results in any order.  Results are only reported on; the receipts decide
    base   : key of the version that this one replaces, "" = whatever is there when the call begins: of the request
             that is named, else the current one
    name   : of the request that the version is made for; what it is made of is then that request's as well
    root   : folder of the lake;  plan : table, facts and parts
    Errors : PartsFailed lists the parts that could not be made (the others are kept); Superseded where another run
             holds the same plan, or has published another version since; Damaged where it is there and not whole
    """
    table, key = plan.table.name, plan.key
    now = _replaced(root, table, name)
    base = now if base == "" else base
    target = layout.version(root, table, key)
    folder = layout.table(root, table)
    lock = folder / f".lock-{key}"
    if now == current_key(root, table) == key and target.exists() and not lock.exists():
        # Nothing is left to do: said without a lock, also where nothing can be written.
        _refuse_damaged(target, table)
        return target
    folder.mkdir(parents=True, exist_ok=True)
    if name is not None:
        _pin_inputs(root, plan, name)
    with locks.held(lock, f"table {table}: another run is making version {key}", locks.MOMENT):
        if target.exists():
            _refuse_damaged(target, table)
        else:
            stage = layout.stage(root, table, key)
            stage.mkdir(exist_ok=True)
            _finish(stage, plan, _make_parts(root, plan, work, mapper, name))
        _publish(root, plan, base, name)
    return target


def _replaced(root: Path, table: str, name: str | None) -> str | None:
    """Key of the version that one made for a request, or for none, comes in the place of."""
    return current_key(root, table) if name is None else names.key_of(root, name, table)


def _pin_inputs(root: Path, plan: Plan, name: str) -> None:
    """What a request's table is made of belongs to the request before it is used, so that nobody removes it."""
    keys = set(names.keys_in(plan.facts))
    for table in set(layout.tables(root)) - {plan.table.name}:
        for key in sorted(keys):
            target = layout.version(root, table, key)
            if target.exists() and names.key_of(root, name, table) is None:
                with locks.table(layout.table(root, table)):
                    if target.exists() and names.key_of(root, name, table) is None:
                        names.pin(root, name, table, key)


def _refuse_damaged(target: Path, name: str) -> None:
    if found := manifest.faults(target, manifest.load(target, name)):
        raise Damaged(f"{found[0]}; remove {target} to have it made again")


def _make_parts(root: Path, plan: Plan, work: Work, mapper: Mapper, name: str | None) -> list[Json]:
    """Receipts of all parts, in the plan's order."""
    table, stage = plan.table, layout.stage(root, plan.table.name, plan.key)
    forget_damaged(stage, plan)
    for version in _others(root, table.name, name):
        reuse.take(stage, version, table.name, missing(stage, plan))
    todo = missing(stage, plan)
    failures: dict[str, str] = {}
    function = partial(attempt, root, plan.key, table, plan.facts, work)
    for result in mapper(function, todo) if todo else ():
        if "error" in result:
            failures[result["part"]] = result["error"]
    made = done(stage, plan)
    if left := [part for part in plan.parts if part.name not in made]:
        lines = [f"{part.name}: {failures.get(part.name, 'ended without a receipt')}" for part in left]
        raise PartsFailed(f"table {table.name}: {len(left)} of {len(plan.parts)} parts failed: " + "; ".join(lines))
    return [made[part.name] for part in plan.parts]


def _others(root: Path, table: str, name: str | None) -> list[Path]:
    """Versions that may hold some of the parts already: the request's own, the last one, those of other requests."""
    keys = [_replaced(root, table, name), current_key(root, table), *names.holders(root, table).values()]
    found = (layout.version(root, table, key) for key in dict.fromkeys(keys) if key is not None)
    return [path for path in found if path.exists()]


def _finish(stage: Path, plan: Plan, made: Sequence[Json]) -> None:
    """Metadata and manifest: after this the stage is the version, all but its name.

    made : receipts of the plan's parts
    """
    refuse_duplicates(stage, plan, made)
    listed = {f["path"]: f for receipt in made for f in receipt["files"]}
    _sweep(stage, set(listed))
    if plan.table.is_catalogue:
        hats_files.write(stage, plan.table, made, receipts(stage))
    rows = {data_path(plan.table, r["part"]): r["rows"] for r in made}
    files = []
    for path in sorted(stage.rglob("*")):
        relative = path.relative_to(stage).as_posix()
        if manifest.is_temporary(path):
            # Of another copy of a task, which is still running.
            continue
        if path.is_file():
            entry = listed.pop(relative, None)
            if entry is None:
                # What a receipt names was synced before.
                entry = manifest.file_facts(path, relative)
                sync(path)
            files.append({**entry, **({"rows": rows[relative]} if relative in rows else {})})
        else:
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
            "machines": sorted({str(r["machine"]) for r in made}),
            "files": files,
            **deflections,
        },
    )


def _sweep(stage: Path, wanted: set[str]) -> None:
    """Remove what no receipt names: temporary files of dead tasks, metadata of an interrupted finish."""
    for path in sorted(stage.rglob("*"), reverse=True):
        if path.is_file() and path.relative_to(stage).as_posix() not in wanted:
            path.unlink(missing_ok=True)


def _publish(root: Path, plan: Plan, base: str | None, name: str | None) -> None:
    table, key = plan.table.name, plan.key
    folder = layout.table(root, table)
    with locks.table(folder):
        now = _replaced(root, table, name)
        if now not in (base, key):
            raise Superseded(
                f"table {table}: version {now} was published since this run began from {base}; run again to replace it"
            )
        stage, target = layout.stage(root, table, key), layout.version(root, table, key)
        if not target.exists():
            os.rename(stage, target)
            sync(folder)
        if name is not None and now != key:
            names.pin(root, name, table, key)
        if current_key(root, table) != key:
            names.swap(layout.current(root, table), target.name)
    shutil.rmtree(receipts(stage), ignore_errors=True)
    (folder / f".lock-{key}").unlink(missing_ok=True)
