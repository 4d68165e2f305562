"""Emission lines of galaxies.

H alpha follows from the star formation rate, and is then shifted so that the number of galaxies by H alpha luminosity
agrees with observed counts. The other lines follow from H alpha by line ratios. The table of shifts
(halpha_matching.csv) is made by scripts/match_halpha.py from galaxies without clustering. All ratios use one
metallicity scale, because mixing two scales changes [O III] / H beta by an order of magnitude. The file
emission_lines.toml contains the parameters.

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
from truesky.cosmology import Cosmology
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, lines
from truesky.randomness.per_source import AnyGenerator

_FILE = "emission_lines.toml"
MATCHING = Path(__file__).with_name("halpha_matching.csv")
# Number of normal deviates per galaxy: one each for the scatter of dust, H alpha, metallicity, [N II], [O III], [O II],
# [S II], [S III] and He I, in this order.
_DEVIATES = 9
_CM_PER_MPC = 3.0856775814913673e24
# log10 of the H alpha luminosities (erg/s) at which the observed luminosity function is integrated if L* = 1e42 erg/s.
# They are shifted to the L* of each redshift.
_L_NODES = np.linspace(38.0, 45.0, 1401)
# Number of redshifts at which the volume integral of `expected_counts` is evaluated.
_Z_NODES = 400


@dataclass(frozen=True, slots=True)
class Halpha:
    """Parameters of the H alpha luminosity by star formation rate; explained in emission_lines.toml, [halpha]."""

    per_sfr: float
    scatter: float
    red_sfr: float


@dataclass(frozen=True, slots=True)
class Gas:
    """Parameters of the dust attenuation of emission lines by stellar mass; explained in emission_lines.toml, [gas]."""

    pivot: float
    limits: tuple[float, float]
    polynomial: tuple[float, ...]
    min_attenuation: float
    scatter: float


@dataclass(frozen=True, slots=True)
class Metals:
    """Parameters of the gas metallicity by mass and star formation rate; explained in emission_lines.toml, [metals]."""

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
    """Parameters of the line ratios by metallicity; explained in emission_lines.toml, [ratios]."""

    n2: tuple[float, ...]
    n2_z: float
    n2_z_limits: tuple[float, float]
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
    """Parameters of the [S III] and He I lines; explained in emission_lines.toml, [others]."""

    siii: float
    siii_scatter: float
    siii_pair: float
    hei: float
    hei_5877: float
    hei_scatter: float


@dataclass(frozen=True, slots=True)
class Pozzetti:
    """Parameters of the observed H alpha luminosity function; explained in emission_lines.toml, [pozzetti]."""

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
        Parameters of H alpha, dust, metallicity and line ratios, from emission_lines.toml.
    hydrogen : dict of str to float
        Ratio of each hydrogen line to H beta without dust, by name such as "halpha".
    other_lines : OtherLines
        Parameters of [S III] and He I.
    dust : dict of str to float
        Extinction coefficient k at the wavelength of each line relative to H alpha, by column such as "flux_oiii".
    z : float array, shape (r,)
        Redshifts of the rows of `shift`.
    log_l : float array, shape (c,)
        log10 of the H alpha luminosities (erg/s) of the columns of `shift`.
    shift : float array, shape (r, c)
        Number that is added to log10 of the H alpha luminosity to match the observed counts, dex.
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
    """Return the emission line model with the built-in parameters and a CSV table of the shifts of H alpha.

    The first row of the file contains log10 L (erg/s), its first column the redshift, and the rest the shifts (dex).
    """
    table = np.loadtxt(matching, delimiter=",")
    return model_from_table(table[1:, 0], table[0, 1:], table[1:, 1:])


def model_from_table(z: Float, log_l: Float, shift: Float) -> LineModel:
    """Return the emission line model with given shifts of the H alpha luminosity.

    Parameters
    ----------
    z : float array, shape (r,)
        Redshifts of the rows of `shift`, ascending.
    log_l : float array, shape (c,)
        log10 of the H alpha luminosities (erg/s) of the columns of `shift`, ascending.
    shift : float array, shape (r, c)
        Number that is added to log10 of the H alpha luminosity, dex; 0 for the luminosity that follows from the star
        formation rate.

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
    """Return the attenuation of H alpha by the dust of the galaxy's gas.

    Parameters
    ----------
    gas : Gas
        Parameters of the attenuation.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    normal : float array, shape (n,)
        Standard normal deviates, which give the scatter.

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
    """Return the attenuated H alpha luminosity that follows from the star formation rate.

    The shift to observed counts (`match_abundance`) is not applied here.

    Parameters
    ----------
    law : Halpha
        Parameters of the relation.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr (Kroupa).
    a_halpha : float array, shape (n,)
        Attenuation of H alpha by the galaxy's dust, mag.
    normal : float array, shape (n,)
        Standard normal deviates, which give the scatter.

    Returns
    -------
    float array, shape (n,)
        log10 of the luminosity after attenuation, erg/s.

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
        The model with the table of shifts.
    z : float array, shape (n,)
        Redshift.
    log_l : float array, shape (n,)
        log10 of the H alpha luminosity after attenuation, erg/s.

    Returns
    -------
    float array, shape (n,)
        log10 of the shifted luminosity, erg/s.

    Notes
    -----
    The shift is interpolated linearly in z and log10 L, and constant beyond the edges of the table.
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
        Parameters, of which `red_sfr` (Msun/yr) is used.
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
    """Return the metallicity of the gas from stellar mass and star formation rate.

    Parameters
    ----------
    law : Metals
        Parameters of the relation.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr.
    normal : float array, shape (n,)
        Standard normal deviates, which give the scatter.

    Returns
    -------
    float array, shape (n,)
        12 + log10(O/H), within the limits of `law`.

    References
    ----------
    Curti et al. 2020, eqs. 2 and 5
    """
    below = law.sharpness * (law.mass + law.mass_sfr * log_sfr - log_mass)
    # Compute log10(1 + 10^x) without overflow.
    fall = np.logaddexp(0.0, np.log(10.0) * below) / np.log(10.0)
    return np.asarray(np.clip(law.highest - law.turn * fall + law.scatter * normal, *law.limits))


