"""When the Sun lets Euclid look somewhere, against astropy's Sun."""

import numpy as np
import pytest
from astropy.coordinates import GCRS, SkyCoord, get_sun
from astropy.time import Time
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.render.sky import solar_aspect

MISSION = resolve()
LOWEST, HIGHEST = solar_aspect.limits(MISSION)


def by_astropy(ra, dec, mjd):
    sun = get_sun(Time(mjd, format="mjd"))
    place = SkyCoord(
        np.full(np.shape(mjd), ra), np.full(np.shape(mjd), dec), unit="deg", frame=GCRS(obstime=sun.obstime)
    )
    return place.separation(SkyCoord(sun.ra, sun.dec, frame=GCRS(obstime=sun.obstime))).deg


@settings(max_examples=20, deadline=None)
@given(
    st.floats(0, 360, exclude_max=True), st.sampled_from([-90.0, -28.0, 0.0, 23.4, 66.0, 90.0]), st.floats(60200, 62000)
)
def test_intervals_are_dates_with_an_allowed_angle_from_the_sun(ra, dec, start):
    days = np.arange(start, start + 399.0, 0.5)
    aspect = by_astropy(ra, dec, days)
    inside = np.zeros(days.size, bool)
    for first, last in solar_aspect.allowed_intervals(ra, dec, start, MISSION):
        inside |= (first <= days) & (days <= last)
    # The tolerance is 0.05 deg, the Sun is good to 0.02.
    assert inside[(aspect > LOWEST) & (aspect < HIGHEST)].all()
    assert not inside[(aspect < LOWEST - 0.1) | (aspect > HIGHEST + 0.1)].any()
    assert solar_aspect.is_allowed(ra, dec, solar_aspect.next_allowed(ra, dec, start, MISSION), MISSION)


def test_the_poles_of_the_ecliptic_are_always_allowed():
    assert list(solar_aspect.allowed_intervals(270.0, 66.5607, 60300.0, MISSION)) == [(60300.0, 60700.0)]


def test_a_refusal_names_dates_that_are_allowed():
    with pytest.raises(BadInput, match=r"next allowed: MJD (\S+) \(\S+\) to (\S+) \(\S+\), ") as refused:
        solar_aspect.check_aspect(53.117, -27.808, 60950.0, MISSION, "here")
    words = str(refused.value).partition("MJD 60950")[2].split()
    dates = [float(word) for word in words if word.replace(".", "").isdigit() and float(word) > 60000]
    assert len(dates) == 4
    for date in dates:
        assert solar_aspect.is_allowed(53.117, -27.808, date, MISSION)


def test_dates_before_the_launch_are_refused():
    launch = MISSION.value("svm.launch", "d")
    words = r"here: MJD 58979 is before the launch of Euclid on MJD 60126\.0 \(2023-07-01\)"
    with pytest.raises(BadInput, match=rf"^{words}; next allowed: MJD (60\d+)") as refused:
        solar_aspect.check_aspect(53.117, -27.808, 58979.0, MISSION, "here")
    assert "deg from the Sun" not in str(refused.value)
    with pytest.raises(BadInput, match=f"^{words}$"):
        solar_aspect.check_launch(58979.0, MISSION, "here")
    solar_aspect.check_launch(launch, MISSION, "here")
    earlier = resolve(overrides={"svm.launch": (58000.0, "d")})
    solar_aspect.check_launch(58979.0, earlier, "here")


def test_where_nothing_is_allowed_it_is_said():
    never = resolve(overrides={"svm.solar_aspect_min": (179.9, "deg"), "svm.solar_aspect_max": (180.0, "deg")})
    with pytest.raises(BadInput, match="no day of the next year"):
        solar_aspect.check_aspect(53.117, -27.808, 60950.0, never, "here")
    with pytest.raises(BadInput, match="on no day of the next year"):
        solar_aspect.next_allowed(53.117, -27.808, 60950.0, never)
