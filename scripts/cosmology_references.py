"""Print distances, growth and power of several cosmologies from CCL and CAMB, with which the tests compare truesky.

    python -m scripts.cosmology_references > tests/truesky/cosmology_references.csv

The packages pyccl and camb must be installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, fields, replace
from itertools import chain
from typing import Any

import numpy as np

from truesky.cosmology import FIDUCIAL, Cosmology

COSMOLOGIES = (
    FIDUCIAL,
    Cosmology(omega_m=0.31, omega_b=0.049, h=0.677, sigma_8=0.81, n_s=0.966),
    replace(FIDUCIAL, w0=-0.9),
    replace(FIDUCIAL, w0=-0.9, wa=0.3),
    Cosmology(omega_m=0.26, omega_b=0.045, h=0.73, sigma_8=0.78, n_s=0.95, w0=-1.1, wa=-0.4),
)
# Universes with massive neutrinos, for which only CAMB has values. The last two have nearly the largest fraction of
# neutrinos that is possible. The error of the growth is larger in the last one than in other such universes.
WITH_NEUTRINOS = (
    *(replace(of, m_nu=m_nu) for of in (FIDUCIAL, COSMOLOGIES[3], COSMOLOGIES[4]) for m_nu in (0.06, 0.5)),
    replace(FIDUCIAL, omega_m=0.3, m_nu=0.5),
    replace(FIDUCIAL, omega_m=0.6, h=0.474, m_nu=0.5),
)
# Universes for which CAMB computes the non-linear power with halofit. The last one is far from a constant.
WITH_HALOFIT = (FIDUCIAL, replace(FIDUCIAL, w0=-0.9, wa=0.1), replace(FIDUCIAL, w0=-0.6, wa=0.3))
# Redshifts of distances and growth, redshifts of sigma_8, and wave numbers (h/Mpc) of the power spectrum. CAMB includes
# radiation, which changes sigma_8(z) / sigma_8(0) by more than 1e-3 beyond z = 2.
REDSHIFTS, SIGMA_REDSHIFTS, WAVE_NUMBERS = (0.5, 1.0, 2.0, 5.0, 10.0), (0.5, 1.0, 2.0), (0.01, 0.1, 1.0)
# Wave numbers of the non-linear power, and redshifts and wave numbers of the power of cold matter (h/Mpc).
HALOFIT_WAVE_NUMBERS = (*WAVE_NUMBERS, 5.0, 30.0)
COLD_REDSHIFTS, COLD_WAVE_NUMBERS = (0.0, 1.0, 2.0, 5.0), (0.005, 0.02, 0.1, 1.0)


def rows() -> Iterator[str]:
    """Yield the lines of the file: parameters of the cosmology, name of the quantity, its argument, and its value."""
    yield ",".join([*(field.name for field in fields(Cosmology) if field.name != "power"), "quantity", "at", "value"])
    groups = (
        (COSMOLOGIES, (_values_of_ccl, _values_of_camb)),
        (WITH_NEUTRINOS, (_values_with_neutrinos,)),
        (WITH_HALOFIT, (_values_of_halofit,)),
    )
    for cosmologies, functions in groups:
        for cosmology in cosmologies:
            numbers = ",".join(f"{value:g}" for value in astuple(cosmology)[:-1])
            for quantity, at, value in chain.from_iterable(values(cosmology) for values in functions):
                yield f"{numbers},{quantity},{at:g},{value:.8g}"


def _values_of_ccl(cosmology: Cosmology) -> Iterator[tuple[str, float, float]]:
    import pyccl

    arguments = {
        "Omega_c": cosmology.omega_m - cosmology.omega_b, "Omega_b": cosmology.omega_b, "h": cosmology.h,
        "sigma8": cosmology.sigma_8, "n_s": cosmology.n_s, "w0": cosmology.w0, "wa": cosmology.wa, "Neff": 0.0,
        "transfer_function": "eisenstein_hu", "matter_power_spectrum": "linear",
    }  # fmt: skip
    # A cold microwave background has no radiation, and one of 2.7255 K is needed for the fitting formula of the power.
    cold, warm = (pyccl.Cosmology(**arguments, T_CMB=temperature) for temperature in (1e-3, 2.7255))
    for z in REDSHIFTS:
        a = 1.0 / (1.0 + z)
        yield "chi", z, float(pyccl.comoving_radial_distance(cold, a)) * cosmology.h
        yield "growth", z, float(pyccl.growth_factor(cold, a))
        yield "growth_rate", z, float(pyccl.growth_rate(cold, a))
    for k in WAVE_NUMBERS:
        yield "power", k, float(pyccl.linear_matter_power(warm, k * cosmology.h, 1.0)) * cosmology.h**3


def _results_of_camb(
    cosmology: Cosmology, redshifts: tuple[float, ...], amplitude: float = 2e-9, k_max: float = 5.0
) -> Any:
    import camb

    h, is_massive = cosmology.h, cosmology.m_nu > 0.0
    cold = (cosmology.omega_m - cosmology.omega_b) * h**2 - cosmology.m_nu / 93.14
    settings = camb.set_params(
        H0=100.0 * h, ombh2=cosmology.omega_b * h**2, omch2=cold, mnu=cosmology.m_nu, neutrino_hierarchy="degenerate",
        num_massive_neutrinos=3 if is_massive else 0, ns=cosmology.n_s, As=amplitude, w=cosmology.w0, wa=cosmology.wa,
        dark_energy_model="ppf", halofit_version="takahashi",
    )  # fmt: skip
    settings.omnuh2 = cosmology.m_nu / 93.14
    settings.set_matter_power(redshifts=[*redshifts, 0.0], kmax=k_max, silent=True)
    return camb.get_results(settings)


def _values_with_neutrinos(cosmology: Cosmology) -> Iterator[tuple[str, float, float]]:
    results = _results_of_camb(cosmology, REDSHIFTS)
    matter, cold = (
        np.sort(results.get_sigmaR(8.0, var1=kind, var2=kind))[::-1] for kind in ("delta_tot", "delta_nonu")
    )
    yield "sigma_8_of_cold_matter", 0.0, cosmology.sigma_8 * float(cold[0] / matter[0])
    for z, value, total in zip(REDSHIFTS, cold[1:], matter[1:], strict=True):
        yield "growth_of_cold_matter", z, float(value / cold[0])
        yield "growth_of_all_matter", z, float(total / matter[0])
        yield "chi_with_neutrinos", z, float(results.comoving_radial_distance(z)) * cosmology.h
    power = results.get_matter_power_interpolator(nonlinear=False, var1="delta_nonu", var2="delta_nonu")
    for z in COLD_REDSHIFTS:
        for k in COLD_WAVE_NUMBERS:
            yield f"cold_power_z{z:g}", k, float(power.P(z, k)) * (cosmology.sigma_8 / float(matter[0])) ** 2


def _values_of_halofit(cosmology: Cosmology) -> Iterator[tuple[str, float, float]]:
    linear = _results_of_camb(cosmology, SIGMA_REDSHIFTS)
    amplitude = 2e-9 * (cosmology.sigma_8 / float(np.max(linear.get_sigma8()))) ** 2
    results = _results_of_camb(cosmology, SIGMA_REDSHIFTS, amplitude, k_max=60.0)
    power = results.get_matter_power_interpolator(nonlinear=True)
    for z in (0.0, *SIGMA_REDSHIFTS):
        for k in HALOFIT_WAVE_NUMBERS:
            yield f"halofit_z{z:g}", k, float(power.P(z, k))


def _values_of_camb(cosmology: Cosmology) -> Iterator[tuple[str, float, float]]:
    results, h = _results_of_camb(cosmology, SIGMA_REDSHIFTS), cosmology.h
    sigma = np.sort(np.asarray(results.get_sigma8()))[::-1]
    for z, value in zip(SIGMA_REDSHIFTS, sigma[1:], strict=True):
        yield "sigma_8", z, cosmology.sigma_8 * float(value / sigma[0])
        yield "chi_with_radiation", z, float(results.comoving_radial_distance(z)) * h


if __name__ == "__main__":
    print("\n".join(rows()))