def fluxes(
    line_model: LineModel,
    cosmology: Cosmology,
    z: Float,
    log_mass: Float,
    log_sfr: Float,
    red: Bool,
    rng: AnyGenerator,
) -> dict[str, Float]:
    """Draw the emission line fluxes of galaxies: one flux per line, or per doublet the flux of its stronger line.

    Parameters
    ----------
    line_model : LineModel
        Model of the emission lines.
    cosmology : Cosmology
        Parameters of the universe, for the distances.
    z : float array, shape (n,)
        True redshift.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun (Chabrier).
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr (Kroupa).
    red : bool array, shape (n,)
        True for galaxies on the red sequence.
    rng : AnyGenerator
        Random numbers of the scatter of dust, luminosity, metallicity and line ratios.

    Returns
    -------
    dict of str to float array, shape (n,)
        Flux by column of table `galaxies` such as "flux_halpha", erg s-1 cm-2. The dust inside the galaxy is included;
        magnification and the Milky Way's dust are not. Galaxies without lines (see `has_lines`) have flux 0.
    """
    normals = np.stack([rng.standard_normal(z.size) for _ in range(_DEVIATES)])
    a_halpha = halpha_attenuation(line_model.gas, log_mass, normals[0])
    observed = match_abundance(line_model, z, raw_halpha(line_model.halpha, log_sfr, a_halpha, normals[1]))
    excess = metallicity(line_model.metals, log_mass, log_sfr, normals[2]) - line_model.metals.sun
    log_l = _luminosities(line_model, z, observed + 0.4 * a_halpha, excess, normals[3:])
    distance = cosmology.luminosity_distance(z) / cosmology.h * _CM_PER_MPC
    area = np.log10(4.0 * np.pi) + 2.0 * np.log10(distance)
    log_dilution = np.where(has_lines(line_model.halpha, log_sfr, red), -area, -np.inf)
    return {
        column: 10.0 ** (log_l[column] - 0.4 * k * a_halpha + log_dilution) for column, k in line_model.dust.items()
    }


def mean_line_flux(band: Passband, z_obs: Float, fluxes: Mapping[str, Float]) -> Float:
    """Return the mean f_nu in a passband that the emission lines of each galaxy add.

    Parameters
    ----------
    band : Passband
        Passband.
    z_obs : float array, shape (n,)
        Observed redshift, with the peculiar velocity.
    fluxes : mapping of str to float array, shape (n,)
        Line flux by column of table `galaxies`, erg s-1 cm-2.

    Returns
    -------
    float array, shape (n,)
        Sum over all lines, erg s-1 cm-2 Hz-1; 0 if no line is in the passband.
    """
    weights = np.pad(passbands.weights(band), 1)
    total = np.zeros(z_obs.size)
    for line in lines.line_list():
        # Interpolate the weights, which have steps of 1 A, at the wavelength of the line: its width is neglected. The
        # zeros that were added at both ends exclude lines outside the band.
        at = line.vacuum * (1.0 + z_obs) - band.wavelength[0] + 1.0
        place = np.clip(at, 0.0, weights.size - 1.0)
        below = np.minimum(place.astype(np.int64), weights.size - 2)
        response = weights[below] + (place - below) * (weights[below + 1] - weights[below])
        total += line.ratio * fluxes[line.column] * response
    return total


