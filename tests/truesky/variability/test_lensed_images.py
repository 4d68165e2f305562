"""Images of point sources: against lenstronomy, the lens equation, formulas of round lenses, and where images merge."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from truesky.catalogue.galaxies import strong_lenses
from truesky.cosmology import FIDUCIAL, Cosmology
from truesky.variability import lensed_images
from truesky.variability.lensed_images import MAX_MAGNIFICATION, Ellipsoids, Images

REFERENCES = Path(__file__).with_name("lensed_image_references.csv")


def images_of(radius, axis_ratio, angle, east, north) -> Images:
    """Return the images of one source, or of several behind the same lens."""
    east, north = np.atleast_1d(east), np.atleast_1d(north)
    lens = Ellipsoids(*(np.full(len(east), float(value)) for value in (radius, axis_ratio, angle)))
    return lensed_images.find_images(lens, east, north)


@pytest.fixture(scope="module")
def references():
    """Return the columns of the table of lenstronomy's images."""
    lines = [line for line in REFERENCES.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_lenstronomy_has_the_same_images_and_delays(references):
    """80 systems, 25 of them with four images.

    The lenses of lenstronomy have a core, which changes the magnification of faint images by up to 4e-5.
    """
    _, first, system = np.unique(references["system"], return_index=True, return_inverse=True)
    given_columns = ("einstein_radius", "axis_ratio", "position_angle", "source_east", "source_north")
    radius, axis_ratio, angle, east, north = (references[name][first] for name in given_columns)
    found = lensed_images.find_images(Ellipsoids(radius, axis_ratio, angle), east, north)
    assert len(first) >= 50
    assert found.source.tolist() == system.tolist()
    assert np.hypot(found.east - references["east"], found.north - references["north"]).max() < 1e-7
    assert found.magnification == pytest.approx(references["magnification"], rel=1e-4, abs=0)
    z_lens, z_source = references["z_lens"], references["z_source"]
    delay = lensed_images.delays(found.lag, z_lens, z_source, FIDUCIAL)
    later = found.number > 1
    assert delay[later] == pytest.approx(references["delay"][later], rel=1e-7, abs=0)
    assert (delay[~later] == 0.0).all()


@given(
    st.floats(0.1, 3.0), st.floats(0.2, 0.999), st.floats(0.0, 180.0), st.floats(0.0, 1.5), st.floats(0.0, 360.0)
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_images_solve_the_lens_equation_in_the_order_of_their_fermat_potentials(radius, q, angle, offset, phi):
    east, north = radius * offset * np.cos(np.radians(phi)), radius * offset * np.sin(np.radians(phi))
    found = images_of(radius, q, angle, east, north)
    lens = strong_lenses.Lens(radius, q, angle)
    x, y = strong_lenses.deflection(lens, found.east, found.north)
    assert found.east - x == pytest.approx(np.full(len(x), east), abs=1e-8)
    assert found.north - y == pytest.approx(np.full(len(x), north), abs=1e-8)
    fermat = 0.5 * (x * x + y * y) - found.east * x - found.north * y
    assert fermat - fermat[0] == pytest.approx(found.lag, abs=1e-12)
    assert (np.diff(found.lag) >= 0.0).all()
    assert found.number.tolist() == list(range(1, len(x) + 1))


@given(
    st.floats(0.1, 3.0), st.floats(0.3, 0.98), st.floats(0.0, 180.0), st.floats(0.01, 0.99), st.floats(0.0, 360.0)
)  # fmt: skip
@settings(max_examples=30, deadline=None)
def test_images_are_those_of_the_slow_search(radius, q, angle, offset, phi):
    """The slow search uses brentq, one lens at a time; it may miss merging images."""
    east, north = radius * offset * np.cos(np.radians(phi)), radius * offset * np.sin(np.radians(phi))
    lens = strong_lenses.Lens(radius, q, angle)
    expected = strong_lenses.image_positions(lens, east, north)
    mu = strong_lenses.magnification(lens, *expected.T)
    assume((np.abs(mu) < 1e3).all())
    found = images_of(radius, q, angle, east, north)
    order = np.argsort(-np.hypot(*expected.T))
    assert np.hypot(found.east, found.north) == pytest.approx(np.hypot(*expected[order].T), abs=1e-8)
    assert found.magnification == pytest.approx(mu[order], rel=1e-6)


def test_a_round_lens_has_the_known_images():
    """theta = beta +- theta_E, magnified by 1 +- theta_E / beta; the delay is 2 theta_E beta."""
    found = images_of(1.3, 1.0, 20.0, 0.3, 0.4)
    assert np.hypot(found.east, found.north) == pytest.approx([1.8, 0.8], rel=1e-5)
    assert found.magnification == pytest.approx([1.0 + 2.6, 1.0 - 2.6], rel=1e-5)
    assert found.lag == pytest.approx([0.0, 2.0 * 1.3 * 0.5], rel=1e-5)


@pytest.mark.parametrize("q", [0.5, 0.9, 0.98])
def test_a_source_behind_the_centre_has_two_pairs_of_equal_images(q):
    found = images_of(0.9, q, 33.0, 1e-14, 0.0)
    assert found.number.tolist() == [1, 2, 3, 4]
    assert found.magnification[0] == pytest.approx(found.magnification[1], rel=1e-6)
    assert found.magnification[2] == pytest.approx(found.magnification[3], rel=1e-6)
    assert (np.sign(found.magnification) == [1, 1, -1, -1]).all()
    assert found.lag[1] == pytest.approx(0.0, abs=1e-13)


def test_a_source_exactly_behind_a_round_lens_has_four_images_of_the_largest_magnification():
    found = images_of(0.9, 1.0, 33.0, 0.0, 0.0)
    assert np.hypot(found.east, found.north) == pytest.approx(np.full(4, 0.9), rel=1e-5)
    assert np.abs(found.magnification).tolist() == [MAX_MAGNIFICATION] * 4
    assert found.lag == pytest.approx(np.zeros(4), abs=1e-5)


@pytest.mark.parametrize("closer", [1e-3, 1e-6, 1e-9, 1e-12])
def test_images_merge_at_a_caustic(closer):
    """The fold on the line of 20 deg; the magnification of the pair grows as 1 / sqrt(distance), their delay falls."""
    direction = np.radians(20.0)

    def inside(offset):
        return images_of(1.0, 0.6, 0.0, offset * np.sin(direction), offset * np.cos(direction))

    low, high = 0.0, 0.8
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if inside(middle).number.max() == 4 else (low, middle)
    found = inside(low - closer)
    pair = np.argsort(-np.abs(found.magnification))[:2]
    assert found.number.max() == 4
    assert inside(high + closer).number.max() == 2
    assert found.magnification[pair].prod() < 0.0
    if closer > 1e-9:
        wider = inside(low - 4.0 * closer)
        wide_pair = np.argsort(-np.abs(wider.magnification))[:2]
        size, wide = (np.abs(m).sum() for m in (found.magnification[pair], wider.magnification[wide_pair]))
        assert size / wide == pytest.approx(2.0, rel=0.1)
        lag, wide_lag = (abs(float(np.diff(m)[0])) for m in (found.lag[pair], wider.lag[wide_pair]))
        assert lag / wide_lag == pytest.approx(1.0 / 8.0, rel=0.1, abs=0)
    assert np.abs(found.magnification).max() <= MAX_MAGNIFICATION
    apart = [float(np.diff(axis[np.sort(pair)])[0]) for axis in (found.east, found.north)]
    assert apart[0] * apart[0] + apart[1] * apart[1] < 16.0 * closer


def test_the_number_of_images_is_that_of_the_region_of_the_source():
    """On a line through the centre there are 4, 2 and 1 images as the source leaves the caustic and the cut."""
    found = images_of(1.0, 0.5, 0.0, np.linspace(0.01, 2.0, 200), np.zeros(200))
    count = np.bincount(found.source)
    assert sorted(set(count.tolist())) == [1, 2, 4]
    assert (np.diff(count) <= 0).all()


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 10.0])
def test_images_scale_with_the_einstein_radius(scale):
    found, unit = (images_of(radius, 0.7, 50.0, 0.1 * radius, -0.05 * radius) for radius in (scale, 1.0))
    assert found.east == pytest.approx(unit.east * scale, rel=1e-9, abs=0)
    assert found.magnification == pytest.approx(unit.magnification, rel=1e-9)
    assert found.lag == pytest.approx(unit.lag * scale**2, rel=1e-9, abs=0)


