"""The compiled sums against the same sums written with the light-cone's own geometry."""

from concurrent.futures import ThreadPoolExecutor

import healpy as hp
import numpy as np
import pytest

from tests.truesky import nightly
from truesky.catalogue.galaxies import lensing
from truesky.catalogue.matter import convergence, density_box, lightcone


def test_sums_are_those_of_the_cells_that_lines_of_sight_meet(box, rng):
    direction = rng.standard_normal((3, 2, 512))
    direction = (direction / np.sqrt((direction**2).sum(0))).astype(np.float32)
    middle = np.array([3.0, 500.0, 1000.0, 2500.0])
    turned = lightcone.draw_replicas(box, 3000.0)
    weights = rng.random((2, middle.size)).astype(np.float32)
    shell = (middle // box.length).astype(np.int64)
    sums = np.zeros((2, 2, 512), np.float32)
    convergence.add_layers(
        np.ascontiguousarray(direction.swapaxes(0, 1)),
        box.smoothed[0].ravel(),
        box.n,
        turned.axes[shell],
        (turned.sign[shell] * (middle / box.length)[:, None]).astype(np.float32),
        (turned.shift[shell] / box.length).astype(np.float32),
        weights,
        sums,
    )
    flat = direction.reshape(3, -1).T.astype(float)
    cells = [lightcone.box_cells(box, turned, flat, np.full(len(flat), chi))[0] for chi in middle]
    wanted = weights.astype(float) @ np.stack([box.smoothed[0].ravel()[cell] for cell in cells])
    found = sums.swapaxes(0, 1).reshape(2, -1)
    # A few lie so near a cell's border that single precision sees them on its other side.
    assert np.mean(np.abs(found - wanted) < 1e-4) > 0.99


def test_no_cell_lies_beyond_the_last():
    """A place so little below a side of the box that it rounds onto it is in the last cell; behind it is no matter."""
    n = 8
    memory = np.full(2 * n**3, np.nan, np.float32)
    memory[: n**3] = np.arange(n**3)
    direction, one = np.ones((1, 3, 1024), np.float32), np.ones((1, 3), np.float32)
    for axis in range(3):
        shift = np.full((1, 3), 0.5, np.float32)
        shift[0, axis] = -1e-9
        wanted = [4, 4, 4]
        wanted[axis] = n - 1
        sums = np.zeros((1, 2, 1024), np.float32)
        weights, axes = np.ones((2, 1), np.float32), np.arange(3)[None]
        convergence.add_layers(direction, memory[: n**3], n, axes, 0.0 * one, shift, weights, sums)
        assert np.all(sums == np.ravel_multi_index(wanted, (n, n, n)))


@nightly.parametrize("factor", [1, 2, 4], (1,))
def test_averages(box, factor):
    with ThreadPoolExecutor(2) as pool:
        found = convergence.average_density(box, 0.7, factor, pool)
    delta = density_box.overdensity(box, np.arange(box.n**3), 0.7)
    n = box.n // factor
    wanted = delta.reshape(n, factor, n, factor, n, factor).mean((1, 3, 5))
    assert np.abs(found - wanted).max() < 1e-4


def test_layers_fill_the_line_of_sight(box):
    """They touch, reach the far end, and are as thick as a pixel is wide, at most `coarsest` cells."""
    slabs = convergence.layers(box, hp.nside2resol(64), 4000.0, 8, 96.0)
    thick = slabs.factor * box.model.cell
    edge = np.concatenate([[0.0], np.cumsum(thick)])
    assert slabs.middle == pytest.approx(0.5 * (edge[1:] + edge[:-1]))
    assert edge[-2] < 4000.0 <= edge[-1]
    assert np.all(thick <= np.maximum(hp.nside2resol(64) * slabs.middle, box.model.cell))
    assert set(slabs.factor) == {1, 2, 4, 8}


def test_a_farther_plane_leaves_the_nearer_as_they_were(box):
    chosen = lensing.settings()
    direction = np.stack(hp.pix2vec(16, np.arange(3072), nest=True)).astype(np.float32)

    def kappa(*chi):
        return convergence.convergence(box, direction, 0.06, np.array(chi), chosen.coarsest, chosen.stretch)

    assert np.array_equal(kappa(300.0, 500.0)[0], kappa(300.0, 1100.0)[0])
