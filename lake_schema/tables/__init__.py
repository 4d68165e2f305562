"""Declarations of the tables of a lake: their columns with types, units, ranges and meanings."""

from __future__ import annotations

from collections.abc import Sequence

from lake_schema.columns import Table


def all_tables(bands: Sequence[str], variables: bool = False) -> list[Table]:
    """Return the declarations of all tables of a lake.

    `bands` are the names of the passbands for which the tables of fluxes have a column. With `variables`, the tables
    `stars` and `gaia` have the columns of variable stars.
    """
    from lake_schema.tables.exposures import EXPOSURES
    from lake_schema.tables.fluxes import fluxes
    from lake_schema.tables.gaia import GAIA, with_variable_flag
    from lake_schema.tables.galaxies import EMISSION_LINES, GALAXIES
    from lake_schema.tables.halos import HALO_LIMITS, HALOS
    from lake_schema.tables.mission import MISSION
    from lake_schema.tables.passbands import PASSBANDS
    from lake_schema.tables.products import EXPOSURE_FILES, PRODUCTS
    from lake_schema.tables.quarantine import QUARANTINE
    from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
    from lake_schema.tables.stars import stars as star_table
    from lake_schema.tables.strong_lenses import STRONG_LENSES
    from lake_schema.tables.survey.depth import DEPTH
    from lake_schema.tables.survey.measured_frames import MEASURED_FRAMES
    from lake_schema.tables.survey.observed import observed_sources
    from lake_schema.tables.survey.randoms import RANDOMS
    from lake_schema.tables.tasks import TASKS
    from lake_schema.tables.templates import EXTINCTION_LAWS, TEMPLATES
    from lake_schema.tables.validation import VALIDATION
    from lake_schema.tables.variability.active_nuclei import ACTIVE_NUCLEI
    from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
    from lake_schema.tables.variability.light_curves import LIGHT_CURVES
    from lake_schema.tables.variability.transients import TRANSIENTS

    galaxies, stars = (fluxes(kind, bands) for kind in ("galaxy", "star"))
    gaia = with_variable_flag(GAIA) if variables else GAIA
    skies = [HALOS, GALAXIES, QUARANTINE, STRONG_LENSES, ACTIVE_NUCLEI, TRANSIENTS, LENSED_IMAGES]
    skies += [star_table(variables), galaxies, stars, gaia, observed_sources(bands), RANDOMS]
    plans, images = [MISSION, EXPOSURES, TASKS], [PRODUCTS, RENDERED_TRUTH, RENDERED_SPECTRA, EXPOSURE_FILES]
    return [
        *skies,
        HALO_LIMITS,
        TEMPLATES,
        EXTINCTION_LAWS,
        EMISSION_LINES,
        PASSBANDS,
        *plans,
        *images,
        DEPTH,
        MEASURED_FRAMES,
        LIGHT_CURVES,
        VALIDATION,
    ]


def to_markdown() -> str:
    """Return a page in Markdown that documents all tables and columns; "<band>" stands for the name of a passband."""
    head = "# Tables of the lake\n\nWritten by `truesky tables`; do not edit.\n"
    return "\n".join([head, *(table.to_markdown() for table in all_tables(["<band>"], variables=True))])


def find_table(name: str, columns: Sequence[str] = ()) -> Table | None:
    """Return the declaration of a table, or None if there is no such table.

    Parameters
    ----------
    name : str
        Name of the table.
    columns : sequence of str, optional
        Names of the columns that the table has in a lake. They are needed for the tables of fluxes and the table
        `observed`, whose columns f_nu_<band> and detected_<band> differ between lakes, and for `stars` and `gaia`,
        which may have columns of variable stars.

    Returns
    -------
    Table or None
        The declaration.
    """
    prefixes = ("f_nu_", "detected_")
    bands = [column.removeprefix(prefix) for prefix in prefixes for column in columns if column.startswith(prefix)]
    variables = not {"variability", "phot_variable_flag"}.isdisjoint(columns)
    return next((table for table in all_tables(bands, variables) if table.name == name), None)
