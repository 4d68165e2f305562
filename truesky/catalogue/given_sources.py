"""Read the user's tables of stars and galaxies for a request that draws no sources, but lists every one.

A table is a CSV file with a line of column names. Sources have positions in the table, or are placed on a grid. A
column that is absent has its default value in GALAXIES or STARS. `mag` is an AB magnitude in the band of the request,
without magnification and without the Milky Way's extinction `a_v`. Galaxies have no emission lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import sky, units, user_files
from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical
from truesky.catalogue.external.ingest import Split
from truesky.catalogue.external.mapping import GALAXY_BOUNDS, Columns, Field
from truesky.catalogue.galaxies import from_catalogue, lensing
from truesky.catalogue.galaxies.from_catalogue import IngestModel
from truesky.catalogue.stars.from_catalogue import KEYS, StarCatalogue
from truesky.catalogue.stars.stars import nearest_template
from truesky.fluxes import integration, passbands
from truesky.fluxes.libraries import stellar, templates
from truesky.fluxes.sources import Stars
from truesky.request.area import Area
from truesky.request.files import SOURCES_KIND, UserSources
from truesky.request.schema import MAX_SHEAR

_POSITION = ("ra", "dec")
# Columns of the table of galaxies, and the default value of each column if it is absent; None if it is required. Units
# and frames are the same as in table `galaxies`.
GALAXIES: Mapping[str, float | None] = {
    "mag": None, "z_true": 0.2, "sed": 15.0, "ext_law": 0.0, "ebv": 0.0, "bulge_fraction": 0.0,
    "bulge_half_light_radius": 0.3, "disk_half_light_radius": 0.3, "bulge_sersic_index": 4.0, "bulge_axis_ratio": 1.0,
    "disk_axis_ratio": 1.0, "position_angle": 0.0, "kappa": 0.0, "gamma1": 0.0, "gamma2": 0.0, "a_v": 0.0,
    "stamp": -1.0,
}  # fmt: skip
STARS: Mapping[str, float | None] = {"mag": None, "teff": 5800.0, "a_v": 0.0}
_GALAXY_BOUNDS = {**GALAXY_BOUNDS, "sed": (0.0, 30.0), "stamp": (-1.0, GALAXY_BOUNDS["stamp"][1])}
# Columns whose values must be whole numbers.
_INTEGER_COLUMNS = ("ext_law", "stamp")
_STAR_BOUNDS = {**KEYS, "mag": GALAXY_BOUNDS["mag"]}
# Largest number of grid positions in the square around the area.
_MAX_GRID_POSITIONS = 4_000_000
# Dust map with A(V) = 0, for the function that makes the rows and requires a map. The map has no effect, because the
# user's table contains the extinction `a_v` of each galaxy.
_NO_DUST: Float32 = np.zeros(12, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class SourceColumns:
    """All galaxies and all stars of the user's tables, sorted by position.

    Attributes
    ----------
    galaxies, stars : mapping of str to array, shape (n,)
        Columns by name. `index` is the order-29 cell of the position, and `origin_id` the number of the row in the
        user's table, from 1. On a grid, a row can occur several times.
    """

    galaxies: Mapping[str, Array]
    stars: Mapping[str, Array]


def load(source_tables: UserSources, area: Area, planned: Json | None = None) -> SourceColumns:
    """Read and check the user's tables of stars and galaxies.

    Parameters
    ----------
    source_tables : UserSources
        Files of the tables, band of the magnitudes, and spacing of the grid if sources are placed on one.
    area : Area
        Area of the request. The order-8 cells that it touches must contain all sources.
    planned : dict, optional
        Checksums and settings of the tables when the job began, with which the files must still agree; None to skip
        this check.

    Returns
    -------
    SourceColumns
        The galaxies and stars.

    Raises
    ------
    BadInput
        If a file has changed since the job began, the band is unknown, a value is missing or out of range, a galaxy is
        near a caustic, or a source is outside the area. For values, the message names the file, the column and the row.
    """
    if planned is not None and canonical(source_tables.facts(area.bounding_circle())) != canonical(planned):
        raise BadInput("sources: a table has changed since the job began")
    if source_tables.band not in passbands.names():
        raise BadInput(f"sources.band = {source_tables.band!r} is not one of {', '.join(passbands.names())}")
    position_columns = () if source_tables.spacing else _POSITION
    tables = {
        "galaxies": _read(source_tables.galaxies, {**dict.fromkeys(position_columns), **GALAXIES}, _GALAXY_BOUNDS),
        "stars": _read(source_tables.stars, {**dict.fromkeys(position_columns), **STARS}, _STAR_BOUNDS),
    }
    if source_tables.spacing:
        tables = _on_grid(tables, area, source_tables.spacing)
    _refuse_caustics(source_tables.galaxies, tables["galaxies"])
    for file, values in zip((source_tables.galaxies, source_tables.stars), tables.values(), strict=True):
        values["ra"] = sky.wrap_angle(values["ra"])
        cell = sky.cell_at(values["ra"], values["dec"], GENERATION_ORDER)
        outside = ~np.isin(cell, area.cells(GENERATION_ORDER))
        if outside.any():
            row = values["origin_id"][outside.argmax()]
            raise BadInput(f"{file}: ra, dec of row {row} must be in the request's area")
        values["index"] = sky.healpix_29(values["ra"], values["dec"])
    return SourceColumns(*(_sort_by_cell(values) for values in tables.values()))


def model(
    seed: int, source_tables: UserSources, sources: SourceColumns, lens: lensing.Shear | None, rotation: float
) -> IngestModel:
    """Return the model from which properties that the table of galaxies does not contain are drawn.

    Parameters
    ----------
    seed : int
        Seed of the random numbers.
    source_tables : UserSources
        Settings of the user's tables, of which the band of the magnitudes is used.
    sources : SourceColumns
        The galaxies and stars, from `load`.
    lens : lensing.Shear or None
        Uniform shear that replaces the lensing of the rows; None to use the lensing of the rows.
    rotation : float
        Angle that is added to the position angle of each galaxy before lensing, deg.

    Returns
    -------
    IngestModel
        The model.
    """
    columns = Columns({"mag": Field(column="mag")}, GALAXY_BOUNDS, band=source_tables.band)
    maxima = [float(sources.galaxies[name].max(initial=0.0)) for name in ("z_true", "ebv")]
    return from_catalogue.model(seed, columns, Split(Path(), {}, 0, *maxima), lens, rotation)


def galaxies(cell: int, sources: SourceColumns, universe: IngestModel) -> pa.Table:
    """Return the rows of table `galaxies` in one generation cell (HEALPix cell of order 8).

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    sources : SourceColumns
        The galaxies and stars, from `load`.
    universe : IngestModel
        The model, from `model`.

    Returns
    -------
    Table
        Rows of table `galaxies`, sorted by position; empty if the cell has no galaxies.
    """
    first, last = np.searchsorted(sources.galaxies["index"], sky.cell_range(GENERATION_ORDER, cell))
    rows = {name: values[first:last] for name, values in sources.galaxies.items()}
    return from_catalogue.draw(cell, {**rows, "flux_halpha": np.full(last - first, np.nan)}, universe, _NO_DUST)


def stars(sources: SourceColumns, band: str) -> StarCatalogue:
    """Return the stars of the user's table as a catalogue with H magnitudes (Vega).

    H follows from the magnitude in `band` (AB) and the template spectrum with the nearest temperature.
    """
    library, values = templates.stellar_library(), dict(sources.stars)
    temperatures = stellar.types().teff
    zeros = np.zeros(temperatures.size)
    rows = Stars.from_templates(np.arange(zeros.size), zeros, zeros)
    ab = units.mag_of_f_nu(integration.star_fluxes(rows, [passbands.load(band)], library)[:, 0])
    values["mag_h"] = values.pop("mag") - ab[nearest_template(temperatures, values["teff"])]
    return StarCatalogue(values.pop("index"), values)


def _read(
    file: Path | None, defaults: Mapping[str, float | None], bounds: Mapping[str, tuple[float, float]]
) -> dict[str, Array]:
    """Read a CSV table, and return its columns by name, with default values for absent columns.

    If `file` is None, all columns are empty. Raises BadInput if a column is unknown or a required one is missing, if
    there are no rows, or if a value is out of `bounds` or not a whole number where it must be one.
    """
    if file is None:
        return {name: np.zeros(0) for name in defaults} | {"origin_id": np.zeros(0, np.int64)}
    titles = external_rows.csv_column_names(file, SOURCES_KIND)
    for title in titles:
        if title not in defaults:
            raise BadInput(
                f"{user_files.format_path(file)}: unknown column {title}, must be one of {', '.join(defaults)}"
            )
    for name, value in defaults.items():
        if value is None and name not in titles:
            raise BadInput(f"{user_files.format_path(file)}: column {name} is missing")
    pieces = list(external_rows.read_batches(file, titles, kind=SOURCES_KIND))
    columns = {title: np.concatenate([np.zeros(0), *(piece.columns[title] for piece in pieces)]) for title in titles}
    n = len(columns["mag"])
    if n == 0:
        raise BadInput(f"{user_files.format_path(file)}: the table has no rows")
    for title, values in columns.items():
        external_rows.check_bounds(file, title, values, bounds[title])
    for title in _INTEGER_COLUMNS:
        if (not_whole := columns.get(title, np.zeros(n)) % 1.0 != 0.0).any():
            raise BadInput(
                f"{user_files.format_path(file)}: {title} of row {not_whole.argmax() + 1} is not a whole number"
            )
    columns |= {name: np.full(n, value) for name, value in defaults.items() if name not in columns}
    columns |= {name: columns[name].astype(np.int64) for name in _INTEGER_COLUMNS if name in columns}
    return columns | {"origin_id": np.arange(1, n + 1)}


def _refuse_caustics(file: Path | None, values: Mapping[str, Array]) -> None:
    """Raise BadInput if a galaxy is near a lensing caustic, because its image would not be an ellipse there.

    BadInput is also raised if a reduced shear |gamma / (1 - kappa)| is larger than `MAX_SHEAR`.
    """
    kappa, gamma1, gamma2 = (values[name] for name in ("kappa", "gamma1", "gamma2"))
    bad = lensing.is_near_caustic(kappa, gamma1, gamma2, lensing.settings().caustic)
    bad |= np.hypot(gamma1, gamma2) > MAX_SHEAR * np.abs(1.0 - kappa)
    if bad.any():
        row, column_names = values["origin_id"][bad.argmax()], "kappa, gamma1, gamma2"
        raise BadInput(
            f"{file}: {column_names} of row {row} are near a caustic: images are ellipses up to |g| = {MAX_SHEAR}"
        )


def _on_grid(tables: Mapping[str, dict[str, Array]], area: Area, spacing: float) -> dict[str, dict[str, Array]]:
    """Place the rows of all tables, one after another, on the positions of a grid.

    The rows are repeated until every position has a source. Each returned table has the additional columns ra and dec
    (deg).
    """
    ra, dec = _grid(area, spacing)
    first_rows = np.cumsum([0, *(len(values["mag"]) for values in tables.values())])
    row_number = np.arange(ra.size) % first_rows[-1]
    out = {}
    for (name, values), first, last in zip(tables.items(), first_rows[:-1], first_rows[1:], strict=True):
        selected = np.flatnonzero((row_number >= first) & (row_number < last))
        rows = {key: column[row_number[selected] - first] for key, column in values.items()}
        out[name] = {**rows, "ra": ra[selected], "dec": dec[selected]}
    return out


def _grid(area: Area, spacing: float) -> tuple[Float, Float]:
    """Return the positions (ra, dec, deg) of a square grid in an area, with `spacing` arcsec between neighbours.

    The positions are sorted from south to north, then from west to east. Raises BadInput if the square around the area
    has more than `_MAX_GRID_POSITIONS` positions, or if no position is in the area.
    """
    ra, dec, radius = area.bounding_circle()
    half = int(radius * 3600.0 / spacing)
    if (2 * half + 1) ** 2 > _MAX_GRID_POSITIONS:
        raise BadInput(
            f"sources.spacing = {spacing:g}: the grid around the area must have at most {_MAX_GRID_POSITIONS} positions"
        )
    steps = np.radians(np.arange(-half, half + 1) * spacing / 3600.0)
    north, east = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    places = lensing.displace(np.full(east.size, ra), np.full(east.size, dec), east, north)
    inside = area.contains(*places)
    if not inside.any():
        raise BadInput("sources: no position of the grid is in the area")
    return places[0][inside], places[1][inside]


def _sort_by_cell(values: Mapping[str, Array]) -> dict[str, Array]:
    order: Int = np.lexsort((values["origin_id"], values["index"]))
    return {name: column[order] for name, column in values.items()}
