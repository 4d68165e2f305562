"""Satellites are not lost or duplicated at any edge, and a cell does not depend on the other drawn cells."""

import numpy as np
import pytest

from lake_schema import ids, sky
from truesky.catalogue.halos import halos, population, satellites
from truesky.catalogue.halos.population import CellCache

# A block of four cells at an edge of an order-5 cell and of a base cell.
BLOCK = [4 * ((3 << 16) // 4 - 1) + i for i in range(4)]


@pytest.fixture(scope="module")
def block(universe):
    drawn = CellCache(universe.population)
    return {cell: population.members(drawn, cell) for cell in BLOCK}


def falling_in(universe, block):
    """Return the identifiers of all satellites of nearby halos that are inside the block."""
    drawn = CellCache(universe.population)
    found_in = []
    for order in halos.LEVELS:
        own = {cell >> 2 * (8 - order) for cell in block}
        ring = {int(c) for cell in own for c in sky.margin_cells(order, cell, order)}
        # One ring more than is needed: nothing comes from there.
        wide = {int(c) for cell in ring for c in sky.margin_cells(order, cell, order)} if order == 8 else set()
        for cell in sorted(own | ring | wide):
            hosts, found = drawn.halos_and_satellites(order, cell)
            inside = np.isin(sky.cell_at(found.ra, found.dec, 8), block)
            inside &= (found.chi > universe.population.halos.steps.edge[0]) & (
                found.chi < universe.population.halos.max_distance
            )
            own = ids.satellite_id(hosts.id[found.host], found.member, hosts.bits[found.host])
            found_in.append(own[inside])
    return np.sort(np.concatenate(found_in))


def satellites_of(members):
    return np.sort(np.concatenate([one.id[one.kind == 1] for one in members]))


def test_satellites_are_neither_lost_nor_doubled(universe, block):
    found = satellites_of(block.values())
    assert found.size > 1000
    assert np.array_equal(found, falling_in(universe, BLOCK))
    assert np.unique(found).size == found.size


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("ra", "dec"), [((45, 135, 225, 315), 89.9), ((45, 135, 225, 315), -89.9), ((359.9, 0, 0.1), 0.1)]
)
def test_satellites_at_a_pole_and_across_the_first_meridian(universe, ra, dec):
    places = sorted({int(cell) for cell in sky.cell_at(np.array(ra, float), np.full(len(ra), dec), 8)})
    drawn = CellCache(universe.population)
    found = satellites_of([population.members(drawn, cell) for cell in places])
    assert found.size > 500
    assert np.array_equal(found, falling_in(universe, places))


def test_some_satellites_are_in_neighbouring_cells(block):
    for cell, members in block.items():
        home = (members.id >> 40) & ((1 << 20) - 1)
        assert np.all(home[members.kind == 0] == cell)
        share = np.mean(home[members.kind == 1] != cell)
        assert 0.001 < share < 0.1


def test_members_lie_in_their_cell_sorted(block):
    for cell, members in block.items():
        assert np.all(members.index >> 2 * (29 - 8) == cell)
        assert np.all(np.diff(members.index) >= 0)
        assert np.array_equal(sky.healpix_29(members.ra, members.dec), members.index)
        # The identifiers of a galaxy and its halo differ in kind and member.
        own = members.id & ((1 << 60) - 1)
        member = own - members.halo_id
        assert np.all(member[members.kind == 0] == 0)
        assert np.all((member[members.kind == 1] > 0) & (own & members.halo_id == members.halo_id)[members.kind == 1])


def test_a_cell_alone_is_the_same(universe, block):
    alone = population.members(CellCache(universe.population), BLOCK[2])
    for name in ("id", "index", "chi", "z_obs", "proxy", "host_mass"):
        assert getattr(alone, name).tobytes() == getattr(block[BLOCK[2]], name).tobytes()


def test_satellites_follow_their_profile(universe, rng):
    """NFW: enclosed mass at the radius that holds a share u of it is that share."""
    for c in (3.0, 8.0, 20.0):
        u = rng.random(500)
        x = c * satellites.nfw_radius(np.full(500, c), u)
        inside = (np.log1p(x) - x / (1 + x)) / (np.log1p(c) - c / (1 + c))
        assert inside == pytest.approx(u, abs=2e-3)


def test_satellites_lie_within_their_halo(universe):
    model = universe.population
    hosts = halos.draw(model.halos, 3, 8, 1234)
    found = satellites.draw(model.halos, model.masses, hosts, 1)
    ra, dec = sky.positions_of_indices(hosts.index)
    angle = np.radians(sky.separation(found.ra, found.dec, ra[found.host], dec[found.host]))
    apart = np.hypot(hosts.chi[found.host] * angle, found.chi - hosts.chi[found.host])
    radius = model.masses.radius(hosts.log_mass)[found.host]
    assert np.all(apart < 1.01 * radius)
    assert 0.3 < np.median(apart / radius) < 0.6
    assert found.member.min() == 1
    assert np.all(np.diff(found.host) >= 0)
