"""Ecliptic coordinates agree with astropy's, and tiles cover the sky without gap or overlap."""

import itertools

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord

from lake_schema import sky
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.sky.ecliptic import ecliptic, equatorial, tile_corners, tile_count
from truesky.request import area


def everywhere(n, seed=1):
    rng = np.random.default_rng(seed)
    return 360.0 * rng.random(n), np.degrees(np.arcsin(rng.uniform(-1, 1, n)))


def test_ecliptic_coordinates_are_astropy_s():
    ra, dec = everywhere(500)
    theirs = SkyCoord(ra * u.deg, dec * u.deg).transform_to(BarycentricMeanEcliptic(equinox="J2000"))
    assert sky.separation(*ecliptic(ra, dec), theirs.lon.deg, theirs.lat.deg).max() * 3600 < 0.1
    assert sky.separation(*equatorial(*ecliptic(ra, dec)), ra, dec).max() < 1e-9


def bounds(tile):
    """Return the ranges of ecliptic longitude and latitude of a tile."""
    lon, lat = ecliptic(*tile_corners(tile).T)
    # A pole has no longitude.
    west, east = (0, 1) if lat[0] > -89.99 else (3, 2)
    return lon[west], lon[east], lat[0], lat[2]


def test_tiles_neither_overlap_nor_leave_gaps():
    """A tile begins at the end of the tile before it: eastward in a row, then at longitude 0 of the next row."""
    last = tile_count() - 1
    assert bounds(0)[2] == pytest.approx(-90.0)
    assert bounds(last)[3] == pytest.approx(90.0)
    for start in (0, 2_000, 40_000, 69_121, last - 1_000):
        for before, tile in itertools.pairwise(bounds(tile) for tile in range(start, start + 1_001)):
            # The tile is in the same row, or begins the next one.
            if tile[2] == pytest.approx(before[2]):
                assert tile[3] == pytest.approx(before[3])
            else:
                assert tile[2] == pytest.approx(before[3])
                assert (tile[0] + 180) % 360 == pytest.approx(180)
            assert (tile[0] - before[1] + 180) % 360 == pytest.approx(180)
    # A tile has the area of the field of view, and all tiles together the area of the sky.
    areas = [tile_area(tile) for tile in range(0, tile_count(), 97)]
    assert np.mean(areas) * tile_count() == pytest.approx(360**2 / np.pi, rel=0.01)
    assert 0.4 < np.median(areas) < 0.6


def tile_area(tile):
    west, east, south, north = bounds(tile)
    return np.degrees(np.sin(np.radians(north)) - np.sin(np.radians(south))) * ((east - west) % 360 or 360.0)


def test_a_request_may_ask_for_a_tile():
    own = area.parse({"tile": 69_121})
    ra, dec, radius = own.bounding_circle()
    west, east, south, north = bounds(69_121)
    (lon,), (lat,) = ecliptic([ra], [dec])
    assert west < lon < east
    assert south < lat < north
    assert 0.4 < radius < 0.6
    assert own.contains([ra], [dec]).all()
    assert int(sky.cell_at([ra], [dec], 8)[0]) in own.cells()
    with pytest.raises(BadInput, match=r"area\.tile"):
        area.parse({"tile": tile_count()})
    with pytest.raises(OutOfRange, match="tile"):
        tile_corners(tile_count())
