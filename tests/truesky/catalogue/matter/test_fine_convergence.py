"""Matter below the cells of the box: a slow reference of the sum along lines of sight, kernels, and statistics."""

from dataclasses import replace

import healpy as hp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j0

from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue.matter import fine_convergence, fine_structure, lightcone
from truesky.catalogue.matter.fine_convergence import FineMatter
from truesky.cosmology import FIDUCIAL, HUBBLE_DISTANCE

SEED, FARTHEST, ARCMIN = 7, 900.0, np.radians(1 / 60)
# Inverse distances of the sources: infinity, 800 and 400 Mpc/h.
PLANES = np.array([0.0, 1 / 800, 1 / 400])
CHILDREN = 1 << 2 * (fine_convergence.settings().order - GENERATION_ORDER)
few = settings(max_examples=6, deadline=None)


@pytest.fixture(scope="module")
def steps(box):
    table = lightcone.distance_table(FIDUCIAL, float(FIDUCIAL.redshift(FARTHEST)) + 0.01)
    return lightcone.radial_steps(box.model.cell, 30.0, FARTHEST, table)


@pytest.fixture(scope="module")
def matter(box, steps):
    structure = fine_structure.model(SEED)
    points = fine_convergence.points(box, steps, structure, FARTHEST)
    return FineMatter(box, lightcone.draw_replicas(box, FARTHEST), structure, points, PLANES)


def frame_at(lon, lat):
    """Return the unit vectors to the east, to the north and to the position (rad) itself."""
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


def reference_convergence(matter, steps, pixel, distance):
    """Sum the overdensity along one line of sight with functions of other modules, one point after another."""
    box, chosen = matter.box, fine_convergence.settings()
    direction = np.array(hp.pix2vec(1 << chosen.order, pixel, nest=True))
    total, all_z = 0.0, FIDUCIAL.redshift(0.5 * (steps.edge[1:] + steps.edge[:-1]))
    all_growth = FIDUCIAL.growth(all_z)
    norms = fine_structure.mean_exponential(matter.structure.scatter, chosen.amplitude * all_growth)
    for inner, outer, z, growth, norm in zip(steps.edge[:-1], steps.edge[1:], all_z, all_growth, norms, strict=True):
        amplitude = chosen.amplitude * growth
        for share in (0.25, 0.75):
            chi = (inner**3 + share * (outer**3 - inner**3)) ** (1 / 3)
            if chi >= distance:
                continue
            cell, _ = lightcone.box_cells(box, matter.replicas, direction[None], np.array([chi]))
            g = float(box.smoothed[0].ravel()[cell[0]])
            density = np.exp(growth * g - 0.5 * growth**2 * box.variance[0])
            fine = np.exp(amplitude * fine_structure.values(matter.structure, direction[:, None], np.array([chi]))[0])
            kernel = 1.5 * FIDUCIAL.omega_m / HUBBLE_DISTANCE**2 * (1 + z) * chi * (1 - chi / distance)
            total += 0.5 * (outer - inner) * kernel * density * (fine / norm - 1)
    return total


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 12 * 4**11 - 1))
def test_convergence_is_that_of_a_sum_point_by_point(matter, steps, pixel):
    found = fine_convergence.convergence(matter, np.array([pixel]))[:, 0]
    expected = [reference_convergence(matter, steps, pixel, 1 / max(inverse, 1e-12)) for inverse in PLANES]
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_no_line_of_sight_depends_on_the_others(matter):
    pixel = 12_345 * CHILDREN + np.arange(CHILDREN)
    whole = fine_convergence.convergence(matter, pixel)
    for rows in (np.arange(0, CHILDREN, 3), np.array([5])):
        part = fine_convergence.convergence(matter, pixel[rows])
        assert part.tobytes() == np.ascontiguousarray(whole[:, rows]).tobytes()


def test_no_mass_is_added(matter):
    """The mean over 3,000 sight lines far apart is 0 (significance 1e-4, 4 standard errors of this sample)."""
    pixel = np.random.default_rng(3).integers(0, 12 * 4 ** fine_convergence.settings().order, 3000)
    kappa = fine_convergence.convergence(matter, pixel)
    assert np.all(kappa.std(1) > 1e-4)
    assert np.all(np.abs(kappa.mean(1)) < 4 * kappa.std(1) / np.sqrt(pixel.size))


def test_without_an_amplitude_nothing_lenses(box, steps, matter, monkeypatch):
    none = replace(fine_convergence.settings(), amplitude=1e-12)
    monkeypatch.setattr(fine_convergence, "settings", lambda: none)
    points = fine_convergence.points(box, steps, matter.structure, FARTHEST)
    empty = FineMatter(box, matter.replicas, matter.structure, points, PLANES)
    _, table = fine_convergence.lensing_grid(empty, frame_at(1.0, 0.3), 10 * ARCMIN)
    assert np.abs(table).max() < 1e-9


