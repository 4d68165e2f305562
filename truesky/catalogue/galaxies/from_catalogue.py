"""Make rows of table `galaxies` from a catalogue of the user; missing properties are drawn as for simulated galaxies.

Columns of the catalogue are not changed, except the lensing and the position angles if the request changes them, and
line fluxes, from which magnification is removed if they include it. Without lensing columns, galaxies are observed at
their true positions and have no shear.

Rows are made for one generation cell (HEALPix cell of order 8) at a time. In each cell the halos are numbered by
position (or the galaxies, if the catalogue has no halos), and the identifier `id` of a galaxy contains the number of
its halo. A halo whose galaxies are in two cells therefore has two numbers. The column
`origin_id` contains the identifier in the user's catalogue.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import ids, sky
from lake_schema.arrays import Array, Bool, Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue import cells, dust_map
from truesky.catalogue.external.ingest import Split
from truesky.catalogue.external.mapping import GALAXY_BOUNDS, Columns
from truesky.catalogue.external.reading import MIN_REDSHIFT
from truesky.catalogue.galaxies import band_ratios, emission_lines, lensing, morphology, sequences, stellar_mass
from truesky.catalogue.galaxies.band_ratios import BandRatios, Sed
from truesky.catalogue.galaxies.emission_lines import LineModel
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.galaxies.morphology import Shapes
from truesky.catalogue.galaxies.sequences import Colour, ColourLimits, Colours
from truesky.catalogue.halos.population import SATELLITE
from truesky.fluxes import sources
from truesky.fluxes.libraries import templates
from truesky.randomness.rng import stream

CatalogueColumns = Mapping[str, Array]

# Smallest upper limit of E(B-V) (mag) in the tables of template brightness. The tables must cover the dust that is
# drawn for galaxies whose dust the catalogue does not contain.
_LEAST_EBV = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class IngestModel:
    """Model from which the properties are drawn that a user's catalogue does not contain.

    Attributes
    ----------
    seed : int
        Seed of the random numbers.
    columns : Columns
        Mapping from the columns of the catalogue to the properties of galaxies, and the cosmology.
    lens : Shear or None
        Uniform shear that replaces the catalogue's lensing; None to keep the lensing of the catalogue.
    rotation : float
        Angle that is added to the position angle of each galaxy before lensing, deg.
    colours, colour_limits : Colours, ColourLimits
        Distributions of the colours, and the range of colours that the templates can have.
    reference : BandRatios
        Brightness of each template in observed 0.1r (SDSS r blueshifted to z = 0.1) by redshift.
    colour : BandRatios
        Brightness of each template in rest-frame 0.1g, relative to rest-frame 0.1r.
    observed_band : BandRatios or None
        Brightness of each template in the band of the catalogue's `mag` by redshift, relative to rest-frame 0.1r; None
        if the catalogue has no `mag`.
    shapes : Shapes
        Distributions of sizes and shapes.
    masses, star_formation : MassToLight, StarFormation
        Parameters of the stellar masses and of the star formation rates.
    lines : LineModel
        Model of the emission lines.
    """

    seed: int
    columns: Columns
    lens: Shear | None
    rotation: float
    colours: Colours
    colour_limits: ColourLimits
    reference: BandRatios
    colour: BandRatios
    observed_band: BandRatios | None
    shapes: Shapes
    masses: stellar_mass.MassToLight
    star_formation: stellar_mass.StarFormation
    lines: LineModel


def model(
    seed: int, columns: Columns, split_catalogue: Split, lens: Shear | None = None, rotation: float = 0.0
) -> IngestModel:
    """Return the model for the missing properties of a catalogue, with tables for its range of redshift and E(B-V).

    Parameters
    ----------
    seed : int
        Seed of the request.
    columns : Columns
        Mapping from the columns of the catalogue to the properties of galaxies.
    split_catalogue : Split
        The catalogue, stored in one file or more per order-5 cell.
    lens : Shear, optional
        Uniform shear that replaces the catalogue's lensing; None to keep the lensing of the catalogue.
    rotation : float
        Angle that is added to the position angle of each galaxy before lensing, deg.

    Returns
    -------
    IngestModel
        The model.
    """
    dustiest = _round_up(max(_LEAST_EBV, split_catalogue.ebv_max))
    library = templates.galaxy_library()
    colours, colour = sequences.model(), band_ratios.load(library, "sdss_g01", 0.0, dustiest)
    return IngestModel(
        seed,
        columns,
        lens,
        rotation,
        colours,
        sequences.colour_limits(colour, colours.dust),
        band_table(band_ratios.REFERENCE_BAND, split_catalogue),
        colour,
        band_table(columns.band, split_catalogue) if "mag" in columns.fields else None,
        morphology.shapes(),
        stellar_mass.mass_to_light(),
        stellar_mass.star_formation(),
        emission_lines.model(),
    )


def band_table(band: str, split_catalogue: Split) -> BandRatios:
    """Return the brightness of each template in a passband, for the redshifts and E(B-V) of a stored catalogue."""
    z_max, dustiest = _round_up(split_catalogue.z_max + 0.1), _round_up(max(_LEAST_EBV, split_catalogue.ebv_max))
    return band_ratios.load(templates.galaxy_library(), band, z_max, dustiest)


def _round_up(value: float) -> float:
    """Round up to a step of 0.1, so that catalogues with similar ranges use the same tables in the disc cache."""
    return float(np.ceil(10.0 * value) / 10.0)


def draw(cell: int, catalogue: CatalogueColumns, universe: IngestModel, dust: Float32) -> pa.Table:
    """Return the rows of table `galaxies` in one generation cell (HEALPix cell of order 8).

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    catalogue : mapping of str to array, shape (n,)
        Galaxies of the user's catalogue in the cell, from `truesky.catalogue.external.ingest.rows_of_cell`. It may be
        empty.
    universe : IngestModel
        Model of the missing properties.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag (truesky.catalogue.dust_map); used if the catalogue has no column a_v.

    Returns
    -------
    Table
        Rows of table `galaxies`, sorted by _healpix_29; empty if `catalogue` is empty.

    Raises
    ------
    BadInput
        If the magnitude of a galaxy and its spectrum give an impossible absolute magnitude.
    """
    if not catalogue or not catalogue["index"].size:
        return GALAXIES.empty()
    n, rng = catalogue["index"].size, _streams(universe.seed, cell)
    z = _first_column(catalogue, "z_true", "z_obs")
    z = np.maximum(z, MIN_REDSHIFT)
    kind = catalogue.get("kind", np.zeros(n, np.int64))
    lens = _lensing(catalogue, n)
    if universe.columns.lines_magnified:
        catalogue = {
            **catalogue,
            **{name: catalogue[name] * _inverse_magnification(lens) for name in catalogue if name.startswith("flux_")},
        }
    lensed = (
        lens if universe.lens is None else lensing.columns(universe.lens, catalogue["ra"] % 360.0, catalogue["dec"], z)
    )
    a_v = catalogue["a_v"] if "a_v" in catalogue else dust_map.a_v(dust, lensed["ra"], lensed["dec"])
    m_r, colour, sed, law_2, ebv_2 = _light(
        catalogue, universe, z, kind, _intrinsic_mag(catalogue, universe, lens, a_v), rng
    )
    cosmology = universe.columns.cosmology
    reference_mag = m_r + cosmology.distance_modulus(z) + band_ratios.offset(universe.reference, z, sed)
    log_mass = stellar_mass.log_stellar_mass(universe.masses, cosmology.h, m_r, colour.colour, z)
    log_mass = _value_or_computed(catalogue, "log_stellar_mass", log_mass)
    log_sfr = _value_or_computed(
        catalogue, "log_sfr", _star_formation(universe.star_formation, z, log_mass, colour, rng)
    )
    line_fluxes = emission_lines.fluxes(universe.lines, cosmology, z, log_mass, log_sfr, colour.red, rng("lines"))
    _refuse_impossible_magnitudes(catalogue, z, m_r, catalogue.get("mag_r01", reference_mag))
    columns: dict[str, Any] = {
        **_identity(catalogue, cell, kind),
        **lensed,
        "kind": kind,
        "density_boost": np.ones(n),
        "z_true": _first_column(catalogue, "z_true", "z_obs"),
        "z_obs": _first_column(catalogue, "z_obs", "z_true"),
        "abs_mag_r01": m_r,
        "mag_r01": catalogue.get("mag_r01", reference_mag),
        "color_gr_01": colour.colour,
        "log_halo_mass": _column_or_nan(catalogue, "log_halo_mass", n),
        "log_stellar_mass": log_mass,
        "log_sfr": log_sfr,
        **band_ratios.columns(sed),
        "ext_law_2": law_2,
        "ebv_2": ebv_2,
        **{
            name: _column_or_nan(catalogue, name, n) if _has_lines(catalogue) else values
            for name, values in line_fluxes.items()
        },
        **_shapes(catalogue, universe, z, log_mass, colour.red, rng("shape")),
        "a_v": a_v,
    }
    if "origin_id" in catalogue:
        columns["origin_id"] = catalogue["origin_id"]
    if "stamp" in catalogue:
        columns["stamp"] = np.ma.masked_less(catalogue["stamp"], 0)
    rows = GALAXIES.build({name: _mask_missing(name, values) for name, values in columns.items()})
    return cells.sort_rows(lensing.rotate_position_angles(rows, universe.rotation))


def _refuse_impossible_magnitudes(catalogue: CatalogueColumns, z: Float, m_r: Float, mag_r01: Float) -> None:
    """Raise BadInput if a galaxy has an absolute or apparent magnitude for which no flux can be computed.

    It can follow from the catalogue's magnitude, redshift and the spectrum that is drawn for the galaxy.
    """
    for name, values in (("abs_mag_r01", m_r), ("mag_r01", mag_r01)):
        lo, hi = GALAXY_BOUNDS[name]
        is_wrong = ~((values >= lo) & (values <= hi))
        if is_wrong.any():
            row = int(is_wrong.argmax())
            galaxy = f"galaxy {catalogue['origin_id'][row]}" if "origin_id" in catalogue else "a galaxy"
            position = f"ra = {catalogue['ra'][row]:.6f}, dec = {catalogue['dec'][row]:.6f}, redshift = {z[row]:g}"
            raise BadInput(
                f"ingest.galaxies: {galaxy} at {position}: its magnitude gives {name} = {values[row]:g}, "
                f"must be in [{lo:g}, {hi:g}]"
            )


def _streams(seed: int, cell: int) -> Any:
    return lambda purpose: stream(seed, f"ingest.{purpose}", cell)


def _first_column(catalogue: CatalogueColumns, *names: str) -> Float:
    return np.asarray(next(catalogue[name] for name in names if name in catalogue), np.float64)


def _value_or_computed(catalogue: CatalogueColumns, name: str, computed: Float) -> Float:
    """Return the catalogue's column `name` with `computed` in place of NaN, or `computed` if the column is missing."""
    return np.where(np.isnan(catalogue[name]), computed, catalogue[name]) if name in catalogue else computed


