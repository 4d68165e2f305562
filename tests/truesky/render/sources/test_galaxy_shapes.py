"""Conventions of the light profiles, measured on drawings: angles, radii, shears, fluxes."""

import galsim
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.special import gammaincinv, gammaln

from tests.truesky.render.fields import galaxies
from truesky.render.sources import galaxy_shapes

FINE = {"nx": 401, "ny": 401, "scale": 0.02, "method": "no_pixel", "dtype": float}


def shape(**columns):
    return galaxy_shapes.shapes(galaxies(10.0, 20.0, **columns))


def drawn(**columns):
    """A galaxy of unit flux in the world frame (u right, v up), 8" square, slightly blurred."""
    body = galaxy_shapes.profile(shape(**columns), 0, 1e-3)
    return galsim.Convolve(body, galsim.Gaussian(sigma=0.04)).drawImage(**FINE).array


def axes(image):
    """(position angle north through east, q^2) of the second moments inside 4", u west."""
    v, u = (np.mgrid[:401, :401] - 200) * 0.02
    inside = image * (np.hypot(u, v) < 4)
    uu, vv, uv = ((inside * a * b).sum() / inside.sum() for a, b in ((u, u), (v, v), (u, v)))
    angle = np.degrees(0.5 * np.arctan2(2 * uv, uu - vv)) - 90.0
    spread = np.hypot(uu - vv, 2 * uv)
    return angle % 180.0, (uu + vv - spread) / (uu + vv + spread)


@pytest.mark.parametrize("part", ["bulge", "disc"])
@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 135.0])
def test_position_angle_is_north_through_east(part, angle):
    kind = {"bulge": {"bulge_fraction": 1.0, "bulge_axis_ratio": 0.5}, "disc": {"inclination": 70.0}}[part]
    measured, _ = axes(drawn(position_angle=angle, **kind))
    assert (measured - angle + 90) % 180 - 90 == pytest.approx(0.0, abs=0.1)


def test_bulge_radius_is_the_half_light_semi_major_axis():
    """Half the light lies inside the ellipse of that semi-major axis, whatever the axis ratio."""
    for q in (1.0, 0.6, 0.3):
        bulge = galaxy_shapes.profile(
            shape(bulge_fraction=1.0, bulge_sersic_index=1.0, bulge_half_light_radius=0.6, bulge_axis_ratio=q),
            0,
            1e-3,
        )
        image = bulge.drawImage(nx=801, ny=801, scale=0.02, method="no_pixel", dtype=float).array
        y, x = (np.mgrid[:801, :801] - 400) * 0.02
        # Position angle 0: the major axis along v.
        assert image[np.hypot(y, x / q) < 0.6].sum() == pytest.approx(0.5, abs=0.01)


def test_disc_radius_is_seen_face_on():
    for inclination in (0.0, 60.0):
        disc = galaxy_shapes.profile(shape(disk_half_light_radius=0.6, inclination=inclination), 0, 1e-3)
        image = disc.drawImage(nx=801, ny=801, scale=0.02, method="no_pixel", dtype=float).array
        y, x = (np.mgrid[:801, :801] - 400) * 0.02
        q = np.cos(np.radians(inclination))
        assert image[np.hypot(y, x / q) < 0.6].sum() == pytest.approx(0.5, abs=0.02)
    _, edge_on = axes(drawn(inclination=90.0, disk_half_light_radius=1.0))
    assert edge_on < 0.03


@given(
    st.floats(0, 1),
    st.floats(0.3, 6.2),
    st.floats(0.02, 1),
    st.floats(0, 90),
    st.floats(-0.3, 0.3),
    st.floats(-0.4, 0.4),
)
def test_flux_is_one_whatever_the_lens(fraction, index, q, inclination, gamma, kappa):
    body = galaxy_shapes.profile(
        shape(
            bulge_fraction=fraction, bulge_sersic_index=index, bulge_axis_ratio=q, inclination=inclination,
            gamma1=gamma, gamma2=-gamma, kappa=kappa,
        ),
        0, 1e-3,
    )  # fmt: skip
    assert body.flux == pytest.approx(1.0, rel=1e-12)
    assert body.kValue(0.0, 0.0) == pytest.approx(1.0, rel=1e-6)


def test_sersic_index_is_the_catalogue_s_within_bounds():
    found = galaxy_shapes.shapes(galaxies([1, 2, 3, 4], 0.0 * np.arange(4), bulge_sersic_index=[2.04, 2.06, 0.1, 7.0]))
    np.testing.assert_allclose(found.sersic_index, [2.04, 2.06, 0.3, 6.2], rtol=1e-6)


# ------------------------------------------------------------------------------------------------ lensing


@pytest.mark.parametrize("bearing", [0.0, 45.0, 90.0, 160.0])
def test_images_lie_tangentially_about_a_mass(bearing):
    """A mass at position angle `bearing` from the galaxy: gamma = -g cos(2 phi), phi from east to north."""
    phi = np.radians(90.0 - bearing)
    image = drawn(gamma1=-0.2 * np.cos(2 * phi), gamma2=-0.2 * np.sin(2 * phi))
    angle, ratio = axes(image)
    assert (angle - bearing) % 180 == pytest.approx(90.0, abs=0.5)
    assert np.sqrt(ratio) == pytest.approx((1 - 0.2) / (1 + 0.2), rel=0.05)


