"""Convert rows of the catalogue tables `galaxies` and `stars` to checked arrays, from which spectra are computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.spectra import lines
from truesky.fluxes.spectra.continuum import COMPONENTS, TemplateMix, check_range, mix_from_columns, take_last_axis

# Largest lensing magnification that is accepted.
MAGNIFICATION_MAX = 100.0
# Numbers k of the columns sed_k and frac_k, which add up to three templates to a star's template `sed`.
STAR_COMPONENTS = (2, 3, 4)
# Values of the column `kind` whose templates are in the galaxy library: 0 central, 1 satellite, 4 strong lens.
GALAXY_KINDS = (0, 1, 4)


@dataclass(frozen=True, slots=True)
class Galaxies:
    """Properties of n galaxies that set their spectra.

    Attributes
    ----------
    mix : TemplateMix
        Redshift, and two templates with their dust, of each galaxy.
    abs_mag_r01, mag_r01 : float array, shape (n,)
        Absolute (M - 5 log10 h) and apparent AB magnitude in the reference band 0.1r, before lensing and Milky Way
        extinction.
    lines : float array, shape (n, n_line)
        Flux of each line of lines.line_list() in erg s-1 cm-2, 0 without a line.
    magnification : float array, shape (n,)
        Flux magnification by gravitational lensing, 1 without lensing.
    a_v : float array, shape (n,)
        Extinction A(V) of the Milky Way in mag.
    """

    mix: TemplateMix
    abs_mag_r01: Float
    mag_r01: Float
    lines: Float
    magnification: Float
    a_v: Float

    def __post_init__(self) -> None:
        # Check the shape here, because compiled code reads all lines without checking array bounds.
        expected_shape = len(self.mix), len(lines.line_list())
        if self.lines.shape != expected_shape:
            raise ValueError(f"lines are of shape {self.lines.shape}, not {expected_shape}")

    def __len__(self) -> int:
        return len(self.mix)

    def select(self, indices: Int | slice) -> Galaxies:
        """Return the galaxies with the given indices, or in the given slice."""
        return Galaxies(
            self.mix.select(indices),
            take_last_axis(self.abs_mag_r01, indices),
            take_last_axis(self.mag_r01, indices),
            self.lines[indices] if isinstance(indices, slice) else np.take(self.lines, indices, 0),
            take_last_axis(self.magnification, indices),
            take_last_axis(self.a_v, indices),
        )


@dataclass(frozen=True, slots=True)
class Stars:
    """Properties of n stars that set their spectra. The spectrum of a star is a mixture of up to k templates.

    Attributes
    ----------
    sed : int array, shape (k, n)
        Indices of the templates in the stellar library.
    frac : float array, shape (k, n)
        Fraction of each template in f_lambda at 5500 A; 0 for a template that is not used.
    mag_h : float array, shape (n,)
        H magnitude (Vega) before extinction.
    a_v : float array, shape (n,)
        Extinction A(V) of the Milky Way in mag.
    """

    sed: Int
    frac: Float
    mag_h: Float
    a_v: Float

    def __len__(self) -> int:
        return len(self.mag_h)

    def select(self, indices: Int | slice) -> Stars:
        """Return the stars with the given indices, or in the given slice."""
        return Stars(self.sed[:, indices], self.frac[:, indices], self.mag_h[indices], self.a_v[indices])

    @classmethod
    def from_templates(cls, sed: Int, mag_h: Float, a_v: Float) -> Stars:
        """Return stars with a single template each.

        Parameters
        ----------
        sed : int array, shape (n,)
            Index of each star's template in the stellar library.
        mag_h : float array, shape (n,)
            H magnitudes (Vega) before extinction.
        a_v : float array, shape (n,)
            Extinction A(V) in mag.

        Returns
        -------
        Stars
            The stars.
        """
        return cls(sed[None, :], np.ones((1, sed.size)), mag_h, a_v)


def galaxies_from_table(table: pa.Table, library: Library) -> Galaxies:
    """Check rows of the table `galaxies`, and convert them to arrays.

    Parameters
    ----------
    table : pa.Table
        Rows with `kind` 0, 1 or 4 (central, satellite, strong lens), or without a column `kind`.
    library : Library
        Templates to which sed_1 and sed_2 refer.

    Returns
    -------
    Galaxies
        The galaxies.

    Raises
    ------
    BadInput
        If a column is missing, a value is null or NaN, or `kind` is another number. The message names the column and
        the source.
    OutOfRange
        If a value is outside its declared bounds, or a magnification is not in (0, 100]. The message names the column.
    """
    _refuse_other_kinds(table)
    names = ["z_obs", *(f"{name}_{k}" for name in ("sed", "frac", "ext_law", "ebv") for k in COMPONENTS)]
    columns = {name: column(table, name) for name in names}
    a_v = column(table, "a_v")
    _check_declared_range("a_v", a_v)
    return Galaxies(
        mix_from_columns(columns, library),
        _check_declared_range("abs_mag_r01", column(table, "abs_mag_r01")),
        _check_declared_range("mag_r01", column(table, "mag_r01")),
        _line_fluxes(table),
        table_magnification(table),
        a_v,
    )


def stars_from_table(table: pa.Table, library: Library) -> Stars:
    """Check rows of the table `stars`, and convert them to arrays.

    `library` has the templates to which the columns `sed`, sed_2, sed_3 and sed_4 refer. If a column sed_k is missing
    or contains only nulls, frac_k is not read and counts as 0. Otherwise a null or NaN in frac_k counts as 0. Raises
    BadInput if another required column or value is missing. Raises OutOfRange if a value is out of bounds, or if sed_k
    is null although frac_k is above 0.
    """
    mag_h, a_v = (column(table, name) for name in ("mag_h", "a_v"))
    for name, values in (("mag_h", mag_h), ("a_v", a_v)):
        declared = STARS.column(name)
        check_range(name, values, _required_bound(declared.lo), _required_bound(declared.hi))
    sed, frac = [column(table, "sed")], []
    check_range("sed", sed[0], 0, len(library) - 1)
    for k in STAR_COMPONENTS:
        if f"sed_{k}" not in table.column_names or table[f"sed_{k}"].null_count == table.num_rows:
            continue
        frac.append(np.nan_to_num(_floats(table, f"frac_{k}"), nan=0.0, posinf=np.inf))
        check_range(f"frac_{k}", frac[-1], 0.0, 1.0)
        sed.append(np.where(frac[-1] > 0.0, _floats(table, f"sed_{k}"), sed[0]))
        check_range(f"sed_{k}", sed[-1], 0, len(library) - 1)
    shares = np.stack([np.ones(table.num_rows), *frac])
    shares[0] = 1.0 - shares[1:].sum(0)
    check_range("1 - frac_2 - frac_3 - frac_4", shares[0], -1e-6, 1.0)
    return Stars(np.stack(sed).astype(np.int64), np.maximum(shares, 0.0), mag_h, a_v)


def magnification(
    kappa: npt.ArrayLike, gamma1: npt.ArrayLike, gamma2: npt.ArrayLike, ids: Sequence[int] | Int
) -> Float:
    """Return the lensing magnification mu = 1 / ((1 - kappa)^2 - gamma^2).

    Parameters
    ----------
    kappa, gamma1, gamma2 : float array, shape (n,)
        Convergence, and both components of the shear.
    ids : sequence of int, length n
        Identifiers of the sources, for error messages.

    Returns
    -------
    float array, shape (n,)
        Flux magnification, above 0 and at most 100.

    Raises
    ------
    OutOfRange
        If mu is not in (0, 100], which occurs near and inside the critical curve. The message names the source.

    References
    ----------
    Serrano et al. 2024, eq. magnification_factor.
    """
    with np.errstate(divide="ignore"):
        mu = 1.0 / determinant(kappa, gamma1, gamma2)
    bad = ~((mu > 0.0) & (mu <= MAGNIFICATION_MAX))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise OutOfRange(f"magnification of source {int(ids[first])}", float(mu[first]), 0.0, MAGNIFICATION_MAX)
    return np.asarray(mu)


def determinant(kappa: npt.ArrayLike, gamma1: npt.ArrayLike, gamma2: npt.ArrayLike) -> Float:
    """Return the inverse magnification (1 - kappa)^2 - gamma^2.

    Parameters
    ----------
    kappa, gamma1, gamma2 : float array, shape (n,)
        Convergence, and both components of the shear.

    Returns
    -------
    float array, shape (n,)
        Determinant of the lensing Jacobian matrix; 0 on the critical curve.
    """
    stretch = 1.0 - np.asarray(kappa, float)
    shear = np.hypot(np.asarray(gamma1, float), np.asarray(gamma2, float))
    # a^2 - b^2 as (a - b)(a + b), which has a smaller rounding error.
    return np.asarray((stretch - shear) * (stretch + shear))


def table_magnification(table: pa.Table) -> Float:
    """Return the lensing magnification of rows of the table `galaxies`, from the columns kappa, gamma1 and gamma2.

    Raises BadInput if a value is missing, and OutOfRange if a magnification is not in (0, 100].
    """
    kappa, gamma1, gamma2 = (column(table, name) for name in ("kappa", "gamma1", "gamma2"))
    return magnification(kappa, gamma1, gamma2, source_ids(table))


def _line_fluxes(table: pa.Table) -> Float:
    """Return the fluxes of all emission lines in erg s-1 cm-2, float64[n, n_line].

    A missing column, null or NaN gives 0, because it marks a line that was not modelled. Raises OutOfRange if a flux is
    outside its declared bounds.
    """
    out = np.zeros((table.num_rows, len(lines.line_list())))
    for k, line in enumerate(lines.line_list()):
        if line.column not in table.column_names:
            continue
        flux = np.nan_to_num(_floats(table, line.column), nan=0.0, posinf=np.inf)
        declared = GALAXIES.column(line.column)
        check_range(line.column, flux, _required_bound(declared.lo), _required_bound(declared.hi))
        out[:, k] = flux * line.ratio
    return out


def _check_declared_range(name: str, values: Float) -> Float:
    declared = GALAXIES.column(name)
    check_range(name, values, _required_bound(declared.lo), _required_bound(declared.hi))
    return values


def _required_bound(value: float | None) -> float:
    if value is None:
        raise BadInput("a column that is required for spectra has no declared bounds")
    return value


def _refuse_other_kinds(table: pa.Table) -> None:
    if "kind" not in table.column_names:
        return
    kinds = column(table, "kind")
    other = ~np.isin(kinds, GALAXY_KINDS)
    if other.any():
        first = int(np.flatnonzero(other)[0])
        source = int(source_ids(table)[first])
        raise BadInput(f"galaxies: source {source} has kind {int(kinds[first])}: not in the galaxy library")


def source_ids(table: pa.Table) -> Int:
    """Return the column `id` as int64, or the row numbers from 0 if the table has no column `id`."""
    if "id" not in table.column_names:
        return np.arange(table.num_rows, dtype=np.int64)
    return np.asarray(table["id"].to_numpy(), np.int64)


def column(table: pa.Table, name: str) -> Float:
    """Return a column as float64; raises BadInput if the column is missing or contains null or NaN."""
    values = _floats(table, name)
    gap = np.isnan(values)
    if gap.any():
        first = int(np.flatnonzero(gap)[0])
        raise BadInput(f"column {name} is missing in the row of source {int(source_ids(table)[first])}")
    return values


def _floats(table: pa.Table, name: str) -> Float:
    """Return a column as float64, with NaN for null; raises BadInput if the column is missing."""
    if name not in table.column_names:
        raise BadInput(f"column {name} is missing")
    return np.asarray(pc.cast(table[name], pa.float64()).to_numpy(), float)
