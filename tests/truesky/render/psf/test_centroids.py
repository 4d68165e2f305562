"""Centroids of PSFs agree with shifted Gaussians, and with measurements of drawn stars."""

from dataclasses import replace

import numpy as np
import pytest
import sep

from tests.truesky.render import nominal
from tests.truesky.render.fields import small
from truesky.render.drawing import transfer
from truesky.render.products import truth_table
from truesky.render.psf import centroids, model, seeing
from truesky.render.psf.centroids import offsets


def shifted(x, y, sigma=0.9, samples=3, side=24):
    """Return a Gaussian at an offset (pixels) from the middle."""
    axis = (np.arange(side * samples + 1) - side * samples // 2) / samples
    one = np.exp(-0.5 * ((axis - x) ** 2 + (axis[:, None] - y) ** 2) / sigma**2)
    return (one / one.sum()).astype(np.float32)


def psf_of(*planes, drift=(), samples=3):
    images, more = np.stack(planes), np.stack(drift) if drift else np.zeros((0, *planes[0].shape), np.float32)
    waves = 6000.0 + 1000.0 * np.arange(len(planes))
    return model.from_planes(
        model.Planes(waves, images, more, (50.0, 50.0), ((1, 0, 0),) * len(drift), samples), 0.1, False, 24
    )


@pytest.mark.parametrize(("samples", "error"), [(3, 0.014), (5, 0.005)])
def test_half_of_the_light_of_a_gaussian(samples, error):
    """The diameter is correct for any width, not only for multiples of the sample spacing."""
    for sigma in np.linspace(0.5, 1.5, 23):
        found = centroids._half_light_diameter(shifted(0.0, 0.0, sigma, samples=samples), samples)
        assert found == pytest.approx(2.0 * sigma * np.sqrt(2.0 * np.log(2.0)), rel=error)


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_of_a_shifted_gaussian_it_is_the_shift(samples):
    found = np.stack(offsets(psf_of(shifted(0.1, -0.05, samples=samples), samples=samples), np.ones((1, 1))))
    assert found[:, 0] == pytest.approx((0.1, -0.05), rel=0.03)


def test_centroid_with_an_even_number_of_samples_is_the_shift():
    waves, none = np.array([6000.0]), np.zeros((0, 49, 49), np.float32)
    planes = model.Planes(waves, shifted(0.1, -0.05, samples=2)[None], none, (50.0, 50.0), (), 2)
    x, y = offsets(model.from_planes(planes, 0.1, False, 24), np.ones((1, 1)))
    assert (x[0], y[0]) == pytest.approx((0.1, -0.05), rel=0.05)


def test_of_colours_and_places_it_is_between():
    """Two wavelengths have different centroids, and the PSF changes across the detector."""
    drift = shifted(0.05, 0.0) - shifted(0.0, 0.0)
    psf = psf_of(shifted(0.1, 0.0), shifted(-0.1, 0.0), drift=(drift,))
    weights = transfer.basis_weights(
        psf, np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.5, 0.5]]), np.array([50, 50, 50, 100.0]), np.full(4, 50.0)
    )
    x, y = offsets(psf, weights)
    assert x == pytest.approx((0.1, -0.1, 0.0, 0.05), abs=0.004)
    assert y == pytest.approx((0.0,) * 4, abs=1e-4)


def test_of_a_round_disc_it_is_nothing():
    psf = seeing.moffat_psf(0.73, 3.0, 0.2)
    assert np.abs(offsets(psf, np.ones((3, 1)))).max() < 1e-6


def test_stars_are_found_where_truth_has_them():
    """Windowed centroids of noise-free VIS stars are 5 mas from the chief ray, as predicted within 1 mas.

    Pixels sample the light coarsely, so centroids scatter by 1 mas from star to star.
    """
    x, y = nominal.lattice(300, 100)
    quiet = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE)
    detector = replace(small("vis", "1-1", 300), injection_rows=0)
    one = nominal.rendered(detector, np.full(len(x), 19.0), x, y, forced=quiet)
    rows = truth_table.truth(one)
    data = np.array(one.noise_free, float)
    found = sep.extract(data, 50.0)
    assert len(found) == len(x)
    radius, _ = sep.flux_radius(data, found["x"], found["y"], np.full(len(found), 30.0), 0.5, subpix=5)
    there = np.stack(sep.winpos(data, found["x"], found["y"], 2.0 / 2.3548 * radius)[:2], axis=1)
    place = np.stack([rows["x"], rows["y"]], axis=1)
    offset = np.stack([rows["psf_x"], rows["psf_y"]], axis=1)
    nearest = np.argmin(np.hypot(*(there[None, :] - place[:, None]).T), axis=0)
    off = 100.0 * (there[nearest] - place)
    assert np.hypot(*off.T).min() > 3.0
    assert np.abs(np.mean(off - 100.0 * offset, axis=0)).max() < 0.5
    assert np.sqrt(np.mean((off - 100.0 * offset) ** 2)) < 1.0


def test_magnitudes_are_by_the_header():
    one = nominal.rendered(small("vis", "3-4", 160), [19.0, 22.5], [50.0, 110.0], [50.0, 110.0])
    assert sorted(truth_table.truth(one)["mag"].to_pylist()) == pytest.approx([19.0, 22.5], abs=1e-5)