def test_a_weak_lens_has_one_image_at_the_source():
    found = images_of(1e-9, 0.7, 50.0, 0.3, -0.2)
    assert (found.east.tolist(), found.north.tolist()) == (pytest.approx([0.3]), pytest.approx([-0.2]))
    assert found.magnification == pytest.approx([1.0], abs=1e-7)


def test_images_do_not_depend_on_other_sources():
    rng = np.random.default_rng(3)
    lens = Ellipsoids(rng.uniform(0.5, 2.0, 600), rng.uniform(0.3, 0.98, 600), rng.uniform(0.0, 180.0, 600))
    east, north = rng.uniform(-0.5, 0.5, (2, 600))
    whole = lensed_images.find_images(lens, east, north)
    for i in (0, 511, 512, 599):
        one = images_of(lens.radius[i], lens.axis_ratio[i], lens.angle[i], east[i], north[i])
        own = whole.source == i
        for name in ("number", "east", "north", "magnification", "lag"):
            assert getattr(one, name).tolist() == getattr(whole, name)[own].tolist()


def test_no_sources_have_no_images():
    assert len(images_of(1.0, 0.7, 0.0, [], []).source) == 0


def test_the_time_delay_distance_of_an_empty_lens_is_a_distance_ratio():
    """(1 + z_l) D_l D_s / D_ls from angular-diameter distances in Mpc."""
    z_lens, z_source = 0.5, 1.7
    chi = FIDUCIAL.comoving_distance(np.array([z_lens, z_source])) / FIDUCIAL.h
    near, far = chi / (1.0 + np.array([z_lens, z_source]))
    between = (chi[1] - chi[0]) / (1.0 + z_source)
    expected = (1.0 + z_lens) * near * far / between
    assert lensed_images.time_delay_distance(z_lens, z_source, FIDUCIAL) == pytest.approx(expected, rel=1e-9)


