"""How often each place of the sky is looked at.

counts   of places: how many of the planned detectors see each
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.render import focal_plane


def counts(tasks: pa.Table, ra: npt.ArrayLike, dec: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """[n] How many footprints of the tasks hold each place, gaps between detectors left out; ra, dec : [n] deg."""
    places = focal_plane.basis(np.asarray(ra, float), np.asarray(dec, float))[2].T
    found = np.zeros(len(places), np.int64)
    centres = focal_plane.basis(tasks["ra"].to_numpy(), tasks["dec"].to_numpy())[2].T
    reach = np.cos(np.radians(tasks["radius"].to_numpy()))
    for i, region in enumerate(tasks["s_region"].to_pylist()):
        near = np.flatnonzero(places @ centres[i] > reach[i])
        if near.size:
            corners = np.array(region.split()[2:], float).reshape(-1, 2)
            edges = focal_plane.basis(corners[:, 0], corners[:, 1])[2].T
            side = places[near] @ np.cross(edges, np.roll(edges, -1, axis=0)).T
            found[near] += (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
    return found
