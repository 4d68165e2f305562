"""NISP's PSF has the widths in the mission database, and fulfils the requirements."""

from dataclasses import replace

import galsim
import numpy as np
import pytest
import sep
from scipy.ndimage import uniform_filter

from benchmarks._errors import measure_image
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import fields
from truesky.fluxes import passbands
from truesky.render.camera.astrometry import wcs
from truesky.render.camera.detectors import detector, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import stamps
from truesky.render.psf import euclid, sub_bands

MISSION, REQUIRED = resolve(), resolve(ladder=("REQ", "CBE", "BLT", "DES", "SIM"))
# FWHM of the optics; FWHM, EE50 and EE80 with the pixel, from diffraction by galsim with 70 nm; arcsec.
WIDTHS = {
    "euclid_y": (0.179, 0.320, 0.210, 0.430),
    "euclid_j": (0.231, 0.322, 0.232, 0.496),
    "euclid_h": (0.299, 0.358, 0.259, 0.599),
}
# One detector of every row and column.
SOME = ("DET12", "DET24", "DET31", "DET43")


def _means(image, count):
    """Replace each sample by the mean over `count` samples around it, in both directions."""
    return uniform_filter(image, count) if count else image


def widths(psf):
    """Return FWHM, EE50 and EE80 of the optics, and the same with the pixel, arcsec."""
    out, most = [], 30
    fine = [
        psf.profile.drawImage(nx=n + 2 * most, ny=n + 2 * most, scale=scale, method="no_pixel", dtype=float)
        for n, scale in ((141, 0.01), (241, 0.02))
    ]
    for pixels in (0.0, 1.0):
        # The light in a pixel of 0.3 arcsec is the mean over its samples in both directions.
        core, wide = (
            galsim.Image(
                _means(one.array, round(0.3 * pixels / one.scale))[most:-most, most:-most].copy(), scale=one.scale
            )
            for one in fine
        )
        # Fractions refer to the light on the whole sky.
        centre = wide.FindAdaptiveMom().moments_centroid
        ee50, ee80 = (wide.calculateHLR(flux=1.0, flux_frac=part, center=centre) for part in (0.5, 0.8))
        out += [core.calculateFWHM(center=core.FindAdaptiveMom().moments_centroid), ee50, ee80]
    return out


@pytest.fixture(
    scope="module",
    params=[pytest.param(band, marks=[] if band == "euclid_h" else [pytest.mark.nightly]) for band in WIDTHS],
)
def found(request):
    """Return a band, and the widths on some detectors; only H is tested every day, on half of them."""
    band, some = passbands.load(request.param), SOME[::2] if request.param == "euclid_h" else SOME
    return request.param, np.array(
        [widths(euclid.nisp_psf(detector("nisp", d, MISSION), band, MISSION, 1)) for d in some]
    )


def test_the_wavefront_has_its_size():
    """The wavefront error is 70 nm in the mean over the field, and nowhere a third more.

    Its low orders have no piston, tip or tilt.
    """
    axis = np.linspace(-1.0, 1.0, 11)
    some = np.array([euclid.wavefront(x, y, "nisp", MISSION) for x in axis for y in axis])
    rms = np.linalg.norm(some, axis=1)
    assert rms.mean() == pytest.approx(MISSION.value("nisp.psf.wavefront_rms", "nm"), rel=0.03)
    assert rms.max() < 1.33 * MISSION.value("nisp.psf.wavefront_rms", "nm")
    assert some.shape[1] == 12
    assert (some[:, :4] == 0).all()
    # The wavefront changes over the field.
    assert some.std(axis=0).max() > 4.0


def test_the_mean_widths_are_the_mission_s(found):
    name, each = found
    optics = [WIDTHS[name][0], *(MISSION.value(f"nisp.{name}.psf.{key}", "arcsec") for key in ("ee50", "ee80"))]
    print(name, np.round(each.mean(axis=0) / [*optics, *WIDTHS[name][1:]] - 1, 4))
    np.testing.assert_allclose(each.mean(axis=0), [*optics, *WIDTHS[name][1:]], rtol=0.03)


def test_every_detector_is_as_required(found):
    name, each = found
    for column, key in ((1, "ee50"), (2, "ee80"), (4, "ee50"), (5, "ee80")):
        assert each[:, column].max() < REQUIRED.value(f"nisp.{name}.{key}", "arcsec")


@pytest.mark.nightly
@pytest.mark.parametrize("name", WIDTHS)
def test_the_whole_field_is_as_required_and_as_wide_as_its_parts(name):
    """The widths of all detectors are measured."""
    band, each = passbands.load(name), []
    for d in detectors("nisp", MISSION):
        each.append(widths(euclid.nisp_psf(d, band, MISSION, 1)))
    each = np.array(each)
    optics = [WIDTHS[name][0], *(MISSION.value(f"nisp.{name}.psf.{key}", "arcsec") for key in ("ee50", "ee80"))]
    np.testing.assert_allclose(each.mean(axis=0), [*optics, *WIDTHS[name][1:]], rtol=0.03)
    for column, key in ((1, "ee50"), (2, "ee80"), (4, "ee50"), (5, "ee80")):
        assert each[:, column].max() < REQUIRED.value(f"nisp.{name}.{key}", "arcsec")


