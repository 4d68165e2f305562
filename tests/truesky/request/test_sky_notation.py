"""Positions and dates of a request may be sexagesimal texts and ISO dates."""

from datetime import date, datetime, timedelta, timezone

import pytest

from lake_schema.errors import BadInput
from truesky.request import sky_notation
from truesky.request.sky_notation import DEC_LIMITS, RA_LIMITS


@pytest.mark.parametrize(
    ("value", "axis", "degrees"),
    [
        (53.5, "ra", 53.5),
        (-10, "ra", -10.0),
        ("03:32:28", "ra", 15.0 * (3 + 32 / 60 + 28 / 3600)),
        ("3h32m28s", "ra", 15.0 * (3 + 32 / 60 + 28 / 3600)),
        ("3 32 28.5", "ra", 15.0 * (3 + 32 / 60 + 28.5 / 3600)),
        ("03:32", "ra", 15.0 * (3 + 32 / 60)),
        ("-27:48:30", "dec", -(27 + 48 / 60 + 30 / 3600)),
        ("-00:30:00", "dec", -0.5),
        ("+2d12m", "dec", 2.2),
        ("-27d48m30s", "dec", -(27 + 48 / 60 + 30 / 3600)),
    ],
)
def test_angles(value, axis, degrees):
    limits = RA_LIMITS if axis == "ra" else DEC_LIMITS
    assert sky_notation.angle(value, "x", axis, limits) == pytest.approx(degrees, abs=1e-12)


@pytest.mark.parametrize(
    ("value", "axis"),
    [
        ("53.1", "ra"), ("53.1 deg", "ra"), ("north", "ra"), ("", "dec"), ("-91:00:00", "dec"), ("25:00:00", "ra"),
        ("1:2:3:4", "ra"), ("9" * 1000 + ":00", "ra"), (True, "ra"), (None, "dec"), ([1], "dec"), ("1:75:00", "dec"),
    ],
)  # fmt: skip
def test_wrong_angles_are_refused_with_their_key(value, axis):
    with pytest.raises(BadInput, match=r"pointing\[0\]\.x") as caught:
        sky_notation.angle(value, "pointing[0].x", axis, RA_LIMITS if axis == "ra" else DEC_LIMITS)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("value", "mjd"),
    [
        (61000.25, 61000.25),
        ("2027-01-01", 61406.0),
        ("2027-01-01T12:00:00", 61406.5),
        ("2027-01-01T12:00:00Z", 61406.5),
        ("2027-01-01 18:00", 61406.75),
        (date(2027, 1, 1), 61406.0),
        (datetime(2027, 1, 1, 6), 61406.25),
        (datetime(2027, 1, 1, 6, tzinfo=timezone(timedelta(hours=6))), 61406.0),
    ],
)
def test_dates(value, mjd):
    assert sky_notation.mjd(value, "x") == mjd


@pytest.mark.parametrize(
    "value", ["yesterday", "2027-13-01", "01/02/2027", 10.0, 2461406.5, True, [61000], "1900-01-01"]
)
def test_wrong_dates_are_refused_with_their_key(value):
    with pytest.raises(BadInput, match=r"pointing\[0\]\.mjd"):
        sky_notation.mjd(value, "pointing[0].mjd")


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("2027-02-30", ": there is no such day, February 2027 has 28 days"),
        ("2027-04-31T12:00:00", ": there is no such day, April 2027 has 30 days"),
        ("2027-13-01", " is not a date: the month must be from 01 to 12"),
        ("2027-01-01T25:00:00", " must be a number (MJD, UTC), or a date"),
    ],
)
def test_days_that_do_not_exist_are_explained(value, problem):
    with pytest.raises(BadInput) as caught:
        sky_notation.mjd(value, "mjd")
    assert str(caught.value).startswith(f"mjd = '{value}'{problem}")


@pytest.mark.parametrize(
    ("axis", "value", "problem"),
    [
        ("ra", "53:07:30", "must be from 0 to 24 hours; if it is in degrees, write the number 53.125"),
        ("ra", "03:72:30", "minutes and seconds must be below 60"),
        ("dec", "-27:61:30", "minutes and seconds must be below 60"),
    ],
)
def test_hours_and_minutes_out_of_range_are_explained(axis, value, problem):
    with pytest.raises(BadInput) as caught:
        sky_notation.angle(value, axis, axis, sky_notation.RA_LIMITS)
    assert str(caught.value).startswith(f"{axis} = '{value}'")
    assert str(caught.value).endswith(problem)


def test_dates_agree_with_astropy():
    from astropy.time import Time

    for text in ("1999-12-31T23:59:30", "2026-02-28T01:02:03.25"):
        assert sky_notation.mjd(text, "x") == pytest.approx(Time(text, scale="utc").mjd, abs=1e-9)


def test_large_radii_may_have_been_meant_in_arcmin():
    assert list(sky_notation.understood_values({"area": {"cone": {"ra": 1.0, "dec": 2.0, "radius": 1.0}}})) == []
    assert list(sky_notation.understood_values({"area": {"cone": {"ra": 1.0, "dec": 2.0, "radius": 12}}})) == [
        "area.cone.radius = 12 is in degrees; for 12 arcmin write 0.2"
    ]


def test_all_values_that_are_not_numbers_are_listed():
    table = {
        "area": {"polygon": [["01:00:00", "-10:00:00"], [20.0, 0.0], ["02:00:00", 10.0]]},
        "pointing": [{"ra": 3.0, "dec": "-00:30:00", "mjd": date(2027, 1, 1), "band": "12:00:00"}],
        "observation": [{"area": {"box": {"ra": ["01:00:00", 30.0], "dec": [0.0, 1.0]}}, "mjd": "2027-01-02"}],
    }
    assert list(sky_notation.understood_values(table)) == [
        "area.polygon[0][0] = 01:00:00 is 15 deg",
        "area.polygon[0][1] = -10:00:00 is -10 deg",
        "area.polygon[2][0] = 02:00:00 is 30 deg",
        "pointing[0].dec = -00:30:00 is -0.5 deg",
        "pointing[0].mjd = 2027-01-01 is MJD 61406 (UTC)",
        "observation[0].area.box.ra[0] = 01:00:00 is 15 deg",
        "observation[0].mjd = 2027-01-02 is MJD 61407 (UTC)",
    ]
