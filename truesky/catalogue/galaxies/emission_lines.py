"""Emission lines: H alpha from the star formation rate, matched to observed counts; other lines from line ratios.

The matching table (halpha_matching.csv) is made by scripts/match_halpha.py from a sample without clustering. All ratios
use one metallicity scale, because mixing two scales changes [O III] / H beta by an order of magnitude. The parameters
are in emission_lines.toml.

References
----------
Kennicutt & Evans 2012; Garn & Best 2010; Curti et al. 2020; Pozzetti et al. 2016, A&A 590, A3
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lake_schema.arrays import Bool, Float
from lake_schema.units import AB_CGS, LIGHT_KM_S
from truesky.catalogue import parameters
from truesky.catalogue.interpolation import bracket
from truesky.fluxes import cosmology, passbands
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, lines
from truesky.randomness.per_source import AnyGenerator

_FILE = "emission_lines.toml"
MATCHING = Path(__file__).with_name("halpha_matching.csv")
# Normal deviates per galaxy: dust, H alpha, metallicity, N2, R3, R2, S2, [S III], He I.
_DEVIATES = 9
_CM_PER_MPC = 3.0856775814913673e24
_L_NODES = np.linspace(38.0, 45.0, 1401)
_Z_NODES = 400


@dataclass(frozen=True, slots=True)
class Halpha:
    """Parameters of H alpha (emission_lines.toml, [halpha])."""

    per_sfr: float
    scatter: float
    red_sfr: float


@dataclass(frozen=True, slots=True)
class Gas:
    """Parameters of the gas dust (emission_lines.toml, [gas])."""

    pivot: float
    limits: tuple[float, float]
    polynomial: tuple[float, ...]
    min_attenuation: float
    scatter: float


@dataclass(frozen=True, slots=True)
class Metals:
    """Parameters of the metallicity (emission_lines.toml, [metals])."""

    highest: float
    turn: float
    sharpness: float
    mass: float
    mass_sfr: float
    scatter: float
    limits: tuple[float, float]
    sun: float


@dataclass(frozen=True, slots=True)
class Ratios:
    """Parameters of the line ratios (emission_lines.toml, [ratios])."""

    n2: tuple[float, ...]
    n2_scatter: float
    r3: tuple[float, ...]
    r3_z: float
    r3_z_last: float
    r3_scatter: float
    r2: tuple[float, ...]
    r2_r3: float
    r2_scatter: float
    s2: tuple[float, ...]
    s2_scatter: float


@dataclass(frozen=True, slots=True)
class OtherLines:
    """Parameters of [S III] and He I (emission_lines.toml, [others])."""

    siii: float
    siii_scatter: float
    siii_pair: float
    hei: float
    hei_5877: float
    hei_scatter: float


@dataclass(frozen=True, slots=True)
class Pozzetti:
    """Parameters of the observed luminosity function (emission_lines.toml, [pozzetti])."""

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
    """Model of the emission lines.

    Attributes
    ----------
    halpha, gas, metals, ratios : Halpha, Gas, Metals, Ratios
        Parameters of the file.
    hydrogen : dict of str to float
        Ratio of each hydrogen line to H beta, without dust.
    other_lines : OtherLines
        Parameters of [S III] and He I.
    dust : dict of str to float
        Extinction coefficient k of each column relative to H alpha.
    z : float array, shape (r,)
        Redshift nodes of the matching.
    log_l : float array, shape (c,)
        Nodes of log10 L, erg/s.
    shift : float array, shape (r, c)
        Shift that the matching adds to log10 L, dex.
    """

    halpha: Halpha
    gas: Gas
    metals: Metals
    ratios: Ratios
    hydrogen: dict[str, float]
    other_lines: OtherLines
    dust: dict[str, float]
    z: Float
    log_l: Float
    shift: Float


def model(matching: Path = MATCHING) -> LineModel:
    """Return the emission lines of the embedded universe."""
    table = np.loadtxt(matching, delimiter=",")
    return model_from_table(table[1:, 0], table[0, 1:], table[1:, 1:])


def model_from_table(z: Float, log_l: Float, shift: Float) -> LineModel:
    """Return emission lines with a given matching table; shifts of 0 leave H alpha as drawn.

    Parameters
    ----------
    z : float array, shape (r,)
        Redshift nodes.
    log_l : float array, shape (c,)
        Nodes of log10 L, erg/s.
    shift : float array, shape (r, c)
        Shift of log10 L, dex.

    Returns
    -------
    LineModel
        The model.
    """
    primaries = {line.column: line.vacuum for line in reversed(lines.line_list())}
    k = extinction.laws(np.array(list(primaries.values())))[extinction.CALZETTI]
    relative = dict(zip(primaries, (k / k[list(primaries).index("flux_halpha")]).tolist(), strict=True))
    return LineModel(
        Halpha(**parameters.section(_FILE, "halpha")),
        Gas(**parameters.section(_FILE, "gas")),
        Metals(**parameters.section(_FILE, "metals")),
        Ratios(**parameters.section(_FILE, "ratios")),
        parameters.section(_FILE, "hydrogen"),
        OtherLines(**parameters.section(_FILE, "others")),
        relative,
        z,
        log_l,
        shift,
    )


def halpha_attenuation(gas: Gas, log_mass: Float, normal: Float) -> Float:
    """Return the attenuation A(H alpha) of the gas.

    Parameters
    ----------
    gas : Gas
        Parameters.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    normal : float array, shape (n,)
        Normal deviates.

    Returns
    -------
    float array, shape (n,)
        A(H alpha), mag.

    References
    ----------
    Garn & Best 2010, eq. 6
    """
    mean = np.polynomial.polynomial.polyval(np.clip(log_mass - gas.pivot, *gas.limits), gas.polynomial)
    return np.asarray(np.maximum(mean, gas.min_attenuation) * np.exp(gas.scatter * normal))


def raw_halpha(law: Halpha, log_sfr: Float, a_halpha: Float, normal: Float) -> Float:
    """Return the observed H alpha luminosity that follows from the star formation rate, before matching.

    Parameters
    ----------
    law : Halpha
        Parameters.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr (Kroupa).
    a_halpha : float array, shape (n,)
        A(H alpha), mag.
    normal : float array, shape (n,)
        Normal deviates.

    Returns
    -------
    float array, shape (n,)
        log10 L, erg/s, behind the dust of the gas.

    References
    ----------
    Kennicutt & Evans 2012
    """
    return np.asarray(log_sfr + law.per_sfr + law.scatter * normal - 0.4 * a_halpha)


def match_abundance(line_model: LineModel, z: Float, log_l: Float) -> Float:
    """Shift H alpha luminosities so that their abundance at each redshift agrees with observations.

    Parameters
    ----------
    line_model : LineModel
        The model with the matching table.
    z : float array, shape (n,)
        Redshift.
    log_l : float array, shape (n,)
        log10 L, erg/s.

    Returns
    -------
    float array, shape (n,)
        Shifted log10 L, erg/s.

    Notes
    -----
    The shift is bilinear in z and log10 L, and constant beyond the edges of the table.
    """
    row, part = bracket(line_model.z, z)
    column, share = bracket(line_model.log_l, log_l)
    low = line_model.shift[row, column] * (1.0 - share) + line_model.shift[row, column + 1] * share
    high = line_model.shift[row + 1, column] * (1.0 - share) + line_model.shift[row + 1, column + 1] * share
    return np.asarray(log_l + low * (1.0 - part) + high * part)


def has_lines(law: Halpha, log_sfr: Float, red: Bool) -> Bool:
    """Return True for galaxies that have emission lines.

    Parameters
    ----------
    law : Halpha
        Parameters.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.

    Returns
    -------
    bool array, shape (n,)
        False for red galaxies below the star formation rate `red_sfr`.
    """
    return np.asarray(~(red & (log_sfr < np.log10(law.red_sfr))))


def metallicity(law: Metals, log_mass: Float, log_sfr: Float, normal: Float) -> Float:
    """Return the metallicity of the gas.

    Parameters
    ----------
    law : Metals
        Parameters.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr.
    normal : float array, shape (n,)
        Normal deviates.

    Returns
    -------
    float array, shape (n,)
        12 + log(O/H).

    References
    ----------
    Curti et al. 2020, eqs. 2 and 5
    """
    below = law.sharpness * (law.mass + law.mass_sfr * log_sfr - log_mass)
    # Compute log10(1 + 10^x) without overflow.
    fall = np.logaddexp(0.0, np.log(10.0) * below) / np.log(10.0)
    return np.asarray(np.clip(law.highest - law.turn * fall + law.scatter * normal, *law.limits))


def fluxes(
    line_model: LineModel, z: Float, log_mass: Float, log_sfr: Float, red: Bool, rng: AnyGenerator
) -> dict[str, Float]:
    """Draw the flux of the primary component of each line.

    Parameters
    ----------
    line_model : LineModel
        The model.
    z : float array, shape (n,)
        True redshift.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun (Chabrier).
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr (Kroupa).
    red : bool array, shape (n,)
        True for galaxies on the red sequence.
    rng : AnyGenerator
        Random numbers of dust, luminosities and ratios.

    Returns
    -------
    dict of str to float array, shape (n,)
        Flux by column of table `galaxies`, erg s-1 cm-2, before magnification and the Milky Way's dust.
    """
    normals = np.stack([rng.standard_normal(z.size) for _ in range(_DEVIATES)])
    a_halpha = halpha_attenuation(line_model.gas, log_mass, normals[0])
    observed = match_abundance(line_model, z, raw_halpha(line_model.halpha, log_sfr, a_halpha, normals[1]))
    excess = metallicity(line_model.metals, log_mass, log_sfr, normals[2]) - line_model.metals.sun
    log_l = _luminosities(line_model, z, observed + 0.4 * a_halpha, excess, normals[3:])
    area = np.log10(4.0 * np.pi) + 2.0 * np.log10(cosmology.luminosity_distance(z) / cosmology.HUBBLE * _CM_PER_MPC)
    log_dilution = np.where(has_lines(line_model.halpha, log_sfr, red), -area, -np.inf)
    return {
        column: 10.0 ** (log_l[column] - 0.4 * k * a_halpha + log_dilution) for column, k in line_model.dust.items()
    }


def mean_line_flux(band: Passband, z_obs: Float, fluxes: Mapping[str, Float]) -> Float:
    """Return the band-averaged f_nu of all lines.

    Parameters
    ----------
    band : Passband
        Passband.
    z_obs : float array, shape (n,)
        Observed redshift.
    fluxes : mapping of str to float array, shape (n,)
        Flux by column of table `galaxies`, erg s-1 cm-2.

    Returns
    -------
    float array, shape (n,)
        f_nu, erg s-1 cm-2 Hz-1.
    """
    weights = np.pad(passbands.weights(band), 1)
    total = np.zeros(z_obs.size)
    for line in lines.line_list():
        # The flux of a line is in bins of 1 A. Lines beyond the band add nothing.
        at = line.vacuum * (1.0 + z_obs) - band.wavelength[0] + 1.0
        place = np.clip(at, 0.0, weights.size - 1.0)
        below = np.minimum(place.astype(np.int64), weights.size - 2)
        response = weights[below] + (place - below) * (weights[below + 1] - weights[below])
        total += line.ratio * fluxes[line.column] * response
    return total


def magnitude_with_light(magnitude: Float, light: Float) -> Float:
    """Return the AB magnitude of sources (AB mag) after adding light (f_nu, erg s-1 cm-2 Hz-1)."""
    return np.asarray(magnitude - 2.5 * np.log10(1.0 + light * 10.0 ** (0.4 * (magnitude + AB_CGS))))


def expected_counts(flux: Float, z_min: float, z_max: float) -> Float:
    """Return the number of galaxies above H alpha fluxes between two redshifts.

    Parameters
    ----------
    flux : float array, shape (n,)
        H alpha flux, erg s-1 cm-2.
    z_min, z_max : float
        Redshift limits.

    Returns
    -------
    float array, shape (n,)
        Number per deg2.

    References
    ----------
    Pozzetti et al. 2016, A&A 590, A3, model 3, in the cosmology of that paper
    """
    law = Pozzetti(**parameters.section(_FILE, "pozzetti"))
    z = np.linspace(z_min, z_max, _Z_NODES)
    rate = np.sqrt(law.omega_m * (1.0 + z) ** 3 + 1.0 - law.omega_m)
    fine = np.linspace(0.0, z_max, 20 * _Z_NODES)
    inverse = 1.0 / np.sqrt(law.omega_m * (1.0 + fine) ** 3 + 1.0 - law.omega_m)
    hubble_distance = LIGHT_KM_S / (100.0 * law.hubble)
    steps = 0.5 * (inverse[1:] + inverse[:-1]) * np.diff(fine)
    chi = hubble_distance * np.interp(z, fine, np.concatenate([[0.0], np.cumsum(steps)]))
    volume = chi**2 * hubble_distance / rate * np.radians(1.0) ** 2
    area = 4.0 * np.pi * ((1.0 + z) * chi * _CM_PER_MPC) ** 2
    totals = [np.trapezoid(volume * _density_above(law, z, np.log10(f * area)), z) for f in np.atleast_1d(flux)]
    return np.array(totals)


def _density_above(law: Pozzetti, z: Float, log_l: Float) -> Float:
    """Density n(> L) of each luminosity, Mpc^-3."""
    fitted = np.maximum(z, law.z_fit)
    log_star = law.l_inf + (1.5 / (1.0 + fitted)) ** law.beta * (law.l_half - law.l_inf)
    log_y = _L_NODES - 42.0
    y = 10.0**log_y
    density = np.log(10.0) * 10.0**law.log_phi * y ** (law.alpha + 1.0) / (1.0 + (np.e - 1.0) * y**law.delta)
    pieces = 0.5 * (density[1:] + density[:-1]) * np.diff(log_y)
    above = np.concatenate([np.cumsum(pieces[::-1])[::-1], [0.0]])
    return np.asarray(np.interp(log_l - log_star, log_y, above))


def _luminosities(line_model: LineModel, z: Float, halpha: Float, excess: Float, normals: Float) -> dict[str, Float]:
    """log10 of the intrinsic luminosities by column, for `excess` = 12 + log(O/H) minus the Sun's value."""
    ratios, other_lines = line_model.ratios, line_model.other_lines
    n2, r3, r2, s2 = (_ratio(numbers, excess) for numbers in (ratios.n2, ratios.r3, ratios.r2, ratios.s2))
    hbeta = halpha - np.log10(line_model.hydrogen["halpha"])
    r3 = r3 + ratios.r3_z * np.minimum(z, ratios.r3_z_last) + ratios.r3_scatter * normals[1]
    r2 = r2 + ratios.r2_r3 * normals[1] + ratios.r2_scatter * normals[2]
    sii = halpha + s2 + ratios.s2_scatter * normals[3]
    siii = sii + other_lines.siii + other_lines.siii_scatter * normals[4]
    helium = hbeta + other_lines.hei_scatter * normals[5]
    return {
        **{f"flux_{line}": hbeta + np.log10(ratio) for line, ratio in line_model.hydrogen.items()},
        "flux_hbeta": hbeta,
        # The catalogue contains one line per pair: half of doublets with equal lines, otherwise the stronger line.
        "flux_oii": hbeta + r2 + np.log10(0.5),
        "flux_oiii": hbeta + r3,
        "flux_nii": halpha + n2 + ratios.n2_scatter * normals[0],
        "flux_sii": sii + np.log10(0.5),
        "flux_siii": siii + np.log10(other_lines.siii_pair / (1.0 + other_lines.siii_pair)),
        "flux_hei": helium + np.log10(other_lines.hei),
        "flux_hei_5877": helium + np.log10(other_lines.hei_5877),
    }


def _ratio(polynomial: Sequence[float], excess: Float) -> Float:
    return np.asarray(np.polynomial.polynomial.polyval(excess, polynomial))
