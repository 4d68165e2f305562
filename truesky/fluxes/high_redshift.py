"""Compute spectra and fluxes of quasars and of galaxies beyond z = 6.

These sources are few, and their fluxes are integrated directly. In the table `galaxies`, quasars have `kind` 2 and
high-redshift galaxies `kind` 3. Such a row has one template, sed_1, without internal dust; emission lines are in the
template. Its mag_r01 is a monochromatic AB magnitude at 1450 A (quasars) or 1500 A (galaxies) in the rest frame
(Serrano et al. 2024, appendix B).
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import units
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.cosmology import Cosmology
from truesky.fluxes import passbands
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import column, source_ids, table_magnification
from truesky.fluxes.spectra import extinction, intergalactic, milky_way
from truesky.fluxes.spectra.continuum import check_range
from truesky.numerics import matrices

QUASAR, HIGH_REDSHIFT = 2, 3
# Rest-frame wavelength (A) at which mag_r01 is the monochromatic magnitude.
MAGNITUDE_WAVELENGTH = {QUASAR: 1450.0, HIGH_REDSHIFT: 1500.0}
Z_MAX = 15.0

# First rest-frame wavelength of the templates, A; 600 A observed at z = 15 is 37.5 A.
_REST_FIRST = 36
# Last rest-frame wavelength, A; 24000 A observed at z = 0, with some margin.
_REST_LAST = 24500
# Wavelength of Lyman alpha, A. Templates of galaxies have no flux below it. Templates of quasars do, and intergalactic
# absorption is applied to their observed spectra.
_LYMAN_ALPHA = 1215.67

# Exponents of a quasar's f_lambda (a power of lambda) below and above 5000 A: Vanden Berk et al. 2001.
_QUASAR_SLOPE, _QUASAR_RED_SLOPE, _QUASAR_BREAK = -1.56, 0.45, 5000.0
# Exponent of f_lambda below Lyman alpha, where f_nu falls as nu^-1.7: Lusso et al. 2015, MNRAS 449, 4204.
_QUASAR_FAR_UV_SLOPE = -0.3
# Offsets from the exponent _QUASAR_SLOPE, and factors of the line fluxes. All 3 x 3 combinations are templates, as in
# Barnett et al. 2019.
QUASAR_OFFSETS, QUASAR_STRENGTHS = (-0.3, 0.0, 0.3), (0.5, 1.0, 2.0)
QUASAR_LINES = Path(__file__).with_name("quasar_lines.csv")

# Exponents of f_lambda of high-redshift galaxies, around the mean of Bouwens et al. 2014.
HIGH_REDSHIFT_SLOPES = (-2.6, -2.3, -2.0, -1.7, -1.4)
# Rest-frame equivalent widths of Lyman alpha, A.
LYMAN_ALPHA_WIDTHS = (0.0, 25.0, 50.0)
# Gaussian sigma of Lyman alpha, A (adopted). Only the red half of the line is transmitted.
_LYMAN_ALPHA_SIGMA = 1.0

# Hubble parameter h for which the luminosity functions of quasars and high-redshift galaxies (absolute magnitudes, and
# densities in Mpc^-3) are published. It defines their unit, whatever the h of the universe.
HUBBLE = 0.67
# Number of sources whose whole spectra are computed at a time.
_BLOCK = 64


@cache
def quasar_library() -> Library:
    """Return the nine quasar templates. Template 3 i + j has QUASAR_OFFSETS[i] and QUASAR_STRENGTHS[j].

    These are the offset of the continuum's exponent from the mean, and the factor of the line fluxes.
    """
    wavelength = _rest_wavelengths()
    flux, names = [], []
    for offset in QUASAR_OFFSETS:
        for strength in QUASAR_STRENGTHS:
            flux.append(_quasar_spectrum(wavelength, _QUASAR_SLOPE + offset, strength))
            names.append(f"QSO slope {offset:+.1f} lines x {strength:g}")
    return Library(wavelength, np.stack(flux).astype(np.float32), tuple(names))


@cache
def high_redshift_library() -> Library:
    """Return the 15 templates of high-redshift galaxies.

    Template 3 i + j has the ultraviolet slope HIGH_REDSHIFT_SLOPES[i] and the Lyman alpha equivalent width
    LYMAN_ALPHA_WIDTHS[j].
    """
    wavelength = _rest_wavelengths()
    flux, names = [], []
    for slope in HIGH_REDSHIFT_SLOPES:
        for width in LYMAN_ALPHA_WIDTHS:
            flux.append(_star_forming_spectrum(wavelength, slope, width))
            names.append(f"slope {slope:.1f} Lya {width:g} A")
    return Library(wavelength, np.stack(flux).astype(np.float32), tuple(names))


def ultraviolet_magnitude(cosmology: Cosmology, abs_mag: npt.ArrayLike, z: npt.ArrayLike) -> Float:
    """Return the apparent monochromatic AB magnitude at the redshifted wavelength, M_UV + DM - 2.5 log10(1 + z).

    The result is stored in the column mag_r01 of quasars and high-redshift galaxies.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    abs_mag : array_like
        Absolute magnitude M_UV, for h = 0.67 as the distance modulus DM.
    z : array_like
        Redshift.

    Returns
    -------
    float array
        AB magnitude.
    """
    distance = cosmology.distance_modulus(z) - 5.0 * np.log10(HUBBLE)
    return np.asarray(np.asarray(abs_mag, float) + distance - 2.5 * np.log10(1.0 + np.asarray(z, float)))


def fluxes(galaxies: pa.Table, bands: Sequence[Passband]) -> Float:
    """Return the fluxes of quasars and high-redshift galaxies, with magnification and Milky Way extinction.

    Parameters
    ----------
    galaxies : pa.Table
        Rows of the table `galaxies` with `kind` 2 (quasars) or 3 (high-redshift galaxies).
    bands : sequence of Passband
        The passbands.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.

    Raises
    ------
    BadInput
        If a value is missing, or frac_2 or ebv_1 is not 0. The message names the column and the source.
    OutOfRange
        If a redshift, magnitude, extinction, template number or magnification is out of range.
    """
    out = np.zeros((galaxies.num_rows, len(bands)))
    first = min((int(band.wavelength[0]) for band in bands), default=passbands.GRID_FIRST)
    last = max((int(band.wavelength[-1]) for band in bands), default=first)
    for start in range(0, galaxies.num_rows, _BLOCK):
        f_lambda = spectra(galaxies.slice(start, _BLOCK), first, last)
        for k, band in enumerate(bands):
            low = int(band.wavelength[0]) - first
            in_band = f_lambda[:, low : low + len(band.wavelength)]
            out[start : start + _BLOCK, k] = matrices.matmul(in_band, passbands.weights(band))
    return units.ujy_of_cgs(out)


def spectra(galaxies: pa.Table, first: int = passbands.GRID_FIRST, last: int = passbands.GRID_LAST) -> Float:
    """Return the observed spectra of quasars and high-redshift galaxies.

    Lensing magnification, intergalactic absorption (quasars) and Milky Way extinction are included.

    Parameters
    ----------
    galaxies : pa.Table
        Rows of the table `galaxies` with `kind` 2 (quasars) or 3 (high-redshift galaxies). Other kinds give 0.
    first, last : int, optional
        First and last wavelength in A, by default 600 and 24000.

    Returns
    -------
    float array, shape (n, last - first + 1)
        f_lambda in erg s-1 cm-2 A-1 at `first` to `last` in steps of 1 A.

    Raises
    ------
    BadInput
        If a value is missing, or frac_2 or ebv_1 is not 0. The message names the column and the source.
    OutOfRange
        If a redshift, magnitude, extinction, template number or magnification is out of range.
    """
    return spectra_at(galaxies, np.arange(first, last + 1.0))


def spectra_at(galaxies: pa.Table, wavelength: Float) -> Float:
    """Return the observed spectra of quasars and high-redshift galaxies at given wavelengths.

    Parameters
    ----------
    galaxies : pa.Table
        Rows as for `spectra`.
    wavelength : float array, shape (w,)
        Increasing wavelengths in A. Absorption by intergalactic hydrogen is that in bins of 1 A.

    Returns
    -------
    float array, shape (n, w)
        f_lambda in erg s-1 cm-2 A-1.

    Raises
    ------
    BadInput
        If a value is missing, or frac_2 or ebv_1 is not 0. The message names the column and the source.
    OutOfRange
        If a redshift, magnitude, extinction, template number or magnification is out of range, or a wavelength is not
        from 600 to 24000 A.
    """
    check_range("wavelength", wavelength, passbands.GRID_FIRST, passbands.GRID_LAST)
    kind, z, mag, a_v = (column(galaxies, name) for name in ("kind", "z_obs", "mag_r01", "a_v"))
    sed = column(galaxies, "sed_1").astype(np.int64)
    check_range("z_obs", z, 0.0, Z_MAX)
    check_range("mag_r01", mag, -5.0, 60.0)
    check_range("a_v", a_v, 0.0, 40.0)
    _refuse_mixtures(galaxies)
    out = np.zeros((galaxies.num_rows, len(wavelength)))
    for code, library in ((QUASAR, quasar_library), (HIGH_REDSHIFT, high_redshift_library)):
        indices = np.flatnonzero(kind == code)
        if not len(indices):
            continue
        templates = library()
        check_range("sed_1", sed[indices].astype(float), 0, len(templates) - 1)
        factors = template_scale(code, templates, sed[indices], mag[indices], z[indices])
        for i, factor in zip(indices, factors, strict=True):
            spectrum = templates.flux[sed[i]].astype(float)
            out[i] = factor * np.interp(wavelength / (1.0 + z[i]), templates.wavelength, spectrum)
        if code == QUASAR:
            absorbed = indices[intergalactic.first_transparent(z[indices]) > wavelength[0]]
            out[absorbed] *= intergalactic.transmission(wavelength, z[absorbed])
    out *= table_magnification(galaxies)[:, None]
    out *= extinction.transmission(milky_way.law(wavelength), a_v[:, None])
    return out


def template_scale(code: int, templates: Library, sed: Int, mag: Float, z: Float) -> Float:
    """Return the factor that converts a template's f_lambda at lambda / (1 + z) to the observed f_lambda at lambda.

    Magnification and extinction are not included.

    Parameters
    ----------
    code : int
        Kind of source, `QUASAR` or `HIGH_REDSHIFT`.
    templates : Library
        Templates of this kind of source.
    sed : int array, shape (n,)
        Index of each source's template.
    mag : float array, shape (n,)
        Apparent AB magnitude (column mag_r01) at the redshifted 1450 A (quasars) or 1500 A (galaxies).
    z : float array, shape (n,)
        Redshifts.

    Returns
    -------
    float array, shape (n,)
        Factors, in erg s-1 cm-2 A-1 per unit of the template.
    """
    wavelength = MAGNITUDE_WAVELENGTH[code]
    template_flux = np.array(
        [np.interp(wavelength, templates.wavelength, spectrum.astype(float)) for spectrum in templates.flux]
    )
    f_nu = units.cgs_of_ujy(units.f_nu_of_mag(mag))
    return np.asarray(f_nu * LIGHT_ANGSTROM_S / (wavelength * (1.0 + z)) ** 2 / template_flux[sed])


def _refuse_mixtures(galaxies: pa.Table) -> None:
    for name, why in (("frac_2", "has a second component"), ("ebv_1", "has internal dust")):
        values = column(galaxies, name)
        if (bad := values != 0.0).any():
            source = int(source_ids(galaxies)[np.flatnonzero(bad)[0]])
            raise BadInput(f"galaxies: source {source} of kind 2 or 3 {why} ({name} is not 0)")


def _rest_wavelengths() -> Float:
    return np.arange(_REST_FIRST, _REST_LAST + 1, dtype=float)


def _quasar_spectrum(wavelength: Float, slope: float, strength: float) -> Float:
    ratio = wavelength / _QUASAR_BREAK
    continuum = np.where(ratio < 1.0, ratio**slope, ratio**_QUASAR_RED_SLOPE)
    edge = (_LYMAN_ALPHA / _QUASAR_BREAK) ** slope
    far_uv = edge * (wavelength / _LYMAN_ALPHA) ** _QUASAR_FAR_UV_SLOPE
    continuum = np.where(wavelength < _LYMAN_ALPHA, far_uv, continuum)
    flux = continuum.copy()
    with QUASAR_LINES.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            centre, width, sigma = (float(row[name]) for name in ("wavelength", "equivalent_width", "sigma"))
            profile = np.exp(-0.5 * ((wavelength - centre) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
            flux += strength * width * np.interp(centre, wavelength, continuum) * profile
    return flux


def _star_forming_spectrum(wavelength: Float, slope: float, width: float) -> Float:
    """Return f_lambda of a high-redshift galaxy: a power law that is 1 at 1500 A, with the red half of Lyman alpha.

    `wavelength` is in A in steps of 1 A, `slope` the exponent, and `width` the equivalent width of Lyman alpha in A.
    f_lambda is 0 below Lyman alpha. The line is averaged over bins of 1 A.
    """
    from scipy.special import erf

    flux = np.where(wavelength < _LYMAN_ALPHA, 0.0, (wavelength / MAGNITUDE_WAVELENGTH[HIGH_REDSHIFT]) ** slope)
    edges = np.append(wavelength, wavelength[-1] + 1.0) - 0.5
    profile = np.diff(erf(np.maximum(edges - _LYMAN_ALPHA, 0.0) / (np.sqrt(2.0) * _LYMAN_ALPHA_SIGMA)))
    return np.asarray(flux + width * (_LYMAN_ALPHA / MAGNITUDE_WAVELENGTH[HIGH_REDSHIFT]) ** slope * profile)
