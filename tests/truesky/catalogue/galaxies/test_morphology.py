"""Sizes, Sersic indices and axis ratios of bulges and discs, against published relations and GalSim."""

import galsim
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

from truesky.catalogue.galaxies import morphology

SHAPES = morphology.shapes()


@pytest.mark.parametrize("sersic", [0.5, 1.0, 2.5, 4.0, 6.0])
def test_light_within_is_galsim_s(sersic):
    profile = galsim.Sersic(sersic, half_light_radius=1.3)
    for radius in (0.3, 1.3, 4.0):
        light = quad(lambda r: 2 * np.pi * r * profile.xValue(r, 0.0), 0.0, radius, epsrel=1e-8, limit=200)[0]
        assert morphology.light_within(radius, 1.3, sersic) == pytest.approx(light, abs=1e-4)


@given(st.floats(0.0, 1.0), st.floats(0.05, 2.0), st.floats(0.3, 6.0), st.floats(0.01, 30.0))
def test_components_hold_half_of_the_light_within_the_total_s_radius(fraction, ratio, sersic, radius):
    arguments = (np.array([value]) for value in (radius, fraction, ratio, sersic))
    bulge, disc = morphology.component_radii(SHAPES, *arguments)
    inside = fraction * morphology.light_within(radius, bulge, sersic)
    inside += (1 - fraction) * morphology.light_within(radius, disc, 1.0)
    assert inside[0] == pytest.approx(0.5, abs=0.005)
    assert bulge[0] / disc[0] == pytest.approx(ratio)


def test_one_component_has_the_total_s_radius():
    one, two = np.ones(2), np.array([0.7, 0.3])
    bulge, disc = morphology.component_radii(SHAPES, two, np.array([1.0, 0.0]), 0.4 * one, 3.0 * one)
    assert bulge[0] == pytest.approx(0.7, rel=1e-6)
    assert disc[1] == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(("red", "log_kpc", "scatter"), [(False, 0.86, 0.16), (True, 0.60, 0.10)])
def test_sizes_at_the_pivot_are_the_published_ones(red, log_kpc, scatter, rng):
    """van der Wel et al. 2014, Table 1, z = 0.25, 5e10 Msun; 10 kpc an arcsec keeps clear of the limits."""
    n = 20_000
    log_mass = np.full(n, np.log10(5e10))
    radius = morphology.half_light_radius(
        SHAPES.size, np.full(n, 0.25), log_mass, np.full(n, red), np.full(n, 10.0), rng
    )
    assert np.mean(np.log10(10 * radius)) == pytest.approx(log_kpc, abs=0.005)
    assert np.std(np.log10(10 * radius)) == pytest.approx(scatter, rel=0.03)


def test_small_early_types_are_on_a_flatter_relation(rng):
    def size(mass, n=20_000):
        arguments = np.full(n, 0.25), np.full(n, np.log10(mass)), np.ones(n, bool), np.full(n, 10.0)
        return np.median(morphology.half_light_radius(SHAPES.size, *arguments, rng))

    assert np.log10(size(2e10) / size(2e9)) == pytest.approx(0.15, abs=0.01)
    assert np.log10(size(2e11) / size(2e10)) == pytest.approx(0.75, abs=0.01)


def test_some_late_types_are_compact_at_high_redshift_only(rng):
    """The share of compact galaxies, and the percentiles of a mixture of the late and the early relation."""
    n, pivot = 40_000, np.log10(5e10)

    def sizes(z, log_mass):
        arguments = np.full(n, z), np.full(n, log_mass), np.zeros(n, bool), np.full(n, 10.0)
        return np.log10(10.0 * morphology.half_light_radius(SHAPES.size, *arguments, rng))

    def share(z, log_mass):
        return morphology.compact_share(SHAPES.size, np.array([z]), np.array([log_mass]))[0]

    assert share(1.25, 10.8) == 0.0
    assert share(1.425, 10.8) == pytest.approx(0.20)
    assert share(2.0, 10.8) == pytest.approx(0.40)
    assert share(2.0, 11.5) == 0.0
    assert np.std(sizes(1.25, pivot)) == pytest.approx(0.17, rel=0.03)
    small = share(2.25, pivot)
    found = sizes(2.25, pivot)
    for size in (0.0, 0.25, 0.55):
        wanted = small * stats.norm(-0.05, 0.14).cdf(size) + (1 - small) * stats.norm(0.55, 0.19).cdf(size)
        assert np.mean(found < size) == pytest.approx(wanted, abs=0.01)


