"""Compare the universe of a request (seed, depth and all else that shapes it) with catalogues and other requests."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.store import read, request_links
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, file_sha256
from truesky.request.files import Catalogue
from truesky.request.schema import Request

CATALOGUES = ("galaxies", "stars")
# Formats of external catalogues. Some formats have pairs of files.
_FORMATS = Path(__file__).parents[1] / "catalogue" / "external" / "ingest_formats.toml"
# Keys that name files or set how rows are written.
_FILE_KEYS = {"tycho2", "catalogue", "columns", "rows_a_file"}


def requested_values(request: Request) -> dict[str, Any]:
    """Return the seed and the values of the sections `universe` and `stars` by name, without files."""
    values = request.facts("universe", "stars")
    star_values = {key: value for key, value in values["stars"].items() if key not in _FILE_KEYS}
    return {"seed": request.seed, **values["universe"], **star_values}


def check_catalogues(catalogues: Iterable[read.Version], request: Request) -> None:
    """Check that every catalogue belongs to the universe of the request; raises BadInput at the first that does not."""
    for version in catalogues:
        if different := _difference(version, request):
            first = f"run build_{version.table} first, then compute_fluxes"
            raise BadInput(f"table {version.table} has {different}: {first}")


def check_lake(root: Path, request: Request) -> None:
    """Check that the other requests in a lake have the universe of this request.

    A lake contains one universe. A request may change the universe if it is the only one in the lake.

    Raises
    ------
    BadInput
        If the catalogues of another request differ.
    """
    for name in request_links.request_names(root):
        for table in CATALOGUES if name != request.name else ():
            if request_links.linked_key(root, name, table) is not None:
                different = _difference(read.version(root, table, request=name), request)
                if different:
                    problem = f"lake {root} holds the universe of request {name}: its {table} have {different}"
                    raise BadInput(f"{problem}: use another folder for request {request.name}")


def _difference(version: read.Version, request: Request) -> str:
    """Describe how the universe of a catalogue differs from that of the request; "" if they agree."""
    facts = version.manifest["facts"]
    values, sources = requested_values(request), request.sources
    source_facts = None if sources is None else sources.facts(request.area.bounding_circle())
    if canonical(facts.get("sources")) != canonical(source_facts):
        return "other sources than the request"
    # Facts of external catalogues do not contain the depth.
    for key in ("seed", *(key for key in values if key in facts and key != "seed")):
        if canonical(facts.get(key)) != canonical(values[key]):
            return f"{key} {facts.get(key)}, the request {values[key]}"
    for key, named in _named_files(version.table, request) if sources is None else ():
        if (named is None) is (key in facts):
            return f"{'no ' if named else ''}files of {key}, the request {'some' if named else 'none'}"
        if named is not None:
            for name, value in named.options.items():
                if canonical(facts[key][name]) != canonical(value):
                    return f"{name} of {key} {facts[key][name] or 'none'}, the request {value or 'none'}"
            if not _is_same(facts[key], named):
                return f"other files of {key} than the request"
    return ""


@dataclass(frozen=True, slots=True)
class _NamedFiles:
    """Files that a request names.

    Attributes
    ----------
    files : sequence of Path
        Files and folders.
    options : mapping of str
        Options with which the files are read.
    pair_prefixes : sequence of str
        Beginnings of the file names of a pair, if rows are split between two files.
    """

    files: Sequence[Path]
    options: Mapping[str, Any] = field(default_factory=dict)
    pair_prefixes: Sequence[str] = ()


def _named_files(table: str, request: Request) -> Iterator[tuple[str, _NamedFiles | None]]:
    """Yield each name under which a catalogue's facts record files, with the files of the request."""
    ingest, stars = request.ingest, request.stars
    dust = {} if ingest.dust is None else {name: value for name, value in asdict(ingest.dust).items() if name != "file"}
    yield "dust", _NamedFiles((ingest.dust.file,), dust) if ingest.dust else None
    if table == "stars":
        yield "tycho2", _NamedFiles(stars.tycho2) if stars.tycho2 else None
        yield (
            "catalogue",
            _NamedFiles((stars.catalogue,), {"columns": dict(stars.columns)}) if stars.catalogue else None,
        )
        return
    yield "ingest", _catalogue_files(ingest.galaxies, with_format=True) if ingest.galaxies else None
    if ingest.galaxies is None:
        yield "halos", _catalogue_files(ingest.halos) if ingest.halos else None
        yield "training", _catalogue_files(ingest.training) if ingest.training else None


def _catalogue_files(catalogue: Catalogue, with_format: bool = False) -> _NamedFiles:
    columns = dict(catalogue.columns)
    options = {"format": catalogue.format, "columns": columns} if with_format else {"columns": columns}
    format_entry = user_files.parse_toml(_FORMATS.read_text(encoding="utf-8")).get(catalogue.format, {})
    pair_prefixes = json.loads(columns["beside"]) if "beside" in columns else format_entry.get("beside", ())
    return _NamedFiles(catalogue.files, options, pair_prefixes)


def _is_same(facts: Json, named: _NamedFiles) -> bool:
    """Return True if the files have the recorded checksums, or if a file is missing and cannot be compared."""
    if not all(path.exists() for path in named.files):
        return True
    all_files = [file for path in named.files for file in (external_rows.find_files(path) if path.is_dir() else [path])]
    if named.pair_prefixes:
        # A folder with pairs of files may contain other tables.
        first, second = named.pair_prefixes
        all_files = [file for file in all_files if file.name.startswith(first) and not file.name.startswith(second)]
        all_files += [file.with_name(second + file.name.removeprefix(first)) for file in all_files]
    checksums = facts["sha256"]
    recorded = [checksums] if isinstance(checksums, str) else checksums
    return sorted(recorded) == sorted(file_sha256(file) for file in all_files if file.exists())
