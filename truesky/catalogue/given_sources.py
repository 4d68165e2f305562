"""Read the user's tables of stars and galaxies for a request that draws no sources, but lists every one.

A table is a Parquet, FITS, CSV or HDF5 file. Its columns have the names of the properties, or the request maps them.
Sources have positions in the table, or are placed on a grid. A property without a column has its default value in
GALAXIES or STARS. `mag` is an AB magnitude in the band of the request, without magnification and without the Milky
Way's extinction `a_v`. Galaxies have no emission lines.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import sky, units
from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.errors import BadInput, Mistakes, refuse_mistakes
from lake_schema.external import rows as external_rows
from lake_schema.external.mistakes import TableMistakes
from lake_schema.external.rows import RowBatch
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical
from lake_schema.texts import spelling, synonyms
from truesky.catalogue.external import ingest, mapping, reading
from truesky.catalogue.external.ingest import Split
from truesky.catalogue.external.mapping import GALAXY_BOUNDS, Columns, Field
from truesky.catalogue.galaxies import band_ratios, from_catalogue, lensing
from truesky.catalogue.galaxies.from_catalogue import IngestModel
from truesky.catalogue.stars.from_catalogue import KEYS, StarCatalogue
from truesky.catalogue.stars.stars import nearest_template
from truesky.cosmology import Cosmology
from truesky.fluxes import integration, passbands
from truesky.fluxes.libraries import stellar, templates
from truesky.fluxes.sources import Stars
from truesky.request.area import Area
from truesky.request.files import SOURCES_KIND, UserSources
from truesky.request.schema import MAX_SHEAR
from truesky.request.toml_values import refuse_name

_POSITION = ("ra", "dec")
# Properties of galaxies, and the default value of each one without a column; None if it is required. Units and frames
# are the same as in table `galaxies`.
GALAXIES: Mapping[str, float | None] = {
    "mag": None, "z_true": 0.2, "sed": 15.0, "ext_law": 0.0, "ebv": 0.0, "bulge_fraction": 0.0,
    "bulge_half_light_radius": 0.3, "disk_half_light_radius": 0.3, "bulge_sersic_index": 4.0, "bulge_axis_ratio": 1.0,
    "disk_axis_ratio": 1.0, "position_angle": 0.0, "kappa": 0.0, "gamma1": 0.0, "gamma2": 0.0, "a_v": 0.0,
    "stamp": -1.0,
}  # fmt: skip
STARS: Mapping[str, float | None] = {"mag": None, "teff": 5800.0, "a_v": 0.0}
# Lowest and highest valid value of each property. The last four are properties of a whole galaxy, which replace those
# of its bulge and disc.
GIVEN_GALAXY_BOUNDS = {
    **{name: GALAXY_BOUNDS[name] for name in (*_POSITION, *GALAXIES, "axis_ratio", "half_light_radius", "e1", "e2")},
    "sed": (0.0, 30.0),
}
GIVEN_STAR_BOUNDS = {**{name: KEYS[name] for name in (*_POSITION, "teff", "a_v")}, "mag": GALAXY_BOUNDS["mag"]}
# Words that describe a mapping, for error messages: a property and the name of its column.
_MAPPING = 'all columns with {{ file = "..", columns = {{ {} = "{}", .. }} }}'
# Settings of the columns of galaxies.
_SETTINGS = ("ellipticity", "frame")
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


def load(source_tables: UserSources, area: Area, cosmology: Cosmology, planned: Json | None = None) -> SourceColumns:
    """Read and check the user's tables of stars and galaxies.

    Parameters
    ----------
    source_tables : UserSources
        Files of the tables, band of the magnitudes, and spacing of the grid if sources are placed on one.
    area : Area
        Area of the request. The order-8 cells that it touches must contain all sources.
    cosmology : Cosmology
        Parameters of the universe.
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
    messages: list[str] = []
    if source_tables.band not in passbands.names():
        messages.append(f"sources.band = {refuse_name(source_tables.band, passbands.names())}")
    tables = {}
    for name, file in (("galaxies", source_tables.galaxies), ("stars", source_tables.stars)):
        try:
            tables[name] = _read(file, name, source_tables, cosmology, None if messages else area)
        except BadInput as error:
            key = f"sources.{name}"
            messages += [text if text.startswith(key) else f"{key}: {text}" for text in error.messages]
    refuse_mistakes(messages)
    if source_tables.spacing:
        tables = _on_grid(tables, area, source_tables.spacing)
    for values in tables.values():
        values["ra"] = sky.wrap_angle(values["ra"])
        values["index"] = sky.healpix_29(values["ra"], values["dec"])
    return SourceColumns(*(_sort_by_cell(values) for values in tables.values()))


