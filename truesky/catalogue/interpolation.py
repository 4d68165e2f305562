"""Find the indices and weights for linear interpolation between the nodes of a table."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int


def bracket(nodes: Float, values: Float, extrapolated: bool = False) -> tuple[Int, Float]:
    """Return the nodes around each value for linear interpolation, and the weight of the upper node.

    Parameters
    ----------
    nodes : float array, shape (m,)
        Nodes in ascending order, m >= 2.
    values : float array
        Values, of any shape.
    extrapolated : bool
        What to do with values beyond the first or last node: True to extrapolate (weights below 0 or above 1), False to
        use the value at that node (weights 0 or 1).

    Returns
    -------
    index : int array
        Index of the node below each value, 0 to m - 2.
    weight : float array
        Weight of the node above each value.
    """
    index = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, nodes.size - 2)
    weight = (values - nodes[index]) / (nodes[index + 1] - nodes[index])
    return index, weight if extrapolated else np.clip(weight, 0.0, 1.0)
