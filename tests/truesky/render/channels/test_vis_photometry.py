"""Photometry of stars in VIS images, and the losses by effects that the photometry does not undo."""

from dataclasses import replace

import numpy as np
import pytest
import sep
from scipy.ndimage import uniform_filter

from benchmarks import effects
from lake_schema.mission.configuration import resolve
from tests.truesky.render import calibrated, nominal
from tests.truesky.render.fields import MISSION, small
from truesky.render.camera import detectors
from truesky.render.drawing import transfer
from truesky.render.products import truth_table

# Radius of the aperture, and radii of the ring in which the sky is measured, arcsec.
APERTURE, RING = 1.3, (2.2, 3.0)
CTI = ("parallel_cti", "serial_cti")
BODY = {"disk_half_light_radius": 0.3}
# Samples per pixel of the drawn PSF.
FINE = 5


def in_aperture(image, x, y, scale):
    """Return the electrons inside the aperture above the mean of the ring, and the numbers of pixels of both."""
    circle = sep.sum_circle(image, x, y, APERTURE / scale, subpix=11)[0]
    ring, _, _ = sep.sum_circann(image, x, y, RING[0] / scale, RING[1] / scale, subpix=11)
    inside, around = (np.pi * (outer**2 - inner**2) / scale**2 for inner, outer in ((0.0, APERTURE), RING))
    return circle - ring * inside / around, inside, around


def correction(one):
    """Return the measured fraction of the light of a star, from the mean model PSF drawn by galsim."""
    weights = transfer.basis_weights(one.psf, one.sources.photons, one.sources.column, one.sources.row)
    fine = transfer.profile_of(one.psf, weights.mean(axis=0)).drawImage(
        nx=801, ny=801, scale=one.psf.pixel_scale / FINE, method="no_pixel", dtype=float
    )
    seen, middle = uniform_filter(fine.array, FINE, mode="constant"), np.array([400.0])
    return float(in_aperture(seen, middle, middle, one.psf.pixel_scale / FINE)[0][0])


def photometry(one):
    """Return measured minus true magnitudes of all usable stars, and their expected noise (mag)."""
    applied = {decision.name for decision in one.decisions if decision.applied}
    image = calibrated.electrons(one.raw, one.scene, nominal.SEED, applied)
    bad = ~np.isfinite(image)
    rows, scale = truth_table.truth(one), one.detector.pixel_scale
    x, y, true = (rows[name].to_numpy() for name in ("x", "y", "expected"))
    found, inside, around = in_aperture(np.ascontiguousarray(np.where(bad, 0.0, image)), x, y, scale)
    blind = sep.sum_circle(bad.astype(float), x, y, RING[1] / scale)[0]
    noise = np.sqrt(true + inside * (1 + inside / around) * one.scene.pixel_noise**2) / true
    good = (blind == 0) & (1 / noise > 200)
    return -2.5 * np.log10(found / correction(one) / true)[good], 1.0857 * noise[good]


def stars(detector, pitch, mags, forced, mission=MISSION, number=1):
    x, y = nominal.lattice(detector.nx, pitch, number)
    inside = y < detector.ny - pitch / 2
    mags = np.resize(mags, inside.sum())
    return nominal.rendered(detector, mags, x[inside], y[inside], mission=mission, forced=forced, number=number)


def test_isolated_stars_are_as_bright_as_the_catalogue_says():
    """The images are linearised, without charge transfer and cosmic rays. The stars have S/N > 200."""
    forced, detector = nominal.off(*nominal.COSMIC_RAYS, *CTI), small("vis", "3-4", 256)
    mags = [18.5, 19.0, 19.5, 20.0]
    found = [photometry(stars(detector, 64, mags, forced, number=number)) for number in (1, 2)]
    change, noise = np.concatenate(found, axis=1)
    assert len(change) >= 20
    assert abs(np.median(change)) <= 0.003
    assert change.std() <= 1.2 * np.sqrt(np.mean(noise**2)) + 0.005