def _column_or_nan(catalogue: CatalogueColumns, name: str, n: int) -> Float:
    return np.asarray(catalogue[name] if name in catalogue else np.full(n, np.nan), np.float64)


def _has_lines(catalogue: CatalogueColumns) -> bool:
    return any(name.startswith("flux_") for name in catalogue)


def _mask_missing(name: str, values: Array) -> Any:
    if GALAXIES.column(name).nullable and values.dtype.kind == "f" and not isinstance(values, np.ma.MaskedArray):
        return np.ma.masked_invalid(values)
    return values


def _identity(catalogue: CatalogueColumns, cell: int, kind: Int) -> dict[str, Int]:
    """Return the columns `id` and `halo_id` of the galaxies in a cell.

    Halos are numbered in the order of their first galaxies. In a halo the central galaxy is member 0, and the
    satellites are numbered from 1.
    """
    n = catalogue["index"].size
    host = catalogue["halo"] if "halo" in catalogue else np.arange(n)
    _, first, host_row = np.unique(host, return_index=True, return_inverse=True)
    number = np.empty(first.size, np.int64)
    number[np.argsort(first, kind="stable")] = np.arange(first.size)
    order = np.lexsort((np.arange(n), kind, host_row))
    begins = np.searchsorted(host_row[order], np.arange(first.size))
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n) - begins[host_row[order]]
    # The satellites are also numbered from 1 if the halo has no central galaxy in this cell.
    lacks_central = np.ones(first.size, bool)
    lacks_central[host_row[kind != SATELLITE]] = False
    source = ids.source_id(kind, cell, number[host_row], rank + lacks_central[host_row])
    return {"id": source, "halo_id": ids.halo_from_id(source)}


