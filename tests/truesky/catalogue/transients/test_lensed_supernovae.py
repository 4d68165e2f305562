"""Supernovae behind strong lenses: those of the table, earlier ones, and only images that shine in the window."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids, sky
from lake_schema.store import validate
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
from truesky.catalogue.transients import lensed_supernovae, supernovae
from truesky.catalogue.transients.supernovae import Window
from truesky.cosmology import FIDUCIAL
from truesky.variability import lensed_rows, spectral_series, supernova_light

CELL, SEED, N = 100, 7, 30


@pytest.fixture(scope="module")
def window():
    templates = spectral_series.templates_from_facts(spectral_series.facts(None))
    return Window(61000.0, 61100.0, ("ia", "core_collapse"), 60.0, templates)


@pytest.fixture(scope="module")
def galaxies():
    """Return galaxies of 3e10 solar masses that form stars, at z = 1."""
    index, ra, dec = sky.random_in_cell(8, CELL, N, np.random.default_rng(2))
    values = {
        "id": ids.source_id(0, CELL, np.arange(N)), "ra": ra, "dec": dec, "_healpix_29": index,
        "kind": np.zeros(N, np.int8),
    }  # fmt: skip
    given = {"z_true": 1.0, "z_obs": 1.0, "log_stellar_mass": 10.5, "log_sfr": 1.0, "a_v": 0.1}
    shapes = {"disk_half_light_radius": 0.3, "disk_axis_ratio": 0.7, "bulge_half_light_radius": 0.1,
              "bulge_axis_ratio": 0.8, "bulge_sersic_index": 3.0}  # fmt: skip
    others = {name: np.full(N, (given | shapes).get(name, 0.0)) for name in supernovae.COLUMNS if name not in values}
    return pa.table(values | others)


@pytest.fixture(scope="module")
def lenses(galaxies):
    """Return lenses of large delays for half of the galaxies."""
    n = N // 2
    rng = np.random.default_rng(3)
    return pa.table({
        "id": ids.source_id(4, CELL, np.arange(n)), "lens_id": galaxies["id"][:n], "source_id": galaxies["id"][N - n :],
        "density_boost": np.full(n, 1.0), "ra": galaxies["ra"][:n], "dec": galaxies["dec"][:n],
        "z_lens": np.full(n, 0.5), "z_source": np.full(n, 1.0), "einstein_radius": np.full(n, 2.0),
        "axis_ratio": np.full(n, 0.7), "position_angle": rng.uniform(0.0, 180.0, n),
        "source_east": rng.uniform(-1.0, 1.0, n), "source_north": rng.uniform(-1.0, 1.0, n),
    })  # fmt: skip


def test_images_are_of_supernovae_of_the_table_and_of_earlier_ones(galaxies, lenses, window):
    images = lensed_supernovae.draw(CELL, galaxies, lenses, SEED, window, FIDUCIAL)
    assert validate.find_violations(images, LENSED_IMAGES) == []
    drawn = supernovae.draw(CELL, galaxies, SEED, window, FIDUCIAL)
    lensed = drawn.filter(pa.array(np.isin(drawn["host_id"].to_numpy(), lenses["source_id"].to_numpy())))
    assert 5 < lensed.num_rows < drawn.num_rows
    found = set(images["source_id"].to_pylist())
    in_table = found & set(drawn["id"].to_pylist())
    assert in_table <= set(lensed["id"].to_pylist())
    assert len(in_table) > 5
    earlier = images.filter(pa.array(~np.isin(images["source_id"].to_numpy(), drawn["id"].to_numpy())))
    assert earlier.num_rows > 5
    assert earlier["delay"].to_numpy().min() > 0.0


def test_all_images_shine_in_the_window_and_none_is_missing(galaxies, lenses, window):
    images = lensed_supernovae.draw(CELL, galaxies, lenses, SEED, window, FIDUCIAL)
    first, last = supernova_light.first_and_last_day(lensed_supernovae.light(images), window.templates)
    assert first.max() <= window.end
    assert last.min() >= window.start
    longer = replace(window, start=window.start - 1500.0, end=window.end + 1500.0)
    whole = lensed_supernovae.draw(CELL, galaxies, lenses, SEED, longer, FIDUCIAL)
    first, last = supernova_light.first_and_last_day(lensed_supernovae.light(whole), window.templates)
    assert images.equals(whole.filter(pa.array((last >= window.start) & (first <= window.end))))


def test_without_lenses_there_are_no_images(galaxies, lenses, window):
    assert lensed_supernovae.draw(CELL, galaxies, lenses.slice(0, 0), SEED, window, FIDUCIAL).num_rows == 0
    assert set(lensed_rows.LENS_COLUMNS) == set(lenses.column_names)
