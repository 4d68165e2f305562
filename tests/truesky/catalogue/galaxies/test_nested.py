"""A shallower or nearer request is a subset of a deeper one: all rows within its limits, with identical bits."""

from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from tests.truesky.catalogue.conftest import SEED, SMALL
from truesky.catalogue import dust_map
from truesky.catalogue.galaxies import band_ratios, emission_lines, galaxies, strong_lenses
from truesky.catalogue.halos import halos, matching, population
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe

# A corner of a base cell, a pole, the first meridian, and cells anywhere.
CELLS = (303_117, 0, 65_535, 5_000, 524_288, 700_001)
LIMITS, REDSHIFTS = (20.0, 23.0, 26.0), (1.0, 2.3)


@cache
def model(limit, z_max, seed=SEED):
    maps = {} if seed == SEED else {"lensing": (0.02, -0.01)}
    universe = galaxies.model(seed, Universe(galaxy_limit=limit, z_max=z_max, **SMALL, **maps))
    return universe, population.CellCache(universe.population)


@cache
def tables(limit, z_max, cell, seed=SEED):
    """Draw galaxies of all kinds and halos once for all tests, which do not change them."""
    universe, cells = model(limit, z_max, seed)
    dust = dust_map.load(SEED)
    return galaxies.draw(cell, universe, cells, dust), galaxies.halo_table(cell, universe.population, cells)


def of(rows, wanted):
    """Return the rows with these identifiers in the order of the table."""
    return rows.filter(pa.array(np.isin(rows["id"].to_numpy(), wanted["id"].to_numpy())))


def magnitude(universe, rows):
    """Return the magnitude in the band of the limit."""
    z, m_r = (rows[name].to_numpy().astype(float) for name in ("z_true", "abs_mag_r01"))
    names = ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
    continuum = galaxies.apparent_magnitude(
        universe, z, m_r, band_ratios.Sed(*(rows[name].to_numpy() for name in names))
    )
    lines = {name: rows[name].to_numpy() for name in rows.column_names if name.startswith("flux_")}
    return emission_lines.magnitude_with_light(
        continuum, emission_lines.mean_line_flux(universe.band, rows["z_obs"].to_numpy(), lines)
    )


def same(one, other):
    assert one.num_rows == other.num_rows
    assert one.schema.equals(other.schema)
    for name in one.column_names:
        a, b = (table[name].combine_chunks() for table in (one, other))
        assert a.equals(b), name
        a, b = (column.flatten() if pa.types.is_list(column.type) else column for column in (a, b))
        if not a.null_count:
            # Zeros of either sign are equal, but not the same.
            assert a.to_numpy(zero_copy_only=False).tobytes() == b.to_numpy(zero_copy_only=False).tobytes(), name


def check(shallow, deep, cell):
    (few, some), (many, every) = tables(*shallow, cell), tables(*deep, cell)
    same(few, of(many, few))
    same(some, of(every, some))
    # And it is all that there is: what a deeper table has to the shallower limits.
    universe, _ = model(*shallow)
    few, many = (rows.filter(pc.less(rows["kind"], 2)) for rows in (few, many))
    # Columns are single precision.
    z = many["z_true"].to_numpy()
    seen = (magnitude(universe, many) < shallow[0] - 1e-3) & (z < np.float32(shallow[1]) - 1e-6)
    assert np.isin(many["id"].to_numpy()[seen], few["id"].to_numpy()).all()
    limits = galaxies.halo_limits(universe.population)
    z, mass = every["z_true"].to_numpy(), every["log_mass"].to_numpy()
    least = np.interp(z, limits["z_true"].to_numpy(), limits["log_mass"].to_numpy()) + 1e-4
    listed = (mass > least) & (z < np.float32(shallow[1]) - 1e-6)
    assert np.isin(every["id"].to_numpy()[listed], some["id"].to_numpy()).all()
    return few.num_rows, some.num_rows


def test_a_shallower_and_a_nearer_request_are_parts_of_a_deeper_one():
    deep = (23.0, 2.3)
    for shallow in ((20.0, 2.3), (23.0, 1.0)):
        few, some = check(shallow, deep, CELLS[0])
        assert few > 50
        assert some > few


