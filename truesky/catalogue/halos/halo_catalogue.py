"""A halo light-cone of a simulation in place of ours.

load   the halos of a request's files, checked, from the cache or read now
draw   those of one cell and level, with the scatter that decides which galaxies they hold

Masses are M_200m in Msun/h. Galaxies and their abundance stay those of our own universe. These halos lens as ours do;
the structure in the lensing maps is not theirs.
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
from truesky.catalogue.external import mapping
from truesky.catalogue.external.mapping import Columns
from truesky.catalogue.halos import halos
from truesky.catalogue.halos.halos import HaloModel, Halos
from truesky.catalogue.halos.matching import Masses
from truesky.fluxes import cosmology
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_keys import code_key
from truesky.randomness.keyed import Keyed


@dataclass(frozen=True, slots=True, eq=False)
class LightCone:
    """n halos, sorted by index.

    index : order-29 cell;  chi : Mpc/h;  log_mass : log10 M_200m / (Msun/h);  velocity : km/s, receding
    """

    index: Int
    chi: Float
    log_mass: Float
    velocity: Float


def load(found: Sequence[Path], sha256: Sequence[str], columns: Columns) -> LightCone:
    """The halos of files; all of them are held in memory once, and mapped from the cache afterwards.

    Errors: BadInput or Damaged names file, column and row of what cannot be used
    """
    about = json.dumps(sorted((key, repr(field)) for key, field in columns.fields.items()))
    arrays = cached_arrays(
        "halo_light_cone", content_key(code_key(__name__), about, *sha256), lambda: _read(found, columns)
    )
    return LightCone(**arrays)


def draw(model: HaloModel, masses: Masses, cone: LightCone, seed: int, order: int, cell: int) -> Halos:
    """The halos of one level in a nested cell of its order; kept are those that halos.draw would keep.

    model, masses : of our own halos: levels and limits, and tables of masses
    cone          : the external halos;  seed : of the request;  order, cell : of the nested cell
    """
    rows = slice(*np.searchsorted(cone.index, sky.cell_range(order, cell)))
    index, velocity = cone.index[rows], cone.velocity[rows]
    chi, log_mass = cone.chi[rows], cone.log_mass[rows]
    # Numbered in their generation cells as the file has them, whatever is kept.
    home = index >> 2 * (sky.DEEPEST - GENERATION_ORDER)
    own = ids.source_id(0, home, np.arange(home.size) - np.searchsorted(home, home))
    proxy = log_mass + model.matching.occupation.scatter * Keyed(own, seed, "halos").standard_normal()
    kept = halos.levels(masses.radius(log_mass) / np.maximum(chi, 1e-3)) == order
    limit = model.mass_limit(chi)
    kept &= (log_mass >= limit + model.host_offset) | (proxy >= limit)
    kept &= (chi > model.line.edge[0]) & (chi < model.far + model.box.model.cell)
    found = Halos(index, chi, log_mass, proxy, velocity, own, np.full(own.size, ids.MEMBER_BITS))
    return found.part(np.flatnonzero(kept))


def _read(found: Sequence[Path], columns: Columns) -> dict[str, Array]:
    pieces = list(mapping.read(found, columns))
    if not sum(len(piece.values["ra"]) for piece in pieces):
        raise BadInput(f"{found[0]}: holds no halo")
    values = {name: np.concatenate([piece.values[name] for piece in pieces]) for name in pieces[0].values}
    ra, dec = sky.checked(values["ra"], values["dec"])
    index, z = sky.healpix_29(ra, dec), values["z_true"]
    chi = cosmology.comoving_distance(z)
    if "origin_id" in values:
        _refuse_twice(pieces, columns.fields["origin_id"].column)
    velocity = values.get("velocity", np.zeros(z.size))
    if "z_obs" in values:
        velocity = LIGHT_KM_S * ((1.0 + values["z_obs"]) / (1.0 + z) - 1.0)
    order = np.lexsort((chi, index))
    arrays = {"index": index, "chi": chi, "log_mass": values["log_mass"], "velocity": velocity}
    return {name: np.asarray(column)[order] for name, column in arrays.items()}


def _refuse_twice(pieces: Sequence[mapping.Rows], column: str) -> None:
    own = np.concatenate([piece.values["origin_id"] for piece in pieces])
    order = np.argsort(own, kind="stable")
    same = np.flatnonzero(np.diff(own[order]) == 0)
    if not same.size:
        return
    edges = np.cumsum([len(piece.values["origin_id"]) for piece in pieces])

    def place(row: int) -> tuple[int, Path]:
        which = int(np.searchsorted(edges, row, side="right"))
        return pieces[which].first + row - (0 if which == 0 else int(edges[which - 1])), pieces[which].file

    (row, file), (other, where) = (place(int(order[same[0] + i])) for i in (1, 0))
    raise BadInput(f"{file}: column {column} of row {row} is {own[order[same[0]]]}, as in row {other} of {where}")
