"""Effective PSF of stars with known light, and fits with it against least squares by scipy."""

import numpy as np
import pytest
import scipy.optimize
from scipy.special import erf

from truesky.validation.lake.measure import effective_psf

FWHM, NOISE = 1.7, 14.0
SIGMA = FWHM / 2.3548


def point(x, y):
    """A Gaussian averaged over the pixel at this distance."""
    edges = [[(axis + side) / (np.sqrt(2) * SIGMA) for side in (0.5, -0.5)] for axis in (x, y)]
    (right, left), (above, below) = [[erf(edge) for edge in pair] for pair in edges]
    return 0.25 * (right - left) * (above - below)


def cut(rng, flux, noise):
    """Distances of pixels from a star at a random position in its pixel, and their electrons."""
    near = int(effective_psf.fit_radius(FWHM) - 0.6)
    axis = np.arange(-near, near + 1.0)
    u, v = (side.ravel() for side in np.meshgrid(axis - rng.uniform(-0.5, 0.5), axis - rng.uniform(-0.5, 0.5)))
    told = flux * point(u, v)
    return u, v, told + noise * np.sqrt(1.0 + told / NOISE**2) * rng.standard_normal(len(u))


@pytest.fixture(scope="module")
def psf():
    rng = np.random.default_rng(5)
    u, v, read = np.concatenate([cut(rng, 1e5, NOISE) for _ in range(40)], axis=1)
    return effective_psf.build(u, v, read / 1e5, np.full(len(u), 1e5**2 / NOISE**2), FWHM)


def test_psf_agrees_with_input(psf):
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-1.8, 1.8, (2, 500))
    value, rise, climb = psf.evaluate(x, y)
    assert value == pytest.approx(point(x, y), abs=0.01 * point(0.0, 0.0))
    step = 1e-4
    assert rise == pytest.approx((psf.evaluate(x + step, y)[0] - psf.evaluate(x - step, y)[0]) / (2 * step), abs=1e-6)
    assert climb == pytest.approx((psf.evaluate(x, y + step)[0] - psf.evaluate(x, y - step)[0]) / (2 * step), abs=1e-6)


def fitted(psf, u, v, read, flux):
    """Fit stars without missing pixels."""
    u, v, read = np.atleast_2d(u), np.atleast_2d(v), np.atleast_2d(read)
    return effective_psf._fit_stars(psf, (u, v), read, np.ones(u.shape, bool), np.full(len(u), flux), NOISE)


def test_light_of_fainter_stars(psf):
    """Stars of 5,000 e- a tenth of a pixel off: fluxes within 1 % on average, with scatter equal to their errors."""
    rng = np.random.default_rng(7)
    u, v, read = np.array([cut(rng, 5000.0, NOISE) for _ in range(150)]).transpose(1, 0, 2)
    light, error = fitted(psf, u + 0.1, v - 0.1, read, 4000.0)
    assert light.mean() == pytest.approx(5000.0, rel=0.01)
    assert np.std(light) == pytest.approx(np.mean(error), rel=0.25)


def test_a_cosmic_ray_is_left_out_and_a_fit_is_that_of_scipy(psf):
    u, v, read = cut(np.random.default_rng(8), 50000.0, NOISE)

    def left(p):
        value = p[0] * psf.evaluate(u - p[1], v - p[2])[0]
        return (read - value) / np.sqrt(NOISE**2 + np.maximum(50000.0 * psf.evaluate(u, v)[0], 0.0))

    told = scipy.optimize.least_squares(left, [50000.0, 0.0, 0.0], x_scale=[1e4, 0.1, 0.1]).x[0]
    assert fitted(psf, u, v, read, 50000.0)[0][0] == pytest.approx(told, rel=2e-3)
    read[3] += 20000.0
    assert fitted(psf, u, v, read, 50000.0)[0][0] == pytest.approx(told, rel=2e-2)


def test_stars_side_by_side_are_fitted_as_each_alone(psf):
    """Padding of stars with fewer pixels has no effect; a star without pixels has no flux."""
    rng = np.random.default_rng(9)
    pixels = [cut(rng, flux, NOISE) for flux in (3000.0, 20000.0, 400.0)]
    keep = [len(pixels[0][0]), 20, 0]
    u, v, read = (np.zeros((3, keep[0])) for _ in range(3))
    there = np.arange(keep[0]) < np.array(keep)[:, None]
    for i, own in enumerate(pixels):
        for plane, part in zip((u, v, read), own, strict=True):
            plane[i] = np.where(there[i], part, 77.0)
    begun = np.array([2500.0, 18000.0, 400.0])
    light, error = effective_psf._fit_stars(psf, (u, v), read, there, begun, NOISE)
    for i in (0, 1):
        alone = [plane[i : i + 1, : keep[i]] for plane in (u, v, read)]
        own = effective_psf._fit_stars(
            psf, tuple(alone[:2]), alone[2], np.ones((1, keep[i]), bool), begun[i : i + 1], NOISE
        )
        assert (light[i], error[i]) == pytest.approx((own[0][0], own[1][0]), rel=1e-9)
    assert np.isnan(light[2])
    assert np.isnan(error[2])


def test_coefficients_are_those_of_a_dense_solution():
    """The second differences are additional equations with small weight."""
    rng, k = np.random.default_rng(10), 9
    x, y = rng.uniform(-1.4, 1.4, (2, 600))
    step, reach = 0.5, 1.5
    (i, first, _), (j, second, _) = (effective_psf._basis(axis, step, reach) for axis in (x, y))
    assert effective_psf._knots(step, reach) == k
    index = (j[:, :, None] * k + i[:, None, :]).reshape(-1, 16)
    basis = (second[:, :, None] * first[:, None, :]).reshape(-1, 16)
    value, weight = rng.standard_normal(600), rng.uniform(0.5, 2.0, 600)
    dense = np.zeros((600, k * k))
    np.add.at(dense, (np.arange(600)[:, None], index), basis)
    bends = []
    for a in range(k):
        for b in range(k - 2):
            for one, two, three in (((a, b), (a, b + 1), (a, b + 2)), ((b, a), (b + 1, a), (b + 2, a))):
                row = np.zeros((k, k))
                row[one], row[two], row[three] = 1.0, -2.0, 1.0
                bends.append(row.ravel())
    smooth = effective_psf._SMOOTH * (dense**2 * weight[:, None]).sum(axis=0).mean()
    root = np.sqrt(weight)
    matrix = np.concatenate([dense * root[:, None], np.sqrt(smooth) * np.array(bends)])
    told = np.linalg.lstsq(matrix, np.concatenate([value * root, np.zeros(len(bends))]), rcond=None)[0]
    found = effective_psf._solve_coefficients(index, basis, value, weight, k)
    assert found == pytest.approx(told, abs=1e-7 * np.abs(told).max())
