"""Stars of cells: counts behind dust, rows as declared, the same stars in any order of cells."""

import dataclasses
import pickle

import numpy as np
import pyarrow as pa
import pytest

from jobs.catalogue.stars import stars
from jobs.fluxes.libraries import stellar
from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import validate
from lake_schema.tables.stars import STARS
from tests.jobs.catalogue.conftest import SEED

UNIVERSE = stars.model()
# l = 283.7, b = 37.9
CELL = 402_512


@pytest.fixture(scope="module")
def cell(dust):
    return stars.draw(CELL, SEED, UNIVERSE, dust)


def galactic_cell(lon, lat):
    """The cell that holds a Galactic position."""
    from astropy.coordinates import SkyCoord

    at = SkyCoord(lon, lat, unit="deg", frame="galactic").icrs
    return int(sky.cell_of([at.ra.deg], [at.dec.deg], ids.GENERATION_ORDER)[0])


@pytest.mark.parametrize(("b", "published"), [(90, 36451), (60, 47254), (45, 67569), (30, 124538), (20, 249659)])
def test_counts_with_dust(dust, b, published):
    """Stars deg^-2 with H < 26 (Vega), mean over longitude; the dust takes a few per cent."""
    numbers = [len(stars.draw(galactic_cell(lon, b), SEED, UNIVERSE, dust)) for lon in range(0, 360, 45)]
    assert np.mean(numbers) / sky.cell_area(ids.GENERATION_ORDER) == pytest.approx(published, rel=0.15)


def test_rows_are_what_the_table_declares(cell):
    assert validate.violations(cell, STARS) == []
    index = cell["_healpix_29"].to_numpy()
    assert np.all(np.diff(index) >= 0)
    assert np.unique(cell["id"].to_numpy()).size == len(cell)
    assert np.all(ids.kind_of(cell["id"].to_numpy()) == stars.STAR)
    ra, dec = cell["ra"].to_numpy(), cell["dec"].to_numpy()
    assert np.all(sky.cell_of(ra, dec, ids.GENERATION_ORDER) == CELL)
    assert np.array_equal(sky.healpix_29(ra, dec), index)


def test_a_cell_is_the_same_alone_or_among_others(dust, cell):
    stars.draw(7, SEED, UNIVERSE, dust)
    again = stars.draw(CELL, SEED, pickle.loads(pickle.dumps(UNIVERSE)), dust)
    for name in cell.column_names:
        assert again[name].to_numpy().tobytes() == cell[name].to_numpy().tobytes()
    assert not stars.draw(CELL, SEED + 1, UNIVERSE, dust).equals(cell)


def test_magnitudes_distances_and_the_limit_agree(cell):
    columns = {name: cell[name].to_numpy().astype(float) for name in ("mag_h", "abs_mag_h", "distance", "a_v")}
    assert columns["mag_h"] == pytest.approx(columns["abs_mag_h"] + 5 * np.log10(columns["distance"] / 10), abs=1e-4)
    seen = columns["mag_h"] + 0.178 * columns["a_v"]
    assert 25.9 < seen.max() <= 26.0 + 1e-4


def test_dust_grows_with_distance_and_ends_at_the_map(dust, cell):
    a_v, distance = cell["a_v"].to_numpy(), cell["distance"].to_numpy()
    near, far = a_v[distance < 200], a_v[distance > 3000]
    assert near.max() < far.min()
    from jobs.catalogue import dust_map

    total = dust_map.a_v(dust, cell["ra"].to_numpy(), cell["dec"].to_numpy())
    assert a_v[distance > 3000] == pytest.approx(total[distance > 3000], rel=1e-3)


def test_a_brighter_limit_has_fewer_stars(dust, cell):
    bright = stars.draw(CELL, SEED, stars.model(20.0), dust)
    wanted = np.sum(cell["mag_h"].to_numpy() + 0.178 * cell["a_v"].to_numpy() < 20)
    assert len(bright) == pytest.approx(wanted, abs=6 * np.sqrt(wanted))
    empty = stars.draw(CELL, SEED, stars.model(0.0), dust)
    assert len(empty) == 0
    assert empty.schema.equals(STARS.arrow())


def test_bright_stars_are_left_out_and_the_others_are_the_same(dust, cell):
    faint = stars.draw(CELL, SEED, stars.model(brightest=20.0), dust)
    seen = cell["mag_h"].to_numpy() + UNIVERSE.h_over_v * cell["a_v"].to_numpy()
    assert 0 < np.sum(seen < 20.0) < len(cell)
    assert faint.equals(cell.filter(pa.array(seen >= 20.0)))


def test_templates_are_the_nearest_in_temperature(rng):
    library = stellar.types().teff
    teff = np.exp(rng.uniform(np.log(2000.0), np.log(50_000.0), 500))
    brute = np.argmin(np.abs(np.log(library)[None, :] - np.log(teff)[:, None]), axis=1)
    found = stars.nearest_template(library, teff)
    assert np.array_equal(library[found], library[brute])


def test_stars_are_as_hot_as_their_template(cell):
    cell = cell.filter(pa.array(cell["component"].to_numpy() != stars.BROWN))
    teff, template = cell["teff"].to_numpy(), UNIVERSE.types.teff[cell["sed"].to_numpy()]
    assert np.median(np.abs(teff / template - 1)) < 0.02


def test_a_cell_in_the_plane(dust):
    """H < 20 towards the Galactic centre: many stars behind 9 mag of dust, all inside their bounds."""
    rows = stars.draw(galactic_cell(0.0, 0.5), SEED, stars.model(26.0, plane_limit=20.0), dust)
    assert len(rows) > 20_000
    assert validate.violations(rows, STARS) == []


def test_numbers_are_those_that_are_drawn(dust):
    cells = np.arange(CELL, CELL + 4)
    found = stars.numbers(cells, UNIVERSE)
    drawn = [len(stars.draw(int(cell), SEED, UNIVERSE, 0 * dust)) for cell in cells]
    assert found == pytest.approx(drawn, rel=0.01, abs=5 * np.sqrt(found.max()))
    assert np.all(stars.numbers(cells, stars.model(18.0)) < 0.1 * found)
    assert stars.numbers([], UNIVERSE).size == 0


def test_the_plane_is_refused_or_has_its_own_limit():
    high, low = galactic_cell(0.0, 6.0), galactic_cell(0.0, 0.5)
    with pytest.raises(BadInput, match=r"1 of the area's cells lie within 5 deg .* stars\.plane_limit"):
        stars.numbers([high, low], UNIVERSE)
    with pytest.raises(BadInput, match=r"1 of the area's cells hold more than .* brighter stars\.plane_limit"):
        stars.numbers([high, low], stars.model(26.0, plane_limit=26.0))
    high_alone = stars.numbers([high], UNIVERSE)
    both = stars.numbers([high, low], stars.model(26.0, plane_limit=18.0))
    assert both[0] == high_alone[0]
    assert both[1] == stars.numbers([low], stars.model(18.0, plane_limit=18.0))[0]


def test_labels_leave_the_numbers_of_the_others(dust, cell):
    metallicity = dataclasses.replace(UNIVERSE.galaxy.metallicity, mean=(0.1, -0.2, -0.5), hotter=(0.0, 0.0, 300.0))
    changed = dataclasses.replace(UNIVERSE, galaxy=dataclasses.replace(UNIVERSE.galaxy, metallicity=metallicity))
    other = stars.draw(CELL, SEED, changed, dust)
    differ = {name for name in cell.column_names if not cell[name].equals(other[name])}
    assert differ == {"metallicity", "teff", "sed"}
