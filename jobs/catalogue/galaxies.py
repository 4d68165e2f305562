"""Galaxies of one generation cell: table `galaxies`, a pure function of (seed, cell, model).

model   every table that the draws need, made once
draw    luminosities -> colours, dust, spectra -> selection -> masses, shapes, positions

Each step draws from a stream of its own, so that a new column leaves the others' numbers as they are. So far
every galaxy is the central of its own halo and lies at a random place of the cell, unlensed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.catalogue import (
    band_ratios,
    dust_map,
    luminosity_function,
    morphology,
    sed_assignment,
    stellar_mass,
)
from jobs.catalogue.band_ratios import BandRatios, Sed
from jobs.catalogue.luminosity_function import Counts, Inverse
from jobs.catalogue.morphology import Shapes
from jobs.fluxes import cosmology, templates
from jobs.rng import stream
from lake_schema import ids, sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.galaxies import GALAXIES

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

CENTRAL = 0
SELECTION_BAND = "euclid_vis"
# Candidates are drawn this much deeper than the brightest SED needs, mag: more than the tables' errors.
_MARGIN = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class GalaxyModel:
    """Everything that galaxies are drawn from; a few MB, made once by `model`.

    limit     : faintest I_E, AB, before the Milky Way's dust
    selection : I_E against redshift; reference : 0.1r against redshift; colour : 0.1g at rest
    """

    limit: float
    inverse: Inverse
    counts: Counts
    colours: sed_assignment.Colours
    selection: BandRatios
    reference: BandRatios
    colour: BandRatios
    shapes: Shapes
    masses: stellar_mass.MassToLight
    light: stellar_mass.Light


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Galaxies after selection: z[n], M_r[n], on the red sequence[n], realised 0.1(g - r)[n], spectra."""

    z: Float
    m_r: Float
    red: Bool
    colour: Float
    sed: Sed


def model(limit: float = 26.0, z_max: float = 2.3) -> GalaxyModel:
    """The embedded universe's galaxies with I_E < limit and z < z_max (1 s, 3 s with an empty cache)."""
    library = templates.galaxy_library()
    colours = sed_assignment.colours_model()
    space = luminosity_function.volume(z_max)
    dustiest = colours.dust.highest
    selection = band_ratios.load(library, SELECTION_BAND, z_max, dustiest)
    nodes, brightest = band_ratios.brightest(selection)

    def faintest(z: Float) -> Float:
        return limit + _MARGIN - cosmology.distance_modulus(z) - np.interp(z, nodes, brightest)

    lf = luminosity_function.schechter()
    return GalaxyModel(
        limit=limit,
        inverse=luminosity_function.inverse(lf, z_max),
        counts=luminosity_function.counts(lf, space, faintest),
        colours=colours,
        selection=selection,
        reference=band_ratios.load(library, band_ratios.REFERENCE_BAND, z_max, dustiest),
        colour=band_ratios.load(library, "sdss_g01", 0.0, dustiest),
        shapes=morphology.shapes(),
        masses=stellar_mass.mass_to_light(),
        light=stellar_mass.light(library, selection.ebv),
    )


def draw(cell: int, seed: int, universe: GalaxyModel, dust: npt.NDArray[np.float32]) -> pa.Table:
    """Table `galaxies` of one order-8 cell, sorted by _healpix_29.

    dust : map of the Milky Way's A(V) (jobs.catalogue.dust_map)
    """
    drawn = select(universe, *_light(cell, seed, universe))
    distance_modulus = cosmology.distance_modulus(drawn.z)
    log_mass = stellar_mass.log_stellar_mass(universe.masses, drawn.m_r, drawn.colour)
    columns = {
        **_places(cell, seed, drawn.z, dust),
        "abs_mag_r01": drawn.m_r,
        "mag_r01": drawn.m_r + distance_modulus + band_ratios.offset(universe.reference, drawn.z, drawn.sed),
        "color_gr_01": drawn.colour,
        "log_stellar_mass": log_mass,
        "log_sfr": stellar_mass.log_sfr(universe.light, drawn.m_r, drawn.sed),
        **_sed_columns(drawn.sed),
        **_shape_columns(cell, seed, universe.shapes, drawn, log_mass),
    }
    return GALAXIES.build(columns)


