"""Galaxies of a finished catalogue as rows of table `galaxies`: what it lacks is drawn as for our own.

model    the tables that this takes
draw     rows of one generation cell

What the catalogue holds stays as it is, but for the lensing and the position angles where a request changes them.
Without magnification a galaxy is seen where it is, and its shear is nothing.
A galaxy's id counts the catalogue's halos of its generation cell (without any, its galaxies), in the order of
position: a halo whose galaxies lie in two cells has two numbers. origin_id is the catalogue's own.
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
from truesky.catalogue.external.mapping import Columns
from truesky.catalogue.galaxies import band_ratios, emission_lines, lensing, morphology, sequences, stellar_mass
from truesky.catalogue.galaxies.band_ratios import BandRatios, Sed
from truesky.catalogue.galaxies.emission_lines import LineModel
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.galaxies.morphology import Shapes
from truesky.catalogue.galaxies.sequences import Colour, Colours, Limits
from truesky.catalogue.halos.population import SATELLITE
from truesky.fluxes import cosmology, sources
from truesky.fluxes.libraries import templates
from truesky.randomness.rng import stream

Given = Mapping[str, Array]

# Of a galaxy whose mapping says nothing of dust: as far as tables of E(B-V) reach at the least.
_LEAST_EBV = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class IngestModel:
    """What missing columns are drawn from; `seen` : the band of the mapping's `mag`, None where it has none.

    lens : in place of the catalogue's lensing, None = the catalogue's;  rotation : as of GalaxyModel
    """

    seed: int
    columns: Columns
    lens: Shear | None
    rotation: float
    templates: int
    colours: Colours
    ends: Limits
    reference: BandRatios
    colour: BandRatios
    seen: BandRatios | None
    shapes: Shapes
    masses: stellar_mass.MassToLight
    star_formation: stellar_mass.StarFormation
    lines: LineModel


def model(seed: int, columns: Columns, given: Split, lens: Shear | None = None, rotation: float = 0.0) -> IngestModel:
    """Tables as far as the catalogue reaches in redshift and E(B-V); lens, rotation : as of IngestModel.

    seed : of the request;  columns : of the mapping;  given : the catalogue, laid out by cell
    """
    # In steps, so that similar catalogues share their tables.
    dustiest, z_max = (float(np.ceil(10.0 * x) / 10.0) for x in (max(_LEAST_EBV, given.ebv_max), given.z_max + 0.1))
    library = templates.galaxy_library()
    colours, colour = sequences.model(), band_ratios.load(library, "sdss_g01", 0.0, dustiest)
    return IngestModel(
        seed,
        columns,
        lens,
        rotation,
        library.flux.shape[0],
        colours,
        sequences.limits(colour, colours.dust),
        band_ratios.load(library, band_ratios.REFERENCE_BAND, z_max, dustiest),
        colour,
        band_ratios.load(library, columns.band, z_max, dustiest) if "mag" in columns.fields else None,
        morphology.shapes(),
        stellar_mass.mass_to_light(),
        stellar_mass.star_formation(),
        emission_lines.model(),
    )


def draw(cell: int, given: Given, universe: IngestModel, dust: Float32) -> pa.Table:
    """Table `galaxies` of one order-8 cell; given : truesky.catalogue.external.ingest.rows.

    dust : float32[pixel] map of A(V), mag (truesky.catalogue.dust_map)
    cell     : nested index at order 8
    universe : what completes the catalogue's columns
    """
    if not given or not given["index"].size:
        return GALAXIES.empty()
    n, rng = given["index"].size, _streams(universe.seed, cell)
    z = _first(given, "z_true", "z_obs")
    z = np.maximum(z, 1e-4)
    kind = given.get("kind", np.zeros(n, np.int64))
    lens = _lensing(given, n)
    if universe.columns.lines_magnified:
        given = {**given, **{name: given[name] * _shrinking(lens) for name in given if name.startswith("flux_")}}
    lens_seen = lens if universe.lens is None else lensing.columns(universe.lens, given["ra"] % 360.0, given["dec"], z)
    a_v = given["a_v"] if "a_v" in given else dust_map.a_v(dust, lens_seen["ra"], lens_seen["dec"])
    m_r, colour, sed, law_2, ebv_2 = _light(given, universe, z, kind, _seen(given, universe, lens, a_v), rng)
    seen = m_r + cosmology.distance_modulus(z) + band_ratios.offset(universe.reference, z, sed)
    log_mass = _known(given, "log_stellar_mass", stellar_mass.log_stellar_mass(universe.masses, m_r, colour.colour, z))
    log_sfr = _known(given, "log_sfr", _star_formation(universe.star_formation, z, log_mass, colour, rng))
    drawn = emission_lines.fluxes(universe.lines, z, log_mass, log_sfr, colour.red, rng("lines"))
    columns: dict[str, Any] = {
        **_identity(given, cell, kind),
        **lens_seen,
        "kind": kind,
        "density_boost": np.ones(n),
        "z_true": _first(given, "z_true", "z_obs"),
        "z_obs": _first(given, "z_obs", "z_true"),
        "abs_mag_r01": m_r,
        "mag_r01": given.get("mag_r01", seen),
        "color_gr_01": colour.colour,
        "log_halo_mass": _or_missing(given, "log_halo_mass", n),
        "log_stellar_mass": log_mass,
        "log_sfr": log_sfr,
        **band_ratios.columns(sed),
        "ext_law_2": law_2,
        "ebv_2": ebv_2,
        **{name: _or_missing(given, name, n) if _has_lines(given) else values for name, values in drawn.items()},
        **_shapes(given, universe.shapes, z, log_mass, colour.red, rng("shape")),
        "a_v": a_v,
    }
    if "origin_id" in given:
        columns["origin_id"] = given["origin_id"]
    if "stamp" in given:
        columns["stamp"] = np.ma.masked_less(given["stamp"], 0)
    rows = GALAXIES.build({name: _masked(name, values) for name, values in columns.items()})
    return cells.in_order(lensing.turned(rows, universe.rotation))


def _streams(seed: int, cell: int) -> Any:
    return lambda what: stream(seed, f"ingest.{what}", cell)


def _first(given: Given, *names: str) -> Float:
    return np.asarray(next(given[name] for name in names if name in given), np.float64)


def _known(given: Given, name: str, computed: Float) -> Float:
    """The catalogue's value, the computed one where it has none."""
    return np.where(np.isnan(given[name]), computed, given[name]) if name in given else computed


