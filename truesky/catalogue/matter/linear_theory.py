"""Linear power, halo abundance, halo bias and concentrations of the embedded universe, from colossus.

Colossus keeps no files here: its persistent storage is off, everything made from it lies in our own cache.

power           P(k) at z = 0
halo_tables     dn/dlog10 M and b on redshift and mass, from the cache or made now

Ref: Eisenstein & Hu 1998; Tinker et al. 2008, ApJ 688, 709; Tinker et al. 2010, ApJ 724, 878;
     Diemer & Joyce 2019, ApJ 871, 168; Diemer 2018, ApJS 239, 35 (colossus)
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.fluxes import cosmology
from truesky.numerics.cache import cache_dir, cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key

MASS_DEFINITION = "200m"
_POWER, _MASS_FUNCTION, _BIAS, _CONCENTRATION = "eisenstein98", "tinker08", "tinker10", "diemer19"
# Concentrations are slow to make (0.1 s a redshift and mass): at fewer redshifts, and every so many masses.
_Z_COARSE, _COARSE = 10, 20


def power(k: Float) -> Float:
    """P(k)[n] at z = 0, (Mpc/h)^3; k h/Mpc.

    k : float[n] h/Mpc
    """
    return np.asarray(_power_cosmology().matterPowerSpectrum(k, 0.0, model=_POWER), float)


def halo_tables(log_mass: Float, z: Float) -> dict[str, Float]:
    """Tables of halos of M_200m, log_mass[m] log10 Msun/h.

    log_mass : float[m] log10 Msun/h;  z : float[z]
    density       : [len(z), m] dn/dlog10 M, comoving (Mpc/h)^-3
    bias          : [len(z), m]
    concentration : [_Z_COARSE, m] c_200m, at redshifts uniform in ln(1 + z) over the same range
    """
    numbers = (cosmology.OMEGA_M, cosmology.OMEGA_B, cosmology.HUBBLE, cosmology.SIGMA_8)
    key = content_key(code_key(__name__), *numbers, cosmology.SPECTRAL_INDEX, log_mass, z)
    return cached_arrays("halo_tables", key, lambda: _halo_tables(log_mass, z))


def _halo_tables(log_mass: Float, z: Float) -> dict[str, Float]:
    _set_cosmology()
    from colossus.halo import concentration
    from colossus.lss import bias, mass_function

    mass, args = 10.0**log_mass, {"mdef": MASS_DEFINITION}
    rows = [mass_function.massFunction(mass, at, model=_MASS_FUNCTION, q_out="dndlnM", **args) for at in z]
    biases = [bias.haloBias(mass, at, model=_BIAS, **args) for at in z]
    coarse_mass, coarse_z = log_mass[::_COARSE], np.expm1(np.linspace(np.log1p(z[0]), np.log1p(z[-1]), _Z_COARSE))
    c = [concentration.concentration(10.0**coarse_mass, MASS_DEFINITION, at, model=_CONCENTRATION) for at in coarse_z]
    concentrations = np.array([np.exp(np.interp(log_mass, coarse_mass, np.log(row))) for row in c])
    return {"density": np.log(10.0) * np.array(rows), "bias": np.array(biases), "concentration": concentrations}


@cache
def _power_cosmology() -> Any:
    """The cosmology of `power`: each new one integrates its normalisation and makes its table of k again."""
    return _set_cosmology()


def _set_cosmology() -> Any:
    """The cosmology of colossus, which is told to keep its files in our cache and to write none."""
    from colossus import settings
    from colossus.cosmology import cosmology as colossus

    settings.BASE_DIR, settings.PERSISTENCE = str(cache_dir() / "colossus"), ""
    numbers = {
        "flat": True,
        "H0": 100.0 * cosmology.HUBBLE,
        "Om0": cosmology.OMEGA_M,
        "Ob0": cosmology.OMEGA_B,
        "sigma8": cosmology.SIGMA_8,
        "ns": cosmology.SPECTRAL_INDEX,
        "relspecies": False,
    }
    return colossus.setCosmology("truesky", numbers, persistence="")
