"""The compiled sums against the same written as formulas, one halo and one source at a time."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from jobs.catalogue.galaxies import halo_lensing_sums
from jobs.catalogue.halos import projected_nfw

ARCMIN = np.radians(1 / 60)
# One tangent plane: east, north, and the direction of its centre.
FRAME = np.array([[[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]])
AMPLITUDE, SIZE, WIDE, CONCENTRATION, CHI = 3e-9, 2 * ARCMIN, 20 * ARCMIN, 6.0, 800.0


def halos(x, y, chi=CHI):
    """Halos at stereographic (x, y) rad."""
    x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
    quarter = (x * x + y * y) / 4
    place = np.stack([1 - quarter, x, y]) / (1 + quarter)
    others = [np.broadcast_to(v, x.shape) for v in (chi, AMPLITUDE, SIZE, WIDE, CONCENTRATION)]
    return np.ascontiguousarray(np.concatenate([place, others]))


def summed(x, y, near, halo):
    x, y, near = (np.atleast_1d(np.asarray(v, float)) for v in (x, y, near))
    out = np.zeros((5, x.size))
    halo_lensing_sums.add_halos(np.stack([x, y]), near, np.array([0, x.size]), FRAME, halo, out)
    return out


def one(x, y, near, halo):
    """Takada & Jain's profile less the compensating kernel."""
    _, at_x, at_y, chi, amplitude, size, wide, c = halo
    quarter = (1 - halo[0]) / (1 + halo[0])
    dx, dy = x - at_x * (1 + quarter), y - at_y * (1 + quarter)
    strength, theta = amplitude * max(1 - chi * near, 0.0), np.hypot(dx, dy)
    theta = max(theta, 1e-6 * size)
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


def test_sums_are_those_of_the_formulas(rng):
    x, y = ARCMIN * rng.uniform(-1.5, 1.5, (2, 40))
    near = np.sort(1 / rng.uniform(300, 3000, 40))
    halo = halos(*(ARCMIN * rng.uniform(-15, 15, (2, 60))), np.sort(rng.uniform(200, 2500, 60)))
    halo[1:3, :20] *= 0.1
    halo[0] = np.sqrt(1 - halo[1] ** 2 - halo[2] ** 2)
    wanted = np.array([sum(one(*source, column) for column in halo.T) for source in zip(x, y, near, strict=True)]).T
    found = summed(x, y, near, halo)
    assert np.abs(found - wanted).max(1) == pytest.approx(np.zeros(5), abs=1e-9)
    assert np.all(np.abs(wanted).max(1) > [1e-2, 1e-2, 1e-2, 1e-6, 1e-6])


def test_a_halo_and_what_makes_up_for_it_have_no_mass():
    """Within 1e-6 of its own; and beyond theta_c there is neither convergence nor shear nor deflection."""

    def ring(theta):
        return 2 * np.pi * theta * summed(theta, 0, 0, halos(0, 0))[0, 0]

    edges = (1e-9, 0.1 * SIZE, SIZE * (1 - 1e-10), WIDE)
    parts = [quad(ring, low, high, epsabs=1e-17, limit=200)[0] for low, high in pairwise(edges)]
    assert sum(parts) == pytest.approx(0.0, abs=1e-6 * np.pi * AMPLITUDE)
    assert parts[0] > 0.05 * np.pi * AMPLITUDE
    assert not summed([1.0001 * WIDE, -2 * WIDE], [0, 0], [0, 0], halos(0, 0)).any()
    assert np.abs(summed(0.9999 * WIDE, 0, 0, halos(0, 0))[4]).max() < 1e-12


def test_behind_a_centre_everything_is_finite():
    kappa, *others = summed(0, 0, 0, halos(0, 0))[:, 0]
    assert others == [0, 0, 0, 0]
    assert kappa == pytest.approx(one(1e-6 * SIZE, 0, 0, halos(0, 0)[:, 0])[0], rel=1e-9)
    assert np.isfinite(summed([0, 1e-300, 1e-12], [0, 0, 0], [0, 0, 0], halos(0, 0))).all()


def test_what_is_in_front_is_not_lensed():
    near = np.array([0.5, 1.0, 1.0 + 1e-12, 2.0]) / CHI
    found = summed(np.full(4, ARCMIN), np.zeros(4), near, halos(0, 0))
    assert found[0, 0] > 0.004
    assert not found[:, 1:].any()


def test_a_source_alone_or_in_another_plane_with_others_is_the_same(rng):
    """Bit by bit alone; halos that reach the others only leave no trace."""
    x, y = ARCMIN * rng.uniform(-1.5, 1.5, (2, 50))
    near = np.sort(1 / rng.uniform(300, 3000, 50))
    halo = halos(*(ARCMIN * rng.uniform(-25, 25, (2, 300))), np.sort(rng.uniform(200, 2500, 300)))
    together = summed(x, y, near, halo)
    for rows in (slice(7, 8), slice(0, 33), slice(1, None, 3)):
        assert summed(x[rows], y[rows], near[rows], halo).tobytes() == together[:, rows].tobytes()


def test_convergence_and_shear_are_derivatives_of_the_deflection():
    h, near = 1e-4 * ARCMIN, 1 / 3000
    for x, y in ((0.3, 0.2), (1.5, -1.0), (4.0, 7.0), (-12.0, 3.0)):
        x, y = x * ARCMIN, y * ARCMIN
        found = summed([x + h, x - h, x, x, x], [y, y, y + h, y - h, y], np.full(5, near), halos(0, 0))
        (xx, xy), (yx, yy) = ((found[3:, i] - found[3:, i + 1]) / (2 * h) for i in (0, 2))
        kappa, gamma1, gamma2 = found[:3, 4]
        expected = (kappa + gamma1, gamma2, gamma2, kappa - gamma1)
        assert (xx, xy, yx, yy) == pytest.approx(expected, rel=1e-4, abs=1e-8)
