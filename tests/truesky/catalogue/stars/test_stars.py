"""Stars of cells: counts behind dust, rows as declared, the same stars in any order of cells."""

import pickle

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import validate
from lake_schema.tables.stars import STARS
from tests.truesky.catalogue.conftest import SEED
from truesky.catalogue.stars import stars
from truesky.fluxes import sources
from truesky.fluxes.libraries import stellar, templates
from truesky.validation.model import star_counts

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
    return int(sky.cell_at([at.ra.deg], [at.dec.deg], ids.GENERATION_ORDER)[0])


@pytest.mark.parametrize(("b", "published"), [(b, found[-1]) for b, found in star_counts.COUNTS.items()])
def test_counts_with_dust(dust, b, published):
    """Primaries deg^-2 with H < 26 (Vega), mean over longitude; the dust takes a few per cent."""
    drawn = (stars.draw(galactic_cell(lon, b), SEED, UNIVERSE, dust) for lon in range(0, 360, 45))
    numbers = [rows["companion_of"].null_count for rows in drawn]
    assert np.mean(numbers) / sky.cell_area(ids.GENERATION_ORDER) == pytest.approx(published, rel=0.15)


def test_rows_are_what_the_table_declares(cell):
    assert validate.find_violations(cell, STARS) == []
    index = cell["_healpix_29"].to_numpy()
    assert np.all(np.diff(index) >= 0)
    assert np.unique(cell["id"].to_numpy()).size == len(cell)
    assert np.all(ids.kind_from_id(cell["id"].to_numpy()) == stars.STAR)
    ra, dec = cell["ra"].to_numpy(), cell["dec"].to_numpy()
    assert np.all(sky.cell_at(ra, dec, ids.GENERATION_ORDER) == CELL)
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
    from truesky.catalogue import dust_map

    total = dust_map.a_v(dust, cell["ra"].to_numpy(), cell["dec"].to_numpy())
    assert a_v[distance > 3000] == pytest.approx(total[distance > 3000], rel=1e-3)


def test_a_brighter_limit_has_fewer_stars(dust, cell):
    """Sample of one cell, drawn twice; significance 2e-5 of the difference (6 Poisson errors of one)."""
    bright = stars.draw(CELL, SEED, stars.model(20.0), dust)
    wanted = np.sum(cell["mag_h"].to_numpy() + 0.178 * cell["a_v"].to_numpy() < 20)
    assert len(bright) == pytest.approx(wanted, abs=6 * np.sqrt(wanted))
    empty = stars.draw(CELL, SEED, stars.model(0.0), dust)
    assert len(empty) == 0
    assert empty.schema.equals(STARS.arrow_schema())


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


def test_stars_are_what_their_templates_are(cell):
    """The mean of a star's templates has its temperature; dwarfs, models and white dwarfs."""
    found = sources.stars_from_table(cell, templates.stellar_library())
    grid = [
        np.log(float(name.split(" K")[0])) if " K " in name else np.nan for name in templates.stellar_library().names
    ]
    ln_teff = np.array(grid)
    ln_teff[: UNIVERSE.types.teff.size] = np.log(UNIVERSE.types.teff)
    mean = np.nansum(found.frac * np.where(found.frac > 0, ln_teff[found.sed], 0.0), axis=0)
    usual = cell["component"].to_numpy() != stars.BROWN
    # Giants cooler than the models take their coolest.
    off = np.exp(mean[usual]) / cell["teff"].to_numpy()[usual] - 1
    assert np.quantile(np.abs(off), 0.99) < 0.003


def test_companions_are_close_to_their_stars(cell):
    rows = {name: cell[name].to_numpy(zero_copy_only=False) for name in cell.column_names}
    second = np.flatnonzero(cell["companion_of"].is_valid().to_numpy())
    place = {int(one): k for k, one in enumerate(rows["id"])}
    of = np.array([place.get(int(one), -1) for one in rows["companion_of"][second]])
    assert np.mean(of >= 0) > 0.999
    second, of = second[of >= 0], of[of >= 0]
    assert 0.1 < second.size / len(cell) < 0.25
    assert np.all(rows["mass"][second] <= rows["mass"][of])
    for name in ("distance", "age", "metallicity", "pm_ra", "pm_dec", "radial_velocity", "component"):
        assert np.array_equal(rows[name][second], rows[name][of])
    apart = 3600 * sky.separation(rows["ra"][second], rows["dec"][second], rows["ra"][of], rows["dec"][of])
    au = apart * rows["distance"][of]
    assert au.max() < 20_001
    assert np.median(au) == pytest.approx(12, rel=0.5)