def _lensing(catalogue: CatalogueColumns, n: int) -> dict[str, Array]:
    zeros = np.zeros(n)
    true = catalogue["ra"], catalogue["dec"]
    observed = catalogue.get("ra_lensed", true[0]), catalogue.get("dec_lensed", true[1])
    shear = {name: catalogue.get(name, zeros) for name in ("kappa", "gamma1", "gamma2")}
    return {**lensing.position_columns(observed, true), **shear}


def _intrinsic_mag(
    catalogue: CatalogueColumns, universe: IngestModel, lens: Mapping[str, Array], a_v: Float
) -> Float | None:
    """Return the catalogue's magnitude `mag` without magnification and the Milky Way's extinction (mag).

    Without a column `mag`, return None. If the mapping does not say that `mag` includes both effects, return it
    unchanged.
    """
    if "mag" not in catalogue:
        return None
    over_v = universe.columns.seen_over_v
    if over_v is None:
        return catalogue["mag"]
    return np.asarray(catalogue["mag"] - over_v * a_v - 2.5 * np.log10(_inverse_magnification(lens)))


def _inverse_magnification(lens: Mapping[str, Array]) -> Float:
    """Return 1 / |magnification|, at least the smallest value for which weak lensing is valid.

    Galaxies below this value are later moved from table `galaxies` to the table `quarantine`.
    """
    determinant = sources.determinant(*(lens[name] for name in ("kappa", "gamma1", "gamma2")))
    return np.asarray(np.maximum(np.abs(determinant), lensing.settings().caustic))


