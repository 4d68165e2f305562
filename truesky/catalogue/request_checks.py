"""What the catalogues' jobs would refuse of a request, before any of them computes anything.

refuse         whatever is wrong with the files, bands and places of the galaxies and stars that a request wants
star_files     what the files of stars hold, as facts of a plan
star_model     what a request's stars are drawn from
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store.plan import Json
from lake_schema.store.provenance import file_sha256
from truesky.catalogue import dust_map, given_sources
from truesky.catalogue.external import ingest, mapping
from truesky.catalogue.stars import bright_stars, from_catalogue, stars
from truesky.fluxes import passbands
from truesky.request.schema import Request, Stars


def refuse(request: Request) -> None:
    """BadInput names the key, or the file and its column or row.

    Of a large catalogue the first rows are read; the job that splits it into cells reads all of them.
    """
    own = request.ingest
    if own.dust is not None:
        dust_map.chosen(request.seed, own.dust)
    if request.sources is not None:
        given_sources.load(request.sources, request.area)
        return
    check_band(request)
    if own.galaxies is not None:
        _looked_at(own.galaxies.files, mapping.galaxies(own.galaxies.format, dict(own.galaxies.columns)))
    if own.halos is not None:
        _looked_at(own.halos.files, mapping.halos(dict(own.halos.columns)))
    if own.training is not None:
        _looked_at(own.training.files, mapping.training(dict(own.training.columns)))
    choice, limit = request.stars, request.universe.star_limit
    stars.numbers(request.area.cells(), star_model(limit, choice, star_files(choice)))


def check_band(request: Request) -> None:
    """The band of the faintest galaxies must be one of the embedded ones."""
    if request.ingest.galaxies is None and request.universe.galaxy_band not in passbands.names():
        known = ", ".join(passbands.names())
        raise BadInput(f"universe.galaxy_band = {request.universe.galaxy_band!r} is not one of {known}")


def _looked_at(files: Sequence[Path], columns: mapping.Columns) -> None:
    found, _ = ingest.listed(files, columns)
    # Columns, units and the values of the first rows.
    next(mapping.read(found[:1], columns), None)


def star_files(choice: Stars) -> dict[str, Any]:
    """What the user's files hold, wherever they lie."""
    facts: dict[str, Any] = {}
    if choice.tycho2:
        sums = bright_stars.sha256(choice.tycho2)
        read = bright_stars.load(choice.tycho2, sums)
        counts = {"records": read.read, "without_color": read.without_color, "left_out": read.without_magnitude}
        facts["tycho2"] = {"sha256": sums, "brighter": read.ra.size, **counts}
    if choice.catalogue:
        columns = dict(choice.columns)
        from_catalogue.checked_columns(columns)
        file = user_files.checked(choice.catalogue, from_catalogue.KIND, "stars.catalogue.file")
        facts["catalogue"] = {"sha256": file_sha256(file), "columns": columns}
    return facts


def star_model(limit: float, choice: Stars, files: Json) -> stars.StarModel:
    """What stars are drawn from.

    limit : faintest H (Vega);  files : as of `star_files`, whose contents the files must still have
    """
    catalogue = bright = None
    if choice.catalogue:
        given = files["catalogue"]
        catalogue = from_catalogue.load(choice.catalogue, given["sha256"], given["columns"])
    if choice.tycho2:
        bright = bright_stars.load(choice.tycho2, files["tycho2"]["sha256"])
    brightest = -math.inf if choice.bright_limit is None else choice.bright_limit
    limits = limit, choice.plane_limit
    return stars.model(*limits, choice.density, choice.brown_dwarf_boost, catalogue, bright, brightest)