def _or_missing(given: Given, name: str, n: int) -> Float:
    return np.asarray(given[name] if name in given else np.full(n, np.nan), np.float64)


def _has_lines(given: Given) -> bool:
    return any(name.startswith("flux_") for name in given)


def _masked(name: str, values: Array) -> Any:
    if GALAXIES.column(name).nullable and values.dtype.kind == "f" and not isinstance(values, np.ma.MaskedArray):
        return np.ma.masked_invalid(values)
    return values


def _identity(given: Given, cell: int, kind: Int) -> dict[str, Int]:
    """Halos are numbered by their first galaxy; a halo's central is member 0, its satellites follow."""
    n = given["index"].size
    host = given["halo"] if "halo" in given else np.arange(n)
    _, first, which = np.unique(host, return_index=True, return_inverse=True)
    number = np.empty(first.size, np.int64)
    number[np.argsort(first, kind="stable")] = np.arange(first.size)
    order = np.lexsort((np.arange(n), kind, which))
    begins = np.searchsorted(which[order], np.arange(first.size))
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n) - begins[which[order]]
    # Halos without a central here begin with member 1, and so does nobody else's.
    headless = np.ones(first.size, bool)
    headless[which[kind != SATELLITE]] = False
    source = ids.source_id(kind, cell, number[which], rank + headless[which])
    return {"id": source, "halo_id": ids.halo_of(source)}


def _lensing(given: Given, n: int) -> dict[str, Array]:
    zeros = np.zeros(n)
    true = given["ra"], given["dec"]
    seen = given.get("ra_lensed", true[0]), given.get("dec_lensed", true[1])
    shear = {name: given.get(name, zeros) for name in ("kappa", "gamma1", "gamma2")}
    return {**lensing.places(seen, true), **shear}


def _seen(given: Given, universe: IngestModel, lens: Mapping[str, Array], a_v: Float) -> Float | None:
    """`mag` before magnification and the Milky Way."""
    if "mag" not in given:
        return None
    over_v = universe.columns.seen_over_v
    if over_v is None:
        return given["mag"]
    return np.asarray(given["mag"] - over_v * a_v - 2.5 * np.log10(_shrinking(lens)))


def _shrinking(lens: Mapping[str, Array]) -> Float:
    """1 / magnification[n]; of galaxies nearer to a caustic, which go into quarantine, that at its edge."""
    found = sources.determinant(*(lens[name] for name in ("kappa", "gamma1", "gamma2")))
    return np.asarray(np.maximum(np.abs(found), lensing.settings().caustic))