def select(universe: GalaxyModel, z: Float, m_r: Float, red: Bool, sed: Sed) -> Drawn:
    """The galaxies brighter than the limit, with their realised colours."""
    keep = apparent(universe, z, m_r, sed) < universe.limit
    kept = sed.part(keep)
    return Drawn(z[keep], m_r[keep], red[keep], sed_assignment.colours(universe.colour, kept), kept)


def apparent(universe: GalaxyModel, z: Float, m_r: Float, sed: Sed) -> Float:
    """I_E[n], AB, unmagnified and before the Milky Way's dust.

    Error: < 0.001 mag (tests/jobs/catalogue/test_band_ratios)
    """
    return m_r + cosmology.distance_modulus(z) + band_ratios.offset(universe.selection, z, sed)


def _light(cell: int, seed: int, universe: GalaxyModel) -> tuple[Float, Float, Bool, Sed]:
    """Candidates of a cell: z, M_r, on the red sequence, spectra."""
    area = sky.cell_area(GENERATION_ORDER)
    z, m_r = luminosity_function.draw(
        universe.inverse, universe.counts, area, stream(seed, "galaxies.luminosity", cell)
    )
    kind = np.full(z.size, CENTRAL)
    red, colour = sed_assignment.draw_colour(universe.colours, m_r, z, kind, stream(seed, "galaxies.colour", cell))
    law, ebv = sed_assignment.draw_dust(universe.colours.dust, m_r, red, colour, stream(seed, "galaxies.dust", cell))
    return z, m_r, red, sed_assignment.invert(universe.colour, colour, law, ebv)


def _places(cell: int, seed: int, z: Float, dust: npt.NDArray[np.float32]) -> dict[str, npt.NDArray[np.generic]]:
    n = z.size
    index, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, n, stream(seed, "galaxies.position", cell))
    kind, zeros = np.full(n, CENTRAL), np.zeros(n)
    source = ids.source_id(kind, cell, np.arange(n))
    return {
        "id": source,
        "halo_id": ids.halo_of(source),
        "ra": ra,
        "dec": dec,
        "_healpix_29": index,
        "ra_lensed": ra,
        "dec_lensed": dec,
        "kind": kind,
        "density_boost": np.ones(n),
        "z_true": z,
        "z_obs": z,
        "kappa": zeros,
        "gamma1": zeros,
        "gamma2": zeros,
        "a_v": dust_map.a_v(dust, ra, dec),
    }


def _sed_columns(sed: Sed) -> dict[str, npt.NDArray[np.generic]]:
    return {
        "sed_1": sed.template_1,
        "frac_1": sed.frac_1,
        "ext_law_1": sed.law,
        "ebv_1": sed.ebv,
        "sed_2": sed.template_2,
        "frac_2": sed.frac_2,
        "ext_law_2": sed.law,
        "ebv_2": sed.ebv,
    }


def _shape_columns(
    cell: int, seed: int, shapes: Shapes, drawn: Drawn, log_mass: Float
) -> dict[str, npt.NDArray[np.generic]]:
    scale = cosmology.kpc_per_arcsec(drawn.z)
    rng = stream(seed, "galaxies.size", cell)
    radius = morphology.half_light_radius(shapes.size, drawn.z, log_mass, drawn.red, scale, rng)
    rng = stream(seed, "galaxies.bulge", cell)
    fraction = morphology.bulge_fraction(shapes.bulge, log_mass, drawn.red, rng)
    sersic = morphology.sersic_index(shapes.bulge, drawn.red, rng)
    ratio = morphology.radius_ratio(shapes.bulge, drawn.red, rng)
    bulge_radius, disc_radius = morphology.component_radii(shapes, radius, fraction, ratio, sersic)
    rng = stream(seed, "galaxies.shape", cell)
    disc_ratio = morphology.disc_axis_ratio(shapes, drawn.z.size, rng)
    return {
        "bulge_half_light_radius": bulge_radius,
        "disk_half_light_radius": disc_radius,
        "bulge_fraction": fraction,
        "bulge_sersic_index": sersic,
        "bulge_axis_ratio": morphology.bulge_axis_ratio(shapes.bulge, drawn.z.size, rng),
        "disk_axis_ratio": disc_ratio,
        "inclination": morphology.inclination(disc_ratio, shapes.scale_height),
        "position_angle": morphology.position_angle(drawn.z.size, rng),
    }