@given(st.floats(5.0, 13.0), st.floats(0.0, 3.0), st.booleans(), st.floats(1e-3, 10.0))
def test_sizes_stay_inside_their_limits(log_mass, z, red, scale):
    arguments = (np.array([value]) for value in (z, log_mass, red, scale))
    radius = morphology.half_light_radius(SHAPES.size, *arguments, np.random.default_rng(0))
    assert SHAPES.size.smallest <= radius[0] <= SHAPES.size.largest


def test_bulges_dominate_early_types_only(rng):
    n = 20_000
    log_mass = np.full(n, 10.5)
    early = morphology.bulge_fraction(SHAPES.bulge, log_mass, np.ones(n, bool), rng)
    late = morphology.bulge_fraction(SHAPES.bulge, log_mass, np.zeros(n, bool), rng)
    assert early.mean() == pytest.approx(2.6 / 4.0, abs=0.005)
    assert late.mean() == pytest.approx(0.15, abs=0.005)
    assert min(early.min(), late.min()) >= 0.0
    assert max(early.max(), late.max()) <= 1.0


def test_sersic_indices(rng):
    red = np.repeat([True, False], 20_000)
    sersic = morphology.sersic_index(SHAPES.bulge, red, rng)
    assert np.median(sersic[red]) == pytest.approx(3.5, rel=0.01)
    assert np.median(sersic[~red]) == pytest.approx(2.0, rel=0.01)
    assert sersic.min() >= 0.3
    assert sersic.max() <= 6.0


def test_disc_ellipticities_are_miller_s(rng):
    """Miller et al. 2013: the mean and three quantiles of p(e), integrated here."""

    def p(e):
        return e * (1 - np.exp((e - 0.804) / 0.2539)) / ((1 + e) * np.sqrt(e**2 + 0.0256**2))

    q = morphology.disc_axis_ratio(SHAPES, 100_000, rng)
    e = (1 - q) / (1 + q)
    norm = quad(p, 0, 0.804)[0]
    assert e.mean() == pytest.approx(quad(lambda x: x * p(x), 0, 0.804)[0] / norm, abs=0.002)
    for at in (0.05, 0.2, 0.5):
        assert np.mean(e < at) == pytest.approx(quad(p, 0, at)[0] / norm, abs=0.005)
    assert e.max() <= 0.804


def projected_by_rotation(middle, minor, cosine, azimuth):
    """Project an ellipsoid by its matrix: the shadow of x M x = 1 has the inverse of a block of the inverse of M."""
    sine = np.sqrt(1 - cosine**2)
    sight = np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
    across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    plane = np.stack([across, np.cross(sight, across)])
    shadow = plane @ np.diag([1.0, middle**2, minor**2]) @ plane.T
    low, high = np.sqrt(np.linalg.eigvalsh(shadow))
    return low / high


@given(st.floats(0.3, 1.0), st.floats(0.3, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 6.28))
def test_ellipsoids_are_projected_as_their_matrix_is(middle, thickness, cosine, azimuth):
    ratio = morphology.project_ellipsoid(middle, thickness * middle, cosine, azimuth)
    # The root of a difference of nearly equal numbers: round ellipsoids lose half of the digits.
    assert ratio == pytest.approx(projected_by_rotation(middle, thickness * middle, cosine, azimuth), abs=1e-6)


