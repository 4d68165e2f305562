"""Emission lines: H alpha from the star formation rate, matched to the observed counts; the others by ratios.

model            the numbers and the stored table of the matching
raw_halpha       log L of H alpha as the star formation rate gives it, dust included
matched          the same, as many per redshift as are observed: a stored monotone table
fluxes           observed fluxes of the six catalogued lines
expected_counts  galaxies per deg2 above an H alpha flux (Pozzetti et al. 2016, model 3)

The table (halpha_matching.csv) is made by scripts/match_halpha.py from a sample without structure.
Ref: Kennicutt 1998; Pozzetti et al. 2016, A&A 590, A3; the other numbers are in emission_lines.toml.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jobs import sums
from jobs.catalogue import parameters
from jobs.catalogue.interpolation import bracket
from jobs.fluxes import cosmology
from jobs.keyed import Draws
from lake_schema.arrays import Bool, Float
from lake_schema.units import LIGHT_KM_S

_FILE = "emission_lines.toml"
MATCHING = Path(__file__).with_name("halpha_matching.csv")
LINES = ("halpha", "hbeta", "oii", "oiii", "nii", "sii")
_CM_PER_MPC = 3.0856775814913673e24
_L_NODES = np.linspace(38.0, 45.0, 1401)
_Z_NODES = 400


@dataclass(frozen=True, slots=True)
class Halpha:
    """emission_lines.toml, [halpha]."""

    sfr_per_luminosity: float
    scatter: float
    stellar_to_gas: float
    red_sfr: float


@dataclass(frozen=True, slots=True)
class Ratios:
    """emission_lines.toml, [ratios]."""

    balmer: float
    oii: float
    oii_scatter: float
    fundamental: tuple[float, ...]
    chabrier: float
    metal_limits: tuple[float, float]
    nii_zero: float
    nii_slope: float
    nii_limits: tuple[float, float]
    nii_scatter: float
    oiii_rate: float
    oiii_pole: float
    oiii_zero: float
    oiii_z: float
    oiii_n2: float
    oiii_limits: tuple[float, float]
    oiii_scatter: float
    sii_zero: float
    sii_rate: float
    sii_pivot: float
    sii_scatter: float


@dataclass(frozen=True, slots=True)
class Pozzetti:
    """emission_lines.toml, [pozzetti]."""

    alpha: float
    delta: float
    log_phi: float
    l_inf: float
    beta: float
    l_half: float
    z_fit: float
    hubble: float
    omega_m: float


@dataclass(frozen=True, slots=True, eq=False)
class LineModel:
    """dust : k of the lines;  z : [r], log_l : [c], shift : [r, c] dex that the matching adds to log L."""

    halpha: Halpha
    ratios: Ratios
    dust: dict[str, float]
    z: Float
    log_l: Float
    shift: Float


def model(matching: Path = MATCHING) -> LineModel:
    """The lines of the embedded universe."""
    table = np.loadtxt(matching, delimiter=",")
    return unmatched(table[1:, 0], table[0, 1:], table[1:, 1:])


def unmatched(z: Float, log_l: Float, shift: Float) -> LineModel:
    """The lines with a table of one's own; a shift of nothing leaves H alpha as it is drawn.

    z : float[r];  log_l : float[l] log10 erg/s;  shift : float[r, l] dex
    """
    return LineModel(
        Halpha(**parameters.section(_FILE, "halpha")),
        Ratios(**parameters.section(_FILE, "ratios")),
        parameters.section(_FILE, "dust"),
        z,
        log_l,
        shift,
    )


def raw_halpha(law: Halpha, dust: float, log_sfr: Float, ebv: Float, rng: Draws) -> Float:
    """log10 of the observed H alpha luminosity[n], erg/s.

    log_sfr : float[n] log10 Msun/yr, Salpeter;  ebv : float[n] mag, internal;  dust : k(H alpha)
    law     : constants of the calibration;  rng : of the scatter
    Ref: Kennicutt 1998
    """
    intrinsic = log_sfr - np.log10(law.sfr_per_luminosity) + law.scatter * rng.standard_normal(log_sfr.size)
    return np.asarray(intrinsic - 0.4 * dust * ebv / law.stellar_to_gas)


def matched(lines: LineModel, z: Float, log_l: Float) -> Float:
    """log10 L[n] with the observed abundance; bilinear in z and log L, held at the table's edges.

    z : float[n];  log_l : float[n] log10 erg/s
    """
    row, part = bracket(lines.z, z)
    column, share = bracket(lines.log_l, log_l)
    low = lines.shift[row, column] * (1.0 - share) + lines.shift[row, column + 1] * share
    high = lines.shift[row + 1, column] * (1.0 - share) + lines.shift[row + 1, column + 1] * share
    return np.asarray(log_l + low * (1.0 - part) + high * part)


def fluxes(
    lines: LineModel, z: Float, log_mass: Float, log_sfr: Float, red: Bool, ebv: Float, rng: Draws
) -> dict[str, Float]:
    """Flux[n] of the primary component of each line, erg s-1 cm-2, before magnification and the Milky Way.

    z : float[n] true redshift;  log_mass, log_sfr : float[n] log10 Msun, log10 Msun/yr (Salpeter)
    red : bool[n] on the red sequence;  ebv : float[n] mag, internal
    lines : constants and matching;  rng : of the scatter of luminosities and ratios
    """
    law, ratios, n = lines.halpha, lines.ratios, z.size
    observed = matched(lines, z, raw_halpha(law, lines.dust["halpha"], log_sfr, ebv, rng))
    gas = 0.4 * ebv / law.stellar_to_gas
    halpha = observed + lines.dust["halpha"] * gas
    hbeta = halpha - np.log10(ratios.balmer)
    n2 = _nitrogen(ratios, log_mass, log_sfr, rng)
    log_l = {
        "halpha": halpha,
        "hbeta": hbeta,
        # The catalogue holds one line of each pair: half of the doublets of equal lines.
        "oii": halpha + np.log10(0.5 * ratios.oii) + ratios.oii_scatter * rng.standard_normal(n),
        "oiii": hbeta + _oxygen(ratios, n2, z, rng),
        "nii": halpha + n2,
        "sii": halpha + np.log10(0.5) + _sulphur(ratios, n2, rng),
    }
    area = np.log10(4.0 * np.pi) + 2.0 * np.log10(cosmology.luminosity_distance(z) / cosmology.HUBBLE * _CM_PER_MPC)
    shines = ~(red & (log_sfr < np.log10(law.red_sfr)))
    return {
        f"flux_{line}": np.where(shines, 10.0 ** (log_l[line] - lines.dust[line] * gas - area), 0.0) for line in LINES
    }


def expected_counts(flux: Float, near: float, far: float) -> Float:
    """Galaxies[n] per deg2 above H alpha fluxes[n], erg s-1 cm-2, between two redshifts.

    flux : float[n] erg s-1 cm-2
    Ref: Pozzetti et al. 2016, A&A 590, A3, model 3, in the cosmology of that paper
    """
    law = Pozzetti(**parameters.section(_FILE, "pozzetti"))
    z = np.linspace(near, far, _Z_NODES)
    rate = np.sqrt(law.omega_m * (1.0 + z) ** 3 + 1.0 - law.omega_m)
    fine = np.linspace(0.0, far, 20 * _Z_NODES)
    inverse = 1.0 / np.sqrt(law.omega_m * (1.0 + fine) ** 3 + 1.0 - law.omega_m)
    hubble_distance = LIGHT_KM_S / (100.0 * law.hubble)
    steps = 0.5 * (inverse[1:] + inverse[:-1]) * np.diff(fine)
    chi = hubble_distance * np.interp(z, fine, np.concatenate([[0.0], np.cumsum(steps)]))
    volume = chi**2 * hubble_distance / rate * np.radians(1.0) ** 2
    area = 4.0 * np.pi * ((1.0 + z) * chi * _CM_PER_MPC) ** 2
    totals = [np.trapezoid(volume * _brighter(law, z, np.log10(f * area)), z) for f in np.atleast_1d(flux)]
    return np.array(totals)


def _brighter(law: Pozzetti, z: Float, log_l: Float) -> Float:
    """n(> L)[n], Mpc^-3."""
    fitted = np.maximum(z, law.z_fit)
    log_star = law.l_inf + (1.5 / (1.0 + fitted)) ** law.beta * (law.l_half - law.l_inf)
    log_y = _L_NODES - 42.0
    y = 10.0**log_y
    density = np.log(10.0) * 10.0**law.log_phi * y ** (law.alpha + 1.0) / (1.0 + (np.e - 1.0) * y**law.delta)
    pieces = 0.5 * (density[1:] + density[:-1]) * np.diff(log_y)
    above = np.concatenate([np.cumsum(pieces[::-1])[::-1], [0.0]])
    return np.asarray(np.interp(log_l - log_star, log_y, above))


def _nitrogen(ratios: Ratios, log_mass: Float, log_sfr: Float, rng: Draws) -> Float:
    """log10 [N II] 6585 / H alpha, from the metallicity that mass and star formation give."""
    m, s = log_mass - 10.0, log_sfr + ratios.chabrier
    terms = np.stack([np.ones(m.size), m, s, m**2, m * s, s**2])
    metals = np.clip(sums.product(np.array(ratios.fundamental), terms), *ratios.metal_limits)
    n2 = np.clip((metals - ratios.nii_zero) / ratios.nii_slope, *ratios.nii_limits)
    return np.asarray(n2 + ratios.nii_scatter * rng.standard_normal(m.size))


def _oxygen(ratios: Ratios, n2: Float, z: Float, rng: Draws) -> Float:
    """log10 [O III] 5008 / H beta on the star-forming sequence."""
    sequence = ratios.oiii_rate / (np.minimum(n2, ratios.oiii_n2) + ratios.oiii_pole) + ratios.oiii_zero
    limited = np.clip(sequence + ratios.oiii_z * z, *ratios.oiii_limits)
    return np.asarray(limited + ratios.oiii_scatter * rng.standard_normal(z.size))


def _sulphur(ratios: Ratios, n2: Float, rng: Draws) -> Float:
    mean = ratios.sii_zero + ratios.sii_rate * (n2 + ratios.sii_pivot)
    return np.asarray(mean + ratios.sii_scatter * rng.standard_normal(n2.size))
