"""A galaxy with a bulge in VIS and in the near infrared: redder in the middle, and of the catalogue's flux.

Through one PSF and on one detector, so that what differs is the galaxy.
"""

import numpy as np
import pytest

from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, aimed, fluxes, galaxies, psf_of, small
from truesky.fluxes import passbands
from truesky.render.camera import astrometry
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.request.accuracy import SURVEY

SIDE, ELECTRONS = 160, 1e6
BANDS = ("euclid_vis", "euclid_y", "euclid_h")
# Columns that the renderer reads for a spectrum: between Scd and Im, without dust, at z = 0.15.
SPECTRUM = {"kind": 0, "z_obs": 0.15, "sed_1": 14, "sed_2": 15, "frac_1": 0.5, "frac_2": 0.5}


def image(band, **known):
    """One galaxy in a band, electrons."""
    detector, psf = small("vis", "3-4", SIDE), psf_of("vis")
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 12.0)
    system = astrometry.wcs(detector, ra, dec, angle)
    middle = np.array([(SIDE - 1) / 2])
    shape = {"bulge_fraction": 0.4, "bulge_half_light_radius": 0.3, "disk_half_light_radius": 1.2}
    body = galaxies(
        *astrometry.sky_of_pixel(system, middle, middle), bulge_sersic_index=1.5, **{**shape, **SPECTRUM, **known}
    )
    for name in ("kind", "sed_1", "sed_2"):
        body = body.set_column(body.schema.get_field_index(name), name, body[name].cast("int16"))
    none = fields.stars([], [])
    aim = aimed(detector, system, passbands.load(band), {"band": band})
    rows = Rows(body, fluxes(body, band, 1.0), none, fluxes(none, band, 1.0))
    rows = visible_sources.rows_at_exposure(rows, aim, MISSION)
    light = np.array([ELECTRONS]), np.zeros(0)
    found, sizes = visible_sources.select_sources(rows, light, aim, psf, 1.0, settings_for(SURVEY))
    return stamps.draw(found, sizes, psf, SIDE, SIDE, None, np.zeros(len(found)))


@pytest.fixture(scope="module")
def frames():
    return {(band, colour): image(band, bulge_color=colour) for band in BANDS for colour in (0.25, np.nan)}


def light(frame, near, far):
    """Between two radii, arcsec."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    radius = np.hypot(x, y) * 0.1
    return frame[(radius >= near) & (radius < far)].sum()


def redder_inside(frames, band):
    """I_E less another band inside 0.5" less that of 1" to 3", mag."""
    inner, outer = (
        -2.5 * np.log10(light(frames["euclid_vis", 0.25], *ring) / light(frames[band, 0.25], *ring))
        for ring in ((0.0, 0.5), (1.0, 3.0))
    )
    return inner - outer


@pytest.mark.parametrize("band", BANDS[1:])
def test_the_middle_is_redder_than_the_outskirts(frames, band):
    assert 0.02 < redder_inside(frames, band) < 0.35


def test_the_farther_the_band_the_redder(frames):
    assert redder_inside(frames, "euclid_h") > 1.2 * redder_inside(frames, "euclid_y")


@pytest.mark.parametrize("band", BANDS)
def test_the_flux_is_the_catalogue_s(frames, band):
    whole, plain = frames[band, 0.25].sum(), frames[band, np.nan].sum()
    assert whole == pytest.approx(plain, rel=1e-4)
    assert whole == pytest.approx(ELECTRONS, rel=0.01)


def test_without_a_colour_bands_are_alike(frames):
    assert np.array_equal(frames["euclid_vis", np.nan], frames["euclid_h", np.nan])
