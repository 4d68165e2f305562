"""Test extreme requests, and the heaviest halo in front of a field."""

from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from lake_schema import ids, sky
from lake_schema.store import validate
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALOS
from lake_schema.tables.stars import STARS
from tests.truesky.catalogue.conftest import SEED, SMALL
from truesky.catalogue import build_galaxies, dust_map
from truesky.catalogue.external import mapping
from truesky.catalogue.galaxies import galaxies, halo_lensing, lensing
from truesky.catalogue.halos import halo_catalogue, population
from truesky.catalogue.stars import stars
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe

CELL = 303_117
FIRST, LAST = 0, 2**63 - 1
# Nobody makes two boxes for the ends of the seeds: one shear in place of the maps.
SHEARED = {**SMALL, "lensing": (0.02, -0.01)}


def drawn(seed, limit, z_max, cell=CELL):
    universe = galaxies.model(seed, Universe(galaxy_limit=limit, z_max=z_max, **SHEARED))
    cells = population.CellCache(universe.population)
    return galaxies.draw(cell, universe, cells, dust_map.load(SEED)), galaxies.halo_table(
        cell, universe.population, cells
    )


def with_either(cases):
    """Return (case, seed): the smallest and largest seed in turn, or both in nightly runs."""
    return [
        pytest.param(*case, seed, marks=[] if number % 2 == turn else [pytest.mark.nightly])
        for number, case in enumerate(cases)
        for turn, seed in enumerate((FIRST, LAST))
    ]


@pytest.mark.parametrize(
    ("limit", "z_max", "seed"),
    [
        *with_either([(29.0, 0.01), (16.0, 2.0)]),
        *(
            pytest.param(*case, seed, marks=pytest.mark.nightly)
            for case in ((16.0, 6.0), (29.0, 0.1), (16.0, 0.01))
            for seed in (FIRST, LAST)
        ),
    ],
)
def test_smallest_and_largest_limits_and_redshifts(seed, limit, z_max):
    rows, halos = drawn(seed, limit, z_max)
    assert validate.find_violations(rows, GALAXIES) == []
    assert validate.find_violations(halos, HALOS) == []
    near = rows.filter(pc.less(rows["kind"], 2))
    assert near["z_true"].to_numpy().max(initial=0.0) <= np.float32(z_max)
    assert np.unique(rows["id"].to_numpy()).size == rows.num_rows
    if limit == 29.0 and z_max == 0.1:
        # A dwarf in 10 (Mpc/h)^3 of 140.
        assert near.num_rows > 5


@pytest.mark.parametrize(
    ("ra", "dec", "seed"), with_either([(0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (266.405, -28.936)])
)
def test_poles_first_meridian_and_galactic_centre(seed, ra, dec):
    """Draw galaxies, and stars up to the limit for the Galactic plane."""
    cell = int(sky.cell_at([ra], [dec], ids.GENERATION_ORDER)[0])
    rows, _ = drawn(seed, 19.0, 0.3, cell)
    assert validate.find_violations(rows, GALAXIES) == []
    assert rows.num_rows > 3
    points = stars.draw(cell, seed, stars.model(20.0, plane_limit=13.0), dust_map.load(SEED))
    assert validate.find_violations(points, STARS) == []
    assert points.num_rows > 20
    for table in (rows, points):
        assert (sky.cell_at(table["ra"].to_numpy(), table["dec"].to_numpy(), ids.GENERATION_ORDER) == cell).all()


# ------------------------------------------------------------------------------------------------ a halo in front


@cache
def in_front(folder):
    """A universe of two halos: of 10^15.5 Msun/h at z = 0.05 in the middle of the cell, and a usual one behind it."""
    ra, dec = sky.cell_centre(ids.GENERATION_ORDER, CELL)
    values = {"ra": [ra, ra], "dec": [dec, dec + 0.02], "z": [0.05, 0.5], "mass": [10.0**15.5, 1e13]}
    path = folder / "halos.parquet"
    pq.write_table(pa.table(values), path)
    columns = {
        "ra": '{"column": "ra", "unit": "deg"}',
        "dec": '{"column": "dec", "unit": "deg"}',
        "z_true": '"z"',
        "log_mass": '{"column": "mass", "log10": true, "unit": "Msun/h"}',
    }
    cone = halo_catalogue.load([path], [file_sha256(path)], mapping.halo_columns(columns, FIDUCIAL))
    universe = galaxies.model(SEED, Universe(galaxy_limit=23.0, z_max=1.0, **SMALL), cone)
    return universe, population.CellCache(universe.population), (ra, dec)


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            halo_catalogue, "cached_arrays", lambda name, key, make: {k: np.asarray(v) for k, v in make().items()}
        )
        yield in_front(tmp_path_factory.mktemp("halos"))


