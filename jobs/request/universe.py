"""The universe that a request asks for, and whether a catalogue is of it: seed, depth, and whatever else shapes it.

wanted          what a request says of its universe
refuse_other    a catalogue of another universe than the request's
refuse_others   a request of another universe than that of the requests which a lake holds already
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jobs.request.schema import Request
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.store import names, read
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, file_sha256

CATALOGUES = ("galaxies", "stars")
# What an older truesky had no key for, and how its catalogues are.
_LATER: Mapping[str, Mapping[str, Any]] = {
    "galaxies": {"lensing": None, "rotation": 0.0},
    "stars": {"bright_limit": None},
}
# What names files, or says how rows are filed.
_NOT_VALUES = {"tycho2", "catalogue", "columns", "rows_a_file"}


def wanted(request: Request) -> dict[str, Any]:
    """Seed and values of the sections universe and stars, by their names."""
    values = request.facts("universe", "stars")
    own = {key: value for key, value in values["stars"].items() if key not in _NOT_VALUES}
    return {"seed": request.seed, **values["universe"], **own}


def refuse_other(catalogues: Iterable[read.Version], request: Request) -> None:
    """Every catalogue must be of the request's universe.  Errors: BadInput names the first that is not, and why"""
    for version in catalogues:
        if different := _difference(version, request):
            first = f"run build_{version.table} first, then compute_fluxes"
            raise BadInput(f"table {version.table} has {different}: {first}")


def refuse_others(root: Path, request: Request) -> None:
    """A lake holds one universe: that of its other requests.  A request that is alone in it may change its own."""
    for name in names.names(root):
        for table in CATALOGUES if name != request.name else ():
            if names.key_of(root, name, table) is not None:
                different = _difference(read.version(root, table, request=name), request)
                if different:
                    what = f"lake {root} holds the universe of request {name}: its {table} have {different}"
                    raise BadInput(f"{what}: use another folder for request {request.name}")


def _difference(version: read.Version, request: Request) -> str:
    """What tells a catalogue's universe from the request's; empty where nothing does."""
    facts = {**_LATER[version.table], **version.manifest["facts"]}
    values, own = wanted(request), request.sources
    theirs = None if own is None else own.facts(request.area.bounds())
    if canonical(facts.get("sources")) != canonical(theirs):
        return "other sources than the request"
    # A catalogue that was not drawn by us has no depth.
    for key in ("seed", *(key for key in values if key in facts and key != "seed")):
        if canonical(facts.get(key)) != canonical(values[key]):
            return f"{key} {facts.get(key)}, the request {values[key]}"
    for key, files in _files(version.table, request) if own is None else ():
        if bool(files) != (key in facts):
            return f"{'no ' if files else ''}files of {key}, the request {'some' if files else 'none'}"
        if files and not _same(facts[key], files):
            return f"other files of {key} than the request"
    return ""


def _files(table: str, request: Request) -> Iterator[tuple[str, Sequence[Path]]]:
    """What a catalogue's facts call files, and those that the request names."""
    own = request.ingest
    yield "dust", (own.dust.file,) if own.dust else ()
    if table == "stars":
        yield "tycho2", request.stars.tycho2
        yield "catalogue", (request.stars.catalogue,) if request.stars.catalogue else ()
        return
    yield "ingest", own.galaxies.files if own.galaxies else ()
    if own.galaxies is None:
        yield "halos", own.halos.files if own.halos else ()
        yield "training", own.training.files if own.training else ()


def _same(facts: Json, files: Sequence[Path]) -> bool:
    """Are they the files that the facts have the sha256 of?  Those that have been moved away cannot be compared."""
    if not all(path.exists() for path in files):
        return True
    sums = facts["sha256"]
    there = {sums} if isinstance(sums, str) else set(sums)
    # A folder may hold other tables as well, and a file may have been read with another beside it.
    every = (file for path in files for file in (external_rows.files(path) if path.is_dir() else [path]))
    here = {file_sha256(file) for file in every}
    return here <= there or there <= here
