"""Light curves of active nuclei, whose magnitudes are damped random walks.

The scatter and the time scale of a walk depend on the rest-frame wavelength, the luminosity and the mass of the black
hole. All passbands of a nucleus have the same random deviates, so that their variations are strongly correlated. The
mean flux of a light curve over all times is the flux of the catalogue. Nuclei of type 2 do not vary, because dust hides
their continuum.

References
----------
MacLeod et al. 2010, ApJ 721, 1014 (arXiv:1004.0276), eq. 7 and table 1; Kelly et al. 2009, ApJ 698, 895
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import units
from lake_schema.arrays import Float, Int
from truesky.fluxes import high_redshift, thin_passbands
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import intergalactic
from truesky.numerics import matrices
from truesky.variability import damped_random_walk, nuclear_luminosity

Columns = Mapping[str, npt.NDArray[np.generic]]
# Columns of table `active_nuclei` that `flux_factors` and `fluxes` need.
FACTOR_COLUMNS = ("light_curve_key", "z_obs", "m_1450", "log_black_hole_mass", "type")
FLUX_COLUMNS = (*FACTOR_COLUMNS, "id", "mag_1450", "template", "kappa", "gamma1", "gamma2", "a_v")

# Coefficients A, B, C and D of log10 f = A + B log10(wavelength / 4000 A) + C (M_i + 23) + D log10(M_BH / 1e9 Msun).
# f is the structure function at long times SF_inf in mag, or the time scale tau in days of the rest frame. M_i is
# K-corrected to z = 2.
_SF_INFINITY, _TAU = (-0.51, -0.479, 0.131, 0.18), (2.4, 0.17, 0.03, 0.21)
# The relations are constant outside this range of rest-frame wavelengths (A), and SF_inf (mag) is limited: assumed. The
# quasars of the paper have wavelengths of 900 to 7000 A and M_i < -22, and faint nuclei would vary by a magnitude.
_WAVELENGTHS = (900.0, 7000.0)
_LARGEST_SF = 0.7
_LN_PER_MAG = 0.4 * np.log(10.0)
_TYPE_1 = 1
# Number of nuclei whose spectra are computed at a time.
_BLOCK = 256
# Nuclei are grouped by the observed wavelength of Lyman alpha in steps of this width, A.
_GROUP_WIDTH = 1000.0


def parameters(m_1450: Float, log_black_hole_mass: Float, wavelength: Float) -> tuple[Float, Float]:
    """Return the parameters of the damped random walks of nuclei.

    Parameters
    ----------
    m_1450 : float array, shape (n,)
        Absolute AB magnitude at 1450 A.
    log_black_hole_mass : float array, shape (n,)
        log10 of the mass of the black hole, Msun.
    wavelength : float array, shape (n,)
        Wavelength in the rest frame, A.

    Returns
    -------
    sf_infinity : float array, shape (n,)
        Structure function at long times, mag: sqrt(2) times the standard deviation of the magnitude.
    tau : float array, shape (n,)
        Time scale in the rest frame, days.
    """
    terms = (
        np.log10(np.clip(wavelength, *_WAVELENGTHS) / 4000.0),
        nuclear_luminosity.i_magnitude(m_1450) + 23.0,
        log_black_hole_mass - 9.0,
    )
    log_sf, log_tau = (
        zero + sum(slope * term for slope, term in zip(slopes, terms, strict=True))
        for zero, *slopes in (_SF_INFINITY, _TAU)
    )
    return np.minimum(10.0**log_sf, _LARGEST_SF), np.asarray(10.0**log_tau)


def mean_wavelength(band: Passband) -> float:
    """Return the mean wavelength (A) of a passband for a source with constant f_lambda, weighted by photons."""
    weight = band.response * band.wavelength
    return float(np.sum(weight * band.wavelength) / np.sum(weight))


def flux_factors(nuclei: Columns, band: Passband, mjd: npt.ArrayLike) -> Float:
    """Return the fluxes of nuclei at dates, relative to their mean fluxes.

    Parameters
    ----------
    nuclei : mapping of str to array, shape (n,)
        Columns FACTOR_COLUMNS of table `active_nuclei`.
    band : Passband
        The passband.
    mjd : float or float array, shape (m,) or (n, m)
        Date, dates of all nuclei, or dates of each nucleus, from 32768 to 98304.

    Returns
    -------
    float array, shape (n,) or (n, m)
        f_nu(t) / mean f_nu; the shape (n,) if `mjd` is one number. It is 1 for nuclei of type 2.

    Raises
    ------
    OutOfRange
        If a date is outside the range.
    """
    stretch = 1.0 + np.asarray(nuclei["z_obs"], float)
    m_1450, mass = (np.asarray(nuclei[name], float) for name in ("m_1450", "log_black_hole_mass"))
    sf_infinity, tau = parameters(m_1450, mass, mean_wavelength(band) / stretch)
    keys = np.ascontiguousarray(nuclei["light_curve_key"], np.int64).view(np.uint64)
    walk = damped_random_walk.values(keys, tau * stretch, mjd)
    scatter = np.where(nuclei["type"] == _TYPE_1, _LN_PER_MAG * sf_infinity / np.sqrt(2.0), 0.0)
    scatter = scatter.reshape(-1, *[1] * (walk.ndim - 1))
    # The second term makes the mean of the flux 1.
    return np.asarray(np.exp(scatter * walk - 0.5 * scatter**2))


def mean_fluxes(nuclei: Columns, bands: Sequence[Passband]) -> Float:
    """Return the mean fluxes of nuclei without their galaxies, with magnification and Milky Way extinction.

    Parameters
    ----------
    nuclei : mapping of str to array, shape (n,)
        Columns FLUX_COLUMNS of table `active_nuclei`.
    bands : sequence of Passband
        The passbands.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky, right within 1e-4 (`thin_passbands.weights`); 0 for nuclei of type 2. The narrow lines are
        part of the galaxy's lines in table `galaxies`.

    Raises
    ------
    BadInput
        If a value is missing.
    OutOfRange
        If a value is out of range.
    """
    row = np.flatnonzero(nuclei["type"] == _TYPE_1)
    out = np.zeros((len(nuclei["type"]), len(bands)))
    # Absorption by intergalactic hydrogen is not smooth. The wavelengths of a nucleus depend on its redshift only, so
    # that its flux does not depend on other nuclei.
    absorbed_below = intergalactic.first_transparent(np.maximum(nuclei["z_obs"], 0.0))
    group = np.ceil(absorbed_below / _GROUP_WIDTH)
    for k, band in enumerate(bands):
        all_below = np.where(absorbed_below > band.wavelength[0], group * _GROUP_WIDTH, 0.0)
        for limit in np.unique(all_below[row]):
            wavelength, weights = thin_passbands.weights(band, float(limit))
            members = row[all_below[row] == limit]
            for block in np.split(members, range(_BLOCK, members.size, _BLOCK)):
                f_lambda = high_redshift.spectra_at(_as_quasars(nuclei, block), wavelength)
                out[block, k] = units.ujy_of_cgs(matrices.matmul(f_lambda, weights))
    return out


def mean_spectra(nuclei: Columns, first: int, last: int) -> Float:
    """Return the mean spectra of nuclei without their galaxies, with magnification and Milky Way extinction.

    Parameters
    ----------
    nuclei : mapping of str to array, shape (n,)
        Columns FLUX_COLUMNS of table `active_nuclei`.
    first, last : int
        First and last wavelength, A.

    Returns
    -------
    float array, shape (n, last - first + 1)
        f_lambda in erg s-1 cm-2 A-1 in steps of 1 A; 0 for nuclei of type 2.

    Raises
    ------
    BadInput
        If a value is missing.
    OutOfRange
        If a value is out of range.
    """
    row = np.flatnonzero(nuclei["type"] == _TYPE_1)
    out = np.zeros((len(nuclei["type"]), last - first + 1))
    out[row] = high_redshift.spectra(_as_quasars(nuclei, row), first, last)
    return out


def _as_quasars(nuclei: Columns, row: Int) -> pa.Table:
    """Return the columns of table `galaxies` with which a quasar has the light of these rows of `active_nuclei`."""
    zeros = np.zeros(row.size)
    columns = {name: nuclei[name][row] for name in ("id", "z_obs", "kappa", "gamma1", "gamma2", "a_v")}
    # Peculiar velocities make the redshifts of the nearest galaxies negative, for which no spectrum is computed.
    columns["z_obs"] = np.maximum(columns["z_obs"], 0.0)
    columns |= {"kind": np.full(row.size, high_redshift.QUASAR), "frac_2": zeros, "ebv_1": zeros}
    columns |= {"mag_r01": nuclei["mag_1450"][row], "sed_1": nuclei["template"][row]}
    return pa.table(columns)


def fluxes(nuclei: Columns, band: Passband, mjd: npt.ArrayLike) -> Float:
    """Return the fluxes of nuclei at dates, without their galaxies.

    Parameters
    ----------
    nuclei : mapping of str to array, shape (n,)
        Columns FLUX_COLUMNS of table `active_nuclei`.
    band : Passband
        The passband.
    mjd : float or float array, shape (m,) or (n, m)
        Date, dates of all nuclei, or dates of each nucleus, from 32768 to 98304.

    Returns
    -------
    float array, shape (n,) or (n, m)
        f_nu in microjansky, with magnification and Milky Way extinction.
    """
    factors = flux_factors(nuclei, band, mjd)
    mean = mean_fluxes(nuclei, (band,))[:, 0]
    return factors * mean.reshape(-1, *[1] * (factors.ndim - 1))
