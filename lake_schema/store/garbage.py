"""What nobody needs any more: versions that no request has and that nothing kept was made of, runs that were given up.

kept        of each table, the versions that stay
collect     says what else there is, and removes it where that is wanted

A version stays that is current, that a request's name links to, or that such a one was made of, however far back. A
folder is renamed before it is emptied: a death in between leaves no half version that looks whole.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import layout, locks, manifest, names
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.stage import receipts

# What stands in a table's folder by a version's key; and what was on its way out.
_KEYED = re.compile(r"(?:v|\.stage|\.receipts|\.lock)-([0-9a-f]{16})", re.ASCII)
_GONE = ".gone*"


def tables(root: Folder) -> list[str]:
    """Folders of the lake in which something was published or begun, sorted."""
    return sorted({path.parent.name for path in root.glob("*/.lock*")} | set(layout.tables(root)))


def kept(root: Path, known: Mapping[str, set[str]] | None = None) -> dict[str, set[str]]:
    """Table -> keys of the versions that stay.

    root   : of the lake
    known  : what this said before; only the manifests of other versions are read, and what stayed stays
    Errors : Damaged where a version that stays is missing or its manifest broken: what it was made of is not known
    """
    links = [(name, layout.current_key(root, name), layout.current(root, name)) for name in layout.tables(root)]
    for request in names.names(root):
        for name in names.tables(root, request):
            links.append((name, names.key_of(root, request, name), layout.pin(root, request, name)))
    for name, key, link in links:
        if key is not None and not layout.version(root, name, key).exists():
            raise Damaged(f"{link} leads to v-{key}, which is missing: nothing is removed")
    found: dict[str, set[str]] = defaultdict(set, {name: set(keys) for name, keys in (known or {}).items()})
    waiting = [(name, key) for name, key, _ in links if key is not None]
    there = tables(root)
    while waiting:
        name, key = waiting.pop()
        if key in found[name]:
            continue
        found[name].add(key)
        made_of = set(names.keys_in(manifest.load(layout.version(root, name, key), name)["facts"]))
        waiting += [(other, k) for other in there for k in made_of if layout.version(root, other, k).exists()]
    return found


def collect(root: Path, name: str | None = None, delete: bool = False) -> list[Path]:
    """What is not kept of a table, or of all of them; removed only where `delete` says so.

    Errors : BadInput where there is no such table; Damaged, and nothing is removed, where it is not known what is kept
    """
    there = tables(root)
    chosen = there if name is None else [layout.table(root, name).name]
    if not set(chosen) <= set(there):
        raise BadInput(f"lake {root} has no table {name}")
    stays = kept(root)
    if not delete:
        return [path for one in chosen for path in _left_over(root, one, stays[one])]
    # What a death has left must not be in the way of a version that was made again since.
    removed = _emptied(root, chosen)
    with contextlib.ExitStack() as stack:
        # Nobody publishes while it is decided: what has been linked since is looked at, and little else.
        for one in there:
            stack.enter_context(locks.table(layout.table(root, one)))
        stays = kept(root, stays)
        removed += [path for one in chosen for path in _taken(root, one, stays[one])]
    _emptied(root, chosen)
    return removed


def _emptied(root: Path, chosen: Iterable[str]) -> list[Path]:
    """Remove what is on its way out of some tables."""
    gone = [path for one in chosen for path in sorted(layout.table(root, one).glob(_GONE))]
    for path in gone:
        shutil.rmtree(path, ignore_errors=True)
    return gone


def _left_over(root: Path, name: str, stays: set[str]) -> list[Path]:
    folder, found = layout.table(root, name), []
    for key in _keys(folder):
        if not locks.is_held(folder / f".lock-{key}"):
            found += _folders(root, name, key, stays)
    return [*found, *sorted(folder.glob(_GONE))]


def _taken(root: Path, name: str, stays: set[str]) -> Iterator[Path]:
    """Give what can go another name; stages that a run is working on stay."""
    folder = layout.table(root, name)
    for key in _keys(folder):
        lock = folder / f".lock-{key}"
        with contextlib.suppress(Superseded), locks.held(lock, "in use"):
            for path in _folders(root, name, key, stays):
                os.rename(path, folder / f".gone{path.name}")
                yield path
            lock.unlink()


def _keys(folder: Path) -> list[str]:
    return sorted({found[1] for path in folder.iterdir() if (found := _KEYED.fullmatch(path.name))})


def _folders(root: Path, name: str, key: str, stays: set[str]) -> list[Path]:
    stage = layout.stage(root, name, key)
    wanted = [stage, receipts(stage)] + ([] if key in stays else [layout.version(root, name, key)])
    return [path for path in wanted if path.exists()]
