"""Compare the universe of a request with the catalogues in a lake (the folder of all tables of a simulation).

A request is a user's TOML file. Its universe is given by the seed, the depth and the other values of its sections
`universe` and `stars`, and the files that replace parts of it.
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
from lake_schema.store import read, request_links
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical, file_sha256
from truesky.cosmology import UNNAMED
from truesky.request.files import Catalogue
from truesky.request.schema import Request

CATALOGUES = ("galaxies", "stars")
# File with the formats of user catalogues. In some formats, the columns are split between two files.
_FORMATS = Path(__file__).parents[1] / "catalogue" / "external" / "ingest_formats.toml"
# Keys of the section `stars` that name files or set how rows are written. They are not compared as values.
_FILE_KEYS = {"tycho2", "catalogue", "columns", "rows_a_file"}


def requested_values(request: Request) -> dict[str, Any]:
    """Return the seed and the values of the sections `universe` and `stars` by name, without names of files."""
    values = request.facts("universe", "stars")
    star_values = {key: value for key, value in values["stars"].items() if key not in _FILE_KEYS}
    return {"seed": request.seed, **values["universe"], **star_values}


def check_catalogues(catalogues: Iterable[read.Version], request: Request) -> None:
    """Raise BadInput if a catalogue in a lake was made from another universe than that of the request.

    The message names the first catalogue and the first value that differ.
    """
    for version in catalogues:
        if different := _difference(version, request):
            remedy = "run truesky build first, then truesky fluxes"
            raise BadInput(f"table {version.table} has {different}: {remedy}")


def check_lake(root: Path, request: Request) -> None:
    """Check that the catalogues of other requests in a lake were made from the universe of this request.

    All requests of a lake must have the same universe. A request may change the universe if it is the only one in the
    lake, since its previous catalogues are not compared. A lake that does not exist is accepted.

    Raises
    ------
    BadInput
        If the catalogues of another request were made from a different universe. The message names the difference.
    """
    for name in request_links.request_names(root):
        for table in CATALOGUES if name != request.name else ():
            if request_links.linked_key(root, name, table) is not None:
                different = _difference(read.version(root, table, request=name), request)
                if different:
                    problem = f"lake {root} holds the universe of request {name}: its {table} have {different}"
                    raise BadInput(f"{problem}: use another folder for request {request.name}")


def _difference(version: read.Version, request: Request) -> str:
    """Describe the first difference between the universe of a catalogue and that of the request; "" if they agree."""
    facts = version.manifest["facts"]
    values, sources = requested_values(request), request.sources
    source_facts = None if sources is None else sources.facts(request.area.bounding_circle())
    if canonical(facts.get("sources")) != canonical(source_facts):
        return "other sources than the request"
    # Compare only values that the manifest (JSON description) of the catalogue contains. For a user's catalogue, for
    # example, the manifest has no limiting magnitude. Galaxies without a cosmology have the only one when they were
    # made, and drawn ones had no structure below the cells of the box then. Drawn stars without this fact are constant.
    if version.table == "galaxies":
        facts = {"cosmology": asdict(UNNAMED), **facts}
    if "box_cells" in facts:
        facts = {"structure_below_cells": False, **facts}
    # Tables without this key have constant stars, no narrow lines of active nuclei, and random positions of quasars.
    is_drawn = "box_cells" in facts or (version.table == "stars" and "star_limit" in facts)
    if is_drawn and bool(facts.get("variables")) is not request.universe.variables:
        return f"variables {bool(facts.get('variables'))}, the request {request.universe.variables}"
    for key in ("seed", *(key for key in values if key in facts and key != "seed")):
        if key == "cosmology":
            if different := _different_parameter(facts[key], values[key], is_drawn="box_cells" in facts):
                return different
            continue
        if canonical(facts.get(key)) != canonical(values[key]):
            remedy = " (by default from area and accuracy: set universe.lensing_nside)" * (key == "lensing_nside")
            return f"{key} {facts.get(key)}, the request {values[key]}{remedy}"
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


def _different_parameter(recorded: Mapping[str, Any], requested: Mapping[str, Any], is_drawn: bool) -> str:
    """Describe the first parameter of two cosmologies that differs; "" if they are equal.

    A user's galaxies, for which `is_drawn` is False, do not depend on the power spectrum.
    """
    for name, value in requested.items():
        if recorded.get(name) != value and (is_drawn or name != "power"):
            return f"the cosmology {name} = {recorded.get(name)}, the request {name} = {value}"
    return ""


@dataclass(frozen=True, slots=True)
class _NamedFiles:
    """Files of a user that replace a part of the universe, such as a catalogue.

    Attributes
    ----------
    files : sequence of Path
        Files and folders.
    options : mapping of str to object
        Options with which the files are read, such as their format and columns.
    pair_prefixes : sequence of str
        Beginnings of the names of both files of a pair, if the columns are split between two files; otherwise empty.
    """

    files: Sequence[Path]
    options: Mapping[str, Any] = field(default_factory=dict)
    pair_prefixes: Sequence[str] = ()


def _named_files(table: str, request: Request) -> Iterator[tuple[str, _NamedFiles | None]]:
    """Yield pairs (kind of user files that may replace parts of a catalogue, files of this kind in the request).

    The kind, such as "dust", is a key in the manifest (JSON description) of the catalogue. `table` is "galaxies" or
    "stars". The files are None if the request names none.
    """
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
    """Return True if the user's files have the checksums `facts["sha256"]`, which were recorded with a catalogue.

    Return True as well if a file no longer exists, because it cannot be compared.
    """
    if not all(path.exists() for path in named.files):
        return True
    all_files = [file for path in named.files for file in (external_rows.find_files(path) if path.is_dir() else [path])]
    if named.pair_prefixes:
        # Use only the pairs of files, because their folder may contain other tables.
        first, second = named.pair_prefixes
        all_files = [file for file in all_files if file.name.startswith(first) and not file.name.startswith(second)]
        all_files += [file.with_name(second + file.name.removeprefix(first)) for file in all_files]
    checksums = facts["sha256"]
    recorded = [checksums] if isinstance(checksums, str) else checksums
    return sorted(recorded) == sorted(file_sha256(file) for file in all_files if file.exists())
