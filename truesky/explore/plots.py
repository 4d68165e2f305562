"""Pictures of what the explorer counts: each takes the result of the function of its name, and draws into axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Int


def hist(counts: Float, edges: Float, ax: Any = None, **style: Any) -> Any:
    """Steps; returns the axes.

    counts : [bins];  edges : [bins + 1], as `Explorer.hist` gives them
    """
    axes = _axes(ax)
    axes.stairs(counts, edges, **style)
    return axes


def heatmap(counts: Float, x_edges: Float, y_edges: Float, ax: Any = None, **style: Any) -> Any:
    """Colours, logarithmic, blank where there is nothing; returns the axes.

    counts : [y bins, x bins];  x_edges, y_edges : one more than bins, as `Explorer.heatmap` gives them
    ax     : of matplotlib; None: a new one
    """
    from matplotlib.colors import LogNorm

    axes = _axes(ax)
    seen = np.ma.masked_less_equal(counts, 0.0)
    norm = LogNorm(1.0, max(2.0, float(counts.max(initial=0.0))))
    mesh = axes.pcolormesh(x_edges, y_edges, seen, **{"norm": norm, "cmap": "viridis", **style})
    axes.figure.colorbar(mesh, ax=axes, label="number")
    return axes


def skymap(cells: Int, counts: Float, order: int, ax: Any = None, **style: Any) -> Any:
    """Number a square degree in HEALPix cells, east to the left; returns the axes.

    cells : int64[n] nested cells of the order;  counts : [n], as `Explorer.skymap` gives them
    ax    : of matplotlib; None: a new one
    """
    from matplotlib.collections import PolyCollection

    axes = _axes(ax)
    corners = sky.cell_corners(order, cells)
    # Each cell as it lies about its own first corner: none is torn at RA 0.
    corners[:, :, 0] = corners[:, :1, 0] + (corners[:, :, 0] - corners[:, :1, 0] + 180.0) % 360.0 - 180.0
    drawn = PolyCollection(list(corners), array=counts / sky.cell_area(order), **{"cmap": "viridis", **style})
    axes.add_collection(drawn)
    axes.autoscale_view()
    axes.invert_xaxis()
    axes.set_aspect(1.0 / max(np.cos(np.radians(corners[:, :, 1].mean())), 0.1))
    axes.set_xlabel("right ascension / deg")
    axes.set_ylabel("declination / deg")
    axes.figure.colorbar(drawn, ax=axes, label="number / deg$^2$")
    return axes


def _axes(ax: Any) -> Any:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]
