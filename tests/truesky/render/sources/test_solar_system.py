"""Bodies of the Solar System: their numbers, their motions and their trails."""

from types import MappingProxyType

import numpy as np
import pytest
from scipy import stats

from lake_schema import sky
from lake_schema.ids import kind_from_id
from lake_schema.mission.configuration import resolve
from lake_schema.sky.ecliptic import ecliptic, equatorial
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, one_source, psf_of, small, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, pointing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.drawing.stamp_sizes import piece_length
from truesky.render.planning import planned_exposures
from truesky.render.products import truth_table
from truesky.render.sources import solar_system
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import SURVEY

DAY = 60905
ECLIPTIC = tuple(float(x) for x in equatorial(70.0, 0.0))
SIDE = 256


def test_counts_and_motions_are_the_mission_s():
    """Sample of all bodies within 2 deg; significance 6e-7 of numbers (5 standard errors), 1e-4 of the law of rates."""
    found = solar_system.population(*ECLIPTIC, 1.0, DAY, MISSION, 1)
    assert len(np.unique(found.ids)) == len(found.ids)
    assert set(kind_from_id(found.ids)) == {solar_system.KIND}
    inside = np.abs(found.lat) < 1.0
    # Bodies in a strip along the ecliptic, within the radius of the sample.
    chosen = inside & (sky.separation(*equatorial(found.lon, found.lat), *ECLIPTIC) < 2.0)
    lat = np.linspace(-1.0, 1.0, 2001)
    width = 2.0 * np.sqrt(4.0 - lat**2)
    expected = np.trapezoid(solar_system.density(lat, MISSION) * width, lat)
    assert chosen.sum() == pytest.approx(expected, abs=5 * np.sqrt(expected))
    # 60 deg-2 at 15 deg down to I_E = 24.5, with a slope of 0.3 dex per magnitude.
    assert solar_system.density(15.0, MISSION) * 10 ** (-0.3 * 1.5) == pytest.approx(60.0)
    assert solar_system.density(90.0, MISSION) == solar_system.density(-60.0, MISSION)
    assert np.mean(found.mag < 25.0) == pytest.approx(10**-0.3, abs=0.02)
    rate = np.hypot(found.east, found.north)
    assert np.mean(rate > 60.0) == pytest.approx(0.01, abs=5 * np.sqrt(0.01 / len(rate)))
    usual = rate <= 60.0
    assert np.abs(found.north[usual]).max() == 0.0
    assert stats.kstest(rate[usual], stats.uniform(10.0, 50.0).cdf).pvalue > 1e-4


def test_bodies_are_the_same_for_every_field_of_a_day_and_move_at_their_rate():
    """Fields at different positions on the same day contain the same bodies."""
    one, other = (
        solar_system.population(*place, 0.2, DAY, MISSION, 1) for place in (ECLIPTIC, (ECLIPTIC[0] + 0.3, ECLIPTIC[1]))
    )
    _, i, j = np.intersect1d(one.ids, other.ids, return_indices=True)
    assert len(i) > 1000
    for name in ("lon", "lat", "east", "north", "mag"):
        np.testing.assert_array_equal(getattr(one, name)[i], getattr(other, name)[j])
    moved = sky.separation(*one.positions_after(0.0), *one.positions_after(2.0)) * 3600.0
    np.testing.assert_allclose(moved, 2.0 * np.hypot(one.east, one.north), rtol=2e-3)
    assert not set(solar_system.population(*ECLIPTIC, 0.2, DAY + 1, MISSION, 1).ids) & set(one.ids)
    assert not set(solar_system.population(*ECLIPTIC, 0.2, DAY, MISSION, 2).mag) & set(one.mag)


def test_they_shine_like_the_sun():
    vis = solar_system.flux(np.array([20.0]), passbands.load("euclid_vis"), MISSION)
    assert vis[0] == pytest.approx(10 ** (0.4 * 3.9))
    # The Sun's r - z is 0.21 (AB; Willmer 2018: LSST r 4.64, z 4.51).
    r, z = (solar_system.flux(np.array([20.0]), passbands.load(f"lsst_{band}"), MISSION)[0] for band in "rz")
    assert 2.5 * np.log10(z / r) == pytest.approx(0.13, abs=0.05)


