"""Closed forms agree with integrals along the line of sight."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from truesky.catalogue.halos import projected_nfw


def surface(x, c):
    """int dl / (r (1 + r)^2) to the edge, l = x sinh u."""
    return quad(lambda u: (1 + x * np.cosh(u)) ** -2, 0, np.arccosh(c / x), epsabs=0, epsrel=1e-11, limit=400)[0]


def enclosed(x, c):
    """Mass in the cylinder: the fraction of each shell of radius r = x exp(w^2) inside it, plus all mass inside x."""

    def shell(w):
        r, q = x * np.exp(w * w), np.exp(-2 * w * w)
        return 2 * w * (r / (1 + r)) ** 2 * q / (1 + np.sqrt(max(1 - q, 0)))

    inner = np.log1p(x) - x / (1 + x) if x > 1e-3 else x * x * (0.5 - x * (2 / 3 - 0.75 * x))
    return inner + quad(shell, 0, np.sqrt(np.log(c / x)), epsabs=0, epsrel=1e-11, limit=400)[0]


def shear(surface, enclosed, x):
    return enclosed / x**2 - surface / 2


def assert_right(x, c):
    found, wanted = projected_nfw.profile(x, c), (surface(x, c), enclosed(x, c))
    assert (*found, shear(*found, x)) == pytest.approx((*wanted, shear(*wanted, x)), rel=1e-5, abs=0)


@given(ln_c=st.floats(0, np.log(60)), part=st.floats(0, 0.999))
def test_closed_forms(ln_c, part):
    c = np.exp(ln_c)
    assert_right(1e-8 ** (1 - part) * c**part, c)


@pytest.mark.parametrize("off", [0.0, 1e-15, -1e-15, 1e-9, -1e-6, 1e-4, -1e-3, 0.02, -0.02, 0.1, -0.1])
@pytest.mark.parametrize("c", [1.2, 5.0, 60.0])
def test_no_seam_at_the_scale_radius(off, c):
    assert_right(1.0 + off, c)


@pytest.mark.parametrize("x", [0.999e-4, 1.001e-4])
def test_no_seam_at_the_centre(x):
    assert_right(x, 7.0)


@pytest.mark.parametrize("c", [1.0, 1.5, 10.0, 60.0])
def test_enclosed_mass_is_total_and_surface_density_is_0_at_the_edge(c):
    near_edge, mass = projected_nfw.profile(c * (1 - 1e-12), c)
    assert mass == pytest.approx(projected_nfw.total(c), rel=1e-9)
    assert abs(near_edge) < 1e-5
