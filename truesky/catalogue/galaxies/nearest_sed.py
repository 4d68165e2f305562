"""Spectra by the nearest of many observed galaxies, in colour, luminosity and redshift: an external training table.

load     the galaxies of a request's files, checked, from the cache or read now
assign   the spectrum of the nearest one, scattered

Near is by the sum of the differences in 0.1(g - r), M_r and z, each in its own unit (sed_assignment.toml, [nearest]).
Ref: Serrano et al. 2024, "Spectral energy distributions"
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput
from truesky.catalogue import parameters
from truesky.catalogue.external import mapping
from truesky.catalogue.external.mapping import Columns
from truesky.catalogue.galaxies import band_ratios
from truesky.catalogue.galaxies.band_ratios import Sed
from truesky.fluxes.libraries import templates
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key
from truesky.randomness.per_source import AnyGenerator

if TYPE_CHECKING:
    from scipy.spatial import KDTree


_KEYS = ("color_gr_01", "abs_mag_r01", "z_true", "sed", "ext_law", "ebv")


@dataclass(frozen=True, slots=True)
class Nearness:
    """What counts as near, and how much is added (sed_assignment.toml, [nearest]).

    units : of 0.1(g - r), M_r and z;  index, ebv : scatter of the template's index and of E(B-V)
    """

    units: tuple[float, float, float]
    index: float
    ebv: float


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """n observed galaxies.

    tree : of their 0.1(g - r), M_r and z in the units of `law`;  sed : real index of the template;  last : of templates
    """

    law: Nearness
    tree: KDTree
    sed: Float
    ext_law: Int
    ebv: Float
    last: int

    @property
    def dustiest(self) -> float:
        """The largest E(B-V)."""
        return float(self.ebv.max())


def load(files: Sequence[Path], sha256: Sequence[str], columns: Columns) -> Training:
    """The training table of files.

    Errors: BadInput or Damaged names file, column and row of what cannot be used
    """
    columns_json = json.dumps(sorted((key, repr(field)) for key, field in columns.fields.items()))
    last = templates.galaxy_library().flux.shape[0] - 1
    key = content_key(code_key(__name__), columns_json, last, *sha256)
    return build_training(cached_arrays("training", key, lambda: _read(files, columns, last)), last)


def build_training(values: dict[str, Array], last: int) -> Training:
    """Of columns by our key.

    values : float[t] each: colour 0.1(g - r) mag, m_r mag, z, sed, ext_law, ebv mag;  last : template of the library
    """
    # Slow to import, and seldom needed.
    from scipy.spatial import KDTree

    law = Nearness(**parameters.section("sed_assignment.toml", "nearest"))
    tree = KDTree(_scale(law, *(values[name] for name in _KEYS[:3])))
    return Training(law, tree, values["sed"], values["ext_law"], values["ebv"], last)


def assign(training: Training, colour: Float, m_r: Float, z: Float, rng: AnyGenerator) -> Sed:
    """Spectra[n] of galaxies of 0.1(g - r), M_r and z.

    colour, m_r, z : float[n] 0.1(g - r) mag, M_r mag, redshift
    given          : observed galaxies with their spectra;  rng : of the scatter
    """
    law, n = training.law, colour.size
    _, nearest = training.tree.query(_scale(law, colour, m_r, z), p=1)
    index = np.clip(training.sed[nearest] + law.index * rng.standard_normal(n), 0.0, training.last)
    # Without a law there is no dust to scatter.
    dusty = training.ext_law[nearest] > 0
    ebv = np.clip(training.ebv[nearest] + law.ebv * rng.standard_normal(n), 0.0, training.dustiest)
    return band_ratios.sed_of_index(index, training.ext_law[nearest], np.where(dusty, ebv, 0.0))


def _scale(law: Nearness, colour: Float, m_r: Float, z: Float) -> Float:
    return np.asarray(np.stack([colour, m_r, z], 1) / np.array(law.units))


def _read(files: Sequence[Path], columns: Columns, last: int) -> dict[str, Array]:
    pieces = list(mapping.read(files, columns))
    for piece in pieces:
        is_unknown = piece.values["sed"] > last
        if is_unknown.any():
            row = int(is_unknown.argmax())
            where = f"{piece.file}: column {columns.fields['sed'].column} (sed) of row {piece.first + row}"
            raise BadInput(f"{where} is {piece.values['sed'][row]:g}, the library's last template is {last}")
    if not sum(len(piece.values["sed"]) for piece in pieces):
        raise BadInput(f"{files[0]}: holds no galaxy")
    return {name: np.concatenate([piece.values[name] for piece in pieces]) for name in _KEYS}
