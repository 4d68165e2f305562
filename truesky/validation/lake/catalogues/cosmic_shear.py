"""Check the gravitational shear of galaxies at z = 1: xi+ and xi- against theory, B modes, and shear with convergence.

Notes
-----
xi+ and xi- do not depend on the sign of the shear, and vary from field to field. The mean tangential shear around
convergence does depend on the sign, and follows from the convergence in the same field: <kappa gamma_t>(theta) is the
mean of <kappa kappa> within theta minus <kappa kappa>(theta).

References
----------
Schneider, van Waerbeke & Mellier 2002, A&A 389, 729
Kaiser 1995, ApJ 439, L1
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from lake_schema.arrays import Array, Float
from lake_schema.store import read
from truesky.cosmology import Cosmology, from_facts
from truesky.validation import field as fields
from truesky.validation import theory, two_points
from truesky.validation.field import Field
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.two_points import ARCMIN, TwoPointFunction

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "shear"
# Sources of the expected values: of xi+ and xi-, of B modes, and of the shear around convergence.
SOURCE = "non-linear theory (Takahashi et al. 2012, ApJ 761, 152) by Limber's approximation"
_NO_B = "gravity makes no B modes (Schneider, van Waerbeke & Mellier 2002, A&A 389, 729)"
_BELONGS = "shear and convergence are of one potential (Kaiser 1995, ApJ 439, L1)"
# Columns of the table `galaxies` that the check of gravitational shear reads.
COLUMNS = ("id", "ra", "dec", "_healpix_29", "kind", "z_true", "gamma1", "gamma2", "kappa")
# Lowest redshift of the galaxies whose shear is checked.
Z_MIN = 0.8
# Highest redshift of the galaxies whose shear is checked.
Z_MAX = 1.2
# With fewer galaxies than this number, the check is not applicable.
_MIN_GALAXIES = 200
# Number of shells of comoving distance into which galaxies are divided for the expected power spectrum of convergence.
_SHELLS = 40
# Number of separations at which the predicted xi+ and xi- are plotted.
_CURVE = 20
# Number of separations at which xi+ is evaluated to average it over all pairs of the field.
_NODES = 40
# Lower edge of the first wide bin of separations between galaxies, arcmin.
_FIRST = 0.15
# Number of wide bins of separation between galaxies; the upper edge of each is twice its lower edge.
_OCTAVES = 9
# Number of fine bins into which each wide bin of separation is divided, for B modes and the shear around convergence.
_EACH = 4
# Smallest separation of galaxies at which measured xi+ and xi- are compared with theory, arcmin.
_FROM = 0.6
# Radii of the circular apertures in which B modes are measured, arcmin; apertures larger than the field are left out.
_APERTURES = (2.4, 4.8, 9.6, 19.2)
# Relative tolerance of the measured xi+ and xi- compared with theory.
_THEORY = 0.2
# Largest allowed deviation from 0 of the B-mode fraction in apertures, and of the cross component divided by xi+.
_CROSS = 0.1
# Relative tolerance of the mean tangential shear around convergence, compared with the value that follows from the
# convergence.
_CONVERGENCE = 0.2
# Range of separations (arcmin) in which xi- is known to be lower than theory if the matter around halos does not lens;
# deviations there are known failures.
_LOW = (2.4, 19.2)
# HEALPix nside of the lensing maps below which deviations of xi+ and xi- from theory count as known failures: such maps
# are too coarse.
_NSIDE = 1024
# Reason why xi- is known to fail without it.
_LOW_WHY = "the matter around halos does not lens: xi- is up to 23 % low from 5' to 10'"


def measure(galaxies: read.Version) -> Result:
    """Check the gravitational shear of the table `galaxies` of a lake.

    Returns rows (measured values with expected values and verdicts) and arrays for plots. The only row is
    "not_applicable" if a required column is missing.
    """
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _no_result(f"table galaxies has no column {', '.join(missing)}")
    table = galaxies.rows(list(COLUMNS))
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    field = fields.from_version(galaxies, columns["_healpix_29"])
    facts = galaxies.manifest.get("facts", {})
    # Lakes without these facts were made before the matter around halos lensed. With a user's halos it does not.
    complete = bool(facts.get("structure_below_cells", False)) and not facts.get("halos")
    return compare(columns, field, from_facts(facts), int(facts.get("lensing_nside", _NSIDE)), complete)


def compare(
    columns: dict[str, Array], field: Field, cosmology: Cosmology, nside: int = _NSIDE, complete: bool = True
) -> Result:
    """Check the gravitational shear of galaxies at 0.8 < z < 1.2 in a field.

    Parameters
    ----------
    columns : dict of str to array, shape (n,)
        COLUMNS of the table `galaxies`.
    field : Field
        Area of the sky that contains the galaxies, with jackknife patches for errors.
    cosmology : Cosmology
        Parameters of the universe.
    nside : int
        HEALPix resolution of the lensing maps from which the shear was interpolated. Below 1024, differences from
        theory count as known failures.
    complete : bool
        False if the matter around halos does not lens. Differences of xi- from theory at 2.4 to 19.2 arcmin then count
        as known failures.

    Returns
    -------
    Result
        Rows of all tests (measured values with expected values and verdicts), and arrays for plots. The only row is
        "not_applicable" for fewer than 200 galaxies, a uniform shear, or a too small field.
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
    c_l = expected_power(cosmology, z[indices])
    plus, minus = theory.shear_correlations(coarse.theta, theory.ELL, c_l)
    note = f"{len(indices)} galaxies at {Z_MIN:g} < z < {Z_MAX:g}, {field.area:.3g} deg2"
    angles = np.geomspace(_FIRST * ARCMIN, np.radians(20.0), _NODES)
    common = two_points.mean_over_pairs(field, angles, theory.shear_correlations(angles, theory.ELL, c_l)[0])
    rows = [
        row
        if np.isfinite([row.value, row.error]).all()
        else replace(row, note=f"too few pairs of galaxies; {row.note}")
        for row in (
            *_theory_rows(coarse, (plus, minus), (common, 0.0), note, (nside, complete)),
            *_b_mode_rows(fine, coarse, note),
            *_convergence_rows(fine, wide, note),
        )
    ]
    curve = np.geomspace(_FROM, wide[-1], _CURVE)
    series = {
        "shear": np.stack(
            [coarse.theta / ARCMIN, *coarse.value[:3], np.hypot(coarse.error[0], common), *coarse.error[1:3]]
        ),
        "shear_theory": np.stack([curve, *theory.shear_correlations(curve * ARCMIN, theory.ELL, c_l)]),
    }
    return Result(Place(), rows, series)


