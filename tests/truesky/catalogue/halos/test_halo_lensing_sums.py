"""The compiled sums agree with independent formulas for one halo and one source at a time."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from truesky.catalogue.halos import halo_lensing_sums as sums
from truesky.catalogue.halos import projected_nfw

ARCMIN = np.radians(1 / 60)
AMPLITUDE, SIZE, CLOSE, WIDE, CONCENTRATION, CHI = 3e-9, 2 * ARCMIN, 6 * ARCMIN, 20 * ARCMIN, 6.0, 800.0


def halos(x, y, chi=CHI, close=CLOSE):
    x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
    others = (np.broadcast_to(v, x.shape) for v in (chi, AMPLITUDE, SIZE, close, WIDE, CONCENTRATION))
    return np.stack([x, y, *others])


def summed(x, y, near, halo, add=None):
    x, y, near = (np.atleast_1d(np.asarray(v, float)) for v in (x, y, near))
    out = np.zeros((5, x.size))
    if add is None:
        sums.add_halos(np.stack([x, y]), near, np.array([0, x.size]), halo, out)
    else:
        add(np.stack([x, y]), near, halo, out)
    return out


def one(x, y, near, halo, circle=sums.CLOSE):
    """Return the profile of Takada & Jain minus its compensating kernel."""
    size, c, wide = halo[sums.SIZE], halo[sums.CONCENTRATION], halo[circle]
    dx, dy = x - halo[sums.X], y - halo[sums.Y]
    strength = halo[sums.AMPLITUDE] * max(1 - halo[sums.CHI] * near, 0.0)
    theta = max(np.hypot(dx, dy), 1e-6 * size)
    w = max(1 - (theta / wide) ** 2, 0.0)
    kappa, inside = -3 * w * w / wide**2, 1.0
    if theta < size:
        surface, mass = projected_nfw.profile(c * theta / size, c)
        kappa += c * c * surface / (2 * projected_nfw.total(c) * size**2)
        inside = mass / projected_nfw.total(c)
    mean = (inside - 1 + w**3) / theta**2
    shear, phi = mean - kappa, np.arctan2(dy, dx)
    tangential = -shear if dx or dy else 0.0
    return strength * np.array(
        [kappa, tangential * np.cos(2 * phi), tangential * np.sin(2 * phi), mean * dx, mean * dy]
    )


@pytest.fixture
def sky(rng):
    """Return sources and halos in a piece of the sky."""
    x, y = ARCMIN * rng.uniform(-1.5, 1.5, (2, 40))
    near = np.sort(1 / rng.uniform(300, 3000, 40))
    halo = halos(*(ARCMIN * rng.uniform(-15, 15, (2, 60))), np.sort(rng.uniform(200, 2500, 60)))
    halo[:2, :20] *= 0.1
    return (x, y, near), halo


def test_sums_are_those_of_the_formulas(sky):
    sources, halo = sky
    wanted = np.array([sum(one(*source, column) for column in halo.T) for source in zip(*sources, strict=True)]).T
    assert np.abs(summed(*sources, halo) - wanted).max(1) == pytest.approx(np.zeros(5), abs=1e-9)
    assert np.all(np.abs(wanted).max(1) > [1e-2, 1e-2, 1e-2, 1e-6, 1e-6])


def test_the_smooth_part_is_the_rest(sky):
    """The smooth part is the lensing compensated within theta_c minus the lensing compensated within theta_s."""
    sources, halo = sky
    rest = summed(*sources, halo, sums.add_smooth)
    wanted = [sum(one(*source, column, sums.WIDE) for column in halo.T) for source in zip(*sources, strict=True)]
    assert np.abs(summed(*sources, halo) + rest - np.array(wanted).T).max(1) == pytest.approx(np.zeros(5), abs=1e-9)
    assert np.all(np.abs(rest).max(1) > [1e-3, 1e-4, 1e-4, 1e-6, 1e-6])


@pytest.mark.parametrize("circle", [sums.CLOSE, sums.WIDE])
def test_a_compensated_halo_has_no_total_mass(circle):
    """The total is 0 within 1e-6 of the halo's mass; there is no convergence, shear or deflection beyond."""
    halo = halos(0, 0)
    end = halo[circle, 0]
    halo[sums.CLOSE] = end

    def ring(theta):
        return 2 * np.pi * theta * summed(theta, 0, 0, halo)[0, 0]

    edges = (1e-9, 0.1 * SIZE, SIZE * (1 - 1e-10), end)
    parts = [quad(ring, low, high, epsabs=1e-17, limit=200)[0] for low, high in pairwise(edges)]
    assert sum(parts) == pytest.approx(0.0, abs=1e-6 * np.pi * AMPLITUDE)
    assert parts[0] > 0.05 * np.pi * AMPLITUDE
    assert not summed([1.0001 * end, -2 * end], [0, 0], [0, 0], halo).any()
    assert np.abs(summed(0.9999 * end, 0, 0, halo)[4]).max() < 1e-12


