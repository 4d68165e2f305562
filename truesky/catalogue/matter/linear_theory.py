"""Linear power spectrum, and halo abundance, bias and concentration in a cosmology, computed with colossus.

Colossus writes no files: its persistent storage is off, and the results are in the disc cache of truesky. Colossus has
one current cosmology per process, which is set before each use.

References
----------
Eisenstein & Hu 1998; Tinker et al. 2008, ApJ 688, 709; Tinker et al. 2010, ApJ 724, 878; Diemer & Joyce 2019, ApJ 871,
168; Diemer 2018, ApJS 239, 35 (colossus)
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.cosmology import Cosmology
from truesky.numerics.cache import cache_dir, cached_arrays, content_key
from truesky.numerics.cache_labels import label_halo_tables
from truesky.numerics.code_fingerprints import code_key

# Halo masses are M_200m, as colossus calls them.
MASS_DEFINITION = "200m"
# Colossus models of the linear power spectrum, the halo mass function, the halo bias and the concentration.
_POWER, _MASS_FUNCTION, _BIAS, _CONCENTRATION = "eisenstein98", "tinker08", "tinker10", "diemer19"
# Number of redshifts of the table of concentrations. It is small, because a concentration takes 0.1 s to compute.
_Z_COARSE = 10
# Concentrations are computed only for every 20th mass, and interpolated between these masses.
_COARSE = 20


def power(cosmology: Cosmology, k: Float) -> Float:
    """Return the linear power P(k) at z = 0 in (Mpc/h)^3, for k in h/Mpc."""
    return np.asarray(_power_cosmology(cosmology).matterPowerSpectrum(k, 0.0, model=_POWER), float)


def halo_tables(cosmology: Cosmology, log_mass: Float, z: Float) -> dict[str, Float]:
    """Return tables of halo properties by redshift and log10 M_200m (Msun/h), by name.

    They are read from the disc cache if they have been computed before.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    log_mass : float array, shape (m,)
        log10 M_200m / (Msun/h).
    z : float array, shape (z,)
        Redshift.

    Returns
    -------
    dict of str to float array
        The abundance dn/dlog10 M in comoving (Mpc/h)^-3 (`density`, shape (z, m)), the linear `bias` (z, m), and the
        `concentration` c_200m (10, m) at 10 redshifts that are uniform in ln(1 + z) over the same range.
    """
    key = content_key(code_key(__name__), cosmology.fingerprint(), log_mass, z)
    label = label_halo_tables(cosmology.fingerprint())
    return cached_arrays("halo_tables", key, lambda: _halo_tables(cosmology, log_mass, z), label)


def _halo_tables(cosmology: Cosmology, log_mass: Float, z: Float) -> dict[str, Float]:
    _set_cosmology(cosmology)
    from colossus.halo import concentration
    from colossus.lss import bias, mass_function

    mass, args = 10.0**log_mass, {"mdef": MASS_DEFINITION}
    rows = [mass_function.massFunction(mass, at, model=_MASS_FUNCTION, q_out="dndlnM", **args) for at in z]
    biases = [bias.haloBias(mass, at, model=_BIAS, **args) for at in z]
    coarse_mass, coarse_z = log_mass[::_COARSE], np.expm1(np.linspace(np.log1p(z[0]), np.log1p(z[-1]), _Z_COARSE))
    c = [concentration.concentration(10.0**coarse_mass, MASS_DEFINITION, at, model=_CONCENTRATION) for at in coarse_z]
    concentrations = np.array([np.exp(np.interp(log_mass, coarse_mass, np.log(row))) for row in c])
    return {"density": np.log(10.0) * np.array(rows), "bias": np.array(biases), "concentration": concentrations}


@lru_cache(maxsize=4)
def _power_cosmology(cosmology: Cosmology) -> Any:
    """Return the colossus cosmology for `power`; it is cached, because a new one computes its power spectrum again."""
    return _set_cosmology(cosmology)


def _set_cosmology(cosmology: Cosmology) -> Any:
    """Set the cosmology of colossus, which is global in a process, and return it; colossus must not write files."""
    from colossus import settings
    from colossus.cosmology import cosmology as colossus

    settings.BASE_DIR, settings.PERSISTENCE = str(cache_dir() / "colossus"), ""
    numbers = {
        "flat": True,
        "H0": 100.0 * cosmology.h,
        "Om0": cosmology.omega_m,
        "Ob0": cosmology.omega_b,
        "sigma8": cosmology.sigma_8,
        "ns": cosmology.n_s,
        "relspecies": False,
    }
    return colossus.setCosmology(f"truesky {cosmology.fingerprint()}", numbers, persistence="")
