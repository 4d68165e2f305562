"""Shear of the galaxies at z = 1: xi+ and xi- against theory, no B modes, and shear that belongs to the convergence.

Two points of shear do not tell its sign, and vary from field to field; the mean shear about convergence does, and that
of the same field: <kappa gamma_t>(theta) is <kappa kappa> within theta less <kappa kappa>(theta).
Ref: Schneider, van Waerbeke & Mellier 2002, A&A 389, 729; Kaiser 1995, ApJ 439, L1
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
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.measure.seen import Result
from truesky.validation.two_points import ARCMIN, Measured

NAME = "shear"
SOURCE = "non-linear theory (Takahashi et al. 2012, ApJ 761, 152) by Limber's approximation"
_NO_B = "gravity makes no B modes (Schneider, van Waerbeke & Mellier 2002, A&A 389, 729)"
_BELONGS = "shear and convergence are of one potential (Kaiser 1995, ApJ 439, L1)"
COLUMNS = ("id", "ra", "dec", "_healpix_29", "kind", "z_true", "gamma1", "gamma2", "kappa")
NEAR, FAR = 0.8, 1.2
# Galaxies, the fewest that are looked at; shells of distance, points of the curve of theory and of all of it.
_FEWEST, _SHELLS, _CURVE, _NODES = 200, 40, 20, 40
# Separations, arcmin: fine bins, of which four make a wide one; from where on they are compared; apertures' radii.
_FIRST, _OCTAVES, _EACH, _FROM = 0.15, 9, 4, 0.6
_APERTURES = (2.4, 4.8, 9.6, 19.2)
_THEORY, _CROSS, _CONVERGENCE = 0.2, 0.1, 0.2
# Where xi- is lower than theory, arcmin, and the resolution of the lensing that all of it is asked of.
_LOW, _NSIDE = (2.4, 19.2), 1024
_LOW_WHY = "between halos and the box of matter structure is missing: xi- is up to 23 % low from 5' to 10'"


def measured(galaxies: read.Version) -> Result:
    """Of a lake's galaxies."""
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _none(f"galaxies have no {' and '.join(missing)}")
    table = galaxies.rows(list(COLUMNS))
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    field = fields.of_version(galaxies, columns["_healpix_29"])
    return compared(columns, field, int(galaxies.manifest.get("facts", {}).get("lensing_nside", _NSIDE)))


def compared(columns: dict[str, Array], field: Field, nside: int = _NSIDE) -> Result:
    """Of columns[n] by name, galaxies in a field; nside : to which structure lenses."""
    z = columns["z_true"].astype(float)
    kept = np.flatnonzero((columns["kind"] < 2) & (z > NEAR) & (z < FAR))
    gamma = np.stack([columns[name][kept].astype(float) for name in ("gamma1", "gamma2", "kappa")], 1)
    known = np.isfinite(gamma).all(1)
    kept, gamma = kept[known], gamma[known]
    if len(kept) < _FEWEST:
        return _none(f"{len(kept)} galaxies with shear at {NEAR:g} < z < {FAR:g}; {_FEWEST} are wanted")
    if not gamma[:, :2].any() or not np.ptp(gamma[:, :2], axis=0).any():
        return _none("all galaxies have the same shear")
    wide = [edge for edge in _FIRST * 2.0 ** np.arange(_OCTAVES + 1) if edge <= 60.0 * field.side * (1 + 1e-9)]
    if len(wide) < 4:
        return _none(f"patches of the field are {60.0 * field.side:.1f}' wide: too small")
    edges = np.append(0.0, _FIRST * 2.0 ** (np.arange(_EACH * (len(wide) - 1) + 1) / _EACH))
    own = [columns[name][kept] for name in ("id", "ra", "dec", "_healpix_29")]
    fine = two_points.shear(own[0], (own[1], own[2]), gamma, own[3], field, edges * ARCMIN)
    wide = [edge for edge in wide if edge > _FROM * (1 - 1e-9)]
    coarse = two_points.grouped(fine, np.array(wide) * ARCMIN)
    c_l = expected(z[kept])
    plus, minus = theory.shear_correlations(coarse.theta, theory.ELL, c_l)
    note = f"{len(kept)} galaxies at {NEAR:g} < z < {FAR:g}, {field.area:.3g} deg2"
    far = np.geomspace(_FIRST * ARCMIN, np.radians(20.0), _NODES)
    common = two_points.of_all_pairs(field, far, theory.shear_correlations(far, theory.ELL, c_l)[0])
    rows = [
        *_theory(coarse, (plus, minus), (common, 0.0), note, nside),
        *_b_modes(fine, coarse, note),
        *_convergence(fine, wide, note),
    ]
    curve = np.geomspace(_FROM, wide[-1], _CURVE)
    series = {
        "shear": np.stack(
            [coarse.theta / ARCMIN, *coarse.value[:3], np.hypot(coarse.error[0], common), *coarse.error[1:3]]
        ),
        "shear_theory": np.stack([curve, *theory.shear_correlations(curve * ARCMIN, theory.ELL, c_l)]),
    }
    return Result(Place(), rows, series)