# ------------------------------------------------------------------------------------------------ kernels


def compensated(theta, sigma, reach):
    """Return kappa and tangential shear at theta of a Gaussian with unit mass within an equal negative mass.

    The negative mass has the weight 3 (1 - (t / reach)^2)^2 / (pi reach^2). It is much wider than the Gaussian, with
    which it is therefore not convolved.
    """
    within = np.minimum(theta / reach, 1.0)
    kappa = np.exp(-0.5 * (theta / sigma) ** 2) / (2 * np.pi * sigma**2)
    kappa = kappa - 3 * (1 - within**2) ** 2 / (np.pi * reach**2)
    enclosed = -np.expm1(-0.5 * (theta / sigma) ** 2) - (1 - (1 - within**2) ** 3)
    return kappa, enclosed / (np.pi * theta**2) - kappa


def test_kernels_are_those_of_a_compensated_mass():
    step, reach, side, sigma = 1.25 * ARCMIN, 40 * ARCMIN, 150, 2.5 * ARCMIN
    axis = step * (np.arange(side) - side // 2)
    x, y = np.meshgrid(axis, axis)
    blob = np.exp(-0.5 * (x * x + y * y) / sigma**2) / (2 * np.pi * sigma**2)
    modes = np.fft.rfft2(blob) * fine_convergence._kernels(side, step, reach, 0.0)
    kappa, gamma1, gamma2, east, north = np.fft.irfft2(modes, (side, side))
    radius, phi = np.hypot(x, y), np.arctan2(y, x)
    tangential = -(gamma1 * np.cos(2 * phi) + gamma2 * np.sin(2 * phi))
    across = gamma2 * np.cos(2 * phi) - gamma1 * np.sin(2 * phi)
    away = east * np.cos(phi) + north * np.sin(phi)
    ring = (radius > 0) & (radius < reach)
    expected = compensated(radius[ring], sigma, reach)
    scale = expected[1].max()
    assert kappa[ring] == pytest.approx(expected[0], abs=0.03 * scale)
    assert tangential[ring] == pytest.approx(expected[1], abs=0.03 * scale)
    assert np.abs(across).max() < 1e-3 * scale
    mean = expected[0] + expected[1]
    assert away[ring] == pytest.approx(mean * radius[ring], abs=0.03 * scale * sigma)
    # Nothing lenses beyond the negative mass and the width of the Gaussian.
    beyond = radius > reach + 4 * sigma
    assert np.abs([kappa[beyond], gamma1[beyond], gamma2[beyond]]).max() < 1e-4 * scale


@few
@given(st.floats(5.0, 60.0), st.integers(20, 60), st.sampled_from([1 / 15, 20.0]))
def test_the_window_is_the_transform_of_its_weight(reach, half, ratio):
    """The factor of kappa against an integral, also at frequencies so small that its formula cancels."""
    side = 2 * half
    step = reach * ratio
    found = fine_convergence._kernels(side, step, reach, 0.0)[0].real
    for k in (0, 1, 2, 5):
        wave = 2 * np.pi * k / (side * step)

        def weight(r, wave=wave):
            return 6 * r * (1 - r * r) ** 2 * j0(wave * reach * r)

        assert found[0, k] == pytest.approx(1 - quad(weight, 0, 1, epsabs=1e-13)[0], rel=1e-4, abs=1e-9)


def test_the_spreading_of_pixels_is_corrected():
    """A Gaussian that is spread with the weight of pixels has its own lensing again, within 10 % of its peak."""
    step, reach, side, sigma, spread = 1.25 * ARCMIN, 20 * ARCMIN, 90, 2 * ARCMIN, 2.6 * ARCMIN
    axis = step * (np.arange(side) - side // 2)
    x, y = np.meshgrid(axis, axis)
    blob = np.exp(-0.5 * (x * x + y * y) / sigma**2)
    expected = np.fft.irfft2(np.fft.rfft2(blob) * fine_convergence._kernels(side, step, reach, 0.0), (side, side))
    window = fine_convergence._kernels(side, step, spread, 0.0)[0].real
    smooth = np.fft.rfft2(blob) * (1 - window)
    corrected, attenuated = (
        np.fft.irfft2(smooth * fine_convergence._kernels(side, step, reach, radius), (side, side))
        for radius in (spread, 0.0)
    )
    error = [
        np.abs(values - expected)[:3].max((1, 2)) / np.abs(expected[:3]).max() for values in (corrected, attenuated)
    ]
    assert np.all(error[0] < 0.10)
    assert np.all(error[0][0] < 0.5 * error[1][0])


# ------------------------------------------------------------------------------------------------ grids


def test_grids_around_two_centres_agree_on_the_sky(matter):
    """Two grids 11' apart give the same lensing at the same places, but for interpolation."""
    lon, lat = 1.2, 0.4
    shift = 11 * ARCMIN
    frames = frame_at(lon, lat), frame_at(lon, lat + shift)
    (step, one), (_, other) = (fine_convergence.lensing_grid(matter, frame, 15 * ARCMIN) for frame in frames)
    middle = one.shape[1] // 2
    # Both grids have east and north along the same meridian, so nodes on it are compared where they lie together.
    rows = np.arange(-2, 9)
    north = rows * step
    place = (north - shift) / step + middle
    low = np.floor(place).astype(int)
    part = (place - low)[:, None]
    at_one = one[0, middle + rows, middle]
    at_other = (1 - part) * other[0, low, middle] + part * other[0, low + 1, middle]
    difference = np.sqrt(np.mean((at_one - at_other) ** 2, 0))
    assert difference[:3] == pytest.approx(np.zeros(3), abs=0.2 * one[0, ..., 1].std())
    assert difference[3:] == pytest.approx(np.zeros(2), abs=0.1 * one[0, ..., 3].std())


def test_the_grid_is_that_of_a_sum_over_pixels(matter):
    """Shear and deflection at places all around the centre, each from a sum over all pixels within `reach`."""
    chosen, frame = fine_convergence.settings(), frame_at(1.2, 0.4)
    reach = chosen.reach * ARCMIN
    step, table = fine_convergence.lensing_grid(matter, frame, 15 * ARCMIN)
    pixel = hp.query_disc(1 << chosen.order, frame[2], 15 * ARCMIN + reach, nest=False)
    pixel = hp.ring2nest(1 << chosen.order, pixel)
    kappa = fine_convergence.convergence(matter, pixel)[0] * hp.nside2pixarea(1 << chosen.order) / np.pi
    east, north, along = frame @ np.array(hp.pix2vec(1 << chosen.order, pixel, nest=True))
    x, y = 2 * east / (1 + along), 2 * north / (1 + along)
    middle, found, expected = table.shape[1] // 2, [], []
    for j, i in np.random.default_rng(4).integers(-9, 10, (80, 2)):
        dx, dy = i * step - x, j * step - y
        square = dx**2 + dy**2
        outer = np.maximum(1 - square / reach**2, 0)
        inner = np.maximum(1 - square / (2 * ARCMIN) ** 2, 0)
        convergence = 3 * (inner**2 / (2 * ARCMIN) ** 2 - outer**2 / reach**2)
        mean = (outer**3 - inner**3) / square
        shear = (mean - convergence) / square
        terms = (-shear * (dx**2 - dy**2), -shear * 2 * dx * dy, mean * dx, mean * dy)
        expected.append([np.sum(kappa * term) for term in terms])
        found.append(table[0, middle + j, middle + i, 1:])
    for one, other in zip(np.array(found).T, np.array(expected).T, strict=True):
        slope = np.sum(one * other) / np.sum(other**2)
        assert slope == pytest.approx(1, abs=0.15)
        assert np.std(one - slope * other) < 0.3 * np.std(other)


@pytest.mark.parametrize("dec", [0.0, 0.5, 1.0, 1.5])
def test_the_lensing_has_no_preferred_direction(matter, dec):
    """The power of gamma1 and gamma2 agrees at any declination, where pixels have different shapes.

    The sample has 24 fields at each declination; significance 1e-3 for 3.3 times the scatter between fields.
    """
    power = []
    for lon in np.linspace(0.1, 6.2, 24):
        _, table = fine_convergence.lensing_grid(matter, frame_at(lon, dec), 10 * ARCMIN)
        power.append([np.mean(table[0, ..., 1] ** 2), np.mean(table[0, ..., 2] ** 2)])
    one, other = np.array(power).T
    difference = (one - other) / (one + other).mean()
    assert abs(difference.mean()) < 3.3 * difference.std() / np.sqrt(24)
    assert difference.std() / np.sqrt(24) < 0.08


def test_at_the_poles_and_where_right_ascension_jumps(matter):
    for lon, lat in ((0.0, np.pi / 2), (0.3, -np.pi / 2), (2 * np.pi - 1e-9, 0.0), (np.pi, 0.7)):
        _, table = fine_convergence.lensing_grid(matter, frame_at(lon, lat), 5 * ARCMIN)
        assert np.isfinite(table).all()
        assert table[0, ..., 0].std() > 1e-4


def test_known_cells_are_used_again_and_change_nothing(matter):
    frame = frame_at(0.5, 0.1)
    _, first = fine_convergence.lensing_grid(matter, frame, 10 * ARCMIN)
    count = len(matter.by_cell)
    _, again = fine_convergence.lensing_grid(matter, frame, 10 * ARCMIN)
    alone = replace(matter, by_cell=type(matter.by_cell)())
    _, fresh = fine_convergence.lensing_grid(alone, frame, 10 * ARCMIN)
    assert len(matter.by_cell) == count
    assert first.tobytes() == again.tobytes() == fresh.tobytes()
