"""Build and read the identifiers of sources: 64-bit integers that contain the kind and sky position of the source.

The kind is a code of 0 to 7 for the type of source: central galaxy, satellite galaxy, star and so on. All identifiers
begin with the kind and the nested HEALPix cell of order 8::

    id = kind (3 bits) << 60 | order-8 cell (20 bits) << 40 | number within the cell (40 bits)

For dark-matter halos that the simulation draws, and the galaxies in them, the last 40 bits are::

    block (17 bits) << 23 | number of the halo in its block and cell << member bits | member

A block is a range of distance along the line of sight and a bin of halo mass. An identifier therefore does not depend
on the halos in other ranges. The member is the number of a galaxy in its halo; member 0 is the central galaxy. Massive
halos are rare and have many members, so they use more bits for the member (`member_bits`).

For most other sources, the last 40 bits are::

    running number (22 bits) << 18 | member (18 bits)

For strong lenses, they are 40 random bits (`hashed_id`). Transients have the kind of stars, whose member is 0 or 1; the
highest bit of their member is 1, and the other 39 bits are random (`transient_id`). The lowest two bits of images of
lensed transients and quasars are the number of the image.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Int
from lake_schema.errors import BadInput

# HEALPix order of the cells in which sources are generated.
GENERATION_ORDER = 8
# HEALPix order of the cells into which most catalogues are divided; each cell has one file.
FILE_ORDER = 5
# Number of bits for the running number of a halo or source in its cell.
_NUMBER_BITS = 22
# Number of bits for the member, the number of a galaxy in its halo.
MEMBER_BITS = 18
# Code of stars, and of transients.
STAR_KIND = 5
# Bit of an identifier that is 1 for transients and 0 for stars: the highest bit of the member.
_TRANSIENT_BIT = np.int64(1 << MEMBER_BITS - 1)
# Number of bits of an identifier after the kind and the order-8 cell, which are its higher bits.
BLOCK_BITS = MEMBER_BITS + _NUMBER_BITS
# Number of bits of an identifier for both the number of a drawn halo and the number of a galaxy (member) in this halo.
_NUMBER_AND_MEMBER_BITS = 23
# Number of blocks (ranges of distance and halo mass). It is below 2^17, so that the highest identifiers of a cell stay
# free for halos and sources with a running number.
BLOCK_COUNT = 7 << 14
# Lowest running number in a cell whose identifiers are above those of all halos that the simulation draws in blocks.
FIRST_NUMBER = BLOCK_COUNT << _NUMBER_AND_MEMBER_BITS >> MEMBER_BITS
# Number of bits for the galaxies (members) of a drawn halo, by mass: lowest log10 mass (Msun/h) of a range, and bits.
# The bits suffice for four times the expected number of galaxies above 10^9.1 Msun/h in a halo. The rest of the 23 bits
# suffices for the halos of the densest block, a range of distance and mass in a cell
# (tests/truesky/catalogue/halos/test_halos.py).
_MEMBER_BITS_BY_MASS = ((0.0, 7), (11.5, 10), (12.5, 13), (13.5, 17), (14.5, 18), (15.0, 20))


def source_id(kind: npt.ArrayLike, cell: npt.ArrayLike, number: npt.ArrayLike, member: npt.ArrayLike = 0) -> Int:
    """Build the identifiers of sources that have a running number in their HEALPix cell.

    Parameters
    ----------
    kind : int or int array, shape (n,)
        Code of the type of source, 0 to 7, as in the column `kind`.
    cell : int or int array, shape (n,)
        Nested HEALPix cell of order 8 that contains the source, or for a galaxy its halo.
    number : int array, shape (n,)
        Running number of the source or halo in the cell, from 0, below 2^22.
    member : int or int array, shape (n,), optional
        Number of the galaxy in its halo, below 2^18; 0 for the central galaxy and for sources that are not in halos.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers.

    Raises
    ------
    BadInput
        If a value is outside its range.
    """
    kinds, numbers, members = (np.asarray(x, np.int64) for x in (kind, number, member))
    _check_range("kind", kinds, 8)
    _check_range("number", numbers, 1 << _NUMBER_BITS)
    _check_range("member", members, 1 << MEMBER_BITS)
    return np.asarray(kinds << 60 | _shifted_cell(cell) | numbers << MEMBER_BITS | members)


def member_bits(log_mass: npt.ArrayLike) -> Int:
    """Return the number of bits that an identifier reserves for the galaxies in a drawn halo of a given mass.

    `b` bits identify the central galaxy and 2^b - 1 satellites.

    Parameters
    ----------
    log_mass : float array, shape (n,)
        Lower edge of the halo's mass bin, log10 of the mass in Msun/h, at least 0.

    Returns
    -------
    int64 array, shape (n,)
        Number of bits, 7 to 20; more for higher masses.
    """
    edges, bits = (np.array(column) for column in zip(*_MEMBER_BITS_BY_MASS, strict=True))
    # Add 1e-6, because the edge of a mass bin is rounded and may be slightly below the edge in the table.
    place = np.searchsorted(edges, np.asarray(log_mass, float) + 1e-6, side="right") - 1
    return np.asarray(bits[place], np.int64)


def drawn_halo_id(cell: npt.ArrayLike, block: Int, number: Int, bits: Int) -> Int:
    """Build the identifiers of halos that the simulation draws in blocks (ranges of distance and halo mass).

    Parameters
    ----------
    cell : int or int array, shape (n,)
        Nested HEALPix cell of order 8 that contains the halo.
    block : int64 array, shape (n,)
        Number of the block (range of distance along the line of sight, and bin of mass), below `BLOCK_COUNT`.
    number : int64 array, shape (n,)
        Number of the halo, from 0, among the halos of its block in this cell, below 2^(23 - bits).
    bits : int64 array, shape (n,)
        Number of member bits, from `member_bits`.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers of the halos, which are also those of their central galaxies (kind 0, member 0).

    Raises
    ------
    BadInput
        If a value is outside its range.
    """
    _check_range("block", block, BLOCK_COUNT)
    _check_range("number in its block", number, 1 << _NUMBER_AND_MEMBER_BITS - bits)
    return np.asarray(_shifted_cell(cell) | block << _NUMBER_AND_MEMBER_BITS | number << bits)


def satellite_id(halo: Int, member: Int, bits: npt.ArrayLike = MEMBER_BITS) -> Int:
    """Build the identifiers of satellite galaxies, which have kind 1.

    Parameters
    ----------
    halo : int64 array, shape (n,)
        Identifiers of the halos that contain the satellites.
    member : int64 array, shape (n,)
        Number of the satellite in its halo, from 1, below 2^bits.
    bits : int or int array, shape (n,), optional
        Number of bits that the identifier of the halo reserves for members: `member_bits` for a drawn halo, by default
        the bits of a halo with a running number.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers.

    Raises
    ------
    BadInput
        If a member is negative or not below 2^bits.
    """
    _check_range("member", member, 1 << np.asarray(bits, np.int64))
    return np.asarray(np.int64(1) << 60 | halo | member)


def hashed_id(kind: int, cell: npt.ArrayLike, words: npt.NDArray[np.uint64]) -> Int:
    """Build the identifiers of rare sources that have no running number, from random bits.

    Parameters
    ----------
    kind : int
        Code of the type of all sources, 0 to 7; not checked.
    cell : int or int array, shape (n,)
        Nested HEALPix cell of order 8 that contains the source.
    words : uint64 array, shape (n,)
        Random 64-bit integers, one per source; their lowest 40 bits are used.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers. They may not be unique: with a thousand sources per cell, two are equal in one of two million
        cells.

    Raises
    ------
    BadInput
        If the cell does not exist.
    """
    hashed_bits = np.asarray(words, np.uint64) & np.uint64((1 << BLOCK_BITS) - 1)
    return np.asarray(np.int64(kind) << 60 | _shifted_cell(cell) | hashed_bits.astype(np.int64))


def transient_id(cell: npt.ArrayLike, words: npt.NDArray[np.uint64]) -> Int:
    """Build the identifiers of transients, such as supernovae, from random bits.

    Parameters
    ----------
    cell : int or int array, shape (n,)
        Nested HEALPix cell of order 8 that contains the transient.
    words : uint64 array, shape (n,)
        Random 64-bit integers, one per transient; 39 of their lowest 40 bits are used.

    Returns
    -------
    int64 array, shape (n,)
        Identifiers. They may not be unique: with a thousand transients per cell, two are equal in one of a million
        cells.

    Raises
    ------
    BadInput
        If the cell does not exist.
    """
    return hashed_id(STAR_KIND, cell, words) | _TRANSIENT_BIT


def is_transient(ids: Int) -> Bool:
    """Return True for the identifiers of transients."""
    return np.asarray((kind_from_id(ids) == STAR_KIND) & (ids & _TRANSIENT_BIT > 0))


def halo_from_id(ids: Int) -> Int:
    """Return the identifier of the halo of each galaxy whose halo has a running number in its cell (`source_id`).

    The bits of the kind and of the member are set to 0. The result is wrong for halos from `drawn_halo_id`, which have
    another number of member bits.
    """
    return ids & np.int64((1 << 60) - 1) & ~np.int64((1 << MEMBER_BITS) - 1)


def kind_from_id(ids: Int) -> Int:
    """Return the code of the type of each source, 0 to 7: the highest bits of its identifier."""
    return ids >> 60


def cell_from_id(ids: Int) -> Int:
    """Return the nested HEALPix cell of order 8 in the identifier of each source: where it, or its halo, was drawn."""
    return ids >> BLOCK_BITS & np.int64((1 << 2 * GENERATION_ORDER + 4) - 1)


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