def _light(
    catalogue: CatalogueColumns, universe: IngestModel, z: Float, kind: Int, intrinsic_mag: Float | None, rng: Any
) -> tuple[Float, Colour, Sed, Int, Float]:
    """Return absolute 0.1r magnitude, colours, spectra, and the dust (law and E(B-V), mag) of each second template.

    A spectrum is a mixture of two templates. The dust in the spectra is that of the first template; in a catalogue, the
    second template may have other dust.
    Values of the catalogue are kept; missing values are drawn or computed from the existing ones. `intrinsic_mag` is
    the catalogue's `mag` without magnification and extinction, or None without `mag`.
    """
    m_r = catalogue.get("abs_mag_r01")
    # Without an absolute magnitude, estimate it for a spectrum with constant f_lambda, in order to draw a colour.
    apparent = catalogue.get("mag_r01", intrinsic_mag)
    distance_modulus = universe.columns.cosmology.distance_modulus(z)
    guess = m_r if m_r is not None else np.asarray(apparent) - distance_modulus - 2.5 * np.log10(1.0 + z)
    fraction = sequences.red_fraction(universe.colours.fraction, guess, z, kind)
    drawn_colour = sequences.draw(universe.colours, universe.colour_limits, guess, z, fraction, rng("colour"))
    if "color_gr_01" in catalogue:
        colour = catalogue["color_gr_01"]
        red = colour > np.quantile(colour, 1.0 - float(np.mean(fraction)))
        drawn_colour = sequences.place_on_sequence(universe.colours, guess, z, colour, red)
    if "sed" in catalogue or "sed_1" in catalogue:
        sed = _spectra(catalogue)
        if "color_gr_01" not in catalogue:
            realised = band_ratios.colours(universe.colour, sed)
            drawn_colour = sequences.place_on_sequence(universe.colours, guess, z, realised, sed.ebv <= 0.0)
    else:
        law, ebv = sequences.draw_dust(universe.colours, universe.colour_limits, guess, z, drawn_colour, rng("dust"))
        sed = band_ratios.sed_of_colour(universe.colour, drawn_colour.colour, law, ebv)
        if "color_gr_01" not in catalogue:
            drawn_colour = Colour(
                drawn_colour.sequence, band_ratios.colours(universe.colour, sed), drawn_colour.deviate
            )
    if m_r is None:
        table = (
            universe.reference if "mag_r01" in catalogue or universe.observed_band is None else universe.observed_band
        )
        m_r = np.asarray(apparent) - distance_modulus - band_ratios.offset(table, z, sed)
    return m_r, drawn_colour, sed, catalogue.get("ext_law_2", sed.law), catalogue.get("ebv_2", sed.ebv)


