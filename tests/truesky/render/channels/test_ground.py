"""Ground cameras: laboratory measurements of a detector, from its files alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy.io import fits as astropy_fits

from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render import fields
from tests.truesky.render.channels.test_readout import put
from tests.truesky.render.fields import MISSION, fluxes, galaxies, stars
from truesky.randomness.rng import stream
from truesky.render.camera import detectors
from truesky.render.camera.sections import Section
from truesky.render.channels import ground
from truesky.render.effects.effect import apply_all
from truesky.render.effects.readout import crosstalk
from truesky.render.effects.scene import Scene
from truesky.request.accuracy import SURVEY

SECONDS = 100.0
BANDS = {
    "decam": "des_r",
    "lsstcam": "lsst_r",
    "megacam": "cfis_r",
    "jpcam": "jedis_g",
    "gpc1": "ps1_i",
    "hsc": "hsc_z",
}
NOBODY = galaxies([], []), stars([], [])


def exposure(camera, side, sky, number=1, forced=None, truth=(), mission=MISSION):
    """Render an exposure of the sky alone, with `sky` electrons per pixel."""
    one = fields.small(camera, detectors.detectors(camera, MISSION)[0].name, side)
    band = BANDS[camera]
    exposed = {
        "exposure_id": number, "channel": "EXT", "camera": camera, "band": band, "exposure_time_s": SECONDS,
        "realisation": number, "sky": sky / SECONDS, "seeing": 0.8, "zero_point": 28.0,
    }  # fmt: skip
    body, points = NOBODY
    tables = body, fluxes(body, band, []), points, fluxes(points, band, [])
    return fields.rendered(exposed, one, tables, mission, SURVEY, 1, forced=forced, truth=truth)


@cache
def sections(path):
    """Return pixels and bias columns of each amplifier of a raw file, as floats, and its header."""
    with astropy_fits.open(path) as units:
        raw, header = units[0].data.astype(float), units[0].header
    numbers = range(1, header["NAMPS"] + 1)
    cut = [[raw[Section.from_text(header[f"{key}{n}"]).slices] for n in numbers] for key in ("DSEC", "BSEC")]
    return *cut, header


def check_photon_transfer(camera, side, folder):
    """Measure the gain of each amplifier within 1 % from pairs of flats, and read noise within 2 % from overscans."""
    files = []
    # The levels are low, so the brighter-fatter effect reduces the variance by only 1e-3.
    for number, sky in enumerate((600.0, 600.0, 600.0, 600.0, 1800.0), 1):
        one = exposure(camera, side, sky, number, {"cosmic_rays": False, "read_noise": True})
        files.append(put(one, folder)["science"])
    *read, bright = [sections(path) for path in files]
    header = bright[2]
    for q in range(header["NAMPS"]):
        light = [pixels[q] - bias[q].mean() for pixels, bias, _ in read]
        spread = np.mean([(bias[q] - bias[q].mean(axis=0)).var() for _, bias, _ in read])
        gains = []
        for first, second in ((0, 1), (2, 3)):
            difference = light[first] - light[second]
            good = np.abs(difference - np.median(difference)) <= 6.0 * difference.std()
            level = 0.5 * (light[first][good].mean() + light[second][good].mean())
            gains.append(level / (0.5 * difference[good].var() - spread))
        # Rounding adds to the scatter, but is not noise of the amplifier.
        assert np.mean(gains) == pytest.approx(header[f"GAIN{q + 1}"], rel=0.01)
        assert np.sqrt(spread - 1.0 / 12.0) * np.mean(gains) == pytest.approx(header[f"RDN{q + 1}"], rel=0.02)
        assert np.median(bright[0][q] - bright[1][q].mean()) / np.median(light[0]) == pytest.approx(3.0, rel=0.01)
    gains = [header[f"GAIN{q + 1}"] for q in range(header["NAMPS"])]
    assert np.ptp(gains) > 0.005 * np.mean(gains)


def test_photon_transfer(tmp_path):
    check_photon_transfer("decam", 1024, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("camera", [camera for camera in CAMERAS if camera != "decam"])
def test_photon_transfer_of_every_camera(camera, tmp_path):
    check_photon_transfer(camera, 4096 if camera in ("gpc1", "jpcam", "lsstcam") else 2048, tmp_path)


def test_levels_of_amplifiers_differ_and_are_measured_in_overscans(tmp_path):
    one = exposure("hsc", 256, 2000.0)
    pixels, bias, header = sections(put(one, tmp_path)["science"])
    levels = [columns.mean() for columns in bias]
    assert np.ptp(levels) > 5.0
    light = [
        np.median(p - level) * header[f"GAIN{n}"] for n, (p, level) in enumerate(zip(pixels, levels, strict=True), 1)
    ]
    np.testing.assert_allclose(light, np.mean(light), rtol=0.03)


def check_crosstalk(camera, nx, ny):
    """Illuminate rows of each amplifier that are read while all other amplifiers are dark."""
    one = replace(detectors.detectors(camera, MISSION)[0], nx=nx, ny=ny)
    scene = Scene(MISSION, one.section, SECONDS, 0.0, 5e4, one, forced={"cosmic_rays": False, "hot_pixels": False})
    own, count = scene.layout, len(scene.layout.amplifiers)
    # Rows per band. Each amplifier is illuminated in one band, and the last band is dark in all amplifiers.
    rows = own.height // (count + 1)
    planes = np.zeros(own.planes_shape)
    bands = [slice(own.prescan_rows + q * rows, own.prescan_rows + (q + 1) * rows) for q in range(count)]
    for q, band in enumerate(bands):
        planes[q, band, own.prescan : own.prescan + own.width] = 5e4
    found, decisions = apply_all(own.assemble(planes), ground.SKY, scene, lambda effect: stream(1, effect.name))
    assert {d.name for d in decisions if d.applied} >= {"crosstalk", "parallel_loss", "serial_loss", "amplifiers"}
    level = found[:, own.prescan_rows + count * rows + 6 : own.prescan_rows + own.height].mean(axis=1, keepdims=True)
    light = (found - level) * scene.amplifier_values("gain", "electron / adu")[:, None, None]
    # Pixel boundaries next to the light of another amplifier are displaced.
    pixels = slice(own.prescan + 4, own.prescan + own.width - 4)
    # The first rows of a band contain charge of the previous band that was delayed in the transfer.
    seen = np.array([light[:, band, pixels][:, 6:-3].mean(axis=(1, 2)) for band in bands]).T
    recovered = seen / np.diag(seen)
    table = crosstalk.coefficients(scene)
    # 1e-5 of the light is half an electron, which equals the noise of these rows. HSC's crosstalk is negative.
    measured = np.abs(table) > 1e-4
    assert measured.any()
    np.testing.assert_allclose(recovered[measured], table[measured], rtol=0.1)
    others = ~measured & ~np.eye(count, dtype=bool)
    assert np.abs(recovered - table)[others].max(initial=0.0) < 2e-5


@pytest.mark.parametrize(("camera", "nx", "ny"), [("decam", 256, 256), ("lsstcam", 1024, 1024)])
def test_the_crosstalk_matrix_is_recovered(camera, nx, ny):
    check_crosstalk(camera, nx, ny)


@pytest.mark.nightly
@pytest.mark.parametrize("camera", ["megacam", "jpcam", "hsc"])
def test_the_crosstalk_matrix_of_every_camera(camera):
    check_crosstalk(camera, 2048, 1024)


def test_no_image_is_read_in_another_way():
    order = ("calibration_lamp", "illumination", "poisson", "bleeding", "amplifiers", "read_noise", "adc")
    for effects in ground.EFFECTS.values():
        names = [effect.name for effect in effects if effect.name in order]
        assert names == [name for name in order if name in names]
        assert names[-3:] == ["amplifiers", "read_noise", "adc"]
