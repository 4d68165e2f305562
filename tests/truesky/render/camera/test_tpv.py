"""TPV and SIP are the same sky, to astropy and to galsim, which has its own reader of TPV; and back, exactly."""

import galsim
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.render.camera import astrometry, tpv
from truesky.render.camera.astrometry import sky_of_pixel, wcs
from truesky.render.camera.detectors import detectors
from truesky.render.camera.pointing import boresight_for
from truesky.request import schema
from truesky.request.from_toml import from_table

MISSION = resolve()
BENT = [d for camera in ("vis", "nisp", "lsstcam", "hsc") for d in detectors(camera, MISSION)]
SKY = st.tuples(st.floats(0, 360, exclude_max=True), st.floats(-90, 90), st.floats(-180, 180))
PLACE = st.tuples(st.floats(0, 1), st.floats(0, 1))


def headers(d, pointing):
    system = wcs(d, *boresight_for(d, *pointing))
    return system, astrometry.cards(system), tpv.from_sip(astrometry.cards(system))


def as_header(cards):
    return fits.Header([fits.Card(*card) for card in cards])


@given(SKY, st.sampled_from(BENT), PLACE)
def test_astropy_finds_every_pixel_where_sip_has_it(pointing, d, within):
    system, sip, found = headers(d, pointing)
    x, y = [within[0] * (d.nx - 1)], [within[1] * (d.ny - 1)]
    header = as_header(found)
    assert header["CTYPE1"] == "RA---TPV"
    assert not any(key.startswith(("A_", "B_")) for key in header)
    theirs = SkyCoord(*WCS(header).all_pix2world(x, y, 0), unit="deg")
    for place in (sky_of_pixel(system, x, y), WCS(as_header(sip)).all_pix2world(x, y, 0)):
        ours = SkyCoord(*place, unit="deg")
        assert ours.separation(theirs).to_value("arcsec")[0] < 1e-6 * d.pixel_scale


@settings(max_examples=20)
@given(st.tuples(st.floats(0, 360, exclude_max=True), st.floats(-85, 85), st.floats(-180, 180)), st.sampled_from(BENT))
def test_galsim_finds_every_pixel_there(pointing, d):
    system, _, found = headers(d, pointing)
    header = as_header(found)
    # Which galsim does not read, and which is the default.
    del header["LONPOLE"]
    theirs = galsim.FitsWCS(header=header)
    for x, y in ((0.0, 0.0), (d.nx - 1.0, 17.0), (100.0, d.ny - 1.0)):
        there = theirs.toWorld(galsim.PositionD(x + 1.0, y + 1.0))
        ra, dec = sky_of_pixel(system, [x], [y])
        here = galsim.CelestialCoord(float(ra[0]) * galsim.degrees, float(dec[0]) * galsim.degrees)
        assert here.distanceTo(there) / galsim.arcsec < 1e-5 * d.pixel_scale


@given(SKY, st.sampled_from(BENT))
def test_and_back(pointing, d):
    system, _, found = headers(d, pointing)
    again = astrometry.from_cards(found)
    for ours, theirs in ((system.sip.a, again.sip.a), (system.sip.b, again.sip.b)):
        side = len(theirs)
        np.testing.assert_allclose(theirs, np.pad(ours, (0, side - len(ours))), atol=1e-13, rtol=1e-9)


def test_without_distortion_nothing_changes():
    straight = detectors("vis", resolve(overrides={"vis.fpa.distortion": (0.0, "")}))[0]
    cards = astrometry.cards(wcs(straight, 10.0, 20.0, 0.0))
    assert tpv.from_sip(cards) == cards


def test_too_high_an_order_is_refused():
    cards = astrometry.cards(wcs(BENT[0], 10.0, 20.0, 0.0))
    higher = [("A_ORDER", 8, "") if card[0] == "A_ORDER" else card for card in cards]
    assert tpv.from_sip([*higher, ("A_5_2", 1e-30, "")])
    with pytest.raises(BadInput, match="order 8: TPV has orders up to 7"):
        tpv.from_sip([*higher, ("A_5_3", 1e-30, "")])


def test_a_request_may_ask_for_it():
    assert schema.WCS_CONVENTIONS == tpv.CONVENTIONS
    table = {"name": "x", "seed": 1, "area": {"cone": {"ra": 53.1, "dec": -27.8, "radius": 1.0}}}
    asked = [from_table({**table, "products": products}).wcs for products in ({}, {"wcs": "sip"}, {"wcs": "tpv"})]
    assert asked == [None, "sip", "tpv"]
