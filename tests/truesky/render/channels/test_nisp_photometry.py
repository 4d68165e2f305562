"""Photometry of stars in images of NISP-P, and the faintest stars that four images detect."""

import numpy as np
import pytest
import sep
from scipy import ndimage

from tests.truesky.render import infrared, nominal
from tests.truesky.render.channels.test_nisp_astrometry import HALF, model
from tests.truesky.render.fields import MISSION, small
from truesky.randomness.rng import stream
from truesky.render.effects.charge import dark_map, pixel_response, ramp, ramp_nonlinearity
from truesky.render.effects.light import chromatic_response
from truesky.render.effects.readout import output_gain
from truesky.render.products import truth_table
from truesky.render.sky import diffuse_light

SIDE = 192
DETECTOR = small("nisp", "DET23", SIDE)
# Radii of the aperture and of the ring in which the sky is measured, pixels.
APERTURE, RING = 5.0, (9.0, 14.0)
# Circles in which the mission requires 80 % of the light of a point source, arcsec; limits of the depth, AB.
CIRCLES = {"euclid_y": 0.62, "euclid_j": 0.63, "euclid_h": 0.70}
DEPTH, REQUIRED = 24.4, 24.0
# Pixels with more electrons of dark current are left out.
HOT = 20.0


def undone(one):
    """Return the electrons of the light, with all known effects undone.

    Blind pixels and pixels whose ramp does not fit are NaN.
    """
    scene, applied = one.scene, {d.name for d in one.decisions if d.applied}

    def fixed(effect):
        return stream(infrared.SEED, "nisp", scene.detector.name, effect.name)

    found = infrared.electrons(one)
    found /= output_gain.apply(np.ones(found.shape), *output_gain.EFFECT.parameters(scene), fixed(output_gain.EFFECT))
    mode = ramp.mode_of_scene(scene)
    bend = ramp_nonlinearity.apply(
        np.zeros(found.shape), *ramp_nonlinearity.EFFECT.parameters(scene), fixed(ramp_nonlinearity.EFFECT)
    )[3]
    # If N electrons arrive per frame, a group lacks b N^2 times the mean square of the numbers of its frames.
    squares = [np.mean(np.arange(end - mode.reads + 1, end + 1.0) ** 2) for end in (mode.frames, mode.reads)]
    part = (squares[0] - squares[1]) / mode.integration_frames**2
    linear = found.copy()
    for _ in range(20):
        linear = found + part * bend * linear**2
    response = np.ones(found.shape)
    if "pixel_response" in applied:
        response = pixel_response.apply(
            response, *pixel_response.EFFECT.parameters(scene), fixed(pixel_response.EFFECT)
        )
    if "chromatic_response" in applied:
        # This is the response for light of flat f_nu. Its dependence on the colour of a star remains.
        _, even, *strength = chromatic_response.EFFECT.parameters(scene)
        maps = chromatic_response.draw_maps(found.shape, *strength, fixed(chromatic_response.EFFECT))
        response *= 1.0 + even[0] * maps[0] + even[1] * maps[1]
    flag = one.readout.extensions[1].data[4:-4, 4:-4] if len(one.readout.extensions) > 1 else 0
    dark = dark_map.apply(np.zeros(found.shape), *dark_map.EFFECT.parameters(scene), fixed(dark_map.EFFECT))
    good = (response > 0.7) & (flag == 0) & (dark < HOT)
    return np.where(good, (linear - dark) / response, np.nan)


def coupled(image):
    """Return an image after inter-pixel capacitance."""
    side, diagonal = (MISSION.value(f"nisp.ipc.{key}", "") for key in ("side", "diagonal"))
    kernel = np.array([[diagonal, side, diagonal], [side, 1 - 4 * (side + diagonal), side], [diagonal, side, diagonal]])
    return ndimage.convolve(image, kernel)


def circles(image, x, y, radius=APERTURE):
    """Return the light inside a circle above the mean of a ring, and the numbers of pixels of both."""
    flux = sep.sum_circle(image, x, y, radius, subpix=11)[0]
    ring = sep.sum_circann(image, x, y, *RING, subpix=11)[0]
    inside, around = np.pi * radius**2, np.pi * (RING[1] ** 2 - RING[0] ** 2)
    return flux - ring * inside / around, inside, around


def by_psf(image, one, x, y, light, sky):
    """Fit the PSF image at the true positions; return fluxes [n] and their noise. `light` is a rough flux (e-)."""
    noise = one.scene.pixel_noise
    out = []
    for column, row in zip(x, y, strict=True):
        x0, y0 = round(column) - HALF, round(row) - HALF
        box = image[y0 : y0 + 2 * HALF + 1, x0 : x0 + 2 * HALF + 1] - sky
        shape = coupled(model(one.psf, column - x0, row - y0))
        # The weights contain the noise of the pixels, including the noise of the star.
        weight = np.where(np.isfinite(box), 1 / (noise**2 + light * np.maximum(shape, 0.0)), 0.0)
        norm = (weight * shape**2).sum()
        out.append(((weight * shape * np.nan_to_num(box)).sum() / norm, norm**-0.5))
    return np.array(out).T