def expected(z: Float) -> Float:
    """C_l of the convergence of galaxies at redshifts z[n], at the multipoles of `theory`."""
    number, edge = np.histogram(np.asarray(cosmology.comoving_distance(z)), _SHELLS)
    return theory.convergence(theory.ELL, 0.5 * (edge[1:] + edge[:-1]), number.astype(float))


def _theory(
    coarse: Measured, wanted: tuple[Float, Float], common: tuple[float, float], note: str, nside: int
) -> list[Row]:
    """common : of xi+ and xi-, what all of a field shares, and its patches do not tell: it is as uncertain as large."""
    rows = []
    rough = f"structure lenses to l = {nside} alone" if nside < _NSIDE else ""
    for c, (name, expect, shared) in enumerate(zip(("xi_plus", "xi_minus"), wanted, common, strict=True)):
        for k, low in enumerate(coarse.edges[:-1] / ARCMIN):
            known = rough or (_LOW_WHY if c == 1 and _LOW[0] * 0.99 < low < _LOW[1] * 0.99 else "")
            about = f"{coarse.value[c, k]:.3g}, by theory {expect[k]:.3g}; {note}"
            value, error = coarse.value[c, k] / expect[k], np.hypot(coarse.error[c, k], shared) / expect[k]
            rows.append(Row(NAME, f"{name}_{low:g}", Place(), float(value), float(error), 1.0, _THEORY, "", SOURCE,
                            note=about, known=known))  # fmt: skip
    return rows


def _b_modes(fine: Measured, coarse: Measured, note: str) -> list[Row]:
    """Share of B modes in apertures; the cross component over xi+."""
    rows, fine_edges = [], fine.edges / ARCMIN
    for radius in _APERTURES:
        if 2.0 * radius > fine_edges[-1] * (1 + 1e-9):
            break
        share, without = (
            _share(*theory.aperture(fine_edges, np.nan_to_num(values[..., 0, :]), np.nan_to_num(values[..., 1, :]),
                                    radius))
            for values in (fine.value, fine.without)
        )  # fmt: skip
        rows.append(Row(NAME, f"b_share_{radius:g}", Place(), float(share), float(fields.spread(without)), 0.0, _CROSS,
                        "", _NO_B, note=note))  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, ratios = (values[..., 2, :] / values[..., 0, :] for values in (coarse.value, coarse.without))
    for low, value, error in zip(coarse.edges[:-1] / ARCMIN, ratio, fields.spread(ratios), strict=True):
        rows.append(Row(NAME, f"cross_{low:g}", Place(), float(value), float(error), 0.0, _CROSS, "", _NO_B, note=note))
    return rows


def _share(mass: Float, cross: Float) -> Float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cross / (np.abs(mass) + np.abs(cross)))


def _convergence(fine: Measured, wide: list[float], note: str) -> list[Row]:
    """Mean shear about convergence over what the convergence foretells."""
    rows = []
    every = [_foretold(fine.edges, values) for values in (fine.value, fine.without)]
    for low, high in pairwise(wide):
        here = (fine.edges[:-1] > low * ARCMIN * 0.99) & (fine.edges[1:] < high * ARCMIN * 1.01)
        weight = fine.number * here
        ratio, ratios = (
            np.sum(weight * found, -1) / np.sum(weight * wanted, -1) for found, wanted in every
        )  # fmt: skip
        rows.append(Row(NAME, f"about_convergence_{low:g}", Place(), float(ratio), float(fields.spread(ratios)), 1.0,
                        _CONVERGENCE, "", _BELONGS, note=note))  # fmt: skip
    return rows


def _foretold(edges: Float, values: Float) -> tuple[Float, Float]:
    """<kappa gamma_t> as it is[..., bin], and as <kappa kappa> has it."""
    both, found = np.nan_to_num(values[..., 3, :]), np.nan_to_num(values[..., 4, :])
    area = edges[1:] ** 2 - edges[:-1] ** 2
    inside = np.cumsum(both * area, -1) - 0.5 * both * area
    return found, inside / (0.5 * (edges[1:] ** 2 + edges[:-1] ** 2)) - both


def _none(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