def expected_power(cosmology: Cosmology, z: Float) -> Float:
    """Return the expected C_l of the convergence of galaxies with redshifts `z`, at the multipoles theory.ELL."""
    number, edge = np.histogram(np.asarray(cosmology.comoving_distance(z)), _SHELLS)
    return theory.convergence_power(cosmology, theory.ELL, 0.5 * (edge[1:] + edge[:-1]), number.astype(float))


def _theory_rows(
    coarse: TwoPointFunction,
    predictions: tuple[Float, Float],
    common: tuple[float, float],
    note: str,
    maps: tuple[int, bool],
) -> list[Row]:
    """Check xi+ and xi- divided by their predictions: one row with a verdict for each function and separation bin.

    `coarse` are the measured functions in wide separation bins, and `predictions` the expected xi+ and xi- in these
    bins. `common` has the mean of each prediction over all pairs of the field. It is added in quadrature to the
    jackknife errors, which do not include the variance of the mean shear of a whole field. `note` describes the sample.
    `maps` has the HEALPix resolution of the lensing maps, and False if the matter around halos does not lens.
    """
    rows, (nside, complete) = [], maps
    rough = f"lensing maps contain structure only to l = {nside}" if nside < _NSIDE else ""
    for c, (name, prediction, shared) in enumerate(zip(("xi_plus", "xi_minus"), predictions, common, strict=True)):
        for k, low in enumerate(coarse.edges[:-1] / ARCMIN):
            known_failure = rough or (
                _LOW_WHY if not complete and c == 1 and _LOW[0] * 0.99 < low < _LOW[1] * 0.99 else ""
            )
            full_note = f"{coarse.value[c, k]:.3g}, theory {prediction[k]:.3g}; {note}"
            value, error = coarse.value[c, k] / prediction[k], np.hypot(coarse.error[c, k], shared) / prediction[k]
            rows.append(Row(NAME, f"{name}_{low:g}", Place(), float(value), float(error), 1.0, _THEORY, "", SOURCE,
                            note=full_note, known_failure=known_failure))  # fmt: skip
    return rows


def _b_mode_rows(fine: TwoPointFunction, coarse: TwoPointFunction, note: str) -> list[Row]:
    """Check that there are no B modes: their fraction in apertures, and the cross component divided by xi+.

    `fine` and `coarse` are the measured functions in fine and wide bins. Apertures larger than the field are left out.
    """
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
    """Check the mean tangential shear around convergence, divided by the value that follows from <kappa kappa>.

    `wide` are the edges of the separation bins in arcmin; each bin gives one row with a verdict.
    """
    rows = []
    curves = [_tangential_shear(fine.edges, values) for values in (fine.value, fine.jackknife)]
    for low, high in pairwise(wide):
        in_bin = (fine.edges[:-1] > low * ARCMIN * 0.99) & (fine.edges[1:] < high * ARCMIN * 1.01)
        weight = fine.number * in_bin
        # Without pairs at this separation, the result is NaN.
        with np.errstate(invalid="ignore"):
            ratio, ratios = (
                np.sum(weight * measured, -1) / np.sum(weight * predicted, -1) for measured, predicted in curves
            )
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
    """Return <kappa gamma_t>, shape (..., bins), as measured, and as derived from the measured <kappa kappa>.

    `values`, shape (..., 6, bins), are xi+, xi-, the cross component, <kappa kappa>, <kappa gamma_t> and
    <kappa gamma_x>. `edges` (rad) are the edges of their separation bins.
    """
    kappa_kappa, kappa_gamma = np.nan_to_num(values[..., 3, :]), np.nan_to_num(values[..., 4, :])
    area = edges[1:] ** 2 - edges[:-1] ** 2
    inside = np.cumsum(kappa_kappa * area, -1) - 0.5 * kappa_kappa * area
    return kappa_gamma, inside / (0.5 * (edges[1:] ** 2 + edges[:-1] ** 2)) - kappa_kappa


def _no_result(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