def test_the_planes_hold_the_light_and_the_last_frequency():
    """Higher frequencies have no light: the optics pass up to 1.84 cycles per pixel in Y."""
    psf = euclid.nisp_psf(detector("nisp", "DET23", MISSION), passbands.load("euclid_y"), MISSION, 1)
    planes = psf.planes
    assert (planes.samples, psf.side) == (euclid.NISP.samples, 256)
    assert 0.995 < psf.profile.flux < 0.9985
    image = planes.images[0].astype(float)
    passed = np.abs(np.fft.rfft2(image))
    cycles = np.hypot(np.fft.fftfreq(len(image))[:, None], np.fft.rfftfreq(len(image))) * planes.samples
    assert passed[cycles > planes.max_frequency / (2 * np.pi)].max() < 1e-4 * image.sum()
    assert passed[(cycles > 1.5) & (cycles < 1.6)].max() > 1e-3 * image.sum()


def test_a_detector_upside_down_sees_the_optics_turned():
    upright, turned = (detector("nisp", d, MISSION) for d in ("DET11", "DET44"))
    assert not upright.upside_down
    assert turned.upside_down
    band = passbands.load("euclid_h")
    one, other = (
        euclid.nisp_psf(replace(turned, rotation=angle), band, MISSION, 1).planes.images for angle in (0.0, 180.0)
    )
    np.testing.assert_array_equal(one[:, ::-1, ::-1], other)


@pytest.mark.parametrize("name", [pytest.param("euclid_y", marks=pytest.mark.nightly), "euclid_h"])
def test_eight_sub_bands_are_as_good_as_many(name):
    """R2 and ellipticity of blue and red stars, and the light in 1", agree with 32 sub-bands."""
    band, d, sampled = passbands.load(name), detector("nisp", "DET12", MISSION), euclid.NISP
    core = replace(sampled, transform=sampled.core_transform, side=sampled.core_side)
    nm, scale = euclid.wavefront(-0.3, 0.7, "nisp", MISSION), d.pixel_scale / sampled.samples
    planes = {}
    for count in (8, 32):
        parts = sub_bands.sub_bands(band, count)
        photons = [p.response / p.wavelength for p in parts]
        waves = [np.sqrt(np.average(p.wavelength**2, weights=w)) for p, w in zip(parts, photons, strict=True)]
        some = [euclid._plane(nm, w, core, scale, euclid._blur_variances(d, w, MISSION), MISSION) for w in waves]
        planes[count] = parts, photons, np.array(some, float)
    for power in (-3.0, 0.0, 3.0):
        seen = []
        for parts, photons, images in planes.values():
            shares = np.array([np.sum(w * p.wavelength**power) for p, w in zip(parts, photons, strict=True)])
            image = np.tensordot(shares / shares.sum(), images, 1)
            seen.append(measure_image(image, scale, len(image) // 2, len(image) // 2))
        few, many = seen
        print(name, power, few[0] / many[0] - 1, few[3] / many[3] - 1, few[4:] - many[4:])
        assert few[0] == pytest.approx(many[0], rel=5e-5)
        assert few[3] == pytest.approx(many[3], rel=4e-4)
        np.testing.assert_allclose(few[4:], many[4:], atol=5e-5)


@pytest.mark.parametrize(
    "name", [pytest.param(band, marks=[] if band == "euclid_h" else [pytest.mark.nightly]) for band in WIDTHS]
)
@nightly.parametrize(("column", "row"), [(1020.0, 1020.0), (60.0, 1980.0)], (1,))
def test_stars_are_found_where_they_are(name, column, row):
    """Windowed positions by sep are averaged within a pixel, in the middle and in a corner of a detector."""
    d = detector("nisp", "DET11", MISSION)
    psf = euclid.nisp_psf(d, passbands.load(name), MISSION, 9)
    system = wcs(d, *boresight_for(d, 10.0, 20.0, 0.0))
    within = (np.arange(6) + 0.5) / 6 - 0.5
    off = []
    for x, y in ((column + u, row + v) for u in within for v in within):
        star = fields.one_source(d, system, 1e6, x, y)
        frame = stamps.draw(star, np.array([64]), psf, 2040, 2040)
        left, low = int(column) - 30, int(row) - 30
        cut = np.ascontiguousarray(frame[low : low + 60, left : left + 60])
        found_x, found_y, _ = sep.winpos(cut, x - left, y - low, psf.window / 0.3)
        off.append((found_x + left - x, found_y + low - y))
    assert np.hypot(*np.mean(off, axis=0)) * 300.0 < 0.5
