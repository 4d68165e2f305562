"""Give each simulated galaxy the spectrum of a similar observed galaxy from a training table of the user.

Similar means nearest in the rest-frame colour 0.1(g - r), the absolute magnitude M_r and redshift. The distance is the
sum of the three absolute differences, each divided by its unit (sed_assignment.toml, [nearest]).

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
from truesky.catalogue.external import mapping, reading
from truesky.catalogue.external.mapping import Columns
from truesky.catalogue.galaxies import band_ratios
from truesky.catalogue.galaxies.band_ratios import Sed
from truesky.fluxes.libraries import templates
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key
from truesky.randomness.per_source import AnyGenerator

if TYPE_CHECKING:
    from scipy.spatial import KDTree


# Columns of a training table: 0.1(g - r), absolute magnitude, redshift, real template index, extinction law, E(B-V).
_KEYS = ("color_gr_01", "abs_mag_r01", "z_true", "sed", "ext_law", "ebv")


@dataclass(frozen=True, slots=True)
class Nearness:
    """Parameters of the search for similar galaxies (sed_assignment.toml, [nearest]).

    Attributes
    ----------
    units : tuple of float
        Differences in 0.1(g - r) (mag), M_r (mag) and redshift that count as a distance of 1.
    index : float
        Standard deviation of the scatter that is added to the index of the template spectrum.
    ebv : float
        Standard deviation of the scatter that is added to E(B-V), mag.
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
        Units of distance, and scatter.
    tree : KDTree
        Search tree of 0.1(g - r), M_r and redshift, each divided by its unit in `law`.
    sed : float array, shape (n,)
        Index of the template spectrum. It is a real number: 3.4 is a mixture of the templates 3 and 4.
    ext_law : int array, shape (n,)
        Extinction law, 0 (no dust) to 4.
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
        """Return the largest E(B-V) of all galaxies in the table, mag."""
        return float(self.ebv.max())


def load(files: Sequence[Path], sha256: Sequence[str], columns: Columns) -> Training:
    """Read a training table from files, or from the disc cache if the same files have been read before.

    Parameters
    ----------
    files : sequence of Path
        Files with the rows of the table.
    sha256 : sequence of str
        SHA-256 of each file, by which the cache recognises the files.
    columns : Columns
        Mapping from the columns of the files to the properties of galaxies.

    Returns
    -------
    Training
        The training table.

    Raises
    ------
    BadInput, Damaged
        If a file cannot be read, a value is missing or out of range, a template index is beyond the library, or the
        files contain no rows. For values, the message names the file, the column and the row.
    """
    columns_json = json.dumps(sorted((key, repr(field)) for key, field in columns.fields.items()))
    last = templates.galaxy_library().flux.shape[0] - 1
    key = content_key(code_key(__name__), columns_json, last, columns.cosmology.fingerprint(), *sha256)
    limited = mapping.with_last_template(columns, last)
    return build_training(cached_arrays("training", key, lambda: _read(files, limited)), last)


def build_training(values: dict[str, Array], last: int) -> Training:
    """Return a training table from arrays of n galaxies.

    `values` has the arrays color_gr_01 and abs_mag_r01 (mag), z_true, sed (real template index), ext_law and ebv (mag).
    `last` is the index of the last template of the library.
    """
    # Import here, because scipy.spatial is slow to import and rarely needed.
    from scipy.spatial import KDTree

    law = Nearness(**parameters.section("sed_assignment.toml", "nearest"))
    tree = KDTree(_scale(law, *(values[name] for name in _KEYS[:3])))
    return Training(law, tree, values["sed"], values["ext_law"], values["ebv"], last)


def assign(training: Training, colour: Float, m_r: Float, z: Float, rng: AnyGenerator) -> Sed:
    """Return a spectrum for each galaxy: the spectrum of the most similar training galaxy, with scatter.

    The scatter is added to the template index and to E(B-V), within the range of the library and of the table.

    Parameters
    ----------
    training : Training
        The training table.
    colour : float array, shape (n,)
        Rest-frame colour 0.1(g - r): SDSS g - r in bands blueshifted to z = 0.1, mag.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
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


def _read(files: Sequence[Path], columns: Columns) -> dict[str, Array]:
    pieces = list(reading.read(files, columns))
    if not sum(len(piece.values["sed"]) for piece in pieces):
        raise BadInput(f"{files[0]}: the table has no rows")
    return {name: np.concatenate([piece.values[name] for piece in pieces]) for name in _KEYS}