def model(
    seed: int,
    source_tables: UserSources,
    sources: SourceColumns,
    cosmology: Cosmology,
    lens: lensing.Shear | None,
    rotation: float,
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
    cosmology : Cosmology
        Parameters of the universe.
    lens : lensing.Shear or None
        Uniform shear that replaces the lensing of the rows; None to use the lensing of the rows.
    rotation : float
        Angle that is added to the position angle of each galaxy before lensing, deg.

    Returns
    -------
    IngestModel
        The model.
    """
    columns = Columns({"mag": Field(column="mag")}, GALAXY_BOUNDS, cosmology, band=source_tables.band)
    return from_catalogue.model(seed, columns, _split(sources.galaxies), lens, rotation)


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


def from_arrays(tables: Mapping[str, tuple[Path, Mapping[str, Array]]], cosmology: Cosmology) -> SourceColumns:
    """Check tables in memory, and return their sources.

    Parameters
    ----------
    tables : mapping of str to (Path, mapping of str to float array)
        For "galaxies" and "stars", the name of the table for messages, and its columns with the names of the
        properties.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    SourceColumns
        The galaxies and stars.

    Raises
    ------
    BadInput
        If a column is unknown or a required one is missing, or a value is missing or out of range.
    """
    checked = {}
    with Mistakes() as mistakes:
        for name in ("galaxies", "stars"):
            place, columns = tables.get(name, (Path(name), {}))
            if "e1" in columns or "e2" in columns:
                remedy = "give axis_ratio and position_angle (deg, north through east) in place of them"
                mistakes.add(BadInput(f"{place}: columns e1 and e2 are not possible here: {remedy}"))
                columns = {title: values for title, values in columns.items() if title not in ("e1", "e2")}
            values = mistakes.read(check_arrays, columns, name, place, cosmology, {}) if columns else _no_sources(name)
            if values is not None:
                checked[name] = {**values, "ra": sky.wrap_angle(values["ra"])}
    for values in checked.values():
        values["origin_id"] = np.arange(1, len(values["ra"]) + 1)
        values["index"] = sky.healpix_29(values["ra"], values["dec"])
    return SourceColumns(*(_sort_by_cell(checked[name]) for name in ("galaxies", "stars")))


def _no_sources(name: str) -> dict[str, Array]:
    return {key: np.zeros(0) for key in (*_POSITION, *_defaults_and_bounds(name)[0])}


def check_arrays(
    columns: Mapping[str, Array],
    name: str,
    place: Path,
    cosmology: Cosmology,
    settings: Mapping[str, str],
    ignored: Collection[str] = (),
) -> dict[str, Array]:
    """Check the columns of a table in memory, and return its properties.

    Parameters
    ----------
    columns : mapping of str to float array, shape (n,)
        Columns, with the names of the properties.
    name : str
        Name of the table, "galaxies" or "stars".
    place : Path
        Name of the table, or of its file, for the messages.
    cosmology : Cosmology
        Parameters of the universe, for absolute magnitudes, which are checked if redshifts are not ignored.
    settings : mapping of str to str
        Settings `ellipticity` and `frame` of the columns e1 and e2; empty without these columns.
    ignored : collection of str, optional
        Properties that are allowed, but neither checked nor returned.

    Returns
    -------
    dict of str to array, shape (n,)
        Properties by name; properties without a column have their default values.

    Raises
    ------
    BadInput
        If a column is unknown or a required one is missing, a value is missing or out of range, or a galaxy is near a
        caustic. There is one message for each column and kind of mistake.
    """
    defaults, bounds = _defaults_and_bounds(name)
    required = [*_POSITION, *(key for key, value in defaults.items() if value is None)]
    _check_titles(list(columns), place, bounds, required)
    used = {title: title for title in columns if title not in ignored}
    constants = {key: value for key, value in defaults.items() if key not in ignored}
    mapped = _parse({**settings, **used}, name, constants, bounds, cosmology, place)
    mistakes = TableMistakes()
    values = reading.check_batch(RowBatch(place, 1, {title: columns[title] for title in used}, {}), mapped, mistakes)
    if name == "galaxies" and values:
        _add_caustics(place, values, mistakes)
    mistakes.refuse()
    return values


def _defaults_and_bounds(name: str) -> tuple[Mapping[str, float | None], Mapping[str, tuple[float, float]]]:
    """Return default values and bounds of the properties of a table, "galaxies" or "stars"."""
    return (GALAXIES, GIVEN_GALAXY_BOUNDS) if name == "galaxies" else (STARS, GIVEN_STAR_BOUNDS)


def _parse(
    entries: Mapping[str, Any],
    name: str,
    defaults: Mapping[str, float | None],
    bounds: Mapping[str, tuple[float, float]],
    cosmology: Cosmology,
    place: object,
    required: Sequence[tuple[str, ...]] = (),
) -> Columns:
    """Return the mapping of columns to properties; `place` is the beginning of the messages of BadInput."""
    replaced = {key for whole, keys in mapping.WHOLE_GALAXY.items() if whole in entries for key in keys}
    constants = {key: {"value": value} for key, value in defaults.items() if value is not None and key not in replaced}
    settings = _SETTINGS if name == "galaxies" else ()
    properties, groups = {**constants, **entries}, list(required)
    return mapping.parse_columns(properties, bounds, cosmology, str(place), groups, legal_settings=settings)


def _columns(file: Path, name: str, source_tables: UserSources, cosmology: Cosmology) -> Columns:
    """Return which columns of a table give which properties; properties without a column have their default values.

    `name` is the name of the table, "galaxies" or "stars". Raises BadInput if a column is unknown or a required one is
    missing.
    """
    defaults, bounds = _defaults_and_bounds(name)
    required = [(key,) for key, value in defaults.items() if value is None]
    if source_tables.spacing:
        bounds = {key: limits for key, limits in bounds.items() if key not in _POSITION}
    else:
        required = [(key,) for key in _POSITION] + required
    requested = source_tables.galaxy_columns if name == "galaxies" else source_tables.star_columns
    entries: dict[str, Any] = {key: json.loads(text) for key, text in requested}
    path = f"sources.{name}.columns"
    if set(entries) <= set(_SETTINGS):
        # The request maps no column, so the columns of the file have the names of the properties.
        titles = external_rows.column_names(file, SOURCES_KIND)
        with Mistakes() as mistakes:
            if placed := [title for title in titles if title in _POSITION and source_tables.spacing]:
                remedy = 'remove them, or write only = "table"'
                problem = (
                    f'columns {" and ".join(placed)} are not possible with only = "grid", which sets the positions'
                )
                mistakes.add(BadInput(f"{file}: {problem}: {remedy}"))
                titles = [title for title in titles if title not in placed]
            mistakes.read(_check_titles, titles, file, bounds, [key for (key,) in required], can_map=True)
        entries |= {title: title for title in titles}
        path = f"sources.{name}: {file.name}"
    return _parse(entries, name, defaults, bounds, cosmology, path, required)


def _check_titles(
    titles: Sequence[str], file: Path, bounds: Mapping[str, object], required: Sequence[str], can_map: bool = False
) -> None:
    """Raise BadInput if names of a file's columns are not names of properties, or one is missing or not unique.

    `can_map` is True if the request can map the columns of the file to properties.
    """
    messages = []
    unknown = [title for title in titles if title not in bounds]
    meant = {title: " or ".join(names) for title in unknown if (names := find_columns(title, bounds))}
    for name in required:
        if name not in titles:
            hint = ""
            similar = [title for title in unknown if meant.get(title, name) == name]
            longer = [title for title in similar if title in meant or title.lower().startswith(name)]
            if similar := longer[:1] or spelling.closest_names(name, similar, 1):
                unknown.remove(similar[0])
                mapped = f", or map {_MAPPING.format(name, similar[0])}" if can_map else ""
                hint = f"; did you mean {similar[0]}? Rename it to {name}{mapped}"
            elif name == "mag" and any("flux" in title.lower() for title in unknown):
                hint = "; compute it from the flux: mag = zero_point - 2.5 log10(flux)"
            messages.append(f"{file}: column {name} is missing{hint}")
    if unknown:
        listed = [
            f"{title} (rename it to {meant[title]})"
            if title in meant
            else f"{title}{spelling.suggestion(title, bounds)}"
            for title in unknown
        ]
        allowed = f"; allowed are {', '.join(bounds)}" if set(listed) & set(unknown) else ""
        noun, them = ("unknown columns", "them") if len(unknown) > 1 else ("unknown column", "it")
        first = next((title for title in unknown if meant.get(title) in bounds), "MAG")
        mapped = f", or map {_MAPPING.format(meant.get(first, 'mag'), first)}" if can_map else ""
        messages.append(f"{file}: {noun} {', '.join(listed)}{allowed}; remove or rename {them}{mapped}")
    messages += [f"{file}: has column {title} more than once" for title in titles if titles.count(title) > 1]
    refuse_mistakes(messages)


def find_columns(title: str, bounds: Container[str] = GIVEN_GALAXY_BOUNDS) -> list[str]:
    """Return the properties that the title of a column can mean, such as half_light_radius for r_e, [] if unknown.

    `bounds` are the properties that are allowed, by default those of galaxies.
    """
    return synonyms.find_columns(title, ("given_galaxies", "galaxies", "stars"), bounds)


def _read(
    file: Path | None, name: str, source_tables: UserSources, cosmology: Cosmology, area: Area | None
) -> dict[str, Array]:
    """Read and check a table, and return its properties by name.

    If `file` is None, all properties are empty. Raises BadInput if a column is unknown or a required one is missing, if
    there are no rows, or if a value is out of bounds or not a whole number where it must be one, with one message for
    each column and kind of mistake. Without `area`, positions and absolute magnitudes are not checked.
    """
    if file is None:
        defaults = GALAXIES if name == "galaxies" else STARS
        empty = {key: np.zeros(0) for key in (*(() if source_tables.spacing else _POSITION), *defaults)}
        return empty | {"origin_id": np.zeros(0, np.int64)}
    columns = _columns(file, name, source_tables, cosmology)
    pieces = list(reading.read([file], columns, SOURCES_KIND))
    count = sum(len(piece.values["mag"]) for piece in pieces)
    if count == 0:
        raise BadInput(f"{file}: the table has no rows")
    values = {key: np.concatenate([piece.values[key] for piece in pieces]) for key in pieces[0].values}
    mistakes = TableMistakes()
    if area is not None and not source_tables.spacing:
        _add_outside(file, values, reading.column_titles(columns, *_POSITION), area, mistakes)
    if name == "galaxies":
        _add_caustics(file, values, mistakes)
        if area is not None:
            _add_magnitudes(file, values, source_tables.band, cosmology, mistakes)
    mistakes.refuse()
    return values | {"origin_id": np.arange(1, count + 1)}


def _add_outside(file: Path, values: Mapping[str, Array], titles: str, area: Area, mistakes: TableMistakes) -> None:
    """Add sources outside the area to `mistakes`; `titles` are the names of the columns with the positions."""
    ra, dec = (values[name] for name in _POSITION)
    outside = ~np.isin(sky.cell_at(sky.wrap_angle(ra), dec, GENERATION_ORDER), area.cells(GENERATION_ORDER))
    if outside.any():
        first = int(np.argmax(outside))
        hint = ingest.unit_hint((ra.min(), ra.max()), (dec.min(), dec.max()), area)
        problem = f"are {ra[first]:g} and {dec[first]:g} deg"
        mistakes.add_rows(file, 1, titles, outside, problem, f"must be in the area, {area.describe()}{hint}", "columns")


def _add_caustics(file: Path, values: Mapping[str, Array], mistakes: TableMistakes) -> None:
    """Add galaxies near a lensing caustic to `mistakes`, because their images would not be ellipses there.

    Also galaxies with a reduced shear |gamma / (1 - kappa)| above `MAX_SHEAR`.
    """
    kappa, gamma1, gamma2 = (values[name] for name in ("kappa", "gamma1", "gamma2"))
    bad = lensing.is_near_caustic(kappa, gamma1, gamma2, lensing.settings().caustic)
    bad |= np.hypot(gamma1, gamma2) > MAX_SHEAR * np.abs(1.0 - kappa)
    allowed = f"images are ellipses only up to |g| = {MAX_SHEAR}"
    mistakes.add_rows(file, 1, "kappa, gamma1 and gamma2", bad, "give an image near a caustic", allowed, "columns")


def _add_magnitudes(
    file: Path, values: Mapping[str, Array], band: str, cosmology: Cosmology, mistakes: TableMistakes
) -> None:
    """Add galaxies to `mistakes` whose magnitude, redshift and spectrum give an impossible absolute magnitude."""
    z = np.maximum(values["z_true"], reading.MIN_REDSHIFT)
    sed = band_ratios.sed_of_index(values["sed"], values["ext_law"], values["ebv"])
    offset = band_ratios.offset(from_catalogue.band_table(band, _split(values)), z, sed)
    absolute = values["mag"] - cosmology.distance_modulus(z) - offset
    lo, hi = GALAXY_BOUNDS["abs_mag_r01"]
    is_wrong = ~((absolute >= lo) & (absolute <= hi))
    noun, allowed = "the absolute magnitude from columns", f"must be from {lo:g} to {hi:g}"
    mistakes.add_rows(file, 1, "mag, z_true and sed", is_wrong, absolute, allowed, noun)


def _split(galaxies: Mapping[str, Array]) -> Split:
    """Return the largest redshift and E(B-V) of galaxies, in the form of a stored catalogue without files."""
    return Split(Path(), {}, 0, *(float(galaxies[name].max(initial=0.0)) for name in ("z_true", "ebv")))


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
