"""Lensing from the catalogue to the pixels: galaxies around a massive halo are aligned tangentially on any detector."""

import healpy as hp
import numpy as np
import pytest

from lake_schema import sky
from tests.truesky.render.fields import aimed, galaxies, moments, psf_of, small, stars
from truesky.catalogue.galaxies import lensing
from truesky.fluxes import passbands
from truesky.render.camera.astrometry import pixel_of_sky, wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import settings, stamps
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.request.accuracy import SURVEY

NOISE, NSIDE, SIDE = 12.0, 64, 160
RA, DEC, WIDTH = 40.0, 20.0, 4.0
BEARINGS = np.arange(0.0, 360.0, 45.0) + 11.0


@pytest.fixture(scope="module")
def shears():
    """Return (gamma1, gamma2) of the catalogue near a round halo, at position angles from north through east."""
    ra, dec = hp.pix2ang(NSIDE, np.arange(12 * NSIDE**2), nest=True, lonlat=True)
    kappa = 0.3 * np.exp(-0.5 * (sky.separation(ra, dec, RA, DEC) / WIDTH) ** 2)
    fields = lensing.maps_of_convergence(kappa.astype(np.float32), NSIDE, np.ones(2 * NSIDE + 1))
    planes = lensing.Planes(NSIDE, np.array([1000.0]), (fields,))
    lon, lat = offset(6.0 * 3600, BEARINGS)
    return lensing.interpolate(planes, lon, lat, np.full(len(lon), 1000.0))[1:3]


def offset(arcsec, bearing):
    """Return positions at a distance and position angles from the halo."""
    distance, angle, dec = np.radians(arcsec / 3600), np.radians(bearing), np.radians(DEC)
    lat = np.arcsin(np.sin(dec) * np.cos(distance) + np.cos(dec) * np.sin(distance) * np.cos(angle))
    lon = np.arctan2(np.sin(angle) * np.sin(distance) * np.cos(dec), np.cos(distance) - np.sin(dec) * np.sin(lat))
    return RA + np.degrees(lon), np.degrees(lat)


@pytest.mark.parametrize(
    ("camera", "name", "angle"),
    [("vis", "2-3", 25.0), ("vis", "2-4", 25.0), ("vis", "5-5", -70.0), ("lsstcam", "R22_S11", 25.0)],
)
def test_alignment_about_a_halo_is_tangential(camera, name, angle, shears):
    detector = small(camera, name)
    scale = detector.pixel_scale
    system = wcs(detector, *boresight_for(detector, RA, DEC, angle))
    band = passbands.load("euclid_vis" if camera == "vis" else "lsst_r")
    lon, lat = offset(50 * scale, BEARINGS)
    body = galaxies(lon, lat, disk_half_light_radius=3.5 * scale, gamma1=shears[0], gamma2=shears[1])
    found, sizes = visible_sources.select_sources(
        Rows(body, None, stars([], []), None), (np.full(len(body), 1e6), np.zeros(0)), aimed(detector, system, band),
        psf_of(camera), NOISE, settings.settings_for(SURVEY),
    )  # fmt: skip
    image = stamps.draw(found, sizes, psf_of(camera), SIDE, SIDE)
    halo = np.array([axis[0] for axis in pixel_of_sky(system, [RA], [DEC])])
    tangential, cross = [], []
    for x, y in zip(found.column, found.row, strict=True):
        left, low = int(np.rint(x)) - 14, int(np.rint(y)) - 14
        rows, columns = np.mgrid[low : low + 29, left : left + 29]
        window = np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 5.0**2)
        _, q = moments(image[low : low + 29, left : left + 29] * window)
        e = (q[0, 0] - q[1, 1] + 2j * q[0, 1]) / (q[0, 0] + q[1, 1])
        turned = -e * np.exp(-2j * np.arctan2(y - halo[1], x - halo[0]))
        tangential.append(turned.real)
        cross.append(turned.imag)
    assert len(tangential) == len(BEARINGS)
    assert min(tangential) > 0.01
    assert np.abs(cross).max() < 0.1 * np.mean(tangential)
