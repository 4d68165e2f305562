"""Source identifiers: int64 that carry the kind, the order-8 cell, the parent halo and the member.

id = kind (3 bits) << 60 | order-8 cell, nested (20) << 40 | which one in its cell (40)

Of halos that are drawn, and of the galaxies in them (member 0 is the central), the last 40 bits are
    block (17) << 23 | number of the halo in its block and cell << bits of a member | member
where a block is a step along the line of sight and a bin of mass: an identifier does not depend on which other halos
are drawn. Massive halos are few and have many members: more bits are a member's in them (`member_bits`).
Of most other sources these bits are
    running number (22) << 18 | member (18)
and of strong lenses bits of a number of their own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Int
from lake_schema.errors import BadInput

GENERATION_ORDER = 8
FILE_ORDER = 5
_NUMBER_BITS = 22
MEMBER_BITS = 18
# Identifiers that differ above these bits stand for another kind or another generation cell.
BLOCK_BITS = MEMBER_BITS + _NUMBER_BITS
# Number and member of drawn halos share so many bits.  Blocks end where the running numbers of other kinds begin.
_NUMBER_AND_MEMBER_BITS = 23
BLOCK_COUNT = 7 << 14
FIRST_NUMBER = BLOCK_COUNT << _NUMBER_AND_MEMBER_BITS >> MEMBER_BITS
# Bits of a member of halos of at least this log10 mass, Msun/h: four times what they have above 10^9.1 are identified,
# and the densest block of the sky has room for its halos (tests/truesky/catalogue/halos/test_halos.py).
_MEMBER_BITS_BY_MASS = ((0.0, 7), (11.5, 10), (12.5, 13), (13.5, 17), (14.5, 18), (15.0, 20))


def source_id(kind: npt.ArrayLike, cell: npt.ArrayLike, number: npt.ArrayLike, member: npt.ArrayLike = 0) -> Int:
    """Identifiers of sources that are numbered in their cell.

    kind : int[n]; cell : int or int[n], order-8 nested cell that the halo lies in
    number : int[n] running number of the halo in the cell; member : int[n]
    returns int64[n].  Errors: BadInput where a number needs more bits than it has
    """
    kinds, numbers, members = (np.asarray(x, np.int64) for x in (kind, number, member))
    _check_range("kind", kinds, 8)
    _check_range("number", numbers, 1 << _NUMBER_BITS)
    _check_range("member", members, 1 << MEMBER_BITS)
    return np.asarray(kinds << 60 | _shifted_cell(cell) | numbers << MEMBER_BITS | members)


def member_bits(log_mass: npt.ArrayLike) -> Int:
    """Bits[n] of a member of drawn halos: which 2^bits - 1 satellites have identifiers.

    log_mass : float[n] log10 Msun/h, the lower edge of the halo's bin
    """
    edges, bits = (np.array(column) for column in zip(*_MEMBER_BITS_BY_MASS, strict=True))
    # Edges of bins are multiples that are rounded.
    place = np.searchsorted(edges, np.asarray(log_mass, float) + 1e-6, side="right") - 1
    return np.asarray(bits[place], np.int64)


def drawn_halo_id(cell: npt.ArrayLike, block: Int, number: Int, bits: Int) -> Int:
    """Identifiers[n] of halos that are drawn by blocks.

    cell  : int or int[n], order-8 nested cell that the halo lies in;  block : int64[n]
    number : int64[n] of the halo among those of its block in this cell;  bits : int64[n] as of `member_bits`
    Errors: BadInput where a number needs more bits than it has
    """
    _check_range("block", block, BLOCK_COUNT)
    _check_range("number in its block", number, 1 << _NUMBER_AND_MEMBER_BITS - bits)
    return np.asarray(_shifted_cell(cell) | block << _NUMBER_AND_MEMBER_BITS | number << bits)


def satellite_id(halo: Int, member: Int, bits: npt.ArrayLike = MEMBER_BITS) -> Int:
    """Identifiers[n] of satellites: kind 1.

    halo : int64[n] identifiers of their halos;  member : int64[n] from 1;  bits : of a member
    Errors: BadInput where a member needs more bits than it has
    """
    _check_range("member", member, 1 << np.asarray(bits, np.int64))
    return np.asarray(np.int64(1) << 60 | halo | member)


def hashed_id(kind: int, cell: int, words: npt.NDArray[np.uint64]) -> Int:
    """Identifiers[n] of rare sources that have no number, of 40 bits of a word of their own.

    kind, cell : of all;  words : uint64[n], random: of a thousand in a cell two are the same once in two million cells
    """
    hashed_bits = np.asarray(words, np.uint64) & np.uint64((1 << BLOCK_BITS) - 1)
    return np.asarray(np.int64(kind) << 60 | _shifted_cell(cell) | hashed_bits.astype(np.int64))


def halo_from_id(ids: Int) -> Int:
    """int64[n] -> identifier of the halo of each source that is numbered in its cell: kind and member bits cleared."""
    return ids & np.int64((1 << 60) - 1) & ~np.int64((1 << MEMBER_BITS) - 1)


def kind_from_id(ids: Int) -> Int:
    """int64[n] -> kind code of each source."""
    return ids >> 60


def _shifted_cell(cell: npt.ArrayLike) -> Int:
    cells = np.asarray(cell, np.int64)
    invalid = (cells < 0) | (cells >= 12 << (2 * GENERATION_ORDER))
    if invalid.any():
        raise BadInput(f"source id: {cells[invalid].ravel()[0]} is not a cell of order {GENERATION_ORDER}")
    return np.asarray(cells << BLOCK_BITS)


def _check_range(name: str, values: Int, limit: int | Int) -> None:
    invalid = (values < 0) | (values >= limit)
    if np.any(invalid):
        first = np.asarray(values)[invalid].ravel()[0] if np.ndim(values) else values
        first_limit = np.broadcast_to(limit, np.shape(values))[invalid].ravel()[0] if np.ndim(values) else limit
        raise BadInput(f"source id: {name} {first} is not in 0 .. {first_limit - 1}")
