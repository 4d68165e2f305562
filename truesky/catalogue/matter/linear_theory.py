"""Linear power spectrum, and halo abundance, bias and concentration in a cosmology, computed with colossus.

Colossus writes no files: its persistent storage is off, and the results are in the disc cache of truesky. Colossus has
one current cosmology per process, which is set before each use.

Colossus has no massive neutrinos. It gets the power spectrum and the growth of cold matter, and for a halo the mass of
all matter in its Lagrangian radius. Only cold matter contributes to halo masses (Castorina et al. 2014).

References
----------
Eisenstein & Hu 1998; Tinker et al. 2008, ApJ 688, 709; Tinker et al. 2010, ApJ 724, 878; Diemer & Joyce 2019, ApJ 871,
168; Diemer 2018, ApJS 239, 35 (colossus); Castorina et al. 2014, JCAP 2, 049 (massive neutrinos)
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from truesky.catalogue.matter import boltzmann
from truesky.cosmology import Cosmology
from truesky.numerics.cache import cache_dir, cached_arrays, content_key
from truesky.numerics.cache_labels import label_halo_tables
from truesky.numerics.code_fingerprints import code_key

# Halo masses are M_200m, as colossus calls them.
MASS_DEFINITION = "200m"
# Colossus models of the linear power spectrum, the halo mass function, the halo bias and the concentration.
_MASS_FUNCTION, _BIAS, _CONCENTRATION = "tinker08", "tinker10", "diemer19"
# Model of colossus for the power spectrum: the fitting formula of Eisenstein & Hu.
_FIT = "eisenstein98"
# log10 of the wave numbers (h/Mpc) at which colossus gets the power spectrum of CAMB, beyond all halos of the tables.
_LOG_K = np.linspace(-5.0, 5.0, 2001)
# Number of redshifts of the table of concentrations. It is small, because a concentration takes 0.1 s to compute.
_Z_COARSE = 10
# Concentrations are computed only for every 20th mass, and interpolated between these masses.
_COARSE = 20


def power(cosmology: Cosmology, k: Float) -> Float:
    """Return the linear power P(k) of cold matter at z = 0 in (Mpc/h)^3, for k in h/Mpc.

    For `cosmology.power` = "camb", the spectrum of CAMB is continued beyond 1e-4 < k < 100 h/Mpc with the shape of the
    fitting formula. Raises BadInput if CAMB is required and not installed.
    """
    fitted = replace(cosmology, power=_FIT, m_nu=0.0)
    fit = np.asarray(_power_cosmology(fitted).matterPowerSpectrum(k, 0.0, model=_FIT), float)
    if cosmology.power == _FIT:
        return fit
    ends = np.array(boltzmann.K_RANGE)
    first, last = boltzmann.power(cosmology, ends) / power(fitted, ends)
    inside = (k >= ends[0]) & (k <= ends[1])
    return np.where(inside, boltzmann.power(cosmology, k), fit * np.where(k < ends[0], first, last))


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
    key = content_key(code_key(__name__), cosmology.fingerprint(), boltzmann.camb_version(cosmology), log_mass, z)
    label = label_halo_tables(cosmology.fingerprint())
    return cached_arrays("halo_tables", key, lambda: _halo_tables(cosmology, log_mass, z), label)


def _halo_tables(cosmology: Cosmology, log_mass: Float, z: Float) -> dict[str, Float]:
    with tempfile.TemporaryDirectory(prefix="truesky-") as folder:
        return _colossus_tables(cosmology, log_mass, z, _spectrum(cosmology, Path(folder)))


def _spectrum(cosmology: Cosmology, folder: Path) -> dict[str, str | None]:
    """Return the arguments that tell colossus the power spectrum; the one of CAMB is written to a file in `folder`."""
    if cosmology.power == _FIT:
        return {"model": _FIT, "path": None}
    path = folder / "linear_power.txt"
    np.savetxt(path, np.stack([_LOG_K, np.log10(power(cosmology, 10.0**_LOG_K))], 1))
    return {"model": f"truesky_{cosmology.fingerprint()}", "path": str(path)}


def _colossus_tables(
    cosmology: Cosmology, log_mass: Float, z: Float, spectrum: dict[str, str | None]
) -> dict[str, Float]:
    _set_cosmology(cosmology, reads_files=spectrum["path"] is not None)
    from colossus.halo import concentration
    from colossus.lss import bias, mass_function, peaks

    # Ratio of all matter to cold matter in the Lagrangian radius of a halo.
    ratio = cosmology.omega_m / cosmology.omega_cold
    mass, args = ratio * 10.0**log_mass, {"mdef": MASS_DEFINITION, "ps_args": spectrum}
    rows = [mass_function.massFunction(mass, at, model=_MASS_FUNCTION, q_out="dndlnM", **args) for at in z]
    biases = [
        bias.haloBiasFromNu(peaks.peakHeight(mass, at, ps_args=spectrum), z=at, mdef=MASS_DEFINITION, model=_BIAS)
        for at in z
    ]
    coarse_mass, coarse_z = log_mass[::_COARSE], np.expm1(np.linspace(np.log1p(z[0]), np.log1p(z[-1]), _Z_COARSE))
    c = [
        concentration.concentration(
            ratio * 10.0**coarse_mass, MASS_DEFINITION, at, model=_CONCENTRATION, ps_args=spectrum
        )
        for at in coarse_z
    ]
    concentrations = np.array([np.exp(np.interp(log_mass, coarse_mass, np.log(row))) for row in c])
    return {"density": np.log(10.0) * np.array(rows), "bias": np.array(biases), "concentration": concentrations}


@lru_cache(maxsize=4)
def _power_cosmology(cosmology: Cosmology) -> Any:
    """Return the colossus cosmology for `power`; it is cached, because a new one computes its power spectrum again."""
    return _set_cosmology(cosmology)


def _set_cosmology(cosmology: Cosmology, reads_files: bool = False) -> Any:
    """Set the cosmology of colossus, which is global in a process, and return it; colossus must not write files.

    If `reads_files` is True, colossus may read a power spectrum from a file.
    """
    from colossus import settings
    from colossus.cosmology import cosmology as colossus

    settings.BASE_DIR, settings.PERSISTENCE = str(cache_dir() / "colossus"), ""
    numbers: dict[str, Any] = {
        "flat": True,
        "H0": 100.0 * cosmology.h,
        "Om0": cosmology.omega_m,
        "Ob0": cosmology.omega_b,
        "sigma8": boltzmann.sigma_8_of_cold_matter(cosmology),
        "ns": cosmology.n_s,
        "relspecies": False,
    }
    if not cosmology.has_constant_dark_energy:
        numbers |= {"de_model": "w0wa", "w0": cosmology.w0, "wa": cosmology.wa}
    name = f"truesky_{cosmology.fingerprint()}"
    current = colossus.setCosmology(name, numbers, persistence="r" if reads_files else "")
    if cosmology.m_nu > 0.0:
        # Colossus computes D(z) for matter without neutrinos. All quantities of `_colossus_tables` get D through this
        # method alone: sigma(M, z), from which abundance, bias and peak height follow, and the exponent of the growth,
        # dlnD / dln(1 + z), in the concentration. The power spectrum of `power` is that of z = 0.
        current.growthFactor = partial(_growth, cosmology)
    return current


def _growth(cosmology: Cosmology, z: npt.ArrayLike, derivative: int = 0, inverse: bool = False) -> Float:
    """Return the linear growth D(z), or dD/dz if `derivative` is 1, with the arguments of growthFactor of colossus.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    z : array_like
        Redshift, 0 to 20.
    derivative : int, optional
        0 for D or 1 for dD/dz.
    inverse : bool, optional
        Only False: z(D) is not available.

    Returns
    -------
    float array
        D or dD/dz, in the shape of `z`.

    Raises
    ------
    NotImplementedError
        If colossus asks for a higher derivative, or for z(D).
    """
    if inverse or derivative not in (0, 1):
        raise NotImplementedError(f"growth with derivative = {derivative}, inverse = {inverse} is not available")
    d = cosmology.growth(z)
    return -d * cosmology.growth_rate(z) / (1.0 + np.asarray(z, float)) if derivative else d