@pytest.mark.parametrize("line", [(0.0, 0.0), (5.0, 0.0), (40.0, -25.0), (-150.0, 90.0)])
def test_a_trail_is_a_row_of_points(line):
    """The number of points is so large that more points make no difference."""
    detector = small("vis", "3-4", SIDE)
    system = astrometry.wcs(detector, *pointing.boresight_for(detector, 10.0, 20.0, 0.0))
    point = one_source(detector, system, 1e5)
    trail = np.array([line])
    body = Sources(*(getattr(point, n) for n in ("ids", "column", "row", "jacobian", "electrons", "shape", "shapes")),
                   trail=trail)  # fmt: skip
    psf = psf_of("vis")
    settings = settings_for(SURVEY)
    sizes = stamp_sizes.stamp_sizes(
        body.electrons, body.shape, body.shapes, psf, 12.0, settings, piece_length(body.trail_length)
    )
    drawn = np.zeros(1)
    image = stamps.draw(body, sizes, psf, SIDE, SIDE, tally=stamps.Tally(drawn))
    count = max(int(12 * np.hypot(*line)), 1)
    part = (np.arange(count) + 0.5) / count - 0.5
    row = Sources(
        np.arange(count), point.column + part * line[0], point.row + part * line[1],
        np.repeat(point.jacobian, count, 0), np.full(count, 1e5 / count), np.full(count, -1), point.shapes,
    )  # fmt: skip
    expected = stamps.draw(row, np.full(count, sizes[0]), psf, SIDE, SIDE)
    np.testing.assert_allclose(image, expected, atol=2e-4 * expected.max())
    assert drawn[0] == pytest.approx(image.sum(), rel=1e-3)
    assert image.sum() == pytest.approx(expected.sum(), rel=1e-6)


def crowded(overrides=MappingProxyType({})):
    """Render a small frame on the ecliptic with a high density of bodies."""
    few = {"env.solar_system.density": (3e3, "deg-2"), "env.solar_system.fast_rate_max": (61.0, "arcsec / h")}
    mission = resolve(overrides=few | dict(overrides))
    detector = small("vis", "3-4", SIDE)
    ra, dec, angle = pointing.boresight_for(detector, *ECLIPTIC, 0.0)
    exposed = {
        "exposure_id": 1, "channel": "VIS", "camera": "vis", "band": "euclid_vis", "image_type": "science",
        "ra": ra, "dec": dec, "position_angle": angle, "mjd": DAY + 0.4, "exposure_time_s": 560.0, "seeing": 0.0,
        "sky": 0.25, "zero_point": planned_exposures.zero_point_of("vis", "euclid_vis", mission),
    }  # fmt: skip
    empty = galaxies([10.0], [20.0]).slice(0, 0), stars([10.0], [20.0]).slice(0, 0)
    tables = [x for rows in empty for x in (rows, fluxes(rows, "euclid_vis", 1.0))]
    return fields.rendered(exposed, detector, tables, mission, SURVEY)


def test_trails_are_in_the_image_and_in_its_truth():
    one = crowded()
    truth = truth_table.truth(one)
    assert len(truth) > 3
    length = np.hypot(truth["trail_x"], truth["trail_y"])
    assert set(truth["method"].to_pylist()) == {truth_table.TRAIL}
    # Rates are 10 to 60 arcsec per hour. Fast bodies are no faster in this mission.
    hours, scale = 560.0 / 3600.0, 0.1
    assert length.min() > 9.9 * hours / scale
    assert length.max() < 61.6 * hours / scale
    x, y = np.asarray(truth["x"]), np.asarray(truth["y"])
    lon, lat = ecliptic(*astrometry.sky_of_pixel(one.wcs, x, y))
    end = ecliptic(*astrometry.sky_of_pixel(one.wcs, x + truth["trail_x"], y + truth["trail_y"]))
    # Trails run eastward along the ecliptic.
    assert (end[0] > lon).mean() > 0.9
    assert np.median(np.abs(end[1] - lat)) < 0.02 / 3600
    # The frame contains the drawn light, and wings beyond stamps.
    assert one.noise_free.sum(dtype=float) == pytest.approx(np.sum(truth["drawn"]), rel=0.05)
    assert np.sum(truth["drawn"]) > 0
    quiet = crowded({"env.solar_system.density": (0.0, "deg-2")})
    assert len(quiet.sources) == 0
