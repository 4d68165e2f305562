"""Two hundred square degrees of sources at z = 1: correlations of shear, and shear about massive halos."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import fft
from scipy.spatial import cKDTree
from scipy.special import jv

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from tests.truesky.catalogue.conftest import SEED
from tests.truesky.catalogue.galaxies.test_halo_lensing import profile
from truesky.catalogue.galaxies import galaxies, halo_lensing, lensing
from truesky.catalogue.halos import lens_halos, matching
from truesky.catalogue.halos.population import CellCache
from truesky.catalogue.matter import density_box
from truesky.cosmology import FIDUCIAL, HUBBLE_DISTANCE
from truesky.fluxes import sources
from truesky.request.schema import Universe
from truesky.validation import theory

pytestmark = pytest.mark.nightly

NSIDE, CHI, ARCMIN = 1024, float(FIDUCIAL.comoving_distance(1.0)), np.radians(1 / 60)
# One cell of order 2 (215 deg2) with this number of sources in each generation cell: 3 per arcmin2.
FIRST, CELLS, SOURCES = 40 << 12, 1 << 12, 560
RINGS = np.array([0.5, 1.0, 2.0, 4.0, 7.0, 10.0])
# About 1.3', 2.6', ..., 88'.
EDGES = 1.3 * 2.0 ** (np.arange(8) - 0.5)
PIXEL = 0.5


@pytest.fixture(scope="module")
def sample():
    """Return sources (frames, shear by the box and by halos, kappa) and halos above 10^13.2."""
    near, drawn = replace(lensing.settings(), planes=(0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0), far_planes=()), []
    chosen, rng = replace(lens_halos.settings(), z_max=1.0), np.random.default_rng(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lensing, "settings", lambda: near)
        patch.setattr(lens_halos, "settings", lambda: chosen)
        population = galaxies.halos_and_galaxies(SEED, Universe(lensing_nside=NSIDE))
        box, cells, halos = lensing.load(population.halos.box, NSIDE), CellCache(population), []
        for cell in range(FIRST, FIRST + CELLS):
            around = halo_lensing.lens_of_cell(box, cells, cell)
            _, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, SOURCES, rng)
            chi = np.full(SOURCES, CHI)
            of_box = lensing.interpolate(box, ra, dec, chi)
            found = halo_lensing.lensing_at_images(around, *lensing.displace(ra, dec, *of_box[3:]), chi)
            seen = lensing.displace(*lensing.displace(ra, dec, *of_box[3:]), *found[3:])
            drawn.append(np.stack([*seen, *of_box[:3], *found[:3]]))
            own, _ = halo_lensing._cached_lenses(chosen, box, cells, GENERATION_ORDER, cell, chosen.lowest)
            halos.append(own[:, own[9] > 13.2])
    ra, dec, kappa, *shear = np.concatenate(drawn, 1)
    by_box, kappa = shear[0] + 1j * shear[1], kappa + shear[2]
    return SimpleNamespace(
        frame=halo_lensing._frames(ra, dec),
        by_box=by_box,
        by_halos=shear[3] + 1j * shear[4],
        kappa=kappa,
        halos=np.concatenate(halos, 1),
    )


def magnification(sample):
    """Return the magnification of each source, 0 at a caustic."""
    shear = sample.by_box + sample.by_halos
    determinant = sources.determinant(sample.kappa, shear.real, shear.imag)
    good = (determinant > 0.05) & (sample.kappa < 1)
    return np.where(good, 1 / np.where(good, determinant, 1), 0)


def test_mean_convergence_and_its_least(sample):
    """The mean over image positions is 0, and no line of sight is below the convergence of empty space."""
    weight = magnification(sample)
    patch = np.arange(weight.size) * 64 // weight.size
    mean = np.bincount(patch, sample.kappa * weight) / np.bincount(patch, weight)
    assert abs(mean.mean()) < 3 * mean.std(ddof=1) / 8
    assert -0.067 < sample.kappa.min() < -0.02
    assert np.mean(weight == 0) < 1e-4


# ------------------------------------------------------------------------------------------------ about halos


def with_neighbours(theta, z, log_mass):
    """Return the mean tangential shear of the linear matter around halos at theta (rad)."""
    ell, chi = np.geomspace(5, 1e5, 3000), float(FIDUCIAL.comoving_distance(z))
    bias = matching.masses(FIDUCIAL).interpolate_pairs(
        matching.masses(FIDUCIAL).bias, np.array([z]), np.array([log_mass])
    )[0]
    power = density_box.linear_power(FIDUCIAL, (ell + 0.5) / chi) * float(FIDUCIAL.growth(z)) ** 2
    lens = 1.5 * FIDUCIAL.omega_m / HUBBLE_DISTANCE**2 * (1 + z) * (1 - chi / CHI) / chi
    c_l = lens * bias * power * np.exp(-((ell / 5e4) ** 2))
    return np.array([np.trapezoid(ell**2 * c_l * jv(2, ell * t), np.log(ell)) / (2 * np.pi) for t in theta])


@pytest.mark.parametrize(("low", "high"), [(13.4, 13.6), (13.75, 14.25), (14.25, 15.0)])
def test_shear_about_halos(sample, low, high):
    """Shear around the box images of halos at 0.2 < z < 0.6: 10 % to 4 arcmin, 30 % to 10 arcmin; no cross shear."""
    near, far = (float(FIDUCIAL.comoving_distance(z)) for z in (0.2, 0.6))
    halos, mass = sample.halos, sample.halos[9]
    halos = halos[:, (halos[3] > near) & (halos[3] < far) & (mass > low) & (mass < high)]
    gamma, tree, total = sample.by_box + sample.by_halos, cKDTree(sample.frame[:, 2]), np.zeros((4, RINGS.size - 1))
    for halo in halos.T:
        rows = np.array(tree.query_ball_point(halo[:3], RINGS[-1] * ARCMIN), int)
        x, y = (-(sample.frame[rows, axis] @ halo[:3]) for axis in range(2))
        ring = np.digitize(np.hypot(x, y) / ARCMIN, RINGS) - 1
        rows, theta, phi = rows[ring >= 0], np.hypot(x, y)[ring >= 0], np.arctan2(y, x)[ring >= 0]
        about = -gamma[rows] * np.exp(-2j * phi)
        own = profile(theta, np.repeat(halo[1:9, None], theta.size, 1))
        values = (about.real, about.imag, own, np.ones(theta.size))
        total += [np.bincount(ring[ring >= 0], value, RINGS.size - 1) for value in values]
    tangential, across, own, _ = total / total[3]
    middle = np.sqrt(0.5 * (RINGS[1:] ** 2 + RINGS[:-1] ** 2)) * ARCMIN
    z = float(np.median(FIDUCIAL.redshift(halos[3])))
    expected = own + with_neighbours(middle, z, float(np.median(halos[9])))
    assert halos.shape[1] > 100
    assert (tangential / expected)[:3] == pytest.approx(np.ones(3), abs=0.10)
    assert (tangential / expected)[3:] == pytest.approx(np.ones(2), abs=0.30)
    assert across / expected == pytest.approx(np.zeros(5), abs=0.05)


# ------------------------------------------------------------------------------------------------ correlations


def correlations(place, gamma, weight):
    """Return xi+ and xi- of the shear at positions (2, n) in arcmin: by pairs up to 3.7 arcmin, from pixels beyond."""
    pairs, (plus, minus) = pixelised(place, gamma, weight)
    count, near, gamma = np.zeros(2), np.zeros((2, 2)), gamma * weight
    for cut in np.array_split(np.arange(gamma.size), 64):
        one, other = cKDTree(place[:, cut].T).query_pairs(EDGES[2], output_type="ndarray").T
        dx, dy = place[:, cut[other]] - place[:, cut[one]]
        ring = np.digitize(np.hypot(dx, dy), EDGES[:3]) - 1
        turned = gamma[cut[one]] * gamma[cut[other]] * np.exp(-4j * np.arctan2(dy, dx))
        values = (gamma[cut[one]] * np.conj(gamma[cut[other]])).real, turned.real
        near += [np.bincount(ring[ring >= 0], value[ring >= 0], 2) for value in values]
        count += np.bincount(ring[ring >= 0], (weight[cut[one]] * weight[cut[other]])[ring >= 0], 2)
    plus[:2], minus[:2] = near / count
    assert np.all(pairs > 0)
    return plus, minus


def pixelised(place, gamma, weight):
    """(pairs, (xi+, xi-)) by ring, from Fourier transforms of sums in pixels."""
    at = ((place - place.min(1, keepdims=True)) / PIXEL).astype(int)
    shape = [fft.next_fast_len(int(n) + int(1.1 * EDGES[-1] / PIXEL)) for n in at.max(1) + 1]
    flat = at[0] * shape[1] + at[1]

    def transformed(values):
        summed = np.bincount(flat, values.real, shape[0] * shape[1]) + 1j * np.bincount(
            flat, values.imag, shape[0] * shape[1]
        )
        return fft.fft2(summed.reshape(shape).astype(np.complex64))

    x, y = (fft.fftfreq(n, 1 / n) * PIXEL for n in shape)
    ring = np.digitize(np.hypot(x[:, None], y[None]), EDGES) - 1
    inside = (ring >= 0) & (ring < EDGES.size - 1)
    ring, phase = ring[inside], np.exp(-4j * np.arctan2(y[None], x[:, None])[inside])
    number, field, mirrored = (transformed(weight * values) for values in (1.0 + 0.0 * gamma, gamma, np.conj(gamma)))
    maps = (number * np.conj(number), field * np.conj(field), field * np.conj(mirrored))
    pairs, plus, minus = (fft.ifft2(one)[inside] for one in maps)
    pairs, plus, minus = (np.bincount(ring, one.real) for one in (pairs, plus, minus * phase))
    return pairs, (plus / pairs, minus / pairs)


def expected(ell, c_l):
    """xi+, xi- [rings] of C_l, averaged over pairs."""
    theta = np.geomspace(EDGES[0], EDGES[-1], 200)
    ring, weight = np.digitize(theta, EDGES[1:-1]), theta**2
    both = theory.shear_correlations(theta * ARCMIN, ell, c_l)
    return [np.bincount(ring, one * weight) / np.bincount(ring, weight) for one in both]


def test_correlations_of_shear_are_those_of_non_linear_theory(sample):
    """Image positions have equal weights in theory, so sources are weighted by their magnification.

    From 1.3' to 83', xi+ agrees within 10 %, and xi- within 15 % at the smallest separation and 13 % at others. The
    amplitude of the matter around halos was chosen with this field. The variance of the box is replaced by its
    theoretical value. Clusters cause an error of 3 % at 5' to 10' in 215 deg2.
    """
    centre = sample.frame[:, 2].mean(0)
    lon, lat = np.degrees([np.arctan2(centre[1], centre[0]), np.arctan2(centre[2], np.hypot(*centre[:2]))])
    frame = halo_lensing._frames(np.array([lon]), np.array([lat]))[0]
    place = halo_lensing._stereographic(frame, sample.frame[:, 2]) / ARCMIN
    turn = sample.frame[:, 0] @ frame[0] + 1j * (sample.frame[:, 0] @ frame[1])
    turn = (turn / np.abs(turn)) ** 2
    whole, of_box = (
        correlations(place, gamma * turn, magnification(sample))
        for gamma in (sample.by_box + sample.by_halos, sample.by_box)
    )
    ell = np.unique(np.geomspace(5, 3e5, 500))
    linear, whole_power = (
        theory.convergence_power(FIDUCIAL, ell, np.array([CHI]), np.ones(1), of)
        for of in (partial(theory.matter_power, is_linear=True), theory.matter_power)
    )
    box, wanted = expected(ell, np.where(ell < 1.5 * NSIDE, linear, 0)), expected(ell, whole_power)
    plus, minus = (
        (one - other + mean) / by_theory for one, other, mean, by_theory in zip(whole, of_box, box, wanted, strict=True)
    )
    assert np.all(np.abs(plus - 1) < 0.10)
    assert np.all(np.abs(minus - 1) < [0.15, *[0.13] * 6])
