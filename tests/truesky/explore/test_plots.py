"""Plots contain the counted numbers."""

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt

from lake_schema import sky
from truesky.explore import plots


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def test_hist(explorer):
    counts, edges = explorer.hist("galaxies", "z_obs", 10)
    (drawn,) = plots.hist(counts, edges, label="all").patches
    assert np.array_equal(drawn.get_data().values, counts)
    assert np.array_equal(drawn.get_data().edges, edges)


def test_results_are_drawn_as_they_come(explorer):
    for name, axes in (("hist", ["z_obs"]), ("heatmap", ["z_obs", "abs_mag_r01"]), ("skymap", [])):
        getattr(plots, name)(*getattr(explorer, name)("galaxies", *axes))


def test_heatmap_leaves_empty_bins_blank(explorer):
    counts, x, y = explorer.heatmap("galaxies", "z_obs", "abs_mag_r01", (40, 30))
    _, ax = plt.subplots()
    assert plots.heatmap(counts, x, y, ax) is ax
    shown = ax.collections[0].get_array()
    assert shown.sum() == counts.sum() == 500
    assert (shown.mask == (counts == 0)).all()
    assert (counts == 0).any()


@pytest.mark.parametrize("cells", [[1607, 1608], [0, 1, 2, 3], [4096 * 3 - 1]])
def test_skymap_draws_each_cell_where_it_lies(cells):
    counts = np.arange(1.0, len(cells) + 1)
    axes = plots.skymap(np.array(cells), counts, 5)
    drawn = axes.collections[0]
    assert np.allclose(drawn.get_array(), counts / sky.cell_area(5), atol=0.0)
    for cell, path in zip(cells, drawn.get_paths(), strict=True):
        ra, dec = sky.cell_centre(5, cell)
        lon = path.vertices[:4, 0]
        assert lon.max() - lon.min() < 180
        assert np.min(np.abs((lon - ra + 180) % 360 - 180)) < 10
        assert path.vertices[:4, 1].min() < dec < path.vertices[:4, 1].max()
    left, right = axes.get_xlim()
    assert left > right
