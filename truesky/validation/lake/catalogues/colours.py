"""Check band fluxes of galaxies against their spectra, and the colours of red galaxies against the observed locus.

The median magnitude in each band is compared with that of the spectra in table `galaxies`, behind the Milky Way and
magnified. An error in one band makes all colours with this band wrong.

Notes
-----
The spectra have no emission lines, which make medians 0.01 mag brighter. The extinction is that of flat spectra. For
red spectra it is off by 0.06 A(V) in the widest band; the tolerance is larger by this amount.

References
----------
Eisenstein et al. 2001, AJ 122, 2267 (c_perp)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lake_schema.arrays import Array, Float, Int
from lake_schema.store import read
from truesky.fluxes import band_fluxes, passbands, sources
from truesky.randomness import rng
from truesky.validation import field as fields
from truesky.validation.field import Field
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.model import observed

NAME = "colours"
SOURCE = "the spectra in table galaxies, by the published passbands"
_LOCUS = "Eisenstein et al. 2001, AJ 122, 2267"
COLUMNS = ("id", "_healpix_29", "kind", "z_true", "mag_r01", "a_v", "kappa", "gamma1", "gamma2", "abs_mag_r01",
           "color_gr_01", "sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")  # fmt: skip
_FLUX = "f_nu_"
# Limits of magnitude and redshift, within which lines are few and intergalactic gas does not absorb; largest and
# smallest number of galaxies.
_MAX_MAG, _MAX_REDSHIFT, _MAX_GALAXIES, _MIN_GALAXIES = 23.0, 1.5, 30_000, 100
_TOLERANCE, _PER_DUST = 0.03, 0.06
# Nodes of A(V) for the interpolation of the extinction.
_NODES = 12
# Redshift ranges and luminosity of red galaxies with known colours.
_RED, _RED_MAG = ((0.15, 0.25), (0.25, 0.35)), -20.5
_LOCUS_TOLERANCE, _MIN_RED_GALAXIES = 0.05, 20
_EDGES = np.linspace(-0.5, 2.5, 91)


def measure(galaxies: read.Version, fluxes: read.Version) -> Result:
    """Check the colours of tables `galaxies` and `galaxy_fluxes` of a lake."""
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _no_result(f"table galaxies has no column {', '.join(missing)}")
    names = [name for name in fluxes.schema.names if name.startswith(_FLUX)]
    bands = [name.removeprefix(_FLUX) for name in names if name.removeprefix(_FLUX) in passbands.names()]
    table, light = galaxies.rows(list(COLUMNS)), fluxes.rows(["id", *(_FLUX + band for band in bands)])
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    field = fields.from_version(galaxies, columns["_healpix_29"])
    selected = np.flatnonzero(
        (columns["kind"] < 2)
        & (columns["mag_r01"] < _MAX_MAG)
        & (columns["z_true"] < _MAX_REDSHIFT)
        & (columns["sed_1"] >= 0)
    )
    chance = rng.mix_bits(columns["id"][selected].astype(np.uint64) * rng.GOLDEN) / 2.0**64
    selected = selected[chance < _MAX_GALAXIES / max(len(selected), 1)]
    columns = {name: values[selected] for name, values in columns.items()}
    flux_ids = light["id"].to_numpy()
    order = np.argsort(flux_ids)
    at = np.minimum(np.searchsorted(flux_ids[order], columns["id"]), max(len(flux_ids) - 1, 0))
    if len(selected) and (not len(flux_ids) or (flux_ids[order][at] != columns["id"]).any()):
        return _no_result("table galaxy_fluxes lacks galaxies of table galaxies: select one request with --name")
    return compare(columns, {band: light[_FLUX + band].to_numpy()[order[at]] for band in bands}, field)


def compare(columns: Mapping[str, Array], flux: Mapping[str, Array], field: Field) -> Result:
    """Check the fluxes of galaxies in a field.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        COLUMNS of the galaxies.
    flux : mapping of str to array, shape (n,)
        Fluxes by band, uJy.
    field : Field
        Area of the galaxies.

    Returns
    -------
    Result
        One row per band, rows of the red locus, and series for figures.
    """
    if len(columns["id"]) < _MIN_GALAXIES or not flux:
        return _no_result(
            f"{len(columns['id'])} galaxies with {len(flux)} bands; {_MIN_GALAXIES} with 1 band are required"
        )
    patch = field.patch_of(columns["_healpix_29"])
    with np.errstate(divide="ignore", invalid="ignore"):
        mag = {band: 23.9 - 2.5 * np.log10(values.astype(float)) for band, values in flux.items()}
    magnified = 1.0 / np.maximum(
        np.abs(sources.determinant(columns["kappa"], columns["gamma1"], columns["gamma2"])), 1e-3
    )
    rows, tolerance = [], _TOLERANCE + _PER_DUST * float(np.median(columns["a_v"]))
    for band, magnitudes in mag.items():
        dust = _transmission(band, columns["a_v"].astype(float))
        offset = magnitudes - observed.apparent_magnitudes(columns, band) + 2.5 * np.log10(magnified * dust)
        # A band without flux is also a fault.
        offset = np.where(np.isfinite(offset), offset, np.inf)
        value, error = _median(offset, patch, field.n_patches)
        note = (
            f"median of {len(offset)} galaxies"
            if np.isfinite(value)
            else f"most of {len(offset)} galaxies have no flux"
        )
        value, error = (value, error) if np.isfinite(value) else (99.0, 0.0)
        rows.append(Row(NAME, f"flux_{band}", Place(), value, error, 0.0, tolerance, "mag", SOURCE, note=note))
    series: dict[str, Float] = {}
    if {"lsst_g", "lsst_r", "lsst_i"} <= set(mag):
        gr, ri = mag["lsst_g"] - mag["lsst_r"], mag["lsst_r"] - mag["lsst_i"]
        rows += _locus_rows(columns, gr, ri)
        series["colour_colour"] = np.histogram2d(gr, ri, (_EDGES, _EDGES))[0]
        series["colour_edges"] = _EDGES
    return Result(Place(), rows, series)


def _transmission(band: str, a_v: Float) -> Float:
    """Transmission of the Milky Way for a flat spectrum in a band at A(V) of each galaxy (mag)."""
    curve, nodes = passbands.load(band), np.linspace(0.0, max(float(a_v.max()), 1e-3), _NODES)
    weight = curve.response / curve.wavelength
    through = band_fluxes.milky_way_transmission(curve.wavelength, nodes)
    return np.asarray(np.interp(a_v, nodes, np.sum(through * weight, 1) / np.sum(weight)))


def _median(values: Float, patch: Int, n_patches: int) -> tuple[float, float]:
    """Median and its error, the larger of the jackknife error and the error from the scatter of the values."""
    middle = float(np.median(values))
    rest = [np.median(values[patch != left_out]) for left_out in range(n_patches)]
    typical = values[np.isfinite(values)]
    typical = typical[np.abs(typical - middle) < 1.0]
    sample_error = 1.25 * float(np.std(typical)) / np.sqrt(max(len(typical), 1)) if len(typical) else 0.0
    by_patch = float(fields.jackknife_error(rest)) if np.isfinite(rest).all() else np.nan
    return middle, float(np.nanmax([sample_error, by_patch]))


def _locus_rows(columns: Mapping[str, Array], gr: Float, ri: Float) -> list[Row]:
    """Check luminous red galaxies: r - i = (g - r) / 4 + 0.18 up to z = 0.4, a relation quoted from memory."""
    m_r, z = columns["abs_mag_r01"], columns["z_true"]
    red = (columns["color_gr_01"] > 0.78 - 0.02 * (m_r + 20.0)) & (m_r < _RED_MAG)
    rows = []
    for z_min, z_max in _RED:
        in_shell = red & (z > z_min) & (z < z_max)
        n_galaxies = int(np.count_nonzero(in_shell))
        name = f"c_perp_z{0.5 * (z_min + z_max):g}"
        if n_galaxies < _MIN_RED_GALAXIES:
            why = f"{n_galaxies} red galaxies with M_r - 5 log h < {_RED_MAG:g} at {z_min:g} < z < {z_max:g}"
            rows.append(not_applicable(NAME, Place(), why, _LOCUS, name))
            continue
        offset = float(np.median((ri - gr / 4.0 - 0.18)[in_shell]))
        note = f"{n_galaxies} red galaxies; the expectation is quoted from memory: not binding"
        rows.append(Row(NAME, name, Place(), offset, np.nan, 0.0, _LOCUS_TOLERANCE, "mag", _LOCUS, note=note))
    return rows


def _no_result(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
