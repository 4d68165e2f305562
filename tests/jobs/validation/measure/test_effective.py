"""The effective PSF of stars whose light is known, and stars fitted with it, against least squares by scipy."""

import numpy as np
import pytest
import scipy.optimize
from scipy.special import erf

from jobs.validation.measure import effective

FWHM, NOISE = 1.7, 14.0
SIGMA = FWHM / 2.3548


def point(x, y):
    """A Gaussian averaged over the pixel at this distance."""
    edges = [[(axis + side) / (np.sqrt(2) * SIGMA) for side in (0.5, -0.5)] for axis in (x, y)]
    (right, left), (above, below) = [[erf(edge) for edge in pair] for pair in edges]
    return 0.25 * (right - left) * (above - below)


def cut(rng, flux, noise):
    """Distances of the pixels from a star anywhere in its pixel, and their electrons."""
    near = int(effective.reach_of(FWHM) - 0.6)
    axis = np.arange(-near, near + 1.0)
    u, v = (side.ravel() for side in np.meshgrid(axis - rng.uniform(-0.5, 0.5), axis - rng.uniform(-0.5, 0.5)))
    told = flux * point(u, v)
    return u, v, told + noise * np.sqrt(1.0 + told / NOISE**2) * rng.standard_normal(len(u))


@pytest.fixture(scope="module")
def psf():
    rng = np.random.default_rng(5)
    u, v, read = np.concatenate([cut(rng, 1e5, NOISE) for _ in range(40)], axis=1)
    return effective.built(u, v, read / 1e5, np.full(len(u), 1e5**2 / NOISE**2), FWHM)


def test_it_is_the_point_that_was_drawn(psf):
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-1.8, 1.8, (2, 500))
    value, rise, climb = psf.at(x, y)
    assert value == pytest.approx(point(x, y), abs=0.01 * point(0.0, 0.0))
    step = 1e-4
    assert rise == pytest.approx((psf.at(x + step, y)[0] - psf.at(x - step, y)[0]) / (2 * step), abs=1e-6)
    assert climb == pytest.approx((psf.at(x, y + step)[0] - psf.at(x, y - step)[0]) / (2 * step), abs=1e-6)


def test_light_of_fainter_stars(psf):
    """5,000 e-, a tenth of a pixel from where they are looked for; within 1 % in the mean, and as noisy as is said."""
    rng, found = np.random.default_rng(7), []
    for _ in range(150):
        u, v, read = cut(rng, 5000.0, NOISE)
        found.append(effective._fitted(psf, u + 0.1, v - 0.1, read, 4000.0, NOISE))
    light, error = np.array(found).T
    assert light.mean() == pytest.approx(5000.0, rel=0.01)
    assert np.std(light) == pytest.approx(np.mean(error), rel=0.25)


def test_a_cosmic_ray_is_left_out_and_a_fit_is_that_of_scipy(psf):
    u, v, read = cut(np.random.default_rng(8), 50000.0, NOISE)

    def left(p):
        value = p[0] * psf.at(u - p[1], v - p[2])[0]
        return (read - value) / np.sqrt(NOISE**2 + np.maximum(50000.0 * psf.at(u, v)[0], 0.0))

    told = scipy.optimize.least_squares(left, [50000.0, 0.0, 0.0], x_scale=[1e4, 0.1, 0.1]).x[0]
    assert effective._fitted(psf, u, v, read, 50000.0, NOISE)[0] == pytest.approx(told, rel=2e-3)
    read[3] += 20000.0
    assert effective._fitted(psf, u, v, read, 50000.0, NOISE)[0] == pytest.approx(told, rel=2e-2)