def _star_formation(law: stellar_mass.StarFormation, z: Float, log_mass: Float, colour: Colour, rng: Any) -> Float:
    main = stellar_mass.main_sequence(law, log_mass, z)
    return stellar_mass.log_sfr(law, main, colour.sequence, colour.deviate, rng("star_formation"))


def _spectra(catalogue: CatalogueColumns) -> Sed:
    if "sed" in catalogue:
        return band_ratios.sed_of_index(catalogue["sed"], catalogue["ext_law"], catalogue["ebv"])
    return Sed(*(catalogue[name] for name in ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")))


def _shapes(
    catalogue: CatalogueColumns, universe: IngestModel, z: Float, log_mass: Float, red: Bool, rng: np.random.Generator
) -> dict[str, Float]:
    n, shapes, scale = z.size, universe.shapes, universe.columns.cosmology.kpc_per_arcsec(z)
    radius = morphology.half_light_radius(shapes.size, z, log_mass, red, scale, rng)
    fraction = catalogue.get("bulge_fraction", morphology.bulge_fraction(shapes.bulge, log_mass, red, rng))
    sersic = catalogue.get("bulge_sersic_index", morphology.sersic_index(shapes.bulge, red, rng))
    ratio = morphology.radius_ratio(shapes.bulge, red, rng)
    bulge, disc = morphology.component_radii(shapes, radius, fraction, ratio, sersic)
    disc_ratio = morphology.disc_axis_ratio(shapes, n, rng)
    if "inclination" in catalogue:
        # An inclination i and an axis ratio q are related by q^2 = cos^2 i + h^2 sin^2 i. Here h is the scale height of
        # the disc divided by its scale length.
        inclined = np.radians(catalogue["inclination"])
        disc_ratio = np.hypot(np.cos(inclined), shapes.scale_height * np.sin(inclined))
    disc_ratio = catalogue.get("disk_axis_ratio", disc_ratio)
    columns = {
        "bulge_half_light_radius": catalogue.get("bulge_half_light_radius", bulge),
        "disk_half_light_radius": catalogue.get("disk_half_light_radius", disc),
        "bulge_fraction": fraction,
        "bulge_sersic_index": sersic,
        "bulge_axis_ratio": catalogue.get("bulge_axis_ratio", morphology.bulge_axis_ratio(shapes, n, rng)),
        "disk_axis_ratio": disc_ratio,
        "inclination": catalogue.get("inclination", morphology.inclination(disc_ratio, shapes.scale_height)),
        "position_angle": sky.wrap_position_angle(catalogue.get("position_angle", morphology.position_angle(n, rng))),
    }
    # The bulge fraction of a catalogue applies to all bands, unless the catalogue also has a bulge colour: without a
    # bulge colour (NaN), bulge and disc have the same spectrum.
    colour = np.full(n, np.nan) if "bulge_fraction" in catalogue else morphology.bulge_colour(shapes.bulge, n, rng)
    columns["bulge_color"] = catalogue.get("bulge_color", colour)
    return {name: np.asarray(values, np.float64) for name, values in columns.items()}
