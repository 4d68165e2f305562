"""Spectra of galaxies for skyCatalogs: luminosities in rest-frame wavelength bins.

Bins are equal in the logarithm of wavelength between spectral breaks and windows around the emission lines.
skyCatalogs makes f_lambda constant in each bin, dims it by the luminosity distance, redshifts it, and applies the
Milky Way's dust. A bin contains the photons of the spectrum inside it. A band whose response is smooth over a bin
therefore gets the same flux as from the full spectrum.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Float32
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes import cosmology, high_redshift, passbands
from truesky.fluxes.calibration import continuum_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.sources import GALAXY_KINDS, Galaxies, column, galaxies_from_table
from truesky.fluxes.spectra import extinction, intergalactic, lines
from truesky.fluxes.spectra.continuum import (
    COMPONENTS,
    REFERENCE_BAND,
    amplitudes,
    check_range,
    dust_curves,
    observed_shape,
)
from truesky.numerics import matrices

# Limits of the first and last bin, A: ultraviolet of galaxies at z = 6 to infrared of nearby galaxies.
FIRST_EDGE, LAST_EDGE = 450.5, 24499.5
# Width of a bin in ln(wavelength), and half the width of a line window relative to its wavelength (4 sigma of 300
# km/s).
_STEP, _WINDOW = 0.02, 0.004
# Wavelengths of spectral breaks, A: the Lyman limit; the lines of the Lyman series, because intergalactic hydrogen
# absorbs less redward of each of them; Lyman alpha with its red wing, narrow or wide; the Balmer limit.
_LYMAN_SERIES = (917.5, 919.5, 920.5, 923.5, 926.5, 930.5, 937.5, 949.5, 972.5, 1025.5)
_RED_OF_ALPHA = (1216.5, 1217.5, 1219.5, 1222.5, 1226.5, 1231.5, 1236.5, 1241.5, 1246.5, 1251.5, 1260.5)
_BREAKS = tuple((at, at) for at in (912.0, *_LYMAN_SERIES, 1215.5, *_RED_OF_ALPHA, 3646.0))
# Unit of L_nu, W/Hz. Source: GCR Catalogs, SCHEMA.md.
TOPHAT_W_HZ = 4.4659e13
_MPC_CM = 3.085677581491367e24
_ERG_W = 1e7
# Smallest redshift at which a luminosity distance is meaningful.
MIN_REDSHIFT = 1e-5
# Number of rows per block; each array of a block has 25 MB.
_BLOCK = 128
# Range and step of the law of Fitzpatrick et al. 2019, A.
_F19_RANGE, _F19_STEP = (1150.0, 33333.0), 5.0
_LYMAN_ALPHA = 1215.67


@lru_cache(maxsize=1)
def edges() -> Float:
    """Return the edges of the n bins, float64, shape (n + 1,), in A, halfway between the samples of the templates."""
    lowest, highest = (1.0 + sign * _WINDOW for sign in (-1.0, 1.0))
    line_windows = [(line.vacuum * lowest, line.vacuum * highest) for line in lines.line_list()]
    windows: list[list[float]] = []
    for low, high in sorted([*line_windows, *_BREAKS]):
        if windows and low < windows[-1][1]:
            windows[-1][1] = high
        else:
            windows.append([low, high])
    nodes, start = [FIRST_EDGE], FIRST_EDGE
    for low, high in [*windows, [LAST_EDGE, LAST_EDGE]]:
        count = int(np.ceil(np.log(low / start) / _STEP))
        nodes += [*np.geomspace(start, low, count + 1)[1:].tolist(), high]
        start = high
    return np.unique(np.floor(np.array(nodes)) + 0.5)


def luminosities(galaxies: pa.Table, library: Library) -> Float:
    """Return L_nu of galaxies in each bin, before magnification.

    Parameters
    ----------
    galaxies : Table
        Rows of table `galaxies`, of any kind.
    library : Library
        Templates of the kinds central, satellite and strong lens.

    Returns
    -------
    float array, shape (n, bins)
        L_nu in units of TOPHAT_W_HZ (4.4659e13 W/Hz).

    Notes
    -----
    skyCatalogs applies the extinction law of Fitzpatrick et al. 2019. The result includes the difference between our
    law and this law at the wavelength of each bin.
    """
    out = np.empty((galaxies.num_rows, len(edges()) - 1))
    for start in range(0, galaxies.num_rows, _BLOCK):
        rows = galaxies.slice(start, _BLOCK)
        z, a_v = column(rows, "z_obs"), column(rows, "a_v")
        is_galaxy = np.isin(column(rows, "kind"), GALAXY_KINDS)
        f_lambda = np.empty((len(z), out.shape[1]))
        if is_galaxy.any():
            f_lambda[is_galaxy] = _galaxies(galaxies_from_table(rows.filter(pa.array(is_galaxy)), library), library)
        if not is_galaxy.all():
            f_lambda[~is_galaxy] = _high_redshift(rows.filter(pa.array(~is_galaxy)))
        f_lambda *= extinction.transmission(_extinction_excess(z), a_v[:, None])
        out[start : start + _BLOCK] = f_lambda * _to_l_nu(z, column(rows, "z_true"))
    return out


def _galaxies(rows: Galaxies, library: Library) -> Float:
    """Observed f_lambda in each bin before magnification and the Milky Way, shape (n, bins), erg s-1 cm-2 A-1."""
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    amplitude = amplitudes(rows.mix, reference, library, dust)
    # Normalise to order 1, so that single precision does not underflow.
    amplitude /= amplitude.sum(0)
    spectra, dust_in_bins = _bin_library(library)
    total = np.zeros((len(rows), len(edges()) - 1))
    for k in range(len(COMPONENTS)):
        transmission = extinction.transmission(dust_in_bins[rows.mix.law[k]], rows.mix.ebv[k][:, None])
        total += amplitude[k][:, None] * spectra[rows.mix.sed[k]] * transmission
    count = len(reference.wavelength)
    shape = observed_shape(rows.mix, amplitude, library, dust, int(reference.wavelength[0]), count)
    scale = continuum_scale(rows.mag_r01, matrices.matmul(shape, passbands.weights(reference)))
    z = rows.mix.z_obs
    total *= (scale / (1.0 + z))[:, None]
    if library.intergalactic:
        total *= _intergalactic_transmission(z)
    return total + _line_light(rows.lines) / (1.0 + z)[:, None]


def templates_in_bins(library: Library) -> Float:
    """Return f_lambda of each template in each bin, float64, shape (templates, bins)."""
    return _bin_library(library)[0]


@lru_cache(maxsize=2)
def _bin_library(library: Library) -> tuple[Float, Float]:
    """Templates and extinction curves in bins; a curve is smooth over a bin, so its mean is sufficient."""
    return bin_spectra(library.flux, library.wavelength), bin_spectra(dust_curves(library), library.wavelength)


def _high_redshift(galaxies: pa.Table) -> Float:
    """Observed f_lambda in each bin of quasars and of galaxies beyond z = 6, otherwise as in `_galaxies`."""
    kind, z, mag, sed = (column(galaxies, name) for name in ("kind", "z_obs", "mag_r01", "sed_1"))
    out = np.empty((len(z), len(edges()) - 1))
    for code in high_redshift.MAGNITUDE_WAVELENGTH:
        selected = kind == code
        templates, spectra = _templates(code)
        template_index = sed[selected].astype(np.int64)
        check_range("sed_1", sed[selected], 0, len(templates) - 1)
        out[selected] = (
            high_redshift.template_scale(code, templates, template_index, mag[selected], z[selected])[:, None]
            * spectra[template_index]
        )
        if code == high_redshift.QUASAR and selected.any():
            out[selected] *= _intergalactic_transmission(z[selected])
    return out


@lru_cache(maxsize=2)
def _templates(kind: int) -> tuple[Library, Float]:
    """Library of quasars or of galaxies beyond z = 6, and its spectra in bins."""
    make_library = high_redshift.quasar_library if kind == high_redshift.QUASAR else high_redshift.high_redshift_library
    library = make_library()
    return library, bin_spectra(library.flux, library.wavelength)


def bin_spectra(spectra: Float32, wavelength: Float) -> Float:
    """Average spectra over the bins so that the number of photons in each bin is kept.

    Parameters
    ----------
    spectra : float32 array, shape (n, m)
        f_lambda.
    wavelength : float array, shape (m,)
        Integer wavelengths in steps of 1 A.

    Returns
    -------
    float array, shape (n, bins)
        f_lambda.
    """
    starts = np.floor(edges() + 0.5 - wavelength[0]).astype(np.int64)
    inside, at = slice(starts[0], starts[-1]), starts[:-1] - starts[0]
    photons = np.add.reduceat(spectra[:, inside] * wavelength[inside], at, axis=1)
    return np.asarray(photons / np.add.reduceat(wavelength[inside], at))


def _line_light(fluxes: Float) -> Float:
    """f_lambda of the lines, all of whose photons are in the bin of their rest-frame wavelength.

    Parameters
    ----------
    fluxes : float array, shape (n, lines)
        Line fluxes, erg s-1 cm-2.

    Returns
    -------
    float array, shape (n, bins)
        f_lambda.
    """
    vacuum = np.array([line.vacuum for line in lines.line_list()])
    bins = np.searchsorted(edges(), vacuum) - 1
    low, high = edges()[bins], edges()[bins + 1]
    out = np.zeros((len(fluxes), len(edges()) - 1))
    for k, place in enumerate(bins.tolist()):
        out[:, place] += fluxes[:, k] * vacuum[k] / (0.5 * (high[k] ** 2 - low[k] ** 2))
    return out


def _intergalactic_transmission(z: Float) -> Float:
    """Mean transmission of the intergalactic medium in each bin, shape (n, bins)."""
    wavelength = np.arange(1.0, np.ceil(_LYMAN_ALPHA * (1.0 + z.max())) + 2.0)
    transmissions = intergalactic.transmission(wavelength, z)
    out = np.empty((len(z), len(edges()) - 1))
    for i, transmission in enumerate(transmissions):
        # There is no absorption redward of the Lyman series.
        cumulative = np.append(0.0, np.cumsum(transmission))
        observed_edges = edges() * (1.0 + z[i])
        integral = np.interp(observed_edges, np.append(wavelength, wavelength[-1] + 1.0) - 0.5, cumulative)
        integral += np.maximum(observed_edges - wavelength[-1] - 0.5, 0.0)
        out[i] = np.diff(integral) / np.diff(observed_edges)
    return out


def _extinction_excess(z: Float) -> Float:
    """Our A(lambda) / A(V) minus the value of skyCatalogs at the observed wavelength of each bin, shape (n, bins)."""
    wavelength = _bin_centres() * (1.0 + z)[:, None]
    grid, difference = _law_difference()
    return np.interp(wavelength, grid, difference)


@lru_cache(maxsize=1)
def _law_difference() -> tuple[Float, Float]:
    """Return wavelengths (A), and our A(lambda) / A(V) minus Fitzpatrick et al. 2019 with R_V = 3.1, in its range."""
    # Import here, because these packages are slow to import.
    import astropy.units as u
    from dust_extinction.parameter_averages import F19

    grid = np.arange(*_F19_RANGE, _F19_STEP)
    curve = F19(Rv=extinction.MILKY_WAY_R_V)
    return grid, extinction.milky_way(grid) - np.asarray(curve(1e4 / grid / u.um), float)


def _to_l_nu(z_obs: Float, z_true: Float) -> Float:
    """Factors that convert observed f_lambda (erg s-1 cm-2 A-1) into L_nu of a bin, shape (n, bins)."""
    low, high = edges()[:-1], edges()[1:]
    width = (high - low) / (LIGHT_ANGSTROM_S * (1.0 / low - 1.0 / high))
    distance = cosmology.luminosity_distance(np.maximum(z_true, MIN_REDSHIFT)) / cosmology.HUBBLE * _MPC_CM
    dimming = 4.0 * np.pi * distance**2 * (1.0 + z_obs) / (_ERG_W * TOPHAT_W_HZ)
    return np.asarray(dimming[:, None] * width)


def _bin_centres() -> Float:
    """Mean wavelength of the photons in each bin of constant f_lambda, A."""
    low, high = edges()[:-1], edges()[1:]
    return 2.0 / 3.0 * (high**3 - low**3) / (high**2 - low**2)
