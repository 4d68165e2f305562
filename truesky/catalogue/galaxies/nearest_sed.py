"""Spectra from the nearest of many observed galaxies in colour, luminosity and redshift: the user's training table.

The distance is the sum of the differences in 0.1(g - r), M_r and z, each divided by its unit (sed_assignment.toml,
[nearest]).

References
----------
Serrano et al. 2024, "Spectral energy distributions"
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
    """Units of distance, and scatter (sed_assignment.toml, [nearest]).

    Attributes
    ----------
    units : tuple of float
        Units of 0.1(g - r), M_r and z.
    index : float
        Scatter of the template's index.
    ebv : float
        Scatter of E(B-V), mag.
    """

    units: tuple[float, float, float]
    index: float
    ebv: float


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """Training table of n observed galaxies.

    Attributes
    ----------
    law : Nearness
        Units and scatter.
    tree : KDTree
        Tree of 0.1(g - r), M_r and z in the units of `law`.
    sed : float array, shape (n,)
        Real index of the template.
    ext_law : int array, shape (n,)
        Extinction law.
    ebv : float array, shape (n,)
        E(B-V), mag.
    last : int
        Index of the last template of the library.
    """

    law: Nearness
    tree: KDTree
    sed: Float
    ext_law: Int
    ebv: Float
    last: int

    @property
    def dustiest(self) -> float:
        """Return the largest E(B-V), mag."""
        return float(self.ebv.max())


def load(files: Sequence[Path], sha256: Sequence[str], columns: Columns) -> Training:
    """Return the training table of files, from the cache or read now.

    Parameters
    ----------
    files : sequence of Path
        Files of the table.
    sha256 : sequence of str
        SHA-256 of the files, which identify the cached copy.
    columns : Columns
        Mapping of the columns.

    Returns
    -------
    Training
        The table.

    Raises
    ------
    BadInput, Damaged
        If a value cannot be used; the message names the file, the column and the row.
    """
    columns_json = json.dumps(sorted((key, repr(field)) for key, field in columns.fields.items()))
    last = templates.galaxy_library().flux.shape[0] - 1
    key = content_key(code_key(__name__), columns_json, last, *sha256)
    return build_training(cached_arrays("training", key, lambda: _read(files, columns, last)), last)


def build_training(values: dict[str, Array], last: int) -> Training:
    """Return a training table from columns: color_gr_01 and abs_mag_r01 (mag), z_true, sed, ext_law, ebv (mag)."""
    # Import here, because scipy.spatial is slow to import and rarely needed.
    from scipy.spatial import KDTree

    law = Nearness(**parameters.section("sed_assignment.toml", "nearest"))
    tree = KDTree(_scale(law, *(values[name] for name in _KEYS[:3])))
    return Training(law, tree, values["sed"], values["ext_law"], values["ebv"], last)


def assign(training: Training, colour: Float, m_r: Float, z: Float, rng: AnyGenerator) -> Sed:
    """Return a spectrum for each galaxy: the spectrum of the nearest training galaxy, with scatter.

    Parameters
    ----------
    training : Training
        The training table.
    colour : float array, shape (n,)
        0.1(g - r), mag.
    m_r : float array, shape (n,)
        M_r, mag.
    z : float array, shape (n,)
        Redshift.
    rng : AnyGenerator
        Random numbers of the scatter.

    Returns
    -------
    Sed
        Spectra.
    """
    law, n = training.law, colour.size
    _, nearest = training.tree.query(_scale(law, colour, m_r, z), p=1)
    index = np.clip(training.sed[nearest] + law.index * rng.standard_normal(n), 0.0, training.last)
    # Do not add scatter to galaxies without an extinction law, because they have no dust.
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
        raise BadInput(f"{files[0]}: the table has no rows")
    return {name: np.concatenate([piece.values[name] for piece in pieces]) for name in _KEYS}
