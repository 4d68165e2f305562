"""Colours, dust and spectra of galaxies.

red_fraction, draw_colour   the red and blue sequences of 0.1(g - r) against luminosity and redshift
draw_dust                   E(B-V) and extinction law
invert                      the SED that has the colour: two neighbouring templates and their shares
between                     the SED of a real template index
columns, colours            an SED as columns of table `galaxies`, its 0.1(g - r)

Ref: Skibba & Sheth 2009, Ilbert et al. 2009; the numbers and their sources are in sed_assignment.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from jobs.catalogue import parameters
from jobs.catalogue.galaxies.band_ratios import BandRatios, Sed, ebv_weights, offset
from jobs.keyed import Draws
from lake_schema.arrays import Bool, Float, Int

_FILE = "sed_assignment.toml"
# The sequences are written in M_r + 20.
_PIVOT = -20.0
PREVOT, CALZETTI = 1, 2


@dataclass(frozen=True, slots=True)
class RedFraction:
    """Share of the red sequence (sed_assignment.toml, [red_fraction])."""

    blue: float
    blue_rate: float
    limits: tuple[float, float]
    times: tuple[float, float]
    z_norm: float
    z_rate: float
    z_floor: float
    dwarf: float
    dwarf_rate: float
    highest: float


@dataclass(frozen=True, slots=True)
class ColourSequence:
    """Mean colours and scatters (sed_assignment.toml, [sequence])."""

    red: float
    red_rate: float
    red_z_rate: float
    red_scatter: float
    red_scatter_rate: float
    red_scatter_limits: tuple[float, float]
    blue: float
    blue_rate: float
    blue_limits: tuple[float, float]
    blue_z_rate: float
    z_first: float
    z_range: float
    blue_scatter: float
    blue_scatter_rate: float
    blue_scatter_limits: tuple[float, float]
    limits: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Dust:
    """Dust of blue galaxies (sed_assignment.toml, [dust])."""

    shape: float
    mean: float
    mean_rate: float
    pivot: float
    mean_limits: tuple[float, float]
    highest: float
    lowest: float
    prevot_colour: float
    calzetti_odds: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Colours:
    """Everything that colours and dust are drawn from, made once by `colours_model`."""

    fraction: RedFraction
    sequence: ColourSequence
    dust: Dust


def colours_model() -> Colours:
    """The colours of the embedded universe."""
    return Colours(
        RedFraction(**parameters.section(_FILE, "red_fraction")),
        ColourSequence(**parameters.section(_FILE, "sequence")),
        Dust(**parameters.section(_FILE, "dust")),
    )


def red_fraction(law: RedFraction, m_r: Float, z: Float, kind: Int) -> Float:
    """Share[n] of galaxies on the red sequence.

    m_r, z : float[n] M_r mag, redshift
    kind : [n] 0 central, 1 satellite
    law   : constants of the relation
    Ref: Skibba & Sheth 2009
    """
    bright = np.clip(1.0 - (law.blue + law.blue_rate * (m_r - _PIVOT)), *law.limits)
    evolved = bright * np.array(law.times)[kind] * np.clip(law.z_norm - law.z_rate * z, law.z_floor, 1.0)
    return np.asarray(np.minimum(evolved * 10.0 ** (-law.dwarf_rate * np.maximum(m_r - law.dwarf, 0.0)), law.highest))


def draw_colour(model: Colours, m_r: Float, z: Float, kind: Int, rng: Draws) -> tuple[Bool, Float]:
    """(on the red sequence[n], 0.1(g - r)[n]).

    m_r, z : float[n] M_r mag, redshift;  kind : int[n] 0 central, 1 satellite
    model   : the two sequences;  rng : of sequence and scatter
    """
    law, x = model.sequence, m_r - _PIVOT
    red = rng.random(m_r.size) < red_fraction(model.fraction, m_r, z, kind)
    red_mean = law.red + law.red_rate * x - law.red_z_rate * z
    since = np.clip(z - law.z_first, 0.0, law.z_range)
    blue_mean = np.clip(law.blue + law.blue_rate * x, *law.blue_limits) - law.blue_z_rate * since
    red_scatter = np.clip(law.red_scatter + law.red_scatter_rate * x, *law.red_scatter_limits)
    blue_scatter = np.clip(law.blue_scatter + law.blue_scatter_rate * x, *law.blue_scatter_limits)
    mean, scatter = np.where(red, red_mean, blue_mean), np.where(red, red_scatter, blue_scatter)
    return red, np.clip(mean + scatter * rng.standard_normal(m_r.size), *law.limits)


def draw_dust(dust: Dust, m_r: Float, red: Bool, colour: Float, rng: Draws) -> tuple[Int, Float]:
    """(extinction law[n], E(B-V)[n] mag); red galaxies have no dust.

    m_r : float[n] mag;  red : bool[n] on the red sequence;  colour : float[n] 0.1(g - r) mag
    dust  : laws and the distribution of E(B-V);  rng : of law and E(B-V)
    Ref: Ilbert et al. 2009
    """
    mean = np.clip(dust.mean + dust.mean_rate * (m_r - dust.pivot), *dust.mean_limits)
    ebv = np.minimum(mean / dust.shape * rng.standard_gamma(dust.shape, m_r.size), dust.highest)
    odds = np.cumsum(dust.calzetti_odds)
    calzetti = CALZETTI + np.searchsorted(odds[:-1], rng.random(m_r.size) * odds[-1], side="right")
    law = np.where(colour > dust.prevot_colour, PREVOT, calzetti)
    clean = red | (ebv < dust.lowest)
    return np.where(clean, 0, law), np.where(clean, 0.0, ebv)


def invert(table: BandRatios, colour: Float, law: Int, ebv: Float) -> Sed:
    """The spectra that have the wanted colours; the end of the library where dust leaves none that has.

    colour : float[n] 0.1(g - r) mag;  law : int[n];  ebv : float[n] mag
    table : of 0.1g at z = 0. Mixing templates i and i - 1 with shares 1 - f and f of the 0.1r flux mixes
            their 0.1g / 0.1r ratios with the same shares, so the inversion is exact.
    """
    weights = ebv_weights(table.ebv, np.where(law > 0, ebv, 0.0))
    by_law = table.values[0].astype(np.float64)[np.maximum(law, 1) - 1]
    ratio = np.exp(np.einsum("nte,ne->nt", by_law, weights))
    target = 10.0 ** (-0.4 * colour)
    last = ratio.shape[1] - 1
    template = np.clip(np.sum(ratio < target[:, None], axis=1), 1, last)
    row = np.arange(colour.size)
    late, early = ratio[row, template], ratio[row, template - 1]
    share = np.clip((late - target) / (late - early), 0.0, 1.0)
    return Sed(template, 1.0 - share, template - 1, share, law, ebv)


def between(index: Float, law: Int, ebv: Float) -> Sed:
    """Of real template indices t[n] >= 0: i = max(ceil(t), 1) and i - 1, with shares 1 - f and f = i - t.

    index : float[n];  law : int[n];  ebv : float[n] mag
    Ref: Serrano et al. 2024, appendix B
    """
    upper = np.maximum(np.ceil(index), 1.0).astype(np.int64)
    share = np.asarray(upper - index, np.float64)
    return Sed(upper, 1.0 - share, upper - 1, share, law, ebv)


def columns(sed: Sed) -> dict[str, npt.NDArray[np.generic]]:
    """Spectra as columns of table `galaxies`: both components behind the same dust.

    returns : [n] each
    """
    return {
        "sed_1": sed.template_1,
        "frac_1": sed.frac_1,
        "ext_law_1": sed.law,
        "ebv_1": sed.ebv,
        "sed_2": sed.template_2,
        "frac_2": sed.frac_2,
        "ext_law_2": sed.law,
        "ebv_2": sed.ebv,
    }


def colours(table: BandRatios, sed: Sed) -> Float:
    """0.1(g - r)[n] of two-component spectra; table : of 0.1g at z = 0."""
    return offset(table, np.zeros(sed.ebv.size), sed)
