"""Build and read source identifiers: 64-bit integers made of the source's kind, sky cell, halo and member.

All identifiers begin with the kind and the nested HEALPix cell of order 8::

    id = kind (3 bits) << 60 | order-8 cell (20 bits) << 40 | number within the cell (40 bits)

For drawn halos and the galaxies in them, the last 40 bits are::

    block (17 bits) << 23 | number of the halo in its block and cell << member bits | member

A block is a step along the line of sight and a bin of halo mass, so an identifier does not depend on which other halos
are drawn. Member 0 is the central galaxy. Massive halos are rare and have many members, so they use more member bits
(`member_bits`).

For most other sources, the last 40 bits are::

    running number (22 bits) << 18 | member (18 bits)

For strong lenses, they are 40 random bits (`hashed_id`).
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
# Identifiers that differ above these bits belong to different kinds or generation cells.
BLOCK_BITS = MEMBER_BITS + _NUMBER_BITS
# The number and the member of a drawn halo share these bits. Blocks end below the running numbers of other kinds.
_NUMBER_AND_MEMBER_BITS = 23
BLOCK_COUNT = 7 << 14
FIRST_NUMBER = BLOCK_COUNT << _NUMBER_AND_MEMBER_BITS >> MEMBER_BITS
# Lowest log10 halo mass (Msun/h) and number of member bits. They suffice for four times the expected number of members
# above 10^9.1 Msun/h, and for the halos of the densest block of the sky (tests/truesky/catalogue/halos/test_halos.py).
_MEMBER_BITS_BY_MASS = ((0.0, 7), (11.5, 10), (12.5, 13), (13.5, 17), (14.5, 18), (15.0, 20))


def source_id(kind: npt.ArrayLike, cell: npt.ArrayLike, number: npt.ArrayLike, member: npt.ArrayLike = 0) -> Int:
    """Build the identifiers of sources that are numbered within their cell.

    Parameters
    ----------
    kind : int or int array, shape (n,)
        Kind code, 0 to 7.
    cell : int or int array, shape (n,)
        Nested cell of order 8 that contains the halo.
    number : int array, shape (n,)
        Running number of the halo in the cell, below 2^22.
    member : int or int array, shape (n,), optional
        Number of the member in the halo, below 2^18.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers.

    Raises
    ------
    BadInput
        If a value is negative or needs more bits than it has.
    """
    kinds, numbers, members = (np.asarray(x, np.int64) for x in (kind, number, member))
    _check_range("kind", kinds, 8)
    _check_range("number", numbers, 1 << _NUMBER_BITS)
    _check_range("member", members, 1 << MEMBER_BITS)
    return np.asarray(kinds << 60 | _shifted_cell(cell) | numbers << MEMBER_BITS | members)


def member_bits(log_mass: npt.ArrayLike) -> Int:
    """Return the number of member bits of drawn halos; `bits` bits identify 2^bits - 1 satellites.

    Parameters
    ----------
    log_mass : float array, shape (n,)
        Lower edge of the halo's mass bin, log10 of the mass in Msun/h.

    Returns
    -------
    int64 array, shape (n,)
        Number of bits, 7 to 20.
    """
    edges, bits = (np.array(column) for column in zip(*_MEMBER_BITS_BY_MASS, strict=True))
    # The edges of the bins are rounded multiples of the bin width.
    place = np.searchsorted(edges, np.asarray(log_mass, float) + 1e-6, side="right") - 1
    return np.asarray(bits[place], np.int64)


def drawn_halo_id(cell: npt.ArrayLike, block: Int, number: Int, bits: Int) -> Int:
    """Build the identifiers of halos that are drawn in blocks.

    Parameters
    ----------
    cell : int or int array, shape (n,)
        Nested cell of order 8 that contains the halo.
    block : int64 array, shape (n,)
        Number of the block: a step along the line of sight and a bin of mass.
    number : int64 array, shape (n,)
        Number of the halo among the halos of its block in this cell.
    bits : int64 array, shape (n,)
        Number of member bits, from `member_bits`.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers of the central galaxies (kind 0, member 0).

    Raises
    ------
    BadInput
        If a value is negative or needs more bits than it has.
    """
    _check_range("block", block, BLOCK_COUNT)
    _check_range("number in its block", number, 1 << _NUMBER_AND_MEMBER_BITS - bits)
    return np.asarray(_shifted_cell(cell) | block << _NUMBER_AND_MEMBER_BITS | number << bits)


def satellite_id(halo: Int, member: Int, bits: npt.ArrayLike = MEMBER_BITS) -> Int:
    """Build the identifiers of satellite galaxies, which have kind 1.

    Parameters
    ----------
    halo : int64 array, shape (n,)
        Identifiers of their halos.
    member : int64 array, shape (n,)
        Number of the satellite in its halo, from 1.
    bits : int or int array, optional
        Number of member bits of the halos.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers.

    Raises
    ------
    BadInput
        If a member is negative or needs more bits than it has.
    """
    _check_range("member", member, 1 << np.asarray(bits, np.int64))
    return np.asarray(np.int64(1) << 60 | halo | member)


def hashed_id(kind: int, cell: int, words: npt.NDArray[np.uint64]) -> Int:
    """Build the identifiers of rare sources that have no number, from 40 bits of a random word.

    Parameters
    ----------
    kind : int
        Kind code of all sources.
    cell : int
        Nested cell of order 8 that contains all sources.
    words : uint64 array, shape (n,)
        Random words, one per source.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers.

    Notes
    -----
    Among a thousand sources in a cell, two have the same identifier in one of two million cells.
    """
    hashed_bits = np.asarray(words, np.uint64) & np.uint64((1 << BLOCK_BITS) - 1)
    return np.asarray(np.int64(kind) << 60 | _shifted_cell(cell) | hashed_bits.astype(np.int64))


def halo_from_id(ids: Int) -> Int:
    """Return the halo identifier of each source that is numbered in its cell, by clearing the kind and member bits."""
    return ids & np.int64((1 << 60) - 1) & ~np.int64((1 << MEMBER_BITS) - 1)


def kind_from_id(ids: Int) -> Int:
    """Return the kind code of each source."""
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