def test_behind_a_centre_everything_is_finite():
    kappa, *others = summed(0, 0, 0, halos(0, 0))[:, 0]
    assert others == [0, 0, 0, 0]
    assert kappa == pytest.approx(one(1e-6 * SIZE, 0, 0, halos(0, 0)[:, 0])[0], rel=1e-9)
    for add in (None, sums.add_smooth):
        assert np.isfinite(summed([0, 1e-300, 1e-12], [0, 0, 0], [0, 0, 0], halos(0, 0), add)).all()


@pytest.mark.parametrize("add", [None, sums.add_smooth])
def test_sources_in_front_are_not_lensed(add):
    near = np.array([0.5, 1.0, 1.0 + 1e-12, 2.0]) / CHI
    found = summed(np.full(4, ARCMIN), np.zeros(4), near, halos(0, 0), add)
    assert found[0, 0] > 5e-4
    assert not found[:, 1:].any()


def test_a_source_alone_is_the_same_as_with_others(rng):
    """The bits are identical: halos that only reach other sources have no effect."""
    x, y = ARCMIN * rng.uniform(-1.5, 1.5, (2, 50))
    near = np.sort(1 / rng.uniform(300, 3000, 50))
    halo = halos(*(ARCMIN * rng.uniform(-25, 25, (2, 300))), np.sort(rng.uniform(200, 2500, 300)))
    together = summed(x, y, near, halo)
    for rows in (slice(7, 8), slice(0, 33), slice(1, None, 3)):
        assert summed(x[rows], y[rows], near[rows], halo).tobytes() == together[:, rows].tobytes()


def test_convergence_and_shear_are_derivatives_of_the_deflection():
    h, near = 1e-4 * ARCMIN, 1 / 3000
    for add in (None, sums.add_smooth):
        for x, y in ((0.3, 0.2), (1.5, -1.0), (2.0, 4.0), (-4.0, 3.0)):
            x, y = x * ARCMIN, y * ARCMIN
            found = summed([x + h, x - h, x, x, x], [y, y, y + h, y - h, y], np.full(5, near), halos(0, 0), add)
            (xx, xy), (yx, yy) = ((found[3:, i] - found[3:, i + 1]) / (2 * h) for i in (0, 2))
            kappa, gamma1, gamma2 = found[:3, 4]
            expected = (kappa + gamma1, gamma2, gamma2, kappa - gamma1)
            assert (xx, xy, yx, yy) == pytest.approx(expected, rel=1e-4, abs=1e-8)


def test_a_smooth_field_is_interpolated_exactly(rng):
    """A cubic in the plane that is linear in inverse distance; there is no lensing nearer than the nearest plane."""
    side, step, planes = 9, 0.5, np.array([0.0, 0.3, 1.0])
    at = step * (np.arange(side) - (side - 1) / 2)
    y, x = np.meshgrid(at, at, indexing="ij")

    def field(x, y, near):
        return (1 - 0.7 * near) * np.stack([1 + 0 * x, x, y, x * y, x * x - y * y])

    table = np.stack([np.moveaxis(field(x, y, near), 0, -1) for near in planes])
    place, near = rng.uniform(-1.4, 1.4, (2, 60)), rng.uniform(0, 0.99, 60)
    out = np.zeros((5, 60))
    sums.add_nodes(place, near, planes, step, table, out)
    assert out == pytest.approx(field(*place, near), abs=1e-12)
    nearer, beyond = np.zeros((5, 1)), np.zeros((5, 1))
    sums.add_nodes(place[:, :1], np.array([1.0]), planes, step, table, nearer)
    sums.add_nodes(100 * place[:, :1], near[:1], planes, step, table, beyond)
    assert not nearer.any()
    assert np.isfinite(beyond).all()
