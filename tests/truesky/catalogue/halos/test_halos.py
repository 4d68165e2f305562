"""Halos: mass function, completeness and bias, and their cells."""

import dataclasses
import hashlib
from functools import cache

import numpy as np
import pytest
import scipy

from lake_schema import ids, sky
from tests.truesky import nightly
from tests.truesky.catalogue.conftest import BOX_CELLS, SEED
from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.halos import halos
from truesky.catalogue.matter import fine_structure, lightcone
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe


@pytest.fixture(scope="module")
def model(universe):
    return universe.population.halos


@pytest.mark.parametrize("order", halos.LEVELS)
def test_a_reach_never_leads_beyond_the_cells_about(order, rng):
    """Cells everywhere on the sky, random positions inside them, and steps in any direction."""
    for cell in rng.integers(0, 12 << 2 * order, 30).tolist():
        _, ra, dec = sky.random_in_cell(order, cell, 300, rng)
        angle, length = 2 * np.pi * rng.random(300), np.degrees(halos.reach(order))
        lat, lon = np.radians(dec), np.radians(ra)
        vector = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(300)])
        north = np.cross(vector, east, axis=0)
        moved = vector * np.cos(np.radians(length)) + np.sin(np.radians(length)) * (
            np.cos(angle) * north + np.sin(angle) * east
        )
        to = sky.cell_at(np.degrees(np.arctan2(moved[1], moved[0])), np.degrees(np.arcsin(moved[2])), order)
        assert np.isin(to, [cell, *sky.margin_cells(order, cell, order).tolist()]).all()


def test_every_halo_has_one_level(model):
    """Each mass bin above the limit is drawn by one order; less than one halo of the sky is larger than any level."""
    wanted = model.log_mass[None, 1:] >= (model.min_mass_limit - model.matching.occupation.depth)[:, None]
    left_out = wanted & (model.level == -1)
    expected = np.sum(np.where(left_out, model.number, 0.0) * model.steps.volume[:, None]) * 4 * np.pi
    assert expected < 1.0
    assert set(np.unique(model.level)) == {-1, *halos.LEVELS}


@pytest.mark.parametrize("order", halos.LEVELS)
def test_halos_lie_in_their_cell(model, order):
    found = halos.draw(model, SEED, order, 70)
    assert np.all(found.index >> 2 * (29 - order) == 70)
    assert np.all(np.diff(found.index) >= 0)
    assert np.unique(found.id).size == found.id.size
    assert np.array_equal(found.id >> ids.BLOCK_BITS, found.index >> 2 * (29 - ids.GENERATION_ORDER))
    assert np.all(
        (found.log_mass >= model.mass_limit(found.chi) + model.host_offset)
        | (found.proxy >= model.mass_limit(found.chi))
    )
    # The scatter ends where the depth does.
    assert np.all(np.abs(found.proxy - found.log_mass) <= model.matching.occupation.depth + 1e-9)


@pytest.mark.parametrize("order", halos.LEVELS)
def test_halos_above_a_mass_are_the_same_to_any_limit(model, order):
    """Halos for lensing do not depend on the request's limit for galaxies."""
    least = np.where(model.steps.z < 1.5, 12.0, np.inf)
    every, few = halos.draw(model, SEED, order, 70, least), halos.draw(model, SEED, order, 70)
    shallow = dataclasses.replace(model, limit=model.limit + 1.0, max_distance=2000.0)
    again = halos.draw(shallow, SEED, order, 70, least)
    both = few.select((few.log_mass >= 12.0) & (few.chi < 2000.0))
    kept = every.select(
        (every.log_mass >= np.maximum(12.0, model.mass_limit(every.chi) + model.host_offset)) & (every.chi < 2000.0)
    )
    assert kept.id.size > 0 or order == 2
    for name in ("id", "index", "chi", "log_mass", "proxy", "velocity"):
        assert getattr(every, name).tobytes() == getattr(again, name).tobytes()
        complete = both.log_mass >= model.mass_limit(both.chi) + model.host_offset
        assert getattr(kept, name).tobytes() == getattr(both, name)[complete].tobytes()


