"""Galaxies are in the cells of their observed positions: none is lost or duplicated at a border."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES
from tests.truesky import nightly
from tests.truesky.catalogue.conftest import SEED, SMALL
from truesky.catalogue.galaxies import galaxies, lensing, observed_cells
from truesky.catalogue.halos.population import CellCache
from truesky.request.schema import Universe

ORDER = ids.GENERATION_ORDER
# Both poles, RA 0 on the equator, and a corner of three files.
PLACES = [(10.0, 90.0), (200.0, -90.0), (0.0, 0.0), (45.0, 41.8)]


def made(limit):
    return galaxies.model(SEED, Universe(galaxy_limit=limit, **SMALL))


@pytest.fixture(scope="module")
def shallow():
    return made(22.5)


@pytest.fixture(scope="module")
def population(shallow):
    return CellCache(shallow.population)


def cell_at(place):
    return int(sky.cell_at([place[0]], [place[1]], ORDER)[0])


def around(cell):
    return sky.margin_cells(ORDER, cell, ORDER).tolist()


def seen_in(rows, cells):
    inside = np.isin(sky.cell_at(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ORDER), cells)
    return rows.filter(pa.array(inside))


def crossing(rows):
    """Return the number of galaxies that are observed in another cell than that with their true position."""
    seen, true = (sky.cell_at(rows[ra].to_numpy(), rows[dec].to_numpy(), ORDER) for ra, dec in NAMES)
    return int(np.sum(seen != true))


NAMES = ("ra", "dec"), ("ra_true", "dec_true")


@nightly.parametrize("place", PLACES, (0,))
def test_a_cell_contains_all_galaxies_observed_in_it(place, shallow, population, dust):
    """The bytes equal those of a complete draw of the cell and all its neighbours by true position."""
    cell = cell_at(place)
    every = pa.concat_tables([galaxies.draw(c, shallow, population, dust) for c in (cell, *around(cell))])
    found = observed_cells.draw([cell], shallow, population, dust)
    assert len(found) > 200
    wanted = seen_in(every, [cell])
    assert found.sort_by("id").equals(wanted.sort_by("id"))
    # Some galaxies cross the border in each direction.
    assert crossing(found) > 0
    own = galaxies.draw(cell, shallow, population, dust)
    assert len(seen_in(own, [cell])) < len(own)
    assert np.all(np.diff(found["_healpix_29"].to_numpy()) >= 0)
    assert validate.find_violations(found, GALAXIES) == []


def test_files_made_apart_hold_every_galaxy_once(shallow, population, dust):
    """Both sides of a border between files, drawn in different orders, separately and together."""
    first = cell_at(PLACES[3])
    second = next(cell for cell in around(first) if cell >> 6 != first >> 6)
    apart = [observed_cells.draw([cell], shallow, CellCache(shallow.population), dust) for cell in (second, first)]
    together = observed_cells.draw([first, second], shallow, population, dust)
    both = pa.concat_tables(apart)
    assert np.unique(both["id"].to_numpy()).size == len(both)
    assert both.sort_by("id").equals(together.sort_by("id"))
    assert crossing(together) > 3


@pytest.mark.nightly
def test_a_shallower_request_has_fewer_of_the_same(shallow, population, dust):
    cell = cell_at(PLACES[3])
    deep, bright = observed_cells.draw([cell], shallow, population, dust), made(20.5)
    found = observed_cells.draw([cell], bright, CellCache(bright.population), dust)
    assert 50 < len(found) < 0.5 * len(deep)
    again = deep.filter(pa.array(np.isin(deep["id"].to_numpy(), found["id"].to_numpy())))
    assert again.sort_by("id").equals(found.sort_by("id"))


def test_without_lensing_nothing_crosses_a_border(shallow, population, dust):
    cell = cell_at(PLACES[2])
    still = galaxies.GalaxyModel(
        **{name: getattr(shallow, name) for name in shallow.__slots__ if name != "lens"}, lens=lensing.Shear()
    )
    found = observed_cells.draw([cell], still, population, dust)
    assert found.equals(galaxies.draw(cell, still, population, dust))
    assert crossing(found) == 0


def test_light_that_is_bent_too_far_is_refused(shallow, population, dust, monkeypatch):
    monkeypatch.setattr(observed_cells, "_MAX_HALO_DEFLECTION", np.radians(10.0 / 3600.0))
    with pytest.raises(BadInput, match="halos may deflect light by"):
        observed_cells.draw([cell_at(PLACES[0])], shallow, population, dust)


@given(st.floats(0, 360, exclude_max=True), st.floats(-90, 90), st.integers(0, 999), st.sampled_from([8, 5]))
def test_the_bound_on_the_deflection_of_the_box_holds(universe, ra, dec, seed, order):
    """The bound is valid for any source in the cell at any distance."""
    cell = int(sky.cell_at([ra], [dec], order)[0])
    rng = np.random.default_rng(seed)
    _, lon, lat = sky.random_in_cell(order, cell, 50, rng)
    bent = np.hypot(*lensing.interpolate(universe.lens, lon, lat, rng.uniform(0.0, 9000.0, 50))[3:])
    assert bent.max() <= lensing.max_deflection(universe.lens, order, cell)


@given(st.integers(0, (12 << 16) - 1), st.floats(1e-5, 2e-3), st.integers(0, 999))
def test_distances_from_requested_cells(cell, angle, seed):
    """Distances from a cell agree with distances from points on its border."""
    own = observed_cells._RequestedCells.from_cells([cell])
    edge = sky.cell_corners(ORDER, [cell])[0]
    rng = np.random.default_rng(seed)
    corner = edge[rng.integers(0, 4, 40)]
    offset = rng.uniform(-2.0, 2.0, (2, 40)) * angle
    lon, lat = lensing.displace(corner[:, 0], np.clip(corner[:, 1], -90, 90), *offset)
    near = own.is_near(lon, lat, angle)
    within = np.radians(sky.separation(lon, lat, corner[:, 0], corner[:, 1])) <= 0.999 * angle
    inside = sky.cell_at(lon, lat, ORDER) == cell
    assert near[within | inside].all()
    width = 4.0 * np.radians(sky.cell_radius(13))
    centre = sky.cell_centre(ORDER, cell)
    beyond = np.radians(sky.separation(lon, lat, *centre) - sky.cell_radius(ORDER)) > angle + width
    assert not near[beyond].any()
