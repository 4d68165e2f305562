"""Check the angular correlation function w(theta) of galaxies brighter than limits in I_E (VIS band of Euclid).

The expected w is computed from the non-linear matter power spectrum in Limber's approximation, with the redshifts of
the galaxies and the bias of their halos. Above 0.3 deg the tolerance is 20 %. Below, it is 50 %, because the prediction
does not include pairs of galaxies within one halo and the finite resolution of the simulated matter. Luminous galaxies
at z = 0.5 are compared with the power law that surveys found.

References
----------
Limber 1953, ApJ 117, 134
Tinker et al. 2010, ApJ 724, 878
Landy & Szalay 1993, ApJ 412, 64
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lake_schema.arrays import Array, Bool, Float
from lake_schema.store import read
from truesky.catalogue.halos import matching
from truesky.cosmology import Cosmology, from_facts
from truesky.validation import checks, theory, two_points
from truesky.validation import field as fields
from truesky.validation.field import Field
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable, row_of_check
from truesky.validation.model import observed, small_scales
from truesky.validation.two_points import ARCMIN, TwoPointFunction

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "clustering"
# Publication on which the expected values are based.
SOURCE = "Limber's approximation with the bias of the galaxies' halos (Tinker et al. 2010, ApJ 724, 878)"
# Band in which galaxies are selected (I_E).
BAND = "euclid_vis"
# Magnitude limits in I_E of the samples whose clustering is measured, AB mag.
LIMITS = (22.0, 23.0, 24.0)
# Columns of the table `galaxies` (magnitude at 5600 A, spectra and dust) from which magnitudes in any band are
# computed.
_SED = ("abs_mag_r01", "sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
# Columns of the table `galaxies` that the check of clustering reads.
COLUMNS = ("id", "ra", "dec", "_healpix_29", "kind", "z_true", "mag_r01", "log_halo_mass", *_SED)
# Galaxies are read if their magnitude at 5600 A (mag_r01) is at most this much fainter than the limit in I_E, mag. No
# galaxy with a larger mag_r01 is brighter than the limit in I_E.
_REDDEST = 3.0
# A catalogue counts as complete to a magnitude limit if it ends at most this much (mag) before the limit.
_DEPTH_MARGIN = 0.1
# The clustering of a sample with fewer galaxies than this number is not measured.
_MIN_GALAXIES = 200
# Edges of the bins of angular separation of two galaxies in which w is measured, arcmin.
EDGES = np.array([0.3, 0.6, 1.2, 2.4, 4.8, 9.6, 18.0, 36.0, 60.0, 90.0])
# Bins that begin at this separation (arcmin) or beyond have the tolerance 20 % instead of 50 %.
_LINEAR = 18.0
# Relative tolerance of w at separations below 18 arcmin.
_NEAR_TOLERANCE = 0.5
# Relative tolerance of w at separations above 18 arcmin.
_FAR_TOLERANCE = 0.2
# Width of the shells of comoving distance into which galaxies are divided for the expected w(theta), Mpc/h.
_SHELL = 100.0
# I_E (AB mag) of the faintest galaxies in the luminous sample (M_r - 5 log h < -20 at 0.4 < z < 0.6). A catalogue that
# is less deep does not have the whole sample.
_LUMINOUS = 23.5


def measure(galaxies: read.Version) -> Result:
    """Check the angular clustering of the table `galaxies` of a lake.

    Returns rows (measured w divided by the expected w, with verdicts) and arrays for plots. The only row is
    "not_applicable" if a required column is missing.
    """
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _no_result(f"table galaxies has no column {', '.join(missing)}")
    table = galaxies.rows(list(COLUMNS))
    index, bright = table["_healpix_29"].to_numpy(), table["mag_r01"].to_numpy() < max(LIMITS) + _REDDEST
    field = fields.from_version(galaxies, index)
    bright &= table["kind"].to_numpy() < 2
    return compare(
        {name: table[name].to_numpy()[bright] for name in COLUMNS},
        field,
        from_facts(galaxies.manifest.get("facts", {})),
    )


def compare(columns: Mapping[str, Array], field: Field, cosmology: Cosmology) -> Result:
    """Check the angular clustering of galaxies in a field.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        COLUMNS of central and satellite galaxies, complete to the faintest limit in I_E if possible.
    field : Field
        Area of the sky that contains the galaxies.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Result
        Measured w divided by expected w in bins of separation, with verdicts. Limits that the catalogue does not reach,
        samples with fewer than 200 galaxies and too small fields give rows "not_applicable".
    """
    if len(columns["id"]) < _MIN_GALAXIES:
        return _no_result(
            f"{len(columns['id'])} galaxies may be brighter than I_E = {max(LIMITS):g}; {_MIN_GALAXIES} are required"
        )
    edges = EDGES[60.0 * field.patch_side * (1 + 1e-9) >= EDGES]
    if len(edges) < 3:
        return _no_result(f"patches of the field are {60.0 * field.patch_side:.1f}' wide, which is too small")
    mag = observed.apparent_magnitudes(columns, BAND, cosmology)
    deepest, rows, series = float(np.percentile(mag, 99.5)), [], {}
    for limit in LIMITS:
        brighter = mag < limit
        if deepest < limit - _DEPTH_MARGIN or np.count_nonzero(brighter) < _MIN_GALAXIES:
            why = f"{np.count_nonzero(brighter)} galaxies with I_E < {limit:g}; the catalogue reaches {deepest:.2f}"
            rows.append(not_applicable(NAME, Place(), why, SOURCE, f"w_vis_{limit:g}"))
            continue
        correlation = _correlate(columns, brighter, field, edges * ARCMIN)
        with_halo = brighter & np.isfinite(columns["log_halo_mass"])
        if np.count_nonzero(with_halo) < 0.9 * np.count_nonzero(brighter):
            why = "the masses of the halos, and thus the bias of the galaxies, are not known"
            rows.append(not_applicable(NAME, Place(), why, SOURCE, f"w_vis_{limit:g}"))
            continue
        curve, w_theory = expected_correlation(columns, with_halo, field, correlation, cosmology)
        note = f"{np.count_nonzero(brighter)} galaxies with I_E < {limit:g}, {field.area:.3g} deg2"
        rows += _rows(f"w_vis_{limit:g}", correlation, w_theory, note)
        series[f"w_{limit:g}"] = np.stack(
            [correlation.theta / ARCMIN, correlation.value[0], correlation.error[0], w_theory]
        )
        series[f"w_theory_{limit:g}"] = np.stack(curve)
    rows += _luminous_rows(columns, field, deepest, cosmology)
    return Result(Place(), rows, series)


def _correlate(columns: Mapping[str, Array], selected: Bool, field: Field, edges: Float) -> TwoPointFunction:
    ids, ra, dec, index = (columns[name][selected] for name in ("id", "ra", "dec", "_healpix_29"))
    return two_points.angular_correlation(ids, ra, dec, index, field, edges)


def _rows(name: str, correlation: TwoPointFunction, w_theory: Float, note: str) -> list[Row]:
    rows = []
    for k, low in enumerate(correlation.edges[:-1] / ARCMIN):
        tolerance = _FAR_TOLERANCE if low > _LINEAR * 0.99 else _NEAR_TOLERANCE
        full_note = f"{correlation.value[0, k]:.3g}, theory {w_theory[k]:.3g}; {note}"
        value, error = correlation.value[0, k] / w_theory[k], correlation.error[0, k] / w_theory[k]
        rows.append(
            Row(
                NAME, f"{name}_{low:g}", Place(), float(value), float(error), 1.0, tolerance, "", SOURCE, note=full_note
            )
        )
    return rows


def expected_correlation(
    columns: Mapping[str, Array], selected: Bool, field: Field, correlation: TwoPointFunction, cosmology: Cosmology
) -> tuple[tuple[Float, Float], Float]:
    """Return the expected angular correlation function w of galaxies in a field.

    w is relative to the mean density of the field, as it is measured: the mean of w over all pairs is subtracted.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        Columns `z_true` and `log_halo_mass` of the galaxies.
    selected : bool array, shape (n,)
        True for the galaxies of the sample, whose halo masses must be finite.
    field : Field
        Area of the sky that contains the galaxies.
    correlation : TwoPointFunction
        Measured w, which defines the separation bins.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    curve : tuple of float arrays
        Separations in arcmin and expected w at these separations, for plots.
    w : float array, shape (bins,)
        Expected w in each bin.
    """
    z, mass = columns["z_true"][selected].astype(float), columns["log_halo_mass"][selected].astype(float)
    chi, halos = np.asarray(cosmology.comoving_distance(z)), matching.masses(cosmology)
    bias = halos.interpolate_pairs(halos.bias, z, mass)
    edges = np.arange(chi.min() * 0.999, chi.max() + _SHELL, _SHELL)
    c_l = theory.galaxy_power(cosmology, theory.ELL, theory.shells(chi, bias, edges))
    curve = np.geomspace(EDGES[0] * ARCMIN, np.radians(20.0), 80)
    w = theory.correlation(curve, theory.ELL, c_l)
    # Subtract the mean of w over all pairs: w was measured relative to the mean density of this field.
    field_mean = two_points.mean_over_pairs(field, curve, w)
    in_range = curve < correlation.edges[-1]
    return (curve[in_range] / ARCMIN, w[in_range] - field_mean), np.interp(correlation.theta, curve, w) - field_mean


def _luminous_rows(columns: Mapping[str, Array], field: Field, deepest: float, cosmology: Cosmology) -> list[Row]:
    """Check w of galaxies with M_r - 5 log h < -20 at 0.4 < z < 0.6, divided by the w of the observed power law.

    `deepest` is the depth of the catalogue in I_E (AB mag). Returns one row with its verdict for each separation bin
    that expectations.csv lists, or a row "not_applicable" if the catalogue is not deep enough, has fewer than 200 such
    galaxies, or covers a too small field.
    """
    z_min, z_max = small_scales.Z_MIN, small_scales.Z_MAX
    z = columns["z_true"].astype(float)
    selected = (columns["abs_mag_r01"] < small_scales.MAX_ABS_MAG) & (z > z_min) & (z < z_max)
    n_galaxies = int(np.count_nonzero(selected))
    low, high = (float(cosmology.comoving_distance(at)) for at in (z_min, z_max))
    edges = small_scales.EDGES / (0.75 * (high**4 - low**4) / (high**3 - low**3))
    edges = edges[edges <= np.radians(field.patch_side)]
    names = [f"w_m20_{edge:g}" for edge in small_scales.EDGES[: len(edges) - 1]]
    if deepest < _LUMINOUS - _DEPTH_MARGIN or n_galaxies < _MIN_GALAXIES or not names:
        why = f"{n_galaxies} galaxies with M_r - 5 log h < -20 at 0.4 < z < 0.6; the depth is I_E = {deepest:.2f}"
        return [not_applicable(NAME, Place(), why, SOURCE, "w_m20")]
    correlation = _correlate(columns, selected, field, edges)
    law = small_scales.power_law(np.asarray(cosmology.comoving_distance(z[selected])), edges)
    value = dict(zip(names, (correlation.value[0] / law).tolist(), strict=True))
    error = dict(zip(names, (correlation.error[0] / law).tolist(), strict=True))
    rows = []
    for check in checks.evaluate(value):
        note = f"{n_galaxies} galaxies with M_r - 5 log h < -20 at 0.4 < z < 0.6, from {check.name[6:]} Mpc/h"
        rows.append(row_of_check(NAME, check, error[check.name], note))
    return rows


def _no_result(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
