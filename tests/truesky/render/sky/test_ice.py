"""Ice on the optics of Euclid dims stars and sky by the same factor, by date and band, and only on request."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from tests.truesky.render import nominal
from tests.truesky.render.fields import small
from truesky.render.planning import planned_exposures
from truesky.render.planning.planned_exposures import Exposure
from truesky.render.products import headers
from truesky.render.sky import ice

ICY = resolve(overrides={"plm.ice": (1.0, "")})
# 19 March 2024, the day before a mirror was heated.
BEFORE, AFTER = 60388.0, 60390.0


def row(mission, mjd, band="euclid_vis", **known):
    """Return the row of the table `exposures` of a pointing."""
    channel, camera = ("VIS", "vis") if band == "euclid_vis" else ("NISP-P", "nisp")
    exposure = Exposure(channel, camera, band, "science", 53.117, -27.808, 0.0, mjd, 560.0, "x", **known)
    return planned_exposures.table([exposure], [mission]).to_pylist()[0]


def test_heating_a_mirror_gains_fifteen_per_cent():
    """ESA, 26 March 2024: VIS received 15 % more light at once."""
    gain = ice.transmission("euclid_vis", AFTER, ICY) / ice.transmission("euclid_vis", BEFORE, ICY)
    assert gain == pytest.approx(1.15, abs=0.01)


def test_the_loss_grows_from_autumn_on():
    found = [ice.transmission("euclid_vis", mjd, ICY) for mjd in (60126.0, 60218.0, 60303.5, BEFORE, AFTER, 62000.0)]
    assert found == pytest.approx([1.0, 1.0, 1.0 - 0.065, 1.0 - 0.13 * 170 / 171, 1.0, 1.0], rel=1e-9)
    assert ice.transmission("euclid_h", BEFORE, ICY) == 1.0
    half = resolve(overrides={"plm.ice": (0.5, "")})
    assert 1.0 - ice.transmission("euclid_vis", BEFORE, half) == pytest.approx(0.5 * (1.0 - found[3]), rel=1e-9)


def test_there_is_no_ice_unless_the_request_says_so():
    usual = resolve()
    assert usual.value("plm.ice") == 0.0
    assert {ice.transmission("euclid_vis", mjd, usual) for mjd in (60126.0, BEFORE, AFTER)} == {1.0}


def test_stars_and_sky_are_dimmed_alike():
    clear, dim = row(resolve(), BEFORE), row(ICY, BEFORE)
    passed = 10.0 ** (0.4 * (dim["zero_point"] - clear["zero_point"]))
    assert passed == pytest.approx(1.0 - 0.13 * 170 / 171, rel=1e-9)
    assert dim["sky"] / clear["sky"] == pytest.approx(passed, rel=1e-9)
    assert row(ICY, BEFORE, "euclid_h") == row(resolve(), BEFORE, "euclid_h")
    assert row(ICY, AFTER) == row(resolve(), AFTER)
    # Numbers that the user gives are those of the detector, whatever the ice.
    given = row(ICY, BEFORE, sky=0.3, zero_point=25.0)
    assert (given["sky"], given["zero_point"]) == (0.3, 25.0)
    # A zero point of the user contains the loss of the sources, so that the sky is not dimmed either.
    assert row(ICY, BEFORE, zero_point=25.0)["sky"] == clear["sky"]


def test_the_header_has_the_lost_fraction():
    """The frame is from the day before the mirror was heated."""
    number = int(BEFORE - nominal.DAY)
    for mission, expected in ((ICY, 0.13 * 170 / 171), (resolve(), None)):
        one = nominal.rendered(
            small("vis", "3-4", 64), [], [], [], kind="bias", seconds=0.0, sky=0.0, mission=mission, number=number
        )
        cards = {keyword: value for keyword, value, _ in headers.science_cards(one)}
        assert cards.get("ICELOSS") == (expected if expected is None else pytest.approx(expected, rel=1e-9))


def test_ice_that_absorbs_everything_is_refused():
    opaque = resolve(overrides={"plm.ice": (9.0, "")})
    with pytest.raises(BadInput, match=r"mission: plm\.ice = 9: ice would absorb all light of euclid_vis on MJD 60388"):
        ice.transmission("euclid_vis", BEFORE, opaque)
    assert np.isfinite(ice.transmission("euclid_vis", AFTER, opaque))
