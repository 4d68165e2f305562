"""Number of frames in an exposure of near-infrared detectors, a MACC ramp (multiple accumulated sampling).

The detector is reset once and then read many times while charge accumulates. The reads form groups of consecutive
frames, with frames between them that are not stored (drops).

References
----------
Euclid Collaboration: Serrano et al. 2024 (MACC: multiple accumulated groups)
"""

from __future__ import annotations

# Largest number of frames that an exposure (ramp) may have in the simulation.
MAX_FRAMES = 4000


def frame_count(groups: int, reads: int, drops: int) -> int:
    """Return the number of frames from the reset of a detector to the last read of its ramp.

    Parameters
    ----------
    groups : int
        Number of groups of consecutive frames, at least 1; not checked.
    reads : int
        Number of frames that are read in each group.
    drops : int
        Number of frames between two groups, which are not stored.

    Returns
    -------
    int
        groups * reads + (groups - 1) * drops.
    """
    return groups * reads + (groups - 1) * drops