def test_nothing_is_missing_at_the_limit():
    """Galaxies that only their lines lift above the limit are present, except one in 10^4."""
    found = (tables(limit, 2.3, CELLS[0])[0] for limit in (23.0, 24.0))
    few, many = (rows.filter(pc.less(rows["kind"], 2)) for rows in found)
    universe, _ = model(23.0, 2.3)
    seen = magnitude(universe, many) < 23.0 - 1e-3
    last = seen & (magnitude(universe, many) > 22.8)
    assert last.sum() > 200
    assert np.isin(many["id"].to_numpy()[seen], few["id"].to_numpy()).all()
    z, m_r = (few[name].to_numpy().astype(float) for name in ("z_true", "abs_mag_r01"))
    names = ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
    continuum = galaxies.apparent_magnitude(
        universe, z, m_r, band_ratios.Sed(*(few[name].to_numpy() for name in names))
    )
    assert 0.005 < np.mean(continuum > 23.0) < 0.05


@pytest.mark.nightly
@pytest.mark.parametrize("cell", CELLS)
def test_every_pair_of_limits(cell):
    requests = [(limit, z_max) for limit in LIMITS for z_max in REDSHIFTS]
    pairs = [(a, b) for a in requests for b in requests if a != b and a[0] <= b[0] and a[1] <= b[1]]
    assert len(pairs) == 12
    for shallow, deep in pairs:
        check(shallow, deep, cell)


@pytest.mark.nightly
def test_the_deepest_and_farthest_request_holds_a_usual_one():
    deepest = (29.0, min(6.0, matching.Z_LAST))
    few, some = check((26.0, 2.3), deepest, CELLS[0])
    many, every = tables(*deepest, CELLS[0])
    for rows, least in ((many, few), (every, some)):
        assert rows.num_rows > 3 * least
        assert np.unique(rows["id"].to_numpy()).size == rows.num_rows


def test_hosts_behind_the_end_of_a_request_have_their_satellites_before_it():
    """Satellites of hosts in the step behind the end, which a farther request always draws."""
    (near, of_near), (_, of_far) = ((one.population, cells) for one, cells in (model(23.0, 0.3), model(23.0, 0.6)))
    for cell in range(303_104, 303_120):
        a, b = population.members(of_near, cell), population.members(of_far, cell)
        assert np.array_equal(a.id, b.id[b.chi < near.halos.max_distance])
    hosts, _ = of_near.halos_and_satellites(halos.LEVELS[0], 303_117)
    assert hosts.chi.max() > near.halos.max_distance
    assert np.all(hosts.chi < near.halos.max_distance + 2 * near.halos.box.model.cell)


def test_strong_lenses_of_a_shallower_catalogue_are_among_those_of_a_deeper_one():
    few, many = (tables(limit, 2.3, CELLS[0])[0] for limit in (23.0, 24.0))
    some, every = (strong_lenses.draw(CELLS[0], rows, SEED, 1000.0, FIDUCIAL) for rows in (few, many))
    assert 5 < some.num_rows < every.num_rows
    same(some, of(every, some))
    lost = ~np.isin(every["id"].to_numpy(), some["id"].to_numpy())
    there = [np.isin(every[name].to_numpy()[lost], few["id"].to_numpy()) for name in ("lens_id", "source_id")]
    assert not np.any(there[0] & there[1])


@pytest.mark.parametrize(
    ("limit", "z_max", "seed"),
    [
        pytest.param(*case, seed, marks=[] if number % 2 == turn else [pytest.mark.nightly])
        for number, case in enumerate([(16.0, 0.01), (16.0, 0.3), (20.0, 0.05)])
        for turn, seed in enumerate((0, 2**63 - 1))
    ],
)
def test_extreme_requests(seed, limit, z_max):
    few, some = tables(limit, z_max, CELLS[0], seed)
    many, every = tables(20.0, 0.3, CELLS[0], seed)
    same(few, of(many, few))
    same(some, of(every, some))