def test_the_time_delay_distance_of_a_source_just_behind_the_lens_is_precise():
    """H0 chi_l chi_s E / (c dz) for a small difference of redshifts; a difference of distances would lose digits."""
    step = 2.0**-30
    chi = float(FIDUCIAL.comoving_distance(0.5))
    between = 2997.92458 / float(FIDUCIAL.expansion_rate(0.5 + 0.5 * step)) * step
    expected = chi * (chi + between) / between / FIDUCIAL.h
    assert lensed_images.time_delay_distance(0.5, 0.5 + step, FIDUCIAL) == pytest.approx(expected, rel=1e-9)


def test_delays_are_inversely_proportional_to_the_hubble_parameter():
    fast, slow = (Cosmology(omega_m=0.3, omega_b=0.05, h=h, sigma_8=0.8, n_s=0.96) for h in (0.8, 0.4))
    short, long = (float(lensed_images.delays(0.5, 0.4, 1.5, cosmology)) for cosmology in (fast, slow))
    assert long == pytest.approx(2.0 * short, rel=1e-12)


@pytest.mark.parametrize(("z_lens", "z_source"), [(0.5, 0.5), (0.5, 0.3), (0.0, 1.0), (np.nan, 1.0)])
def test_a_source_that_is_not_behind_the_lens_is_refused(z_lens, z_source):
    with pytest.raises(BadInput, match=f"z_lens = {z_lens:g}.*behind the lens"):
        lensed_images.delays([0.1], [z_lens], [z_source], FIDUCIAL)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ((0.0, 0.7, 0.0, 0.1, 0.1), "einstein_radius"),
        ((np.nan, 0.7, 0.0, 0.1, 0.1), "einstein_radius"),
        ((1.0, 0.0, 0.0, 0.1, 0.1), "axis_ratio"),
        ((1.0, 1.1, 0.0, 0.1, 0.1), "axis_ratio"),
        ((1.0, 0.7, np.inf, 0.1, 0.1), "position_angle"),
        ((1.0, 0.7, 0.0, np.nan, 0.1), "position"),
    ],
)
def test_lenses_that_do_not_exist_are_refused(values, name):
    with pytest.raises(BadInput, match=name):
        images_of(*values)
