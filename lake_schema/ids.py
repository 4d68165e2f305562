"""Source identifiers: int64 that carry the kind, the order-5 cell, the parent halo and the member.

id = kind (3 bits) << 60 | order-5 cell, nested (14) << 46 | index (28) << 18 | member (18; 0 = the halo's own central)
index = generation cell within the order-5 cell (6 bits) << 22 | running number in that generation cell (22)
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Int
from lake_schema.errors import BadInput

GENERATION_ORDER = 8
FILE_ORDER = 5
_SUB_BITS = 2 * (GENERATION_ORDER - FILE_ORDER)
_NUMBER_BITS = 22
_MEMBER_BITS = 18
_FILE_BITS = _MEMBER_BITS + _NUMBER_BITS + _SUB_BITS
# Identifiers that differ above these bits stand for another kind or another generation cell.
BLOCK_BITS = _MEMBER_BITS + _NUMBER_BITS


def source_id(kind: npt.ArrayLike, cell: npt.ArrayLike, number: npt.ArrayLike, member: npt.ArrayLike = 0) -> Int:
    """Identifiers of sources.

    kind : int[n]; cell : int or int[n], order-8 nested cell that the halo lies in
    number : int[n] running number of the halo in the cell; member : int[n]
    returns int64[n].  Errors: BadInput where a number needs more bits than it has
    """
    kinds, numbers, members = (np.asarray(x, np.int64) for x in (kind, number, member))
    for name, values, bits in (
        ("kind", kinds, 3),
        ("number", numbers, _NUMBER_BITS),
        ("member", members, _MEMBER_BITS),
    ):
        if values.size and (values.min() < 0 or values.max() >= 1 << bits):
            raise BadInput(f"source id: {name} needs {bits} bits, got {values.min()} .. {values.max()}")
    cells = np.asarray(cell, np.int64)
    beyond = (cells < 0) | (cells >= 12 << (2 * GENERATION_ORDER))
    if beyond.any():
        raise BadInput(f"source id: {cells[beyond].ravel()[0]} is not a cell of order {GENERATION_ORDER}")
    file_cells, sub = cells >> _SUB_BITS, cells & ((1 << _SUB_BITS) - 1)
    index = sub << _NUMBER_BITS | numbers
    return np.asarray(kinds << 60 | file_cells << _FILE_BITS | index << _MEMBER_BITS | members)


def halo_of(ids: Int) -> Int:
    """int64[n] -> identifier of each source's halo: the kind and member bits cleared."""
    return ids & np.int64((1 << 60) - 1) & ~np.int64((1 << _MEMBER_BITS) - 1)


def kind_of(ids: Int) -> Int:
    """int64[n] -> kind code of each source."""
    return ids >> 60
