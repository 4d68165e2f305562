"""Galaxies of cells: counts, luminosities and star formation as published; rows as declared."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids, sky
from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALOS
from lake_schema.units import LIGHT_KM_S
from tests.truesky import nightly
from tests.truesky.catalogue.conftest import SEED, SMALL
from truesky.catalogue import build_galaxies, dust_map
from truesky.catalogue.galaxies import band_ratios, emission_lines, galaxies, observed_cells
from truesky.catalogue.halos import luminosity_function, population
from truesky.catalogue.matter import fine_structure, lightcone
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe

NEARBY = {"high_redshift_boost": 0.0, "quasar_boost": 0.0}

ARCMIN2_PER_DEG2 = 3600.0
CELL = 303_117


@pytest.fixture(scope="module")
def cell(universe, cells, dust):
    return galaxies.draw(CELL, universe, cells, dust)


def test_counts_to_the_limits_of_the_survey(drawn):
    """Sky with structure: 30 per arcmin2 with I_E < 24.5, median z 0.87 (Serrano et al. 2024)."""
    vis = drawn.mags["euclid_vis"]
    area = drawn.area * ARCMIN2_PER_DEG2
    bright = vis < 24.5
    assert np.sum(bright) / area == pytest.approx(30.0, rel=0.15)
    assert np.median(drawn.z[bright]) == pytest.approx(0.87, abs=0.05)


@pytest.mark.parametrize(("limit", "observed"), [(21, 1.45), (22, 3.7), (23, 9.0), (24, 21.0), (25, 44.5)])
def test_i_band_counts_are_the_observed_ones(drawn, limit, observed):
    """Per arcmin2: GAMA (Driver et al. 2016), VVDS (Le Fevre et al. 2005), LSST Science Book 2009."""
    found = np.sum(drawn.mags["lsst_i"] < limit) / (drawn.area * ARCMIN2_PER_DEG2)
    assert found == pytest.approx(observed, rel=0.22)


def test_slope_of_the_counts(drawn):
    number = np.histogram(drawn.mags["euclid_vis"], np.arange(19.5, 24.0, 1.0))[0]
    assert np.mean(np.diff(np.log10(number))) == pytest.approx(0.39, abs=0.03)


def test_there_is_no_hole_in_redshift(drawn):
    """Counts per arcmin2 and unit redshift for I_E < 26, from an independent program; no gap or step below z = 6."""
    expected = {1.9: 22.1, 2.2: 18.2, 2.5: 15.8, 2.8: 12.5}
    area = drawn.area * ARCMIN2_PER_DEG2
    for z, number in expected.items():
        assert np.sum(np.abs(drawn.z - z) < 0.15) / 0.3 / area == pytest.approx(number, rel=0.2)
    counted = np.histogram(drawn.z, np.arange(2.0, 6.01, 0.5))[0]
    assert np.all(counted[1:] < 1.05 * counted[:-1])
    # The brightest galaxies of z = 6 are as faint as the limit: each step has a fifth of the one before or more.
    assert np.all(counted[1:] > 0.12 * counted[:-1])
    assert counted[-1] > 50


def expected_number(lf, near, far, faintest, area):
    """Galaxies brighter than `faintest` between two redshifts, from the luminosity function."""
    grid = np.linspace(near, far, 41)
    density = luminosity_function.number_density(lf, faintest, grid)
    shells = FIDUCIAL.comoving_volume(grid[:-1], grid[1:])
    return float(np.sum(0.5 * (density[1:] + density[:-1]) * shells) * area * np.radians(1.0) ** 2)


def richness(universe, places, near, far, log_mass):
    """Return the halo density in these cells relative to the mean: the effect of structure on counts."""
    model = universe.population.halos
    steps = (model.steps.z > near) & (model.steps.z < far)
    column = np.searchsorted(model.log_mass, log_mass) - 1
    total = []
    for place in places:
        found = lightcone.voxels(model.box, model.replicas, model.steps, ids.GENERATION_ORDER, place, steps)
        amplitude, field = model.amplitude[found.step, column], model.field[found.step, column]
        g = np.stack([smooth.ravel()[found.box] for smooth in model.box.smoothed], 1)[np.arange(field.size), field]
        volume = model.steps.volume[found.step] / 4.0**found.order
        weight = fine_structure.divide(model.fine, model.steps, found).weight[np.arange(field.size), field]
        density = weight * np.exp(amplitude * g - 0.5 * amplitude**2 * model.box.variance[field])
        total.append([np.sum(volume * density), np.sum(volume)])
    return float(np.divide(*np.sum(total, 0)))


@pytest.mark.parametrize(
    ("z", "half", "reddest", "mass", "within"),
    [(0.1, 0.08, 0.2, 11.4, 0.15), (0.5, 0.05, 0.3, 11.4, 0.10), (1.0, 0.1, 1.5, 12.0, 0.10)],
)
def test_the_luminosity_function_comes_out_of_the_catalogue(drawn, universe, z, half, reddest, mass, within):
    """Counted where even the reddest spectrum is brighter than the limit, relative to the richness of the box."""
    near, far = z - half, z + half
    faintest = min(26.0 - float(FIDUCIAL.distance_modulus(far)) - reddest, -16.0)
    found = np.sum((drawn.z > near) & (drawn.z < far) & (drawn.m_r < faintest))
    expected = expected_number(universe.luminosities, near, far, faintest, drawn.area)
    # About three of ten faint galaxies are satellites in heavy halos, which follow structure more strongly.
    central, satellite = (richness(universe, drawn.places, near, far, log_mass) for log_mass in (mass, 13.5))
    expected *= 0.7 * central + 0.3 * satellite
    assert expected > 400
    assert found == pytest.approx(expected, rel=within)


@pytest.mark.nightly
def test_the_luminosity_function_comes_out_of_a_deep_catalogue_at_z_2(dust):
    deep = galaxies.model(SEED, Universe(galaxy_limit=28.0, **SMALL))
    drawn, cells = population.CellCache(deep.population), (4000, 4001, 4002, 4003, 40_000, 40_001)
    rows = pa.concat_tables([galaxies.draw(cell, deep, drawn, dust) for cell in cells])
    z, m_r = rows["z_true"].to_numpy(), rows["abs_mag_r01"].to_numpy()
    faintest = 28.0 - float(FIDUCIAL.distance_modulus(2.15)) - 4.0
    found = np.sum((z > 1.85) & (z < 2.15) & (m_r < faintest))
    area = len(cells) * sky.cell_area(ids.GENERATION_ORDER)
    expected = expected_number(deep.luminosities, 1.85, 2.15, faintest, area)
    assert expected > 400
    assert found == pytest.approx(expected, rel=0.20)


@pytest.mark.parametrize("z", [0.3, 0.9, 1.5, 2.1])
def test_cosmic_star_formation(drawn, z):
    """Madau & Dickinson 2014, eq. 15, times 0.63 from Salpeter to Chabrier; galaxies below the limit are missing."""
    inside = np.abs(drawn.z - z) < 0.2
    volume = drawn.area * np.radians(1.0) ** 2 * float(FIDUCIAL.comoving_volume(z - 0.2, z + 0.2)) / 0.67**3
    found = np.log10(np.sum(10.0 ** drawn.columns["log_sfr"][inside].astype(float)) / volume)
    assert found == pytest.approx(np.log10(0.63 * 0.015 * (1 + z) ** 2.7 / (1 + ((1 + z) / 2.9) ** 5.6)), abs=0.2)


def test_rows_are_what_the_table_declares(drawn):
    assert validate.find_violations(drawn.every, GALAXIES) == []
    assert validate.find_violations(drawn.halos, HALOS) == []


def test_rows_are_sorted_inside_their_cell(cell):
    index = cell["_healpix_29"].to_numpy()
    ra, dec = cell["ra"].to_numpy(), cell["dec"].to_numpy()
    assert np.all(np.diff(index) >= 0)
    assert np.unique(cell["id"].to_numpy()).size == len(cell)
    true = (cell[name].to_numpy() for name in ("ra_true", "dec_true"))
    assert np.all(sky.cell_at(*true, ids.GENERATION_ORDER) == CELL)
    assert np.array_equal(sky.healpix_29(ra, dec), index)


def test_galaxies_name_halos_of_the_table(drawn):
    """The table contains the halo of each central galaxy, and of each satellite unless its cell was not drawn."""
    columns = drawn.columns
    central, halos = columns["kind"] == 0, drawn.halos["id"].to_numpy()
    assert np.array_equal(columns["halo_id"][central], columns["id"][central])
    assert np.isin(columns["halo_id"][central], halos).all()
    known = np.isin(columns["halo_id"][~central], halos)
    assert 0.9 < known.mean() < 1.0
    mass = dict(zip(halos.tolist(), drawn.halos["log_mass"].to_pylist(), strict=True))
    rows = np.flatnonzero(~central)[known][:1000]
    assert [mass[i] for i in columns["halo_id"][rows].tolist()] == columns["log_halo_mass"][rows].tolist()


@pytest.mark.nightly
def test_satellite_fraction():
    """Zehavi et al. 2011: 0.21 with M_r < -20 nearby; 10 deg2, because a cluster changes the fraction of few cells."""
    universe = galaxies.halos_and_galaxies(SEED, Universe(galaxy_limit=22.0, z_max=0.35, **SMALL))
    cells, bright = population.CellCache(universe), []
    for cell in range(25, 12 << 16, (12 << 16) // 200):
        found = population.members(cells, cell)
        bright.append(found.kind[universe.halos.matching.magnitude(found.z, found.proxy) < -20.0])
    assert np.mean(np.concatenate(bright)) == pytest.approx(0.21, abs=0.02)


def test_redshifts_have_peculiar_velocities(drawn):
    near, columns = drawn.z < 0.5, drawn.columns
    velocity = LIGHT_KM_S * (columns["z_obs"].astype(float) - drawn.z) / (1 + drawn.z)
    central = near & (columns["kind"] == 0)
    assert np.std(velocity[central]) == pytest.approx(290.0, rel=0.15)
    rich = near & (columns["kind"] == 1) & (columns["log_halo_mass"] > 13.5)
    assert np.std(velocity[rich]) > 1.2 * np.std(velocity[central])


def test_positions_are_lensed(drawn):
    columns = drawn.columns
    shift = sky.separation(*(columns[name] for name in ("ra", "dec", "ra_true", "dec_true")))
    assert 0.2 < 60.0 * np.sqrt(np.mean(shift[drawn.z > 1.5] ** 2)) < 3.0
    assert shift[drawn.z < 0.1].max() < 0.2 * shift.max()


@pytest.mark.nightly
def test_a_cell_is_the_same_alone_or_among_others(dust, monkeypatch):
    """A cell has identical bytes in another process, and in a file between other cells."""
    universe = galaxies.model(SEED, Universe(galaxy_limit=22.5, **SMALL))
    other = pickle.loads(pickle.dumps(universe))
    monkeypatch.setattr(build_galaxies, "_universe", lambda facts, own: other)
    monkeypatch.setattr(dust_map, "map_for_request", lambda seed, own: dust)
    facts = {"seed": SEED, "generation_cells": [CELL + 1, CELL, CELL - 1]}
    rows = build_galaxies.draw_galaxies(Path(), facts).rows
    first, last = np.searchsorted(rows["_healpix_29"].to_numpy(), sky.cell_range(ids.GENERATION_ORDER, CELL))
    assert 0 < first < last < rows.num_rows
    again = rows.slice(first, last - first).combine_chunks()
    cell = observed_cells.draw([CELL], universe, population.CellCache(universe.population), dust)
    assert again.equals(cell.combine_chunks())
    # Null columns apart, the bytes themselves.
    for name in cell.column_names:
        if not cell[name].null_count:
            assert again[name].to_numpy().tobytes() == cell[name].to_numpy().tobytes()


def test_a_step_leaves_the_numbers_of_the_others(universe, cells, dust, cell):
    size = dataclasses.replace(universe.shapes.size, pivot=1e10)
    changed = dataclasses.replace(universe, shapes=dataclasses.replace(universe.shapes, size=size))
    other = galaxies.draw(CELL, changed, cells, dust)
    differ = {name for name in cell.column_names if not cell[name].equals(other[name])}
    assert differ == {"bulge_half_light_radius", "disk_half_light_radius"}


def test_the_limit_is_the_limit(drawn):
    vis = drawn.mags["euclid_vis"]
    # The columns are single precision: 1e-5 mag at redshift and luminosity.
    assert vis.max() < 26.0 + 1e-3
    assert np.sum(vis > 25.99) > 0


def test_the_apparent_reference_magnitude_is_near_the_seen_ones(drawn):
    """0.1r (5620 A) lies between LSST g and r for any smooth spectrum."""
    m = drawn.columns["mag_r01"]
    blue, red = drawn.mags["lsst_g"], drawn.mags["lsst_r"]
    between = (m < np.maximum(blue, red) + 0.15) & (m > np.minimum(blue, red) - 0.15)
    assert between.mean() > 0.99


def test_an_empty_cell_is_an_empty_table(dust):
    shallow = galaxies.model(SEED, Universe(galaxy_limit=10.0, **SMALL, **NEARBY))
    rows = galaxies.draw(0, shallow, population.CellCache(shallow.population), dust)
    # High-redshift galaxies and quasars have separate limits.
    assert (rows["z_true"].to_numpy() < 6).sum() < 5
    assert rows.schema.equals(GALAXIES.arrow_schema())
    assert validate.find_violations(rows, GALAXIES) == []


@nightly.parametrize(("band", "limit"), [("euclid_h", 21.5), ("lsst_g", 23.0)], (1,))
def test_a_limit_in_another_band(drawn, dust, band, limit):
    """The number equals that of a deeper catalogue, no galaxy is fainter, and fewer halos are drawn."""
    there = galaxies.model(SEED, Universe(galaxy_limit=limit, galaxy_band=band, **SMALL, **NEARBY))
    cells = population.CellCache(there.population)
    places = drawn.places[:2]
    rows = pa.concat_tables([galaxies.draw(cell, there, cells, dust) for cell in places])
    true = drawn.columns["ra_true"], drawn.columns["dec_true"]
    wanted = np.isin(sky.cell_at(*true, ids.GENERATION_ORDER), places)
    expected = np.sum(drawn.mags[band][wanted] < limit)
    assert rows.num_rows == pytest.approx(expected, rel=0.1)
    z, m_r = (rows[name].to_numpy().astype(float) for name in ("z_true", "abs_mag_r01"))
    sed = band_ratios.Sed(
        *(rows[name].to_numpy() for name in ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1"))
    )
    names = [name for name in rows.column_names if name.startswith("flux_")]
    lines = {name: rows[name].to_numpy() for name in names}
    light = emission_lines.mean_line_flux(there.band, rows["z_obs"].to_numpy(), lines)
    seen = emission_lines.magnitude_with_light(galaxies.apparent_magnitude(there, z, m_r, sed), light)
    assert limit - 0.1 < seen.max() < limit + 1e-3
    halos = sum(galaxies.halo_table(cell, there.population, cells).num_rows for cell in places)
    assert halos < 0.5 * drawn.halos.num_rows * len(places) / len(drawn.places)


def test_a_shallow_limit_needs_little_of_the_volume():
    """Number of drawn halos per steradian, by distance."""
    wanted = (Universe(galaxy_limit=limit, **SMALL) for limit in (18.0, 26.0))
    near, deep = (galaxies.halos_and_galaxies(SEED, one).halos for one in wanted)
    number = [np.sum(m.blocks_above(m.min_mass_limit - 0.6) * m.number, 1) * m.steps.volume for m in (near, deep)]
    assert number[0].sum() < 0.01 * number[1].sum()
    assert np.sum(number[0][near.steps.z > 1.2]) < 1e-3 * number[0].sum()
    assert np.sum(number[1][deep.steps.z > 1.2]) > 0.3 * number[1].sum()


@nightly.parametrize("place", [(0.0, 90.0), pytest.param((0.0, -90.0), marks=pytest.mark.nightly), (0.0, 0.0)], (2,))
def test_poles_and_the_first_meridian(universe, dust, place):
    at = int(sky.cell_at([place[0]], [place[1]], ids.GENERATION_ORDER)[0])
    rows = galaxies.draw(at, universe, population.CellCache(universe.population), dust)
    assert validate.find_violations(rows, GALAXIES) == []
    assert len(rows) == pytest.approx(19_200, rel=0.3)
    # On both sides of the meridian; at the poles a quarter of all right ascensions.
    west = np.mean(rows["ra_true"].to_numpy() > 180.0)
    assert 0.4 < west < 0.6 if place[1] == 0.0 else west in (0.0, 1.0)


@pytest.mark.nightly
def test_the_deepest_and_widest_request(dust):
    deep = galaxies.model(SEED, Universe(galaxy_limit=28.0, **SMALL))
    rows = galaxies.draw((12 << 16) - 1, deep, population.CellCache(deep.population), dust)
    assert validate.find_violations(rows, GALAXIES) == []
    assert rows.filter(pa.array(rows["kind"].to_numpy() < 2))["z_true"].to_numpy().max() > 5.7
    nearer = np.sum(rows["z_true"].to_numpy() < 2.3) / sky.cell_area(ids.GENERATION_ORDER)
    # Twice those of I_E < 26 and more; fewer than the counts to i = 26 extrapolated (LSST Science Book 2009, eq. 3.7).
    assert 2.0 * 73.0 * ARCMIN2_PER_DEG2 < nearer < 46.0 * 10.0 ** (0.31 * 3.0) * ARCMIN2_PER_DEG2
