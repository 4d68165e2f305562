"""Linear power spectrum of cold matter from CAMB, which solves the Boltzmann equations: shipped, or computed now.

The table linear_power.toml contains the spectrum of the fiducial cosmology, and is written by
scripts/linear_power_table.py. It is scaled for other values of sigma_8. For other cosmologies, the optional package
CAMB must be installed.

Cold matter is dark matter and baryons. With massive neutrinos, sigma_8 of all matter is that of the cosmology, and cold
matter has more power. Halos and galaxies follow cold matter (Castorina et al. 2014).

References
----------
Lewis, Challinor & Lasenby 2000, ApJ 538, 473 (CAMB)
Castorina et al. 2014, JCAP 2, 049 (halos and massive neutrinos)
"""

from __future__ import annotations

from dataclasses import replace
from importlib import metadata

import numpy as np
import scipy

from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput
from truesky.catalogue import parameters
from truesky.cosmology import FIDUCIAL, Cosmology
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key

_FILE = "linear_power.toml"
# First and last wave number (h/Mpc) of a table, and number of wave numbers, which are uniform in ln k. The
# interpolation between them has a relative error of 1e-5.
K_RANGE, K_NODES = (1e-4, 100.0), 700
# Number of wave numbers at which the integrand of sigma_8 is evaluated.
_SIGMA_NODES = 20_000
# Amplitude of the primordial power for which CAMB computes the spectrum, before it is scaled to sigma_8.
_AMPLITUDE = 2e-9
# Density of radiation: temperature of the microwave background (K), and effective number of neutrinos.
_T_CMB, _NEUTRINOS = 2.7255, 3.044


def wave_numbers() -> Float:
    """Return the wave numbers k of a table, h/Mpc."""
    return np.geomspace(*K_RANGE, K_NODES)


def power(cosmology: Cosmology, k: Float) -> Float:
    """Interpolate the linear power P(k) of cold matter at z = 0, (Mpc/h)^3, for k from 1e-4 to 100 h/Mpc; 0 elsewhere.

    Raises BadInput for a cosmology that differs from the fiducial one in more than sigma_8 if the package CAMB is not
    installed.
    """
    ln_k = np.log(wave_numbers())
    spline = scipy.interpolate.CubicSpline(ln_k, np.log(_table(cosmology)))
    at = np.log(np.asarray(k, float))
    # The rounding errors of the ends of a range of k do not matter.
    inside = (at > ln_k[0] - 1e-9) & (at < ln_k[-1] + 1e-9)
    return np.where(inside, np.exp(spline(np.clip(at, ln_k[0], ln_k[-1]))), 0.0)


def sigma_8_of_cold_matter(cosmology: Cosmology) -> float:
    """Return the rms of the linear overdensity of cold matter in spheres of 8 Mpc/h today, which exceeds sigma_8.

    Without massive neutrinos it is sigma_8. Raises BadInput with them if CAMB is not installed.
    """
    return _sigma_8(_table(cosmology)) if cosmology.m_nu > 0.0 else cosmology.sigma_8


def camb_version(cosmology: Cosmology) -> str:
    """Return the version of CAMB if it computes the spectrum of this cosmology, and "" for a table or a formula.

    It belongs to the key of everything in the cache, and in a lake, that depends on the spectrum. Raises BadInput if
    CAMB is required and not installed.
    """
    if cosmology.power != "camb" or _is_shipped(cosmology):
        return ""
    # The metadata of the package suffice: a key does not need its compiled library.
    try:
        return metadata.version("camb")
    except metadata.PackageNotFoundError:
        raise _not_installed() from None


def compute(cosmology: Cosmology) -> dict[str, Array]:
    """Compute the spectrum of cold matter at the wave numbers of a table with CAMB, as the array "power".

    It is scaled so that all matter has the sigma_8 of the cosmology. It takes 3 CPU s. The radiation, which distances
    neglect, is included. Raises BadInput if CAMB is not installed.
    """
    try:
        import camb
    except ModuleNotFoundError:
        raise _not_installed() from None
    h, is_massive = cosmology.h, cosmology.m_nu > 0.0
    settings = camb.set_params(
        H0=100.0 * h, ombh2=cosmology.omega_b * h**2, omch2=(cosmology.omega_cold - cosmology.omega_b) * h**2, omk=0.0,
        mnu=cosmology.m_nu, num_massive_neutrinos=3 if is_massive else 0, neutrino_hierarchy="degenerate",
        nnu=_NEUTRINOS, TCMB=_T_CMB, ns=cosmology.n_s, As=_AMPLITUDE,
        w=cosmology.w0, wa=cosmology.wa, dark_energy_model="ppf",
    )  # fmt: skip
    # CAMB converts masses to a density that differs from ours by 1e-3.
    settings.omnuh2 = cosmology.omega_nu * h**2
    settings.WantCls = False
    settings.NonLinear = camb.model.NonLinear_none
    settings.set_matter_power(redshifts=[0.0], kmax=1.2 * K_RANGE[1] * h, k_per_logint=0, silent=True)
    results = camb.get_results(settings)

    def spectrum(kind: str) -> Float:
        interpolator = results.get_matter_power_interpolator(
            nonlinear=False, hubble_units=True, k_hunit=True, var1=kind, var2=kind
        )
        return np.asarray(interpolator.P(0.0, wave_numbers()), float)

    matter = spectrum("delta_tot")
    cold = spectrum("delta_nonu") if is_massive else matter
    return {"power": cold * (cosmology.sigma_8 / _sigma_8(matter)) ** 2}


def _sigma_8(spectrum: Float) -> float:
    """Return the rms of the overdensity in spheres of 8 Mpc/h for a table of P(k), with a relative error of 1e-5."""
    ln_k = np.log(wave_numbers())
    fine = np.linspace(ln_k[0], ln_k[-1], _SIGMA_NODES)
    k, values = np.exp(fine), np.exp(scipy.interpolate.CubicSpline(ln_k, np.log(spectrum))(fine))
    x = 8.0 * k
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    return float(np.sqrt(np.trapezoid(values * window**2 * k**3 / (2.0 * np.pi**2), fine)))


def _table(cosmology: Cosmology) -> Float:
    if _is_shipped(cosmology):
        scale = (cosmology.sigma_8 / FIDUCIAL.sigma_8) ** 2
        return np.array(parameters.section(_FILE, "camb")["power"]) * scale
    key = content_key(code_key(__name__), cosmology.fingerprint(), camb_version(cosmology))
    return cached_arrays("linear_power", key, lambda: compute(cosmology))["power"]


def _is_shipped(cosmology: Cosmology) -> bool:
    """Return True if the shipped table is for this cosmology: it differs from the fiducial one in sigma_8 at most."""
    return replace(cosmology, sigma_8=FIDUCIAL.sigma_8, power=FIDUCIAL.power) == FIDUCIAL


def _not_installed() -> BadInput:
    return BadInput(
        'universe.cosmology: power = "camb" requires the package camb, which is not installed: '
        "pip install 'truesky[camb]', or camb alone"
    )
