"""Count the frames of a MACC (multiple accumulated sampling) ramp of the near-infrared detectors.

References
----------
Euclid Collaboration: Serrano et al. 2024 (MACC: multiple accumulated groups)
"""

from __future__ import annotations

# Largest number of frames in a ramp that is simulated.
MAX_FRAMES = 4000


def frame_count(groups: int, reads: int, drops: int) -> int:
    """Return the number of frames from the reset to the last read of a ramp.

    Parameters
    ----------
    groups : int
        Number of groups.
    reads : int
        Frames that are read in each group.
    drops : int
        Frames that are dropped between two groups.

    Returns
    -------
    int
        groups * reads + (groups - 1) * drops.
    """
    return groups * reads + (groups - 1) * drops