def lensed(heavy, ra, dec, chi):
    universe, cells, _ = heavy
    around = halo_lensing.lens_of_cell(universe.lens, cells, CELL)
    found = halo_lensing.columns(around, np.atleast_1d(ra), np.atleast_1d(dec), np.atleast_1d(chi))
    return {name: values.astype(float) for name, values in found.items()}


def test_heaviest_halo_deflects_and_shears_background_galaxies(heavy):
    """Deflections point away from its centre and are at most 1.5 arcmin; foreground galaxies stay in place."""
    ra, dec = heavy[2]
    far, near = (float(FIDUCIAL.comoving_distance(z)) for z in (1.0, 0.03))
    east = ra + np.array([1.0, 3.0, 8.0]) / 60.0 / np.cos(np.radians(dec))
    behind, before = (lensed(heavy, east, np.full(3, dec), np.full(3, chi)) for chi in (far, near))
    for found in (behind, before):
        assert all(np.isfinite(values).all() for values in found.values())
    moved = (behind["ra"] - east) * np.cos(np.radians(dec)) * 3600.0
    assert (moved > 3.0).all()
    assert (moved < 90.0).all()
    # Tangential to a mass in the west: negative along east-west.
    assert (behind["gamma1"] < -0.01).all()
    assert np.abs(before["gamma1"]).max() < 0.01


def test_a_galaxy_exactly_behind_a_centre(heavy):
    """A galaxy at the centre of the halo stays in place with finite values; one next to it is deflected."""
    universe, cells, place = heavy
    around = halo_lensing.lens_of_cell(universe.lens, cells, CELL)
    near, far = (np.full(2, float(FIDUCIAL.comoving_distance(z))) for z in (0.05, 1.0))
    centre = [np.full(2, angle) for angle in place]
    seen = lensing.displace(*centre, *lensing.interpolate(around.box, *centre, near)[3:])
    seen[1][1] += 5e-3
    kappa, _, _, east, north = halo_lensing.lensing_at_images(around, *seen, far)
    assert np.isfinite([kappa, east, north]).all()
    moved = np.degrees(np.hypot(east, north)) * 3600.0
    assert moved[0] < 1.0 < 5.0 < moved[1]
    assert kappa[0] > kappa[1] > 0.0
    assert kappa[0] > 0.1
    whole = lensed(heavy, *place, far[0])
    assert all(np.isfinite(values).all() for values in whole.values())


def test_the_catalogue_behind_the_heaviest_halo(heavy):
    """Rows are within their bounds; galaxies at caustics are separate, and no galaxy is lost."""
    universe, cells, _ = heavy
    rows = galaxies.draw(CELL, universe, cells, dust_map.load(SEED))
    hosts = galaxies.halo_table(CELL, universe.population, cells)
    assert hosts["log_mass"].to_numpy().max() == pytest.approx(15.5, abs=1e-6)
    made = build_galaxies._split_quarantine({"generation_cells": [CELL]}, rows)
    assert validate.find_violations(made.rows, GALAXIES) == []
    apart = rows.num_rows - made.rows.num_rows
    assert bool(apart) == bool(made.files)
    assert made.rows.num_rows > 300
