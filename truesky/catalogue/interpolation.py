"""Places of values between the nodes of a table, for linear interpolation."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int


def bracket(nodes: Float, values: Float, extrapolated: bool = False) -> tuple[Int, Float]:
    """(index of the node below, weight of the node above) of each value.

    nodes        : float64[m] ascending;  values : float64[...]
    extrapolated : whether weights go below 0 and above 1 beyond the nodes; else the outermost nodes hold there
    """
    index = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, nodes.size - 2)
    weight = (values - nodes[index]) / (nodes[index + 1] - nodes[index])
    return index, weight if extrapolated else np.clip(weight, 0.0, 1.0)
