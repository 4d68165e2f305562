"""Count the detector footprints on the sky that contain given positions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema.arrays import Int
from truesky.numerics import matrices
from truesky.render.camera import pointing


def counts(tasks: pa.Table, ra: npt.ArrayLike, dec: npt.ArrayLike) -> Int:
    """Return how many detector footprints contain each position; gaps between detectors are not covered.

    Parameters
    ----------
    tasks : pyarrow.Table
        One row per detector and exposure, with the columns `ra` and `dec` (centre, deg), `radius` (of a circle around
        the footprint, deg) and `s_region` (STC-S polygon of the corners). The table may be empty.
    ra, dec : array_like, shape (n,)
        Positions, deg.

    Returns
    -------
    int array, shape (n,)
        Number of footprints at each position. Positions on the edge of a footprint count as inside.
    """
    from scipy.spatial import cKDTree

    places = pointing.basis(np.asarray(ra, float), np.asarray(dec, float))[2].T
    footprint_counts = np.zeros(len(places), np.int64)
    centres = pointing.basis(tasks["ra"].to_numpy(), tasks["dec"].to_numpy())[2].T
    chords = 2.0 * np.sin(np.radians(tasks["radius"].to_numpy()) / 2.0)
    nearby_places = cKDTree(places).query_ball_point(centres, chords) if len(tasks) else []
    for indices, region in zip(nearby_places, tasks["s_region"].to_pylist(), strict=True):
        if indices:
            corners = np.array(region.split()[2:], float).reshape(-1, 2)
            edges = pointing.basis(corners[:, 0], corners[:, 1])[2].T
            side = matrices.matmul(places[indices], np.cross(edges, np.roll(edges, -1, axis=0)).T)
            footprint_counts[indices] += (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
    return footprint_counts
