"""The universe that a request asks for, and whether a catalogue is of it: seed, depth, and whatever else shapes it.

wanted          what a request says of its universe
refuse_other    a catalogue of another universe than the request's
refuse_others   a request of another universe than that of the requests which a lake holds already
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.store import names, read
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, file_sha256
from truesky.request.files import Catalogue
from truesky.request.schema import Request

CATALOGUES = ("galaxies", "stars")
# What the formats of external catalogues are; some are of two files each.
_FORMATS = Path(__file__).parents[1] / "catalogue" / "external" / "ingest_formats.toml"
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
    facts = version.manifest["facts"]
    values, own = wanted(request), request.sources
    theirs = None if own is None else own.facts(request.area.bounds())
    if canonical(facts.get("sources")) != canonical(theirs):
        return "other sources than the request"
    # A catalogue that was not drawn by us has no depth.
    for key in ("seed", *(key for key in values if key in facts and key != "seed")):
        if canonical(facts.get(key)) != canonical(values[key]):
            return f"{key} {facts.get(key)}, the request {values[key]}"
    for key, given in _given(version.table, request) if own is None else ():
        if (given is None) is (key in facts):
            return f"{'no ' if given else ''}files of {key}, the request {'some' if given else 'none'}"
        if given is not None:
            for name, value in given.about.items():
                if canonical(facts[key][name]) != canonical(value):
                    return f"{name} of {key} {facts[key][name] or 'none'}, the request {value or 'none'}"
            if not _same(facts[key], given):
                return f"other files of {key} than the request"
    return ""


@dataclass(frozen=True, slots=True)
class _Given:
    """Files that a request names; about : how they are read; beside : of the names of files that are read in pairs."""

    files: Sequence[Path]
    about: Mapping[str, Any] = field(default_factory=dict)
    beside: Sequence[str] = ()


def _given(table: str, request: Request) -> Iterator[tuple[str, _Given | None]]:
    """What a catalogue's facts call files, and those that the request names."""
    own, stars = request.ingest, request.stars
    dust = {} if own.dust is None else {name: value for name, value in asdict(own.dust).items() if name != "file"}
    yield "dust", _Given((own.dust.file,), dust) if own.dust else None
    if table == "stars":
        yield "tycho2", _Given(stars.tycho2) if stars.tycho2 else None
        yield "catalogue", _Given((stars.catalogue,), {"columns": dict(stars.columns)}) if stars.catalogue else None
        return
    yield "ingest", _catalogue(own.galaxies, format=True) if own.galaxies else None
    if own.galaxies is None:
        yield "halos", _catalogue(own.halos) if own.halos else None
        yield "training", _catalogue(own.training) if own.training else None


def _catalogue(given: Catalogue, format: bool = False) -> _Given:
    columns = dict(given.columns)
    about = {"format": given.format, "columns": columns} if format else {"columns": columns}
    known = user_files.toml_tables(_FORMATS.read_text(encoding="utf-8")).get(given.format, {})
    beside = json.loads(columns["beside"]) if "beside" in columns else known.get("beside", ())
    return _Given(given.files, about, beside)


def _same(facts: Json, given: _Given) -> bool:
    """Are they the files that the facts have the sha256 of?  Those that have been moved away cannot be compared."""
    if not all(path.exists() for path in given.files):
        return True
    every = [file for path in given.files for file in (external_rows.files(path) if path.is_dir() else [path])]
    if given.beside:
        # A folder of such pairs holds tables of other things as well.
        first, second = given.beside
        every = [file for file in every if file.name.startswith(first) and not file.name.startswith(second)]
        every += [file.with_name(second + file.name.removeprefix(first)) for file in every]
    sums = facts["sha256"]
    there = [sums] if isinstance(sums, str) else sums
    return sorted(there) == sorted(file_sha256(file) for file in every if file.exists())
