"""One galaxy model, one dust map and one drawn sky for all tests of the folder."""

from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from jobs.catalogue import band_ratios, dust_map, galaxies
from jobs.fluxes import cosmology, templates
from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER

SEED = 7


@pytest.fixture(scope="session")
def library():
    return templates.galaxy_library()


@pytest.fixture(scope="session")
def dust():
    return dust_map.load(SEED)


@pytest.fixture(scope="session")
def universe():
    return galaxies.model()


@pytest.fixture(scope="session")
def drawn(universe, dust, library):
    """Twenty cells spread over the sky (1.05 deg2): the rows, columns by name, and magnitudes by band."""
    cells = range(100, 12 << 16, (12 << 16) // 20)
    rows = pa.concat_tables([galaxies.draw(cell, SEED, universe, dust) for cell in cells])
    columns = {name: rows[name].to_numpy() for name in rows.column_names if not rows[name].null_count}
    z = columns["z_true"].astype(float)
    m_r = columns["abs_mag_r01"].astype(float)
    sed = band_ratios.Sed(*(columns[name] for name in ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")))

    def mag(band):
        table = band_ratios.load(library, band, 2.3, 0.5)
        return m_r + cosmology.distance_modulus(z) + band_ratios.offset(table, z, sed)

    area = len(cells) * sky.cell_area(GENERATION_ORDER)
    bands = ("euclid_vis", "euclid_y", "euclid_h", "lsst_g", "lsst_r", "lsst_i", "lsst_z")
    mags = {band: mag(band) for band in bands}
    return SimpleNamespace(rows=rows, columns=columns, z=z, m_r=m_r, sed=sed, mags=mags, area=area)


@pytest.fixture
def rng():
    return np.random.default_rng(20)
