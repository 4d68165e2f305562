"""Check the galaxies and stars of a request, and the user's files that it names, before a job computes anything."""

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


def check_request(request: Request) -> None:
    """Check the settings of the galaxies and stars of a request, and the user's files that it names.

    Raises BadInput if a passband is unknown, a file is missing or has wrong columns or values, or an area has too many
    stars. The message names the key of the request, or the file and its column or row. A catalogue of
    galaxies, halos or training galaxies is checked here only by the first rows of its first file; the job that uses it
    reads all rows.
    """
    user_inputs = request.ingest
    if user_inputs.dust is not None:
        dust_map.map_for_request(request.seed, user_inputs.dust)
    if request.sources is not None:
        given_sources.load(request.sources, request.area)
        return
    check_band(request)
    if user_inputs.galaxies is not None:
        _check_first_rows(
            user_inputs.galaxies.files,
            mapping.galaxy_columns(user_inputs.galaxies.format, dict(user_inputs.galaxies.columns)),
        )
    if user_inputs.halos is not None:
        _check_first_rows(user_inputs.halos.files, mapping.halo_columns(dict(user_inputs.halos.columns)))
    if user_inputs.training is not None:
        _check_first_rows(user_inputs.training.files, mapping.training_columns(dict(user_inputs.training.columns)))
    choice, limit = request.stars, request.universe.star_limit
    stars.expected_counts(request.area.cells(), star_model(limit, choice, star_files(choice)))


def check_band(request: Request) -> None:
    """Raise BadInput if galaxies are drawn and the band of their magnitude limit is not a built-in passband."""
    if request.ingest.galaxies is None and request.universe.galaxy_band not in passbands.names():
        band_names = ", ".join(passbands.names())
        raise BadInput(f"universe.galaxy_band = {request.universe.galaxy_band!r} is not one of {band_names}")


def _check_first_rows(files: Sequence[Path], columns: mapping.Columns) -> None:
    listed_files, _ = ingest.list_files(files, columns)
    # Reading the first rows checks the columns, the units and the values of these rows.
    next(mapping.read(listed_files[:1], columns), None)


def star_files(choice: Stars) -> dict[str, Any]:
    """Return checksums and settings that identify the contents of the user's star files, independent of their paths.

    The dict has the keys "tycho2" and "catalogue" for the files that the request names. Raises BadInput if a file does
    not exist, if a file of Tycho-2 has wrong values, or if the mapping to the catalogue's columns is incomplete. The
    contents of the catalogue are not checked here.
    """
    facts: dict[str, Any] = {}
    if choice.tycho2:
        checksums = bright_stars.sha256(choice.tycho2)
        bright = bright_stars.load(choice.tycho2, checksums)
        counts = {
            "records": bright.record_count,
            "without_color": bright.without_color,
            "left_out": bright.without_magnitude,
        }
        facts["tycho2"] = {"sha256": checksums, "brighter": bright.ra.size, **counts}
    if choice.catalogue:
        columns = dict(choice.columns)
        from_catalogue.check_columns(columns)
        file = user_files.check_file(choice.catalogue, from_catalogue.KIND, "stars.catalogue.file")
        facts["catalogue"] = {"sha256": file_sha256(file), "columns": columns}
    return facts


def star_model(limit: float, choice: Stars, files: Json) -> stars.StarModel:
    """Return the model from which the stars are drawn.

    Parameters
    ----------
    limit : float
        Faintest observed H magnitude (Vega).
    choice : Stars
        Section `stars` of the request.
    files : dict
        Checksums and settings of the user's files, from `star_files`.

    Returns
    -------
    stars.StarModel
        The model.
    """
    catalogue = bright = None
    if choice.catalogue:
        catalogue_facts = files["catalogue"]
        catalogue = from_catalogue.load(choice.catalogue, catalogue_facts["sha256"], catalogue_facts["columns"])
    if choice.tycho2:
        bright = bright_stars.load(choice.tycho2, files["tycho2"]["sha256"])
    brightest = -math.inf if choice.bright_limit is None else choice.bright_limit
    limits = limit, choice.plane_limit
    return stars.model(*limits, choice.density, choice.brown_dwarf_boost, catalogue, bright, brightest)
