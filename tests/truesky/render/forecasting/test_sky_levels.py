"""Brightness of the sky by band, and its causes, as truesky check prints them."""

import re

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.forecasting.sky_levels import SkyLevels, describe_cause
from truesky.render.planning import planned_exposures, survey
from truesky.request.from_toml import from_table

MISSION = resolve()
PLACE = {"ra": 30.0, "dec": -45.0}
LINE = re.compile(r"sky of (\w+): ([\d.]+) mag/arcsec2, ([\d.]+) electron/s/pixel on MJD ([\d.]+): (.+)")


def lines(*pointings, chunks=1):
    """Return the lines for EXT pointings with the given keys."""
    table = {
        "name": "sky", "seed": 1, "area": {"cone": {**PLACE, "radius": 2.0}},
        "pointing": [{"channel": "EXT", "camera": "lsstcam", **PLACE, **pointing} for pointing in pointings],
    }  # fmt: skip
    request = from_table(table)
    planned = survey.exposures(request, MISSION)
    rows = planned_exposures.table([one for one, _ in planned], [mission for _, mission in planned], seed=1)
    levels = SkyLevels(request)
    for part in np.array_split(np.arange(rows.num_rows), chunks):
        levels.add(rows.take(part))
    return list(levels.lines())


def test_dark_skies_have_their_published_brightness():
    """SMTN-002: 22.25, 21.20 and 18.60 mag/arcsec2 at a dark zenith; zodiacal light makes it up to 0.4 mag brighter."""
    found = [LINE.fullmatch(line).groups() for line in lines(*({"band": f"lsst_{name}"} for name in "gry"))]
    assert [band for band, *_ in found] == ["lsst_g", "lsst_r", "lsst_y"]
    for (_, brightness, rate, _, cause), published, electrons in zip(
        found, (22.254, 21.198, 18.602), (15.45, 32.95, 90.6), strict=True
    ):
        assert published - 0.4 < float(brightness) < published + 0.1
        # The rate is in the unit of the published pair of brightness and rate.
        assert float(rate) == pytest.approx(electrons * 10.0 ** (0.4 * (published - float(brightness))), rel=0.01)
        assert re.fullmatch(r"dark sky, airmass 1\.0\d", cause)


def test_moon_and_twilight_are_causes():
    """Astropy gives the Moon: some days after it was full, and its distance from the field."""
    from astropy.coordinates import SkyCoord, get_body
    from astropy.time import Time

    when = Time(60986.1, format="mjd")
    moon, sun = (get_body(name, when) for name in ("moon", "sun"))
    elongation = sun.separation(moon)
    phase = np.arctan2(sun.distance * np.sin(elongation), moon.distance - sun.distance * np.cos(elongation))
    away = SkyCoord(PLACE["ra"], PLACE["dec"], unit="deg").separation(SkyCoord(moon.ra, moon.dec)).deg
    (line,) = lines({"band": "lsst_g", "mjd": 60986.1})
    lit, found = map(float, re.search(r"dark sky, Moon (\d+) % lit at (\d+) deg, airmass", line).groups())
    assert lit == pytest.approx(50.0 * (1.0 + np.cos(phase.value)), abs=1.0)
    assert found == pytest.approx(away, abs=1.5)
    (line,) = lines({"band": "lsst_g", "mjd": 60999.015})
    assert re.search(r"dark sky, twilight, Sun at -1[0-7]\.\d deg, airmass", line)


def test_the_brightest_exposure_of_a_band_is_described():
    """However the plan is divided."""
    pointings = [{"band": "lsst_r", "mjd": 60986.1 + 3.0 * i} for i in range(4)]
    (line,) = lines(*pointings)
    assert "on MJD 60986.100" in line
    assert re.search(r"; brightest of 4 exposures, faintest 2[01]\.\d\d$", line)
    assert lines(*pointings, chunks=3) == [line]


def test_other_causes():
    (line,) = lines({"camera": "decam", "band": "des_g", "mjd": 60986.1})
    assert ": mean of the survey, airmass " in line
    (line,) = lines({"channel": "VIS", "camera": "vis", "band": "euclid_vis"})
    assert line.endswith(": zodiacal light, light scattered or emitted by the telescope")
    row = {
        "channel": "EXT", "camera": "lsstcam", "band": "lsst_r", "image_type": "science", **PLACE, "mjd": 60990.2,
        "sky": 500.0, "airmass": 1.1,
    }  # fmt: skip
    assert describe_cause(row, passbands.load("lsst_r"), 28.36, MISSION).startswith("given by the request")
