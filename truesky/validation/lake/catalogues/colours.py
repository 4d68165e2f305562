"""Check fluxes of galaxies in each band against their spectra, and colours of red galaxies against observations.

The magnitudes from the table `galaxy_fluxes` are compared with magnitudes that are computed from the spectra in the
table `galaxies`, including extinction by the Milky Way and lensing magnification. The median difference is checked.

Notes
-----
The spectra here have no emission lines, which make galaxies 0.01 mag brighter in the median. The extinction is computed
for flat spectra. For red spectra it is wrong by up to 0.06 A(V) in the widest band, so the tolerance is larger by this
amount.

References
----------
Eisenstein et al. 2001, AJ 122, 2267 (c_perp)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lake_schema.arrays import Array, Float, Int
from lake_schema.store import read
from truesky.cosmology import Cosmology, from_facts
from truesky.fluxes import band_fluxes, passbands, sources
from truesky.randomness import rng
from truesky.validation import field as fields
from truesky.validation.field import Field
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.model import observed

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "colours"
# Source of the expected magnitudes, as text for the report.
SOURCE = "the spectra in table galaxies, by the published passbands"
# Source of the observed colours of red galaxies.
_LOCUS = "Eisenstein et al. 2001, AJ 122, 2267"
# Columns of the table `galaxies` that the check of magnitudes and colours reads.
COLUMNS = ("id", "_healpix_29", "kind", "z_true", "mag_r01", "a_v", "kappa", "gamma1", "gamma2", "abs_mag_r01",
           "color_gr_01", "sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")  # fmt: skip
# Beginning of the names of flux columns; the name of the band follows.
_FLUX = "f_nu_"
# Faintest magnitude at 5600 A (mag_r01) of the checked galaxies.
_MAX_MAG = 23.0
# Largest redshift of the checked galaxies: below it, intergalactic gas does not absorb and emission lines are weak.
_MAX_REDSHIFT = 1.5
# Approximate largest number of galaxies; of more galaxies, a random subset is checked.
_MAX_GALAXIES = 30_000
# With fewer galaxies than this number, the check is not applicable.
_MIN_GALAXIES = 100
# Tolerance of the median difference between a magnitude from the table of fluxes and one computed from the spectrum, if
# the Milky Way has no dust in the field, mag.
_TOLERANCE = 0.03
# Additional tolerance of the median magnitude difference, in mag per magnitude of the Milky Way's extinction A(V): the
# extinction is computed for flat spectra.
_PER_DUST = 0.06
# Number of values of A(V) at which the extinction in a band is computed; it is interpolated between them.
_NODES = 12
# Ranges of redshift (lowest, highest) in which the colours of luminous red galaxies are checked.
_RED = ((0.15, 0.25), (0.25, 0.35))
# Red galaxies must be brighter than this M_r - 5 log h, mag.
_RED_MAG = -20.5
# Tolerance of the median deviation of luminous red galaxies from the observed relation of two colours, mag.
_LOCUS_TOLERANCE = 0.05
# With fewer red galaxies than this number in a redshift range, their colours are not checked.
_MIN_RED_GALAXIES = 20
# Edges of the bins of the plotted colour-colour histogram, for both colours, mag.
_EDGES = np.linspace(-0.5, 2.5, 91)


def measure(galaxies: read.Version, fluxes: read.Version) -> Result:
    """Check the magnitudes and colours of the tables `galaxies` and `galaxy_fluxes` of a lake.

    Returns rows (measured values with expected values and verdicts) and arrays for plots. The only row is
    "not_applicable" if a required column is missing, or if `galaxy_fluxes` lacks a selected galaxy.
    """
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
    by_band = {band: light[_FLUX + band].to_numpy()[order[at]] for band in bands}
    return compare(columns, by_band, field, from_facts(galaxies.manifest.get("facts", {})))


def compare(columns: Mapping[str, Array], flux: Mapping[str, Array], field: Field, cosmology: Cosmology) -> Result:
    """Check the fluxes of galaxies in several bands against their spectra.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        COLUMNS of the table `galaxies`.
    flux : mapping of str to array, shape (n,)
        Fluxes of the same galaxies by band, uJy.
    field : Field
        Area of the sky that contains the galaxies, with jackknife patches for errors.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Result
        One row per band with its verdict and the median magnitude difference: magnitude of the flux minus magnitude
        computed from the spectrum. With the bands g, r and i of LSST, also rows for the colours of red galaxies, and a
        colour-colour histogram for plots. With fewer than 100 galaxies or without bands, the only row is
        "not_applicable".
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
        offset = magnitudes - observed.apparent_magnitudes(columns, band, cosmology) + 2.5 * np.log10(magnified * dust)
        # Count galaxies without flux in the band as infinitely faint, so that many of them make the check fail.
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
    """Return the fraction of a galaxy's light in a band that dust in the Milky Way transmits, for each A(V) (mag).

    The spectrum of the galaxies is assumed to be flat in f_nu.
    """
    curve, nodes = passbands.load(band), np.linspace(0.0, max(float(a_v.max()), 1e-3), _NODES)
    weight = curve.response / curve.wavelength
    through = band_fluxes.milky_way_transmission(curve.wavelength, nodes)
    return np.asarray(np.interp(a_v, nodes, np.sum(through * weight, 1) / np.sum(weight)))


def _median(values: Float, patch: Int, n_patches: int) -> tuple[float, float]:
    """Return the median of magnitude differences and its standard error.

    The error is the larger of the jackknife error over patches and the error from the scatter of the values within 1
    mag of the median. A jackknife error that cannot be computed is ignored.
    """
    middle = float(np.median(values))
    remaining = [values[patch != left_out] for left_out in range(n_patches)]
    rest = [np.median(sample) if len(sample) else np.nan for sample in remaining]
    typical = values[np.isfinite(values)]
    typical = typical[np.abs(typical - middle) < 1.0]
    sample_error = 1.25 * float(np.std(typical)) / np.sqrt(max(len(typical), 1)) if len(typical) else 0.0
    by_patch = float(fields.jackknife_error(rest)) if np.isfinite(rest).all() else np.nan
    return middle, float(np.nanmax([sample_error, by_patch]))


def _locus_rows(columns: Mapping[str, Array], gr: Float, ri: Float) -> list[Row]:
    """Check the colours of luminous red galaxies against the observed locus r - i = (g - r) / 4 + 0.18 at z < 0.4.

    Returns one row for each redshift range. The relation is quoted from memory, so the verdict is always "undecided",
    or "not_applicable" with fewer than 20 galaxies.
    """
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
