"""How many frames a ramp has, and may have.

Ref : Euclid Collaboration: Serrano et al. 2024 (MACC: multiple accumulated groups)
"""

from __future__ import annotations

# Of a ramp: more are not drawn.
MAX_FRAMES = 4000


def frame_count(groups: int, reads: int, drops: int) -> int:
    """Of groups of reads, with drops between two groups: from the reset to the last read."""
    return groups * reads + (groups - 1) * drops