def test_stars_move_as_their_populations_do(cell):
    """Mean velocities (km/s) of discs and halo; halo stars lag behind the Sun."""
    across = 4.74e-3 * np.hypot(cell["pm_ra"].to_numpy(), cell["pm_dec"].to_numpy()) * cell["distance"].to_numpy()
    component = cell["component"].to_numpy()
    speeds = [np.median(across[component == code]) for code in (0, 1, 2)]
    assert 30 < speeds[0] < 60
    assert speeds[0] < speeds[1] < 0.6 * speeds[2]
    assert 90 < cell["radial_velocity"].to_numpy()[component == 2].std() < 140


def test_there_are_more_stars_towards_the_bulge(dust):
    """H < 17 at l = 0, b = -8, where every seventh giant of the bulge is seen; and none at l = 180."""
    universe = stars.model(26.0, plane_limit=17.0)
    rows = stars.draw(galactic_cell(0.0, -8.0), SEED, universe, 0 * dust)
    of_bulge = rows["component"].to_numpy() == 5
    assert 0.3 < of_bulge.mean() < 0.9
    assert np.median(rows["distance"].to_numpy()[of_bulge]) == pytest.approx(7000, abs=1500)
    far = stars.draw(galactic_cell(180.0, -8.0), SEED, universe, 0 * dust)
    assert np.sum(far["component"].to_numpy() == 5) == 0


def test_a_cell_in_the_plane(dust):
    """H < 17 towards the Galactic centre: many stars behind 9 mag of dust, all inside their bounds."""
    rows = stars.draw(galactic_cell(0.0, 0.5), SEED, stars.model(26.0, plane_limit=17.0), dust)
    assert len(rows) > 20_000
    assert validate.find_violations(rows, STARS) == []


def test_numbers_are_those_that_are_drawn(dust):
    """Sample of four cells; significance 2e-9 (6 standard errors), or 1 % for the finer grid of the draws."""
    cells = np.arange(CELL, CELL + 4)
    found = stars.expected_counts(cells, UNIVERSE)
    drawn = [len(stars.draw(int(cell), SEED, UNIVERSE, 0 * dust)) for cell in cells]
    assert found == pytest.approx(drawn, rel=0.01, abs=6 * np.sqrt(found.max()))
    assert np.all(stars.expected_counts(cells, stars.model(18.0)) < 0.1 * found)
    assert stars.expected_counts([], UNIVERSE).size == 0


def test_the_plane_is_refused_or_has_its_own_limit():
    high, low = galactic_cell(90.0, 6.0), galactic_cell(0.0, 0.5)
    assert [bool(stars._is_crowded(*at)) for at in ((0.0, 10.5), (21.0, 6.0), (340.5, -9.5))] == [False, False, True]
    with pytest.raises(BadInput, match=r"1 of the area's cells lie within 5 deg .* stars\.plane_limit"):
        stars.expected_counts([high, low], UNIVERSE)
    with pytest.raises(BadInput, match=r"1 of the area's cells contain more than .* brighter stars\.plane_limit"):
        stars.expected_counts([high, low], stars.model(26.0, plane_limit=26.0))
    high_alone = stars.expected_counts([high], UNIVERSE)
    both = stars.expected_counts([high, low], stars.model(26.0, plane_limit=18.0))
    assert both[0] == high_alone[0]
    assert both[1] == stars.expected_counts([low], stars.model(18.0, plane_limit=18.0))[0]


def test_seeds_at_both_ends(dust):
    """Seeds 0 and 2^63 - 1, at both poles."""
    for lat in (90.0, -90.0):
        rows = [stars.draw(galactic_cell(0.0, lat), seed, stars.model(20.0), dust) for seed in (0, 2**63 - 1)]
        assert not rows[0].equals(rows[1])
        for each in rows:
            assert validate.find_violations(each, STARS) == []