def test_ellipsoids_along_their_axes_show_the_other_two():
    assert morphology.project_ellipsoid(0.8, 0.5, 1.0, 0.3) == pytest.approx(0.8)
    assert morphology.project_ellipsoid(0.8, 0.5, 0.0, 0.0) == pytest.approx(0.5 / 0.8)
    assert morphology.project_ellipsoid(0.8, 0.5, 0.0, np.pi / 2) == pytest.approx(0.5)


def test_bulge_axis_ratios_are_those_of_ellipsoids_in_random_directions(rng):
    """Two samples of 20,000 ratios; significance 1e-3 (Kolmogorov-Smirnov)."""
    n = 20_000
    thickness = stats.truncnorm((0.3 - 0.908) / 0.138, (1.0 - 0.908) / 0.138, 0.908, 0.138).rvs(n, random_state=rng)
    elongation = np.exp(stats.truncnorm(-np.inf, (np.log(0.7) + 2.3) / 0.8, -2.3, 0.8).rvs(n, random_state=rng))
    middle = 1.0 - elongation
    slow = morphology.project_ellipsoid(middle, thickness * middle, rng.random(n), 2 * np.pi * rng.random(n))
    found = morphology.bulge_axis_ratio(SHAPES, n, rng)
    assert stats.ks_2samp(found, slow).pvalue > 1e-3
    assert found.min() > 0.05
    assert found.max() <= 1.0


def test_bulges_are_as_round_as_early_types(rng):
    """Joachimi et al. 2013, early types of COSMOS: quartiles of (1 - q^2) / (1 + q^2)."""
    q = morphology.bulge_axis_ratio(SHAPES, 100_000, rng)
    ellipticity = (1 - q**2) / (1 + q**2)
    assert np.percentile(ellipticity, (25, 50, 75)) == pytest.approx([0.088, 0.155, 0.255], rel=0.05)


def test_position_angles_are_uniform(rng):
    """Sample of 20,000 angles; significance 1e-3 (Kolmogorov-Smirnov)."""
    angle = morphology.position_angle(20_000, rng)
    assert stats.kstest(angle, stats.uniform(0, 180).cdf).pvalue > 1e-3


@pytest.mark.parametrize(("q", "degrees"), [(1.0, 0.0), (0.1, 90.0), (0.0999, 90.0), (0.02, 90.0)])
def test_inclination_at_the_edges(q, degrees):
    assert morphology.inclination(q, 0.1) == pytest.approx(degrees, abs=1e-12)


@given(st.floats(0.11, 0.999))
def test_inclination_is_the_printed_arcsine_inside(q):
    printed = np.degrees(np.arcsin(np.sqrt((1 - q**2) / (1 - 0.1**2))))
    assert morphology.inclination(q, 0.1) == pytest.approx(printed, abs=1e-6)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_thinner_discs_are_more_inclined(q1, q2):
    wide, thin = morphology.inclination([max(q1, q2), min(q1, q2)], 0.1)
    assert 0.0 <= wide <= thin + 1e-12
    assert thin <= 90.0


def test_inclination_keeps_its_digits_where_a_disc_is_nearly_round():
    """i = sqrt(2 (1 - q) / 0.99) for 1 - q << 1."""
    assert np.radians(morphology.inclination(1 - 1e-12, 0.1)) == pytest.approx(np.sqrt(2e-12 / 0.99), rel=1e-3)


def test_bulges_are_redder_than_discs_as_near_galaxies_are(rng):
    """0.1 - 0.3 mag in g - r, from memory of bulge-disc decompositions of nearby galaxies."""
    colour = morphology.bulge_colour(SHAPES.bulge, 20_000, rng)
    assert 0.1 < np.mean(colour) < 0.3
    assert np.mean(colour > 0.0) > 0.9
    assert np.std(colour) == pytest.approx(SHAPES.bulge.colour_scatter, rel=0.1)