def magnitude_with_light(magnitude: Float, light: Float) -> Float:
    """Return the AB magnitude of sources with `magnitude` (AB) after `light` (f_nu, erg s-1 cm-2 Hz-1) is added."""
    return np.asarray(magnitude - 2.5 * np.log10(1.0 + light * 10.0 ** (0.4 * (magnitude + AB_CGS))))


def expected_counts(flux: Float, z_min: float, z_max: float) -> Float:
    """Return the observed number of galaxies per deg2 that are brighter than H alpha fluxes, between two redshifts.

    Parameters
    ----------
    flux : float or float array, shape (n,)
        Smallest observed H alpha flux, erg s-1 cm-2.
    z_min, z_max : float
        Redshift limits.

    Returns
    -------
    float array, shape (n,)
        Number per deg2 above each flux.

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
    """Return the number density (Mpc^-3) of galaxies at redshift z with log10 L (H alpha, erg/s) above `log_l`."""
    fitted = np.maximum(z, law.z_fit)
    log_star = law.l_inf + (1.5 / (1.0 + fitted)) ** law.beta * (law.l_half - law.l_inf)
    log_y = _L_NODES - 42.0
    y = 10.0**log_y
    density = np.log(10.0) * 10.0**law.log_phi * y ** (law.alpha + 1.0) / (1.0 + (np.e - 1.0) * y**law.delta)
    pieces = 0.5 * (density[1:] + density[:-1]) * np.diff(log_y)
    above = np.concatenate([np.cumsum(pieces[::-1])[::-1], [0.0]])
    return np.asarray(np.interp(log_l - log_star, log_y, above))


def _luminosities(line_model: LineModel, z: Float, halpha: Float, excess: Float, normals: Float) -> dict[str, Float]:
    """Return log10 of the luminosity (erg/s) of each line before attenuation, by column of table `galaxies`.

    `halpha` is log10 of the H alpha luminosity, and `excess` is 12 + log10(O/H) minus the Sun's value. `normals`, shape
    (6, n), are normal deviates for the scatter of [N II], [O III], [O II], [S II], [S III] and He I, in this order.
    """
    ratios, other_lines = line_model.ratios, line_model.other_lines
    n2, r3, r2, s2 = (_ratio(numbers, excess) for numbers in (ratios.n2, ratios.r3, ratios.r2, ratios.s2))
    hbeta = halpha - np.log10(line_model.hydrogen["halpha"])
    n2 = n2 + ratios.n2_z * (np.clip(z, *ratios.n2_z_limits) - ratios.n2_z_limits[0]) + ratios.n2_scatter * normals[0]
    r3 = r3 + ratios.r3_z * np.minimum(z, ratios.r3_z_last) + ratios.r3_scatter * normals[1]
    r2 = r2 + ratios.r2_r3 * normals[1] + ratios.r2_scatter * normals[2]
    sii = halpha + s2 + ratios.s2_scatter * normals[3]
    siii = sii + other_lines.siii + other_lines.siii_scatter * normals[4]
    helium = hbeta + other_lines.hei_scatter * normals[5]
    return {
        **{f"flux_{line}": hbeta + np.log10(ratio) for line, ratio in line_model.hydrogen.items()},
        "flux_hbeta": hbeta,
        # Table `galaxies` contains one line of each doublet: half of the flux of [O II] and [S II], whose two lines
        # are equal in this model, and the stronger line of [O III], [N II] and [S III].
        "flux_oii": hbeta + r2 + np.log10(0.5),
        "flux_oiii": hbeta + r3,
        "flux_nii": halpha + n2,
        "flux_sii": sii + np.log10(0.5),
        "flux_siii": siii + np.log10(other_lines.siii_pair / (1.0 + other_lines.siii_pair)),
        "flux_hei": helium + np.log10(other_lines.hei),
        "flux_hei_5877": helium + np.log10(other_lines.hei_5877),
    }


def _ratio(polynomial: Sequence[float], excess: Float) -> Float:
    return np.asarray(np.polynomial.polynomial.polyval(excess, polynomial))