def _light(
    given: Given, universe: IngestModel, z: Float, kind: Int, seen: Float | None, rng: Any
) -> tuple[Float, Colour, Sed, Int, Float]:
    """M_r, colours, spectra, and law and E(B-V) of the second component."""
    m_r = given.get("abs_mag_r01")
    # Without an absolute magnitude, colours are drawn for that of a flat spectrum.
    apparent = given.get("mag_r01", seen)
    guess = m_r if m_r is not None else np.asarray(apparent) - cosmology.distance_modulus(z) - 2.5 * np.log10(1.0 + z)
    fraction = sequences.red_fraction(universe.colours.fraction, guess, z, kind)
    found = sequences.draw(universe.colours, universe.ends, guess, z, fraction, rng("colour"))
    if "color_gr_01" in given:
        colour = given["color_gr_01"]
        red = colour > np.quantile(colour, 1.0 - float(np.mean(fraction)))
        found = sequences.known(universe.colours, guess, z, colour, red)
    if "sed" in given or "sed_1" in given:
        sed = _spectra(given, universe.templates)
        if "color_gr_01" not in given:
            realised = band_ratios.colours(universe.colour, sed)
            found = sequences.known(universe.colours, guess, z, realised, sed.ebv <= 0.0)
    else:
        law, ebv = sequences.dust(universe.colours, universe.ends, guess, z, found, rng("dust"))
        sed = band_ratios.invert(universe.colour, found.colour, law, ebv)
        if "color_gr_01" not in given:
            found = Colour(found.sequence, band_ratios.colours(universe.colour, sed), found.deviate)
    if m_r is None:
        table = universe.reference if "mag_r01" in given or universe.seen is None else universe.seen
        m_r = np.asarray(apparent) - cosmology.distance_modulus(z) - band_ratios.offset(table, z, sed)
    return m_r, found, sed, given.get("ext_law_2", sed.law), given.get("ebv_2", sed.ebv)


def _star_formation(law: stellar_mass.StarFormation, z: Float, log_mass: Float, colour: Colour, rng: Any) -> Float:
    main = stellar_mass.main_sequence(law, log_mass, z)
    return stellar_mass.log_sfr(law, main, colour.sequence, colour.deviate, rng("star_formation"))


def _spectra(given: Given, count: int) -> Sed:
    if "sed" in given:
        sed = band_ratios.between(given["sed"], given["ext_law"], given["ebv"])
    else:
        sed = Sed(*(given[name] for name in ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")))
    highest = max(int(sed.template_1.max()), int(sed.template_2.max()))
    if highest >= count:
        raise BadInput(f"ingest.galaxies: a galaxy has template {highest}, the library holds 0 .. {count - 1}")
    return sed


def _shapes(
    given: Given, shapes: Shapes, z: Float, log_mass: Float, red: Bool, rng: np.random.Generator
) -> dict[str, Float]:
    n = z.size
    radius = morphology.half_light_radius(shapes.size, z, log_mass, red, cosmology.kpc_per_arcsec(z), rng)
    fraction = given.get("bulge_fraction", morphology.bulge_fraction(shapes.bulge, log_mass, red, rng))
    sersic = given.get("bulge_sersic_index", morphology.sersic_index(shapes.bulge, red, rng))
    ratio = morphology.radius_ratio(shapes.bulge, red, rng)
    bulge, disc = morphology.component_radii(shapes, radius, fraction, ratio, sersic)
    thin = morphology.disc_axis_ratio(shapes, n, rng)
    if "inclination" in given:
        # q^2 = cos^2 i + h^2 sin^2 i: what table `galaxies` means by an inclination.
        inclined = np.radians(given["inclination"])
        thin = np.hypot(np.cos(inclined), shapes.scale_height * np.sin(inclined))
    thin = given.get("disk_axis_ratio", thin)
    found = {
        "bulge_half_light_radius": given.get("bulge_half_light_radius", bulge),
        "disk_half_light_radius": given.get("disk_half_light_radius", disc),
        "bulge_fraction": fraction,
        "bulge_sersic_index": sersic,
        "bulge_axis_ratio": given.get("bulge_axis_ratio", morphology.bulge_axis_ratio(shapes.bulge, n, rng)),
        "disk_axis_ratio": thin,
        "inclination": given.get("inclination", morphology.inclination(thin, shapes.scale_height)),
        "position_angle": sky.position_angle(given.get("position_angle", morphology.position_angle(n, rng))),
    }
    # A catalogue's own fraction stands for every band, unless it has a colour as well.
    colour = np.full(n, np.nan) if "bulge_fraction" in given else morphology.bulge_colour(shapes.bulge, n, rng)
    found["bulge_color"] = given.get("bulge_color", colour)
    return {name: np.asarray(values, np.float64) for name, values in found.items()}