def test_reduced_shear_and_size():
    """kappa = 0.1, gamma = 0.05: stretched by 1 / (1 - kappa -+ gamma), the flux left to the catalogue."""
    v, u = (np.mgrid[:401, :401] - 200) * 0.02
    plain, lensed = (
        drawn(disk_half_light_radius=0.4),
        drawn(disk_half_light_radius=0.4, kappa=0.1, gamma1=0.05),
    )
    width = [[np.sqrt((i * a * a).sum() / i.sum() - 0.04**2) for a in (u, v)] for i in (plain, lensed)]
    assert width[1][0] / width[0][0] == pytest.approx(1 / (1 - 0.1 - 0.05), rel=0.01)
    assert width[1][1] / width[0][1] == pytest.approx(1 / (1 - 0.1 + 0.05), rel=0.01)
    assert lensed.sum() == pytest.approx(plain.sum(), rel=2e-3)


@pytest.mark.parametrize(
    ("kappa", "gamma1", "gamma2"),
    [(1.0, 0.1, 0.0), (1.0, 0.0, 0.0), (0.5, 0.5, 0.0), (0.2, -0.9, 0.9), (2.0, 1.0, 1.0)],
)
def test_critical_lines_do_no_harm(kappa, gamma1, gamma2):
    found = shape(kappa=kappa, gamma1=gamma1, gamma2=gamma2)
    assert np.hypot(found.g1, found.g2) <= 0.9 + 1e-9
    assert 0 < found.magnification <= 1000 + 1e-6
    assert np.isfinite(galaxy_shapes.profile(found, 0, 1e-3).kValue(1.0, 1.0))


# ------------------------------------------------------------------------------------------------ extent


@given(st.floats(0.3, 6.2))
@example(0.3)
def test_half_of_the_light_lies_inside_the_half_light_radius(index):
    assert galaxy_shapes._b(np.array([index]))[0] == pytest.approx(gammaincinv(2 * index, 0.5), rel=4e-5)
    one = shape(bulge_fraction=1.0, bulge_sersic_index=index, bulge_half_light_radius=2.0)
    assert galaxy_shapes.flux_outside(one, np.array([2.0]))[0] == pytest.approx(0.5, abs=1e-4)
    sky = galaxy_shapes.real_space_profile(one, galaxy_shapes.forms(one, np.eye(2)[None]))[0]
    # The light in the middle and the area of exp(-r^(1 / n)) make up all of the flux.
    whole = sky[0] * 2 * np.pi * index * np.exp(gammaln(2 * index)) / np.linalg.det(sky[2:6].reshape(2, 2))
    assert (abs(whole), sky[6]) == pytest.approx((1.0, 0.5 / index), rel=1e-5)


@pytest.mark.parametrize("kind", [{"bulge_fraction": 1.0, "bulge_axis_ratio": 0.5}, {"inclination": 50.0}])
def test_surface_brightness_along_the_major_axis(kind):
    lens = {"kappa": 0.1, "gamma1": 0.05}
    image = galaxy_shapes.profile(shape(**kind, **lens), 0, 1e-3)
    blurred = galsim.Convolve(image, galsim.Gaussian(sigma=0.02)).drawImage(**FINE).array / 0.02**2
    radius = np.array([0.6, 1.0, 1.6])
    bound = galaxy_shapes.surface_brightness(shape(**kind, **lens), radius)[0]
    v, u = (np.mgrid[:401, :401] - 200) * 0.02
    for r, most in zip(radius, bound, strict=True):
        ring = blurred[np.abs(np.hypot(u, v) - r) < 0.015]
        assert ring.max() < 1.1 * most
        assert ring.max() > 0.4 * most


@pytest.mark.parametrize("index", [0.5, 1.0, 4.0, 6.0])
@pytest.mark.parametrize("distance", [0.5, 2.0, 8.0])
def test_light_of_a_line_is_the_sum_along_it(index, distance):
    """By a sum over a fine grid in x = sinh t, of a round bulge and a disc seen face-on."""
    t = np.linspace(-9.0, 9.0, 40_001)
    for fraction in (0.0, 1.0):
        one = shape(
            bulge_fraction=fraction, bulge_half_light_radius=0.7, bulge_sersic_index=index, bulge_axis_ratio=1.0,
            disk_half_light_radius=1.1, inclination=0.0,
        )  # fmt: skip
        along = galaxy_shapes.surface_brightness(one, np.hypot(distance, np.sinh(t)))[0]
        wanted = np.trapezoid(along * np.cosh(t), t)
        # The disc's surface counts its thickness in: 0.5 %.
        assert galaxy_shapes.line_brightness(one, distance)[0] == pytest.approx(wanted, rel=0.015, abs=1e-12)


def test_a_point_has_no_size():
    found = shape(bulge_fraction=1.0, bulge_half_light_radius=0.0)
    assert isinstance(galaxy_shapes.profile(found, 0, 1e-3).original, galsim.DeltaFunction)