@pytest.mark.parametrize(
    ("order", "cell", "number", "digest"),
    [(8, 70, 14245, "56c735ae6a209f37"), (8, 303_117, 13913, "b862094a7c3f1f5d"), (5, 70, 37, "7089267ffcceef4f")],
)
def test_without_structure_below_the_cells_halos_have_random_positions_in_voxels(order, cell, number, digest):
    """Bit by bit the sky of the version before this structure, with the spectrum of that version."""
    cosmology = dataclasses.replace(FIDUCIAL, power="eisenstein98")
    requested = Universe(24.5, box_cells=BOX_CELLS, structure_below_cells=False, cosmology=cosmology)
    drawn = halos.draw(galaxies.halos_and_galaxies(SEED, requested).halos, SEED, order, cell)
    columns = b"".join(getattr(drawn, name).tobytes() for name in drawn.__slots__)
    assert drawn.id.size == number
    assert hashlib.sha256(columns).hexdigest()[:16] == digest


@pytest.mark.parametrize("seed", [0, 2**63 - 1])
def test_the_nearest_halos_are_the_same_to_any_redshift(seed):
    """Smallest and largest `z_max`, with the smallest box: the halos nearer than z = 0.01, bit by bit."""
    drawn = []
    for z_max in (0.01, 6.0):
        requested = Universe(galaxy_limit=24.5, z_max=z_max, box_cells=BOX_CELLS, structure_below_cells=True)
        whole = dataclasses.replace(galaxies.halos_and_galaxies(SEED, requested).halos, fine=fine_structure.model(seed))
        cells = [halos.draw(whole, seed, order, 7 >> 2 * (8 - order)) for order in halos.LEVELS]
        near = [found.select(found.chi < float(FIDUCIAL.comoving_distance(0.01))) for found in cells]
        drawn.append([getattr(found, name).tobytes() for found in near for name in found.__slots__])
    assert sum(found.id.size for found in near) > 0
    assert drawn[0] == drawn[1]
    # Most halos of the deep catalogue are farther.
    assert cells[0].id.size > 1000 + near[0].id.size


