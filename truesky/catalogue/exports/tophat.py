"""Compute the spectra of galaxies for skyCatalogs: luminosities in rest-frame wavelength bins.

Between spectral breaks and narrow windows around the emission lines, bins have equal widths in the logarithm of
wavelength. skyCatalogs makes f_lambda constant in each bin, dims it by the luminosity distance, redshifts it, and
applies the Milky Way's dust. Each bin has the same number of photons as the spectrum inside it. A band whose response
is smooth over a bin therefore gets the same flux as from the full spectrum.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Float32
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.cosmology import Cosmology
from truesky.fluxes import high_redshift, passbands
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

# Lower limit of the first and upper limit of the last bin (rest frame, A). They cover the ultraviolet of galaxies at
# z = 6 and the infrared of nearby galaxies.
FIRST_EDGE, LAST_EDGE = 450.5, 24499.5
# Largest width of a bin in ln(wavelength), before the edges are rounded to half an angstrom.
_STEP = 0.02
# Half the width of the window around an emission line relative to its wavelength (4 sigma of a line with 300 km/s).
_WINDOW = 0.004
# Wavelengths (A) of the lines of the Lyman series except Lyman alpha, which are edges of bins, because intergalactic
# hydrogen absorbs less redward of each line.
_LYMAN_SERIES = (917.5, 919.5, 920.5, 923.5, 926.5, 930.5, 937.5, 949.5, 972.5, 1025.5)
# Edges of bins (A) in the red wing of Lyman alpha, narrow near the line and wider farther from it.
_RED_OF_ALPHA = (1216.5, 1217.5, 1219.5, 1222.5, 1226.5, 1231.5, 1236.5, 1241.5, 1246.5, 1251.5, 1260.5)
# Windows (lower limit, upper limit) without width, in A, so that the wavelengths of spectral breaks are edges of bins:
# Lyman limit, Lyman series, Lyman alpha and its wing, and Balmer limit.
_BREAKS = tuple((at, at) for at in (912.0, *_LYMAN_SERIES, 1215.5, *_RED_OF_ALPHA, 3646.0))
# Unit of luminosities per frequency in skyCatalogs, W/Hz. Source: GCR Catalogs, SCHEMA.md.
TOPHAT_W_HZ = 4.4659e13
_MPC_CM = 3.085677581491367e24
_ERG_W = 1e7
# Smaller redshifts are replaced by this value, because the luminosity distance must not be 0.
MIN_REDSHIFT = 1e-5
# Number of galaxies that are computed together; each of their arrays has 25 MB.
_BLOCK = 128
# Wavelength range and step (A) in which the extinction law of Fitzpatrick et al. 2019 is tabulated.
_F19_RANGE, _F19_STEP = (1150.0, 33333.0), 5.0
_LYMAN_ALPHA = 1215.67


@lru_cache(maxsize=1)
def edges() -> Float:
    """Return the edges of the n rest-frame wavelength bins in A, float64, shape (n + 1,).

    The edges end in .5, because the templates have samples at integer wavelengths.
    """
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


def luminosities(galaxies: pa.Table, library: Library, cosmology: Cosmology) -> Float:
    """Return the luminosities L_nu of galaxies in each wavelength bin, without magnification.

    Parameters
    ----------
    galaxies : Table
        Rows of table `galaxies`, which may also contain quasars and galaxies beyond z = 6.
    library : Library
        Template spectra of the galaxies in halos.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    float array, shape (n, bins)
        L_nu in units of TOPHAT_W_HZ (4.4659e13 W/Hz).

    Notes
    -----
    skyCatalogs applies the Milky Way's dust with the extinction law of Fitzpatrick et al. 2019, but truesky uses
    another law (O'Donnell 1994). The result therefore includes the difference between both laws at the observed
    wavelength of each bin.
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
        out[start : start + _BLOCK] = f_lambda * _to_l_nu(cosmology, z, column(rows, "z_true"))
    return out


def _galaxies(rows: Galaxies, library: Library) -> Float:
    """Return the observed f_lambda (erg s-1 cm-2 A-1) of galaxies in halos in each bin, shape (n, bins).

    Emission lines and intergalactic absorption are included; magnification and the Milky Way's dust are not.
    """
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    amplitude = amplitudes(rows.mix, reference, library, dust)
    # Normalise the amplitudes of each galaxy's templates to a sum of 1, so that single precision does not underflow.
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
    """Return the mean f_lambda of each template in each rest-frame wavelength bin, shape (templates, bins).

    The unit is that of `library.flux`. The array is cached and must not be changed."""
    return _bin_library(library)[0]


@lru_cache(maxsize=2)
def _bin_library(library: Library) -> tuple[Float, Float]:
    """Return the spectra of all templates and the curves of all extinction laws, averaged over each wavelength bin.

    The arrays have the shapes (templates, bins) and (laws, bins).
    """
    return bin_spectra(library.flux, library.wavelength), bin_spectra(dust_curves(library), library.wavelength)


def _high_redshift(galaxies: pa.Table) -> Float:
    """Return the observed f_lambda (erg s-1 cm-2 A-1) of quasars and galaxies beyond z = 6 in each bin, (n, bins).

    Magnification and the Milky Way's dust are not included.
    """
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
    """Return the template library of quasars or of galaxies beyond z = 6, and its spectra in wavelength bins.

    `kind` is high_redshift.QUASAR or high_redshift.HIGH_REDSHIFT.
    """
    make_library = high_redshift.quasar_library if kind == high_redshift.QUASAR else high_redshift.high_redshift_library
    library = make_library()
    return library, bin_spectra(library.flux, library.wavelength)


def bin_spectra(spectra: Float32, wavelength: Float) -> Float:
    """Average spectra over the wavelength bins so that the number of photons in each bin is kept.

    Parameters
    ----------
    spectra : float32 array, shape (n, m)
        f_lambda, in any unit.
    wavelength : float array, shape (m,)
        Integer wavelengths in steps of 1 A, which must cover all bins.

    Returns
    -------
    float array, shape (n, bins)
        Mean f_lambda of each bin, weighted with the wavelength, in the same unit.
    """
    starts = np.floor(edges() + 0.5 - wavelength[0]).astype(np.int64)
    inside, at = slice(starts[0], starts[-1]), starts[:-1] - starts[0]
    photons = np.add.reduceat(spectra[:, inside] * wavelength[inside], at, axis=1)
    return np.asarray(photons / np.add.reduceat(wavelength[inside], at))


def _line_light(fluxes: Float) -> Float:
    """Return the f_lambda that emission lines add to each bin; a line is completely in the bin of its wavelength.

    Parameters
    ----------
    fluxes : float array, shape (n, lines)
        Line fluxes, erg s-1 cm-2.

    Returns
    -------
    float array, shape (n, bins)
        f_lambda per rest-frame A, erg s-1 cm-2 A-1.
    """
    vacuum = np.array([line.vacuum for line in lines.line_list()])
    bins = np.searchsorted(edges(), vacuum) - 1
    low, high = edges()[bins], edges()[bins + 1]
    out = np.zeros((len(fluxes), len(edges()) - 1))
    for k, place in enumerate(bins.tolist()):
        out[:, place] += fluxes[:, k] * vacuum[k] / (0.5 * (high[k] ** 2 - low[k] ** 2))
    return out


def _intergalactic_transmission(z: Float) -> Float:
    """Return the mean transmission of the intergalactic medium in each bin for galaxies at redshifts z, (n, bins)."""
    wavelength = np.arange(1.0, np.ceil(_LYMAN_ALPHA * (1.0 + z.max())) + 2.0)
    transmissions = intergalactic.transmission(wavelength, z)
    out = np.empty((len(z), len(edges()) - 1))
    for i, transmission in enumerate(transmissions):
        # Redward of Lyman alpha, where `wavelength` ends, the transmission is 1.
        cumulative = np.append(0.0, np.cumsum(transmission))
        observed_edges = edges() * (1.0 + z[i])
        integral = np.interp(observed_edges, np.append(wavelength, wavelength[-1] + 1.0) - 0.5, cumulative)
        integral += np.maximum(observed_edges - wavelength[-1] - 0.5, 0.0)
        out[i] = np.diff(integral) / np.diff(observed_edges)
    return out


def _extinction_excess(z: Float) -> Float:
    """Return A(lambda) / A(V) of truesky minus that of skyCatalogs at the observed wavelengths of bins, (n, bins)."""
    wavelength = _bin_centres() * (1.0 + z)[:, None]
    grid, difference = _law_difference()
    return np.interp(wavelength, grid, difference)


@lru_cache(maxsize=1)
def _law_difference() -> tuple[Float, Float]:
    """Return wavelengths (A), and A(lambda) / A(V) of truesky's law minus that of Fitzpatrick et al. 2019.

    Both laws are for R_V = 3.1. The wavelengths are the range of the latter law.
    """
    # Import here, because these packages are slow to import.
    import astropy.units as u
    from dust_extinction.parameter_averages import F19

    grid = np.arange(*_F19_RANGE, _F19_STEP)
    curve = F19(Rv=extinction.MILKY_WAY_R_V)
    return grid, extinction.milky_way(grid) - np.asarray(curve(1e4 / grid / u.um), float)


def _to_l_nu(cosmology: Cosmology, z_obs: Float, z_true: Float) -> Float:
    """Return the factors from observed f_lambda (erg s-1 cm-2 A-1) to L_nu (TOPHAT_W_HZ) in each bin, (n, bins)."""
    low, high = edges()[:-1], edges()[1:]
    width = (high - low) / (LIGHT_ANGSTROM_S * (1.0 / low - 1.0 / high))
    distance = cosmology.luminosity_distance(np.maximum(z_true, MIN_REDSHIFT)) / cosmology.h * _MPC_CM
    dimming = 4.0 * np.pi * distance**2 * (1.0 + z_obs) / (_ERG_W * TOPHAT_W_HZ)
    return np.asarray(dimming[:, None] * width)


def _bin_centres() -> Float:
    """Return the mean wavelength (A) of the photons in each bin, for a constant f_lambda."""
    low, high = edges()[:-1], edges()[1:]
    return 2.0 / 3.0 * (high**3 - low**3) / (high**2 - low**2)
