"""The light-cone through replicas of the box: distances, voxels and orientations."""

import healpy as hp
import numpy as np
import pytest

from lake_schema import sky
from truesky.catalogue.matter import lightcone
from truesky.cosmology import FIDUCIAL


def test_distance_and_redshift(rng):
    table = lightcone.distance_table(FIDUCIAL, 2.3)
    assert table.chi[-1] == pytest.approx(3844.0, rel=1e-3)
    z = 2.3 * rng.random(1000)
    assert table.redshift(FIDUCIAL.comoving_distance(z)) == pytest.approx(z, abs=1e-7)


def test_voxels_fill_the_cell(box):
    """Every voxel lies in the cell, and together they have its volume."""
    table = lightcone.distance_table(FIDUCIAL, 2.3)
    line = lightcone.radial_steps(box.model.cell, 6.0, float(table.chi[-1]), table)
    turned = lightcone.draw_replicas(box, float(table.chi[-1]))
    used = np.ones(line.z.size, bool)
    found = lightcone.voxels(box, turned, line, 8, 5000, used)
    assert np.all(found.cell >> 2 * (found.order - 8) == 5000)
    volume = np.sum(np.pi / 3 / 4.0**found.order * line.volume[found.step])
    expected = np.radians(1) ** 2 * sky.cell_area(8) * (line.edge[-1] ** 3 - line.edge[0] ** 3) / 3
    assert volume == pytest.approx(expected, rel=1e-9)
    width = line.middle[found.step] * 1.023 / 2.0**found.order
    assert width.max() < 1.25 * box.model.cell
    assert np.diff(line.edge).max() <= box.model.cell + 1e-9


def test_replicas_are_turns_of_one_box(box):
    """Neighbours on the sky are neighbours in the box, inside a shell; the direction keeps its length."""
    turned = lightcone.draw_replicas(box, 5000.0)
    assert np.array_equal(turned.axes[0], [0, 1, 2])
    assert len({tuple(row) for row in np.hstack([turned.axes, turned.sign]).tolist()}) > 2
    direction = np.stack(hp.ang2vec(np.array([1.0, 1.0]), np.array([2.0, 2.0])))
    for chi in (100.0, 900.0, 3000.0):
        cell, seen = lightcone.box_cells(box, turned, direction, np.array([chi, chi + box.model.cell]))
        assert np.sum(seen**2, 1) == pytest.approx(np.ones(2))
        place = np.array(np.unravel_index(cell, (box.n,) * 3))
        step = np.abs(place[:, 1] - place[:, 0])
        assert np.all(np.minimum(step, box.n - step) <= 1)


def test_nothing_lies_across_the_edge_of_the_box(box):
    """Steps end where a replica does; positions a side apart are one cell, also where a side ends."""
    table = lightcone.distance_table(FIDUCIAL, 2.3)
    line = lightcone.radial_steps(box.model.cell, 6.0, float(table.chi[-1]), table)
    edges = box.length * np.arange(1, int(table.chi[-1] // box.length) + 1)
    assert edges.size == 5
    assert np.isin(edges, line.edge).all()
    turned = lightcone.Replicas(np.array([[0, 1, 2]] * 6), np.ones((6, 3)), np.zeros((6, 3)))
    ahead = np.array([[1.0, 0.0, 0.0]] * 3)
    at = np.array([0.25, 0.25, box.model.cell * 0.75])
    first, _ = lightcone.box_cells(box, turned, ahead, at)
    later, _ = lightcone.box_cells(box, turned, ahead, at + box.length * np.array([1, 3, 4]))
    before, _ = lightcone.box_cells(box, turned, ahead, box.length * np.array([1, 3, 4]) - 0.25)
    assert np.array_equal(first, later)
    assert np.array_equal(before, first + (box.n - 1) * box.n**2)
    assert np.all((later >= 0) & (before < box.n**3))


def test_a_deeper_light_cone_leaves_the_nearer_shells(box):
    near, far = lightcone.draw_replicas(box, 2000.0), lightcone.draw_replicas(box, 6000.0)
    assert np.array_equal(near.shift, far.shift[: len(near.shift)])
    assert np.array_equal(near.sign, far.sign[: len(near.sign)])
