"""Plot histograms, heat maps and sky maps with matplotlib.

Each function draws the result of the method of `truesky.Lake` with the same name: `hist`, `heatmap` or `skymap`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema import arguments, sky
from lake_schema.arrays import Float, Int
from truesky.explore.explorer import ORDER


@arguments.refuse_missing("truesky.plots.hist(counts, edges), with the result of lake.hist")
def hist(counts: Float, edges: Float, ax: Any = None, **style: Any) -> Any:
    """Draw a histogram as steps.

    Parameters
    ----------
    counts : float array, shape (bins,)
        Number of rows or sum of weights in each bin, as returned by `Lake.hist`.
    edges : float array, shape (bins + 1,)
        Edges of the bins, ascending.
    ax : matplotlib Axes, optional
        Axes to draw in. The default is a new figure.
    **style
        Options of `matplotlib.axes.Axes.stairs`.

    Returns
    -------
    matplotlib Axes
        Axes with the plot.
    """
    axes = _axes(ax)
    axes.stairs(counts, edges, **style)
    return axes


@arguments.refuse_missing("truesky.plots.heatmap(counts, x_edges, y_edges), with the result of lake.heatmap")
def heatmap(counts: Float, x_edges: Float, y_edges: Float, ax: Any = None, **style: Any) -> Any:
    """Draw a two-dimensional histogram as colours on a logarithmic scale, with a colour bar.

    Bins whose value is not positive are blank.

    Parameters
    ----------
    counts : float array, shape (y bins, x bins)
        Number of rows or sum of weights in each bin, as returned by `Lake.heatmap`.
    x_edges : float array, shape (x bins + 1,)
        Edges of the bins in x.
    y_edges : float array, shape (y bins + 1,)
        Edges of the bins in y.
    ax : matplotlib Axes, optional
        Axes to draw in. The default is a new figure.
    **style
        Options of `matplotlib.axes.Axes.pcolormesh`.

    Returns
    -------
    matplotlib Axes
        Axes with the plot.
    """
    from matplotlib.colors import LogNorm

    axes = _axes(ax)
    nonempty = np.ma.masked_less_equal(counts, 0.0)
    norm = LogNorm(1.0, max(2.0, float(counts.max(initial=0.0))))
    mesh = axes.pcolormesh(x_edges, y_edges, nonempty, **{"norm": norm, "cmap": "viridis", **style})
    axes.figure.colorbar(mesh, ax=axes, label="number")
    return axes


@arguments.refuse_missing("truesky.plots.skymap(cells, counts, order), with the result of lake.skymap")
def skymap(cells: Int, counts: Float, order: int = ORDER, ax: Any = None, **style: Any) -> Any:
    """Draw a sky map in HEALPix cells: the number of rows per square degree, with east to the left.

    Parameters
    ----------
    cells : int array, shape (n,)
        Nested HEALPix indices of the cells, as returned by `Lake.skymap`.
    counts : float array, shape (n,)
        Number of rows or sum of weights in each cell.
    order : int, optional
        HEALPix order of the cells, as given to `Lake.skymap`.
    ax : matplotlib Axes, optional
        Axes to draw in. The default is a new figure.
    **style
        Options of `matplotlib.collections.PolyCollection`.

    Returns
    -------
    matplotlib Axes
        Axes with the plot.
    """
    from matplotlib.collections import PolyCollection

    axes = _axes(ax)
    corners = sky.cell_corners(order, cells)
    # Right ascensions of corners are moved by 360 deg to within 180 deg of the cell's first corner, so that a cell at
    # RA 0 is not drawn across the whole map.
    corners[:, :, 0] = corners[:, :1, 0] + (corners[:, :, 0] - corners[:, :1, 0] + 180.0) % 360.0 - 180.0
    collection = PolyCollection(list(corners), array=counts / sky.cell_area(order), **{"cmap": "viridis", **style})
    axes.add_collection(collection)
    axes.autoscale_view()
    axes.invert_xaxis()
    axes.set_aspect(1.0 / max(np.cos(np.radians(corners[:, :, 1].mean())), 0.1))
    axes.set_xlabel("right ascension / deg")
    axes.set_ylabel("declination / deg")
    axes.figure.colorbar(collection, ax=axes, label="number / deg$^2$")
    return axes


def _axes(ax: Any) -> Any:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]
