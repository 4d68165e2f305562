"""Read a table of halos of the user, for example the light-cone of an N-body simulation, which replaces drawn halos.

Masses are M_200m in Msun/h. The galaxies in these halos and their luminosities are drawn by the same model as in drawn
halos. The user's halos also lens, but the lensing maps do not contain the matter around them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lake_schema import ids, sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.units import LIGHT_KM_S
from truesky.catalogue.external import reading
from truesky.catalogue.external.mapping import Columns
from truesky.catalogue.halos import halos
from truesky.catalogue.halos.halos import HaloModel, Halos
from truesky.catalogue.halos.matching import Masses
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key
from truesky.randomness.per_source import PerSourceGenerator


@dataclass(frozen=True, slots=True, eq=False)
class LightCone:
    """The user's halos, sorted by position, then by distance.

    Attributes
    ----------
    index : int array, shape (n,)
        Position: nested index of the HEALPix cell of order 29.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    log_mass : float array, shape (n,)
        log10 M_200m / (Msun/h).
    velocity : float array, shape (n,)
        Line-of-sight peculiar velocity, km/s, positive if receding.
    """

    index: Int
    chi: Float
    log_mass: Float
    velocity: Float


def load(files: Sequence[Path], sha256: Sequence[str], columns: Columns) -> LightCone:
    """Read and check the user's halos, or map them from the disc cache if the same files have been read before.

    Parameters
    ----------
    files : sequence of Path
        Files with the halos.
    sha256 : sequence of str
        SHA-256 of each file, by which the cache recognises the files.
    columns : Columns
        Mapping from the columns of the files to the properties of halos, and the cosmology.

    Returns
    -------
    LightCone
        The halos. The first call for these files needs memory for all rows.

    Raises
    ------
    BadInput, Damaged
        If a file cannot be read, has no rows, or has a missing, wrong or repeated value. For values, the message names
        the file, the column and the row.
    """
    columns_json = json.dumps(sorted((key, repr(field)) for key, field in columns.fields.items()))
    key = content_key(code_key(__name__), columns_json, columns.cosmology.fingerprint(), *sha256)
    arrays = cached_arrays("halo_light_cone", key, lambda: _read(files, columns))
    return LightCone(**arrays)


def draw(model: HaloModel, masses: Masses, cone: LightCone, seed: int, order: int, cell: int) -> Halos:
    """Return the user's halos in a HEALPix cell that belong to the level (order) of this cell.

    The angular radius of a halo determines its level: halos that span a larger angle belong to larger cells.

    Parameters
    ----------
    model : HaloModel
        Mass limits and distance limits of the catalogue.
    masses : Masses
        Tables of halos, of which the radius is used.
    cone : LightCone
        The user's halos.
    seed : int
        Seed of the random scatter between halo mass and proxy mass (which determines luminosities).
    order, cell : int
        Order (8, 5 or 2) and nested index of the cell.

    Returns
    -------
    Halos
        Halos in the cell that may contain a galaxy that is bright enough for the catalogue.
    """
    rows = slice(*np.searchsorted(cone.index, sky.cell_range(order, cell)))
    index, velocity = cone.index[rows], cone.velocity[rows]
    chi, log_mass = cone.chi[rows], cone.log_mass[rows]
    # Number all halos of an order-8 cell in the order of `cone`, before any selection, so that the identifiers do not
    # depend on the limits of the catalogue.
    generation_cell = index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
    identifiers = ids.source_id(
        0, generation_cell, np.arange(generation_cell.size) - np.searchsorted(generation_cell, generation_cell)
    )
    proxy = (
        log_mass + model.matching.occupation.scatter * PerSourceGenerator(identifiers, seed, "halos").standard_normal()
    )
    selected = halos.levels(masses.radius(log_mass) / np.maximum(chi, 1e-3)) == order
    limit = model.mass_limit(chi)
    selected &= (log_mass >= limit + model.host_offset) | (proxy >= limit)
    selected &= (chi > model.steps.edge[0]) & (chi < model.max_distance + model.box.model.cell)
    drawn = Halos(index, chi, log_mass, proxy, velocity, identifiers, np.full(identifiers.size, ids.MEMBER_BITS))
    return drawn.select(np.flatnonzero(selected))


def _read(files: Sequence[Path], columns: Columns) -> dict[str, Array]:
    pieces = list(reading.read(files, columns))
    if not sum(len(piece.values["ra"]) for piece in pieces):
        raise BadInput(f"{files[0]}: the table has no rows")
    values = {name: np.concatenate([piece.values[name] for piece in pieces]) for name in pieces[0].values}
    ra, dec = sky.check_positions(values["ra"], values["dec"])
    index, z = sky.healpix_29(ra, dec), values["z_true"]
    chi = columns.cosmology.comoving_distance(z)
    if "origin_id" in values:
        _refuse_duplicates(pieces, columns.fields["origin_id"].column)
    velocity = values.get("velocity", np.zeros(z.size))
    if "z_obs" in values:
        velocity = LIGHT_KM_S * ((1.0 + values["z_obs"]) / (1.0 + z) - 1.0)
    order = np.lexsort((chi, index))
    arrays = {"index": index, "chi": chi, "log_mass": values["log_mass"], "velocity": velocity}
    return {name: np.asarray(column)[order] for name, column in arrays.items()}


def _refuse_duplicates(pieces: Sequence[reading.Rows], column: str) -> None:
    identifiers = np.concatenate([piece.values["origin_id"] for piece in pieces])
    order = np.argsort(identifiers, kind="stable")
    duplicates = np.flatnonzero(np.diff(identifiers[order]) == 0)
    if not duplicates.size:
        return
    edges = np.cumsum([len(piece.values["origin_id"]) for piece in pieces])

    def place(row: int) -> tuple[int, Path]:
        piece_number = int(np.searchsorted(edges, row, side="right"))
        return pieces[piece_number].first + row - (0 if piece_number == 0 else int(edges[piece_number - 1])), pieces[
            piece_number
        ].file

    (row, file), (other, where) = (place(int(order[duplicates[0] + i])) for i in (1, 0))
    raise BadInput(
        f"{file}: column {column} of row {row} is {identifiers[order[duplicates[0]]]}, as in row {other} of {where}"
    )
