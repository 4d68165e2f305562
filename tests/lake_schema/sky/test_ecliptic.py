"""Ecliptic coordinates against astropy's, and tiles that cut the sky without gap or overlap."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.sky.ecliptic import ecliptic, equatorial, tile_corners, tile_count, tile_of
from truesky.request import area


def everywhere(n, seed=1):
    rng = np.random.default_rng(seed)
    return 360.0 * rng.random(n), np.degrees(np.arcsin(rng.uniform(-1, 1, n)))


def test_ecliptic_coordinates_are_astropy_s():
    ra, dec = everywhere(500)
    theirs = SkyCoord(ra * u.deg, dec * u.deg).transform_to(BarycentricMeanEcliptic(equinox="J2000"))
    assert sky.separation(*ecliptic(ra, dec), theirs.lon.deg, theirs.lat.deg).max() * 3600 < 0.1
    assert sky.separation(*equatorial(*ecliptic(ra, dec)), ra, dec).max() < 1e-9


@given(st.floats(0, 360, exclude_max=True), st.floats(-90, 90))
def test_a_place_lies_in_its_tile(ra, dec):
    (tile,), ((lon,), (lat,)) = tile_of([ra], [dec]), ecliptic([ra], [dec])
    west, east, south, north = bounds(int(tile))
    assert (lon - west) % 360 <= (east - west) % 360 + 1e-6
    assert south - 1e-6 <= lat <= north + 1e-6


def bounds(tile):
    """Ecliptic longitudes and latitudes between which a tile lies."""
    lon, lat = ecliptic(*tile_corners(tile).T)
    # At a pole there is no longitude.
    west, east = (0, 1) if lat[0] > -89.99 else (3, 2)
    return lon[west], lon[east], lat[0], lat[2]


def test_tiles_neither_overlap_nor_leave_gaps():
    tiles = [0, 2, 3, 2_000, 40_000, 69_121, tile_count() - 1]
    for tile in tiles:
        west, east, south, north = bounds(tile)
        lon = west + np.array([0.01, 0.5, 0.99]) * ((east - west) % 360 or 360.0)
        inside = equatorial(lon % 360, np.full(3, south + 0.3 * (north - south)))
        assert tile_of(*inside).tolist() == [tile] * 3
        beyond = equatorial([(east + 1e-3) % 360], [0.5 * (south + north)])
        assert tile_of(*beyond)[0] != tile
    # As large as the field of view, and together as large as the sky.
    areas = [tile_area(tile) for tile in range(0, tile_count(), 97)]
    assert np.mean(areas) * tile_count() == pytest.approx(360**2 / np.pi, rel=0.01)
    assert 0.4 < np.median(areas) < 0.6


def tile_area(tile):
    west, east, south, north = bounds(tile)
    return np.degrees(np.sin(np.radians(north)) - np.sin(np.radians(south))) * ((east - west) % 360 or 360.0)


def test_a_request_may_ask_for_a_tile():
    own = area.parse({"tile": 69_121})
    ra, dec, radius = own.bounds()
    assert tile_of([ra], [dec]).tolist() == [69_121]
    assert 0.4 < radius < 0.6
    assert own.contains([ra], [dec]).all()
    assert int(sky.cell_of([ra], [dec], 8)[0]) in own.cells()
    with pytest.raises(BadInput, match=r"area\.tile"):
        area.parse({"tile": tile_count()})
    with pytest.raises(OutOfRange, match="tile"):
        tile_corners(tile_count())