def measured(band, mags, number):
    """Return measured minus true magnitudes [2, n], by aperture and by PSF, and the expected noise of both (mag)."""
    x, y = nominal.lattice(SIDE, 32, number)
    # Pixels hit by cosmic rays are flagged, so 2 % of the stars are lost.
    one = infrared.rendered(np.resize(mags, len(x)), x, y, DETECTOR, band=band, mjd=infrared.MJD + number)
    rows, image = truth_table.truth(one), undone(one)
    x, y, true = (rows[name].to_numpy() for name in ("x", "y", "expected"))
    bad = ~np.isfinite(image)
    reference = coupled(one.noise_free.astype(float))
    # Sky level in pixels without wings of stars.
    sky = float(np.nanmedian(image[reference < 0.5]))
    found, inside, around = circles(np.where(bad, sky, image), x, y)
    counted = circles(reference, x, y)[0] / true
    fits, sigma = by_psf(image, one, x, y, float(np.median(true)), sky)
    noise = np.sqrt(true + inside * (1 + inside / around) * one.scene.pixel_noise**2) / true
    blind = sep.sum_circle(bad.astype(float), x, y, APERTURE + 1.0)[0]
    edge = np.minimum(np.minimum(x, y), SIDE - 1 - np.maximum(x, y)) > 15
    good = (blind == 0) & edge & (1 / noise > 100)
    change = -2.5 * np.log10(np.stack([found / counted, fits]) / true)
    return change[:, good], 1.0857 * noise[good], 1.0857 * (sigma / true)[good]


def check(band, numbers):
    parts = [measured(band, [17.6, 18.0, 18.4, 18.8], number) for number in numbers]
    change, noise, sigma = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    print(f"{band}: {change.shape[1]} stars, median {np.median(change, axis=1)}, rms {change.std(axis=1)}")
    print(f"expected {np.sqrt(np.mean(noise**2)):.4f}, {np.sqrt(np.mean(sigma**2)):.4f} mag")
    assert change.shape[1] >= 10 * len(numbers)
    assert np.abs(np.median(change, axis=1)).max() <= 0.01
    for found, expected in zip(change, (noise, sigma), strict=True):
        assert np.median(np.abs(found)) * 1.4826 <= 1.3 * np.sqrt(np.mean(expected**2)) + 0.003


def test_stars_are_as_bright_as_the_catalogue_says():
    """Stars have S/N > 100 in an aperture and by their PSF; all effects are on, and the detector is known."""
    check("euclid_h", (1, 2))


@pytest.mark.nightly
@pytest.mark.parametrize("band", CIRCLES)
def test_stars_of_every_band(band):
    check(band, range(1, 9))


# ------------------------------------------------------------------------------------------------ depth


def sky_of(band):
    """Return the sky rate of a field with mean zodiacal light, 30 deg from the ecliptic at quadrature."""
    own = diffuse_light.thermal_sky(DETECTOR, band, MISSION)
    return diffuse_light.sky_rate(own, 53.1, -27.8, infrared.MJD, MISSION)


def spread(values):
    """Return the standard deviation without outliers, from the median deviation."""
    return 1.4826 * np.nanmedian(np.abs(values - np.nanmedian(values)))


def depth(band, detector, pitch=7):
    """Return AB magnitudes of S/N 5 in the mean of four dithers: in the mission's circle, and by the PSF.

    The signal is the light of a star of given magnitude. The noise is the scatter over empty positions in four
    exposures.
    """
    radius, images = CIRCLES[band] / 0.3, []
    for number in range(1, 5):
        date = infrared.MJD + number
        one = infrared.rendered([DEPTH], [30.3], [40.8], detector, band=band, sky=sky_of(band), mjd=date)
        image = undone(one) - coupled(one.noise_free.astype(float))
        # Each dither observes a position with different pixels.
        images.append(np.roll(image - np.nanmedian(image), (5 * number, -3 * number), (0, 1)))
    stack = np.nan_to_num(np.nanmean(images, axis=0))
    x, y = (at + 2 * HALF for at in nominal.lattice(detector.nx - 4 * HALF, pitch))
    light = sep.sum_circle(stack, x, y, radius, subpix=11)[0]
    fits, _ = by_psf(stack, one, x[::12], y[::12], 0.0, 0.0)
    alone = coupled(model(one.psf, HALF + 0.2, HALF - 0.3))
    part = float(sep.sum_circle(alone, [HALF + 0.2], [HALF - 0.3], radius, subpix=11)[0][0])
    scatter, true = np.array([spread(light), spread(fits)]), one.sources.electrons[0]
    print(f"{band}: {part:.3f} of {true:.0f} e- in the circle, scatter {scatter} of {len(x)} and {len(fits)} places")
    return DEPTH + 2.5 * np.log10(np.array([part * true, true]) / scatter / 5.0)


def check_depth(band, detector):
    circle, fit = depth(band, detector)
    print(f"{band}: S/N 5 at {circle:.2f} in the mission's circle, {fit:.2f} by the PSF, sky {sky_of(band):.2f} e-/s")
    assert circle == pytest.approx(DEPTH, abs=0.2)
    assert min(circle, fit) >= REQUIRED
    assert fit > circle


@pytest.mark.nightly
@pytest.mark.parametrize("band", CIRCLES)
def test_faint_stars_are_seen_in_a_stack_of_four(band):
    check_depth(band, small("nisp", "DET23", 320))


@pytest.mark.nightly
@pytest.mark.parametrize("band", CIRCLES)
def test_faint_stars_are_seen_all_over_a_detector(band):
    """The detector differs from the other tests."""
    check_depth(band, small("nisp", "DET41", 1024))
