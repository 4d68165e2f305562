"""Check the shear of galaxies at z = 1: xi+ and xi- against theory, B modes, and consistency of shear with convergence.

Notes
-----
Two-point functions of shear do not depend on its sign and vary from field to field. The mean shear around convergence
depends on the sign and follows from the convergence in the same field: <kappa gamma_t>(theta) is the mean of
<kappa kappa> within theta minus <kappa kappa>(theta).

References
----------
Schneider, van Waerbeke & Mellier 2002, A&A 389, 729
Kaiser 1995, ApJ 439, L1
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lake_schema.arrays import Array, Float
from lake_schema.store import read
from truesky.fluxes import cosmology
from truesky.validation import field as fields
from truesky.validation import theory, two_points
from truesky.validation.field import Field
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.two_points import ARCMIN, TwoPointFunction

NAME = "shear"
SOURCE = "non-linear theory (Takahashi et al. 2012, ApJ 761, 152) by Limber's approximation"
_NO_B = "gravity makes no B modes (Schneider, van Waerbeke & Mellier 2002, A&A 389, 729)"
_BELONGS = "shear and convergence are of one potential (Kaiser 1995, ApJ 439, L1)"
COLUMNS = ("id", "ra", "dec", "_healpix_29", "kind", "z_true", "gamma1", "gamma2", "kappa")
Z_MIN, Z_MAX = 0.8, 1.2
# Smallest number of galaxies; number of shells of distance, of points of the plotted theory and of nodes for its mean.
_MIN_GALAXIES, _SHELLS, _CURVE, _NODES = 200, 40, 20, 40
# Separations, arcmin: first edge, number of octaves, fine bins per octave, smallest compared separation; apertures.
_FIRST, _OCTAVES, _EACH, _FROM = 0.15, 9, 4, 0.6
_APERTURES = (2.4, 4.8, 9.6, 19.2)
_THEORY, _CROSS, _CONVERGENCE = 0.2, 0.1, 0.2
# Range in arcmin in which xi- is lower than theory, and the resolution of lensing maps that all checks require.
_LOW, _NSIDE = (2.4, 19.2), 1024
_LOW_WHY = "structure between the scales of halos and of the box is missing: xi- is up to 23 % low from 5' to 10'"


def measure(galaxies: read.Version) -> Result:
    """Check the shear of table `galaxies` of a lake."""
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _no_result(f"table galaxies has no column {', '.join(missing)}")
    table = galaxies.rows(list(COLUMNS))
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    field = fields.from_version(galaxies, columns["_healpix_29"])
    return compare(columns, field, int(galaxies.manifest.get("facts", {}).get("lensing_nside", _NSIDE)))


def compare(columns: dict[str, Array], field: Field, nside: int = _NSIDE) -> Result:
    """Check the shear of galaxies in a field.

    Parameters
    ----------
    columns : dict of str to array, shape (n,)
        COLUMNS of the galaxies.
    field : Field
        Area of the galaxies.
    nside : int
        Resolution of the lensing maps.

    Returns
    -------
    Result
        Rows of all tests of shear, and series for figures.
    """
    z = columns["z_true"].astype(float)
    indices = np.flatnonzero((columns["kind"] < 2) & (z > Z_MIN) & (z < Z_MAX))
    gamma = np.stack([columns[name][indices].astype(float) for name in ("gamma1", "gamma2", "kappa")], 1)
    is_finite = np.isfinite(gamma).all(1)
    indices, gamma = indices[is_finite], gamma[is_finite]
    if len(indices) < _MIN_GALAXIES:
        return _no_result(
            f"{len(indices)} galaxies with shear at {Z_MIN:g} < z < {Z_MAX:g}; {_MIN_GALAXIES} are required"
        )
    if not gamma[:, :2].any() or not np.ptp(gamma[:, :2], axis=0).any():
        return _no_result("all galaxies have the same shear")
    wide = [edge for edge in _FIRST * 2.0 ** np.arange(_OCTAVES + 1) if edge <= 60.0 * field.patch_side * (1 + 1e-9)]
    if len(wide) < 4:
        return _no_result(f"patches of the field are {60.0 * field.patch_side:.1f}' wide, which is too small")
    edges = np.append(0.0, _FIRST * 2.0 ** (np.arange(_EACH * (len(wide) - 1) + 1) / _EACH))
    identity = [columns[name][indices] for name in ("id", "ra", "dec", "_healpix_29")]
    fine = two_points.shear_correlations(
        identity[0], (identity[1], identity[2]), gamma, identity[3], field, edges * ARCMIN
    )
    wide = [edge for edge in wide if edge > _FROM * (1 - 1e-9)]
    coarse = two_points.rebin(fine, np.array(wide) * ARCMIN)
    c_l = expected_power(z[indices])
    plus, minus = theory.shear_correlations(coarse.theta, theory.ELL, c_l)
    note = f"{len(indices)} galaxies at {Z_MIN:g} < z < {Z_MAX:g}, {field.area:.3g} deg2"
    angles = np.geomspace(_FIRST * ARCMIN, np.radians(20.0), _NODES)
    common = two_points.mean_over_pairs(field, angles, theory.shear_correlations(angles, theory.ELL, c_l)[0])
    rows = [
        *_theory_rows(coarse, (plus, minus), (common, 0.0), note, nside),
        *_b_mode_rows(fine, coarse, note),
        *_convergence_rows(fine, wide, note),
    ]
    curve = np.geomspace(_FROM, wide[-1], _CURVE)
    series = {
        "shear": np.stack(
            [coarse.theta / ARCMIN, *coarse.value[:3], np.hypot(coarse.error[0], common), *coarse.error[1:3]]
        ),
        "shear_theory": np.stack([curve, *theory.shear_correlations(curve * ARCMIN, theory.ELL, c_l)]),
    }
    return Result(Place(), rows, series)


def expected_power(z: Float) -> Float:
    """Return C_l of the convergence of galaxies with redshifts `z`, at the multipoles theory.ELL."""
    number, edge = np.histogram(np.asarray(cosmology.comoving_distance(z)), _SHELLS)
    return theory.convergence_power(theory.ELL, 0.5 * (edge[1:] + edge[:-1]), number.astype(float))


def _theory_rows(
    coarse: TwoPointFunction, predictions: tuple[Float, Float], common: tuple[float, float], note: str, nside: int
) -> list[Row]:
    """Compare xi+ and xi- with theory.

    `common` is the part of both that a whole field shares. Jackknife errors do not contain it; its uncertainty is as
    large as its value.
    """
    rows = []
    rough = f"lensing maps contain structure only to l = {nside}" if nside < _NSIDE else ""
    for c, (name, prediction, shared) in enumerate(zip(("xi_plus", "xi_minus"), predictions, common, strict=True)):
        for k, low in enumerate(coarse.edges[:-1] / ARCMIN):
            known_failure = rough or (_LOW_WHY if c == 1 and _LOW[0] * 0.99 < low < _LOW[1] * 0.99 else "")
            full_note = f"{coarse.value[c, k]:.3g}, theory {prediction[k]:.3g}; {note}"
            value, error = coarse.value[c, k] / prediction[k], np.hypot(coarse.error[c, k], shared) / prediction[k]
            rows.append(Row(NAME, f"{name}_{low:g}", Place(), float(value), float(error), 1.0, _THEORY, "", SOURCE,
                            note=full_note, known_failure=known_failure))  # fmt: skip
    return rows


def _b_mode_rows(fine: TwoPointFunction, coarse: TwoPointFunction, note: str) -> list[Row]:
    """Check the share of B modes in apertures, and the cross component over xi+."""
    rows, fine_edges = [], fine.edges / ARCMIN
    for radius in _APERTURES:
        if 2.0 * radius > fine_edges[-1] * (1 + 1e-9):
            break
        share, jackknife = (
            _b_mode_share(
                *theory.aperture_mass(
                    fine_edges, np.nan_to_num(values[..., 0, :]), np.nan_to_num(values[..., 1, :]), radius
                )
            )
            for values in (fine.value, fine.jackknife)
        )
        rows.append(
            Row(
                NAME,
                f"b_share_{radius:g}",
                Place(),
                float(share),
                float(fields.jackknife_error(jackknife)),
                0.0,
                _CROSS,
                "",
                _NO_B,
                note=note,
            )
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, ratios = (values[..., 2, :] / values[..., 0, :] for values in (coarse.value, coarse.jackknife))
    for low, value, error in zip(coarse.edges[:-1] / ARCMIN, ratio, fields.jackknife_error(ratios), strict=True):
        rows.append(Row(NAME, f"cross_{low:g}", Place(), float(value), float(error), 0.0, _CROSS, "", _NO_B, note=note))
    return rows


def _b_mode_share(mass: Float, cross: Float) -> Float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cross / (np.abs(mass) + np.abs(cross)))


def _convergence_rows(fine: TwoPointFunction, wide: list[float], note: str) -> list[Row]:
    """Check the mean shear around convergence against that expected from the convergence."""
    rows = []
    curves = [_tangential_shear(fine.edges, values) for values in (fine.value, fine.jackknife)]
    for low, high in pairwise(wide):
        in_bin = (fine.edges[:-1] > low * ARCMIN * 0.99) & (fine.edges[1:] < high * ARCMIN * 1.01)
        weight = fine.number * in_bin
        ratio, ratios = (
            np.sum(weight * measured, -1) / np.sum(weight * predicted, -1) for measured, predicted in curves
        )  # fmt: skip
        rows.append(
            Row(
                NAME,
                f"about_convergence_{low:g}",
                Place(),
                float(ratio),
                float(fields.jackknife_error(ratios)),
                1.0,
                _CONVERGENCE,
                "",
                _BELONGS,
                note=note,
            )
        )
    return rows


def _tangential_shear(edges: Float, values: Float) -> tuple[Float, Float]:
    """<kappa gamma_t>, shape (..., bin), as measured and as derived from <kappa kappa>."""
    kappa_kappa, kappa_gamma = np.nan_to_num(values[..., 3, :]), np.nan_to_num(values[..., 4, :])
    area = edges[1:] ** 2 - edges[:-1] ** 2
    inside = np.cumsum(kappa_kappa * area, -1) - 0.5 * kappa_kappa * area
    return kappa_gamma, inside / (0.5 * (edges[1:] ** 2 + edges[:-1] ** 2)) - kappa_kappa


def _no_result(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
