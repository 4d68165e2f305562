"""One galaxy model, one dust map and one drawn sky for all tests of the folder."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue import dust_map
from truesky.catalogue.galaxies import band_ratios, emission_lines, galaxies
from truesky.catalogue.halos import matching, population
from truesky.catalogue.matter import density_box
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.request.schema import Universe
from truesky.validation.model import mean_sky

SEED = 7
BOX_CELLS = 192
NSIDE = 64


@pytest.fixture(scope="session")
def library():
    return templates.galaxy_library()


@pytest.fixture(scope="session")
def dust():
    return dust_map.load(SEED)


SMALL = {"box_cells": BOX_CELLS, "lensing_nside": NSIDE}


@pytest.fixture(scope="session")
def universe():
    return made()


@cache
def made():
    return galaxies.model(SEED, Universe(**SMALL))


@pytest.fixture(scope="session")
def box():
    return density_box.load(SEED, BOX_CELLS, FIDUCIAL)


@pytest.fixture(scope="session")
def cells(universe):
    """Cache of the cells that are drawn in this run of the tests."""
    return population.CellCache(universe.population)


# Cells of a sky without structure, 1.7 deg2. A survey would need a few degrees for the same precision.
FLAT_CELLS = 32


@pytest.fixture(scope="session")
def flat_sky():
    return draw_flat_sky()


# Cached as well, for the fixtures of another folder are others.
@cache
def draw_flat_sky():
    """Draw the galaxies of cells of a sky without structure."""
    return mean_sky.rows(mean_sky.without_clustering(made()), 0, FLAT_CELLS)


@pytest.fixture(scope="session")
def drawn():
    return draw_sky()


@cache
def draw_sky():
    """Draw five blocks of four cells spread over the sky (1.05 deg2): rows, columns by name, magnitudes by band."""
    universe, library = made(), templates.galaxy_library()
    cells, dust = population.CellCache(universe.population), dust_map.load(SEED)
    places = [4 * block + i for block in range(25, 3 << 16, (3 << 16) // 5) for i in range(4)]
    rows = pa.concat_tables([galaxies.draw(cell, universe, cells, dust) for cell in places])
    halos = pa.concat_tables([galaxies.halo_table(cell, universe.population, cells) for cell in places])
    # Keep the galaxies of the light-cone; objects beyond redshift 6 have separate tests.
    every, rows = rows, rows.filter(pa.array(rows["kind"].to_numpy() < 2))
    columns = {name: rows[name].to_numpy() for name in rows.column_names if not rows[name].null_count}
    z = columns["z_true"].astype(float)
    m_r = columns["abs_mag_r01"].astype(float)
    distance_modulus = FIDUCIAL.distance_modulus(z)
    sed = band_ratios.Sed(*(columns[name] for name in ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")))

    def mag(band):
        table = band_ratios.load(library, band, matching.Z_LAST, 0.5)
        continuum = m_r + distance_modulus + band_ratios.offset(table, z, sed)
        return emission_lines.magnitude_with_light(
            continuum, emission_lines.mean_line_flux(passbands.load(band), columns["z_obs"], columns)
        )

    area = len(places) * sky.cell_area(GENERATION_ORDER)
    bands = ("euclid_vis", "euclid_y", "euclid_j", "euclid_h", "lsst_g", "lsst_r", "lsst_i", "lsst_z")
    mags = {band: mag(band) for band in bands}
    return SimpleNamespace(
        every=every,
        rows=rows,
        halos=halos,
        columns=columns,
        z=z,
        m_r=m_r,
        sed=sed,
        mags=mags,
        area=area,
        places=places,
    )


@pytest.fixture
def rng():
    return np.random.default_rng(20)