def test_losses_by_charge_effects_are_those_of_the_benchmark():
    """Charge transfer with old traps and brighter-fatter dim a star by the losses in benchmarks/effects.py."""
    old = resolve(overrides={"vis.cti.age": (10.0, "")})
    detector = small("vis", "3-4", 256)
    quiet = nominal.off(*nominal.COSMIC_RAYS)
    # Both renderings have the same noise.
    without = stars(detector, 64, 20.0, quiet | nominal.off(*nominal.CHARGE), old)
    through = stars(detector, 64, 20.0, quiet | dict.fromkeys(nominal.CHARGE, True), old)
    (before, noise), (after, _) = photometry(without), photometry(through)
    found = np.mean(after - before)
    rows = truth_table.truth(without)
    places = replace(
        without.sources, column=rows["x"].to_numpy(), row=rows["y"].to_numpy(), electrons=rows["expected"].to_numpy()
    )
    told = effects.effect_changes(without.scene, places, without.noise_free.astype(float))
    expected = sum(np.nanmean(told[name][:, 0]) for name in nominal.CHARGE)
    print(f"shift {1e3 * found:.2f} mmag, by the benchmark {1e3 * expected:.2f}, noise of a star {1e3 * noise[0]:.2f}")
    assert expected > 0.003
    assert found == pytest.approx(expected, rel=0.1)


def test_signal_to_noise_of_weak_lensing_galaxies_is_as_stated():
    """Galaxies have I_E = 24.5 and r_e = 0.3" in a stack of four. Their fluxes scatter by the expected noise.

    Sample of 240 galaxies or more; significance 6e-5 of the mean (4 standard errors), 0.03 of the scatter (10 %).
    """
    detector, forced = small("vis", "3-4", 512), nominal.off(*nominal.COSMIC_RAYS, *CTI)
    x, y = nominal.lattice(512, 32)
    stack = []
    for number in range(1, 5):
        one = nominal.rendered(
            detector, np.full(len(x), 24.5), x, y, BODY, forced=forced, number=number, truth=("sky",)
        )
        applied = {decision.name for decision in one.decisions if decision.applied}
        diffuse = one.maps["sky"] + one.scene.dark_electrons * ("dark_current" in applied)
        stack.append(calibrated.electrons(one.raw, one.scene, nominal.SEED, applied) - diffuse)
    image = np.mean(stack, axis=0)
    bad = ~np.isfinite(image)
    # The aperture is 1.3" across.
    flux, blind = (sep.sum_circle(part, x, y, 6.5)[0] for part in (np.where(bad, 0.0, image), bad.astype(float)))
    true = sep.sum_circle(one.noise_free.astype(float), x, y, 6.5)[0].mean()
    scene = one.scene
    gain, read_noise = (scene.amplifier_values(*of) for of in (("gain", "electron / adu"), ("read_noise", "electron")))
    pixel = scene.sky_electrons + scene.dark_electrons + np.mean(read_noise**2 + gain**2 / 12)
    noise = np.sqrt((true + np.pi * 6.5**2 * pixel) / 4)
    seen = flux[blind == 0]
    assert len(seen) > 240
    assert seen.mean() == pytest.approx(true, abs=4 * noise / np.sqrt(len(seen)))
    # The scatter of 240 values is uncertain by 4.5 %.
    assert seen.std() == pytest.approx(noise, rel=0.1)
    assert true / noise == pytest.approx(20.5, rel=0.1)


@pytest.mark.nightly
def test_stars_of_a_whole_detector():
    forced = nominal.off(*nominal.COSMIC_RAYS, *CTI)
    detector = detectors.detector("vis", "1-1", MISSION)
    change, noise = photometry(stars(detector, 128, np.arange(18.2, 20.2, 0.1), forced))
    print(f"{len(change)} stars: median {np.median(change):.5f}, rms {change.std():.5f}, expected {noise.mean():.5f}")
    assert len(change) > 800
    assert abs(np.median(change)) <= 0.003
    assert change.std() <= 1.2 * np.sqrt(np.mean(noise**2)) + 0.005