@cache
def masses_and_places(with_structure):
    """Draw the halos of 24 cells between 1,700 and 3,000 Mpc/h: log10 mass, chi, unit vectors and G, by cell."""
    requested = Universe(galaxy_limit=24.5, box_cells=BOX_CELLS)
    whole = galaxies.halos_and_galaxies(SEED, requested).halos
    model, drawn = whole if with_structure else dataclasses.replace(whole, fine=None), []
    least = np.where((whole.steps.edge[:-1] > 1700.0) & (whole.steps.edge[1:] < 3000.0), 11.0, np.inf)
    for cell in range(1000, 12 << 16, (12 << 16) // 24):
        found = halos.draw(model, SEED, 8, cell, least)
        vector = np.ascontiguousarray(sky.unit_vectors(*sky.positions_of_indices(found.index)).T)
        value = fine_structure.values(whole.fine, vector, found.chi)
        drawn.append((found.log_mass, found.chi, vector, value))
    return drawn


def test_structure_below_the_cells_does_not_change_the_number_of_halos():
    """Sample of 24 cells, halos above 10^11, 10^12 and 10^13 Msun/h: 3 % and significance 6e-5 (4 standard errors)."""
    with_structure, without = (np.concatenate([cell[0] for cell in masses_and_places(kind)]) for kind in (True, False))
    for least in (11.0, 12.0, 13.0):
        number, expected = np.sum(with_structure > least), np.sum(without > least)
        assert number == pytest.approx(expected, abs=0.03 * expected + 4 * np.sqrt(2 * expected))


def test_halos_follow_the_structure_below_the_cells():
    """The mean of G over halos whose density is exp(B G) is B for a Gaussian G, and 0 without the structure."""
    for with_structure, low, high in ((True, 0.75, 1.15), (False, -0.05, 0.05)):
        value = np.concatenate([cell[3] for cell in masses_and_places(with_structure)])
        assert low < value.mean() < high


def test_halos_are_closer_together_with_structure_below_the_cells():
    """Pairs within 1 Mpc/h are more than twice as many, and at 8 to 12 Mpc/h as many."""
    near, far = np.zeros(2), np.zeros(2)
    for column, with_structure in enumerate((True, False)):
        for log_mass, chi, vector, _ in masses_and_places(with_structure):
            tree = scipy.spatial.cKDTree((chi * vector).T[log_mass > 11.5])
            counts = tree.count_neighbors(tree, [0.5, 1.0, 8.0, 12.0])
            near[column] += counts[1] - counts[0]
            far[column] += counts[3] - counts[2]
    assert near[0] > 2.0 * near[1] > 0
    assert far[0] == pytest.approx(far[1], rel=0.05)


def test_identifiers_can_number_the_fullest_block(model):
    """Mean numbers in blocks at the densest place of the box fit into identifiers, for any limit and redshift.

    The structure below the voxels has the highest mean weight of the steps of 20 order-8 cells, for each distance.
    Significance 1e-9 for one block (6 standard errors): the sample is every block of the sky.
    """
    weight = np.zeros((model.steps.z.size, model.fine.norm.size))
    for cell in range(17, 12 << 16, (12 << 16) // 20):
        every = np.ones(model.steps.z.size, bool)
        voxels = lightcone.voxels(model.box, model.replicas, model.steps, 8, cell, every)
        subvoxels = fine_structure.divide(model.fine, model.steps, voxels)
        number = np.bincount(voxels.step)
        means = [np.bincount(voxels.step, column) / number for column in subvoxels.weight.T]
        weight = np.maximum(weight, np.stack(means, 1))
    # Neighbouring steps have similar distributions.
    weight = scipy.ndimage.maximum_filter1d(weight, 51, axis=0)
    most = np.array([float(smooth.max()) for smooth in model.box.smoothed])
    peak = np.exp(model.amplitude * most[model.field] - 0.5 * model.amplitude**2 * model.box.variance[model.field])
    peak *= np.take_along_axis(weight, model.field, 1)
    mean = model.number * (model.steps.volume * np.radians(1.0) ** 2 * sky.cell_area(8))[:, None] * peak
    room = 2.0 ** (23 - ids.member_bits(model.log_mass[:-1]))
    # A block is wider than a cell of the box only where its pieces are of several: its densest is of one.
    assert np.max((mean + 6.0 * np.sqrt(mean)) / room) < 1.0


def test_mass_function_comes_out(model, drawn):
    """Above the limit, where halos are complete; 20 cells share large structures.

    Significance 6e-5 (4 standard errors), or 10 % for the structures: the sample is all halos of 1.05 deg2.
    """
    z, mass = (drawn.halos[name].to_numpy() for name in ("z_true", "log_mass"))
    for low, high in ((0.5, 1.0), (1.0, 1.6), (1.6, 2.2)):
        steps = (model.steps.z > low) & (model.steps.z < high)
        for least in (11.0, 12.0, 13.0):
            bins = np.round(model.log_mass[:-1], 3) >= least - 1e-3
            mean = np.sum(model.number[np.ix_(steps, bins)].sum(1) * model.steps.volume[steps])
            mean *= drawn.area * np.radians(1.0) ** 2
            found = np.sum((z > low) & (z < high) & (mass > least))
            assert found == pytest.approx(mean, rel=0.10, abs=4 * np.sqrt(mean))


@nightly.parametrize("low_k", [0.03, 0.08], (0,))
@pytest.mark.parametrize(("low", "high", "redshift"), [(11.5, 12.5, 0.0), (12.5, 13.5, 0.5), (12.0, 13.0, 1.5)])
def test_bias_of_the_field_that_halos_follow(model, low, high, redshift, low_k):
    """On large scales the power of exp(x g - ...) is x^2 / D^2 times that of the matter."""
    from tests.truesky.catalogue.matter.test_density_box import spectrum

    box, step = model.box, int(np.searchsorted(model.steps.z, max(redshift, 0.003)))
    growth = float(FIDUCIAL.growth(redshift))
    for column in (np.searchsorted(model.log_mass, low), np.searchsorted(model.log_mass, high)):
        x, field, amplitude = (float(table[step, column]) for table in (model.x, model.field, model.amplitude))
        smooth, variance = box.smoothed[int(field)], box.variance[int(field)]
        number = np.exp(amplitude * smooth - 0.5 * amplitude**2 * variance) - 1.0
        k, power, weight = spectrum(number, box.model.cell)
        inside = (k > low_k) & (k < 2.5 * low_k)
        matter = spectrum(np.expm1(box.smoothed[0] - 0.5 * box.variance[0]), box.model.cell)[1]
        ratio = np.sum((weight * power)[inside]) / np.sum((weight * matter)[inside])
        assert np.sqrt(ratio) / x == pytest.approx(1.0, abs=0.07), (growth, x)
