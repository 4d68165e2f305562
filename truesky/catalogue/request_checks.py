"""Check the galaxies and stars of a request, and the user's files that it names, before a job computes anything."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from lake_schema import ids, user_files
from lake_schema.errors import BadInput, Mistakes
from lake_schema.external import rows as external_rows
from lake_schema.store.plan import Json
from lake_schema.store.provenance import file_sha256
from truesky.catalogue import dust_map, given_sources, parameters
from truesky.catalogue.external import ingest, mapping
from truesky.catalogue.halos import matching
from truesky.catalogue.matter import boltzmann, density_box
from truesky.catalogue.stars import bright_stars, from_catalogue, stars
from truesky.cosmology import Cosmology
from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.request.files import SOURCES_KIND, Catalogue
from truesky.request.schema import Request, Stars
from truesky.request.toml_values import refuse_name
from truesky.variability import spectral_series

# Largest boost of quasars with which halos have one quasar at most, rounded down.
_MAX_QUASAR_BOOST = 6.0


def check_request(request: Request) -> None:
    """Check the settings of the galaxies and stars of a request, and the user's files that it names.

    Every row of a user's file is checked. The result is stored in the disc cache, so that a second check of the same
    files only computes their checksums. A catalogue of galaxies is also stored there by sky cell, for the job that uses
    it. Files of any size are read in batches.

    Raises BadInput if a passband is unknown, a file is missing or has wrong columns or values, or an area has too many
    stars. There is one message for each mistake, which names the key of the request, or the file, its column and row.
    """
    with Mistakes() as mistakes:
        for check in (
            _check_cosmology,
            _check_dust,
            _check_sources,
            _check_galaxies,
            _check_halos,
            _check_training,
            _check_stars,
            _check_variables,
            check_transients,
        ):
            mistakes.read(check, request)


def _check_cosmology(request: Request) -> None:
    if request.sources is None and request.ingest.galaxies is None:
        check_cosmology(request.universe.cosmology)


def check_cosmology(cosmology: Cosmology) -> None:
    """Raise BadInput if galaxies cannot be drawn in this cosmology.

    The universe may be so large that its steps in distance have no identifiers, or the package CAMB may be missing.
    """
    law, cell = parameters.section("halos.toml", "mass_function"), density_box.box_model(cosmology).cell
    # There are two more steps than the distance has cells: around its end, and at the start.
    largest = (ids.BLOCK_COUNT // round((law["highest"] - law["lowest"]) / law["bin"]) - 2) * cell
    distance = float(cosmology.comoving_distance(matching.Z_LAST))
    if distance > largest:
        problem = f"the distance to z = {matching.Z_LAST:g} is {distance:.0f} Mpc/h, at most {largest:.0f} is possible"
        raise BadInput(f"universe.cosmology: {problem}: increase omega_m, w0 or wa")
    boltzmann.camb_version(cosmology)


def _check_variables(request: Request) -> None:
    """Raise BadInput if quasars would be too many for the halos in which variable ones are."""
    boost = request.universe.quasar_boost
    if request.universe.variables and request.ingest.galaxies is None and boost > _MAX_QUASAR_BOOST:
        limit = f"must be at most {_MAX_QUASAR_BOOST:g} with universe.variables"
        raise BadInput(f"universe.quasar_boost = {boost:g} {limit}, so that no halo has two quasars")


def check_transients(request: Request) -> None:
    """Raise BadInput if a request has transients and no galaxies in which they explode, or a wrong file of spectra."""
    if request.transients is None:
        return
    if request.sources is not None:
        raise BadInput(
            "universe.transients: galaxies from the tables of [sources] have no stellar masses, so none explodes"
        )
    if (path := request.transients.light_curves) is not None:
        user_files.check_file(path, "spectral series", "universe.transients.light_curves")
        spectral_series.read(path)


def _check_dust(request: Request) -> None:
    if request.ingest.dust is not None:
        dust_map.map_for_request(request.seed, request.ingest.dust)


def _check_sources(request: Request) -> None:
    if request.sources is not None:
        with Mistakes() as mistakes:
            for name, file in (("galaxies", request.sources.galaxies), ("stars", request.sources.stars)):
                if file is not None:
                    mistakes.read(user_files.check_file, file, SOURCES_KIND, f"sources.{name}")
        given_sources.load(request.sources, request.area, request.universe.cosmology)


def _check_galaxies(request: Request) -> None:
    if request.sources is None:
        check_band(request)
    if (catalogue := request.ingest.galaxies) is not None:
        settings = request.universe.lensing is not None, request.universe.cosmology
        columns = _with_existing_files(
            "ingest.galaxies", catalogue, lambda: ingest.galaxy_columns(catalogue, *settings)
        )
        files, sha256 = ingest.files_with_checksums(catalogue.files, columns)
        split = ingest.split_by_cell(files, sha256, columns)
        ingest.check_area(split, files, columns, request.area)


def _check_halos(request: Request) -> None:
    if (catalogue := request.ingest.halos) is not None:
        entries, cosmology = dict(catalogue.columns), request.universe.cosmology
        columns = _with_existing_files("ingest.halos", catalogue, lambda: mapping.halo_columns(entries, cosmology))
        ingest.check_rows(*ingest.files_with_checksums(catalogue.files, columns), columns, request.area)


def _check_training(request: Request) -> None:
    if (catalogue := request.ingest.training) is not None:
        entries, cosmology = dict(catalogue.columns), request.universe.cosmology
        columns = _with_existing_files(
            "ingest.training", catalogue, lambda: mapping.training_columns(entries, cosmology)
        )
        columns = mapping.with_last_template(columns, templates.galaxy_library().flux.shape[0] - 1)
        ingest.check_rows(*ingest.files_with_checksums(catalogue.files, columns), columns)


def _with_existing_files(
    section: str, catalogue: Catalogue, make_columns: Callable[[], mapping.Columns]
) -> mapping.Columns:
    """Return the mapping of a catalogue; raise BadInput for mistakes in it and for files that do not exist.

    `section` is the section of the request that names the files.
    """
    with Mistakes() as mistakes:
        for path in catalogue.files:
            try:
                external_rows.find_files(path)
            except BadInput as error:
                mistakes.add(error.with_prefix(f"{section}.files"))
        columns = mistakes.read(make_columns)
    return columns


def _check_stars(request: Request) -> None:
    if request.sources is not None:
        return
    choice, limit = request.stars, request.universe.star_limit
    model = star_model(limit, choice, star_files(choice))
    try:
        stars.expected_counts(request.area.cells(), model)
    except BadInput as error:
        raise error.with_prefix("area") from None


def check_band(request: Request) -> None:
    """Raise BadInput if galaxies are drawn and the band of their magnitude limit is not a built-in passband."""
    if request.ingest.galaxies is None and request.universe.galaxy_band not in passbands.names():
        raise BadInput(f"universe.galaxy_band = {refuse_name(request.universe.galaxy_band, passbands.names())}")


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
