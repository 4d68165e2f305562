"""Compute spectra of L and T dwarfs: 365 templates, about 19 for each of 19 subtypes, which differ by random colours.

The mean colours are from Pecaut & Mamajek 2013: i - z (AB), and J - H and H - Ks (Vega). The colour z - J is computed
from z - Y with an adopted Y - J.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.fluxes import passbands
from truesky.fluxes.libraries import stellar
from truesky.randomness.rng import stream

COUNT = 365
_FIRST, _LAST = "L0V", "T8V"
_BANDS = ("sdss_i", "sdss_z", "twomass_j", "twomass_h", "twomass_ks")
_J = _BANDS.index("twomass_j")
# Adopted Y - J in AB magnitudes; in UKIDSS it varies from 0.7 to 0.9 along the sequence (Hewett et al. 2006).
_COLOR_YJ = 0.8
# Gaussian scatter of J - H and H - Ks within a subtype, mag (adopted).
_SCATTER = 0.07
# Largest error of a colour (mag), and largest number of iterations of the search for a spectrum with given colours.
_TOLERANCE = 1e-4, 200
# Centre (A), Gaussian sigma (A) and depth of methane and water bands. They are adopted and only make spectra look
# realistic, since colours are corrected afterwards.
_METHANE = ((11_500.0, 700.0, 0.6), (16_700.0, 900.0, 0.8), (22_500.0, 1200.0, 0.8))
_WATER = ((9_300.0, 300.0, 0.4), (14_000.0, 700.0, 0.7), (18_700.0, 900.0, 0.8))


@dataclass(frozen=True, slots=True)
class Subtypes:
    """Properties of n spectral subtypes of L and T dwarfs.

    Attributes
    ----------
    names : tuple of str
        Names of the subtypes, L0 to T8.
    teff : float array, shape (n,)
        Effective temperature in K.
    abs_mag_j : float array, shape (n,)
        Absolute J magnitude (Vega).
    colors : float array, shape (n, 5)
        Mean colours m_band - m_J (AB) of i, z, J, H and Ks in mag.
    """

    names: tuple[str, ...]
    teff: Float
    abs_mag_j: Float
    colors: Float


def subtypes() -> Subtypes:
    """Return the properties of the 19 whole subtypes L0 to T8 in the table of Pecaut & Mamajek 2013."""
    names, column = _whole_subtypes()
    j, h, ks = (_vega(band) for band in _BANDS[_J:])
    zj = column["z-Y"] + _COLOR_YJ
    jh, hk = column["J-H"] + j - h, column["H-Ks"] + h - ks
    colors = np.stack([column["i-z"] + zj, zj, 0.0 * zj, -jh, -jh - hk], 1)
    return Subtypes(names, column["Teff"], column["M_J"], colors)


def _whole_subtypes() -> tuple[tuple[str, ...], dict[str, Float]]:
    """Return the names L0 to T8 of the whole subtypes, and the columns of the published table for them."""
    names, column = stellar.table(_FIRST, _LAST)
    # Leave out the half subtypes T4.5, T5.5 and T7.5 of the table.
    is_whole_subtype = np.array(["." not in name for name in names])
    return (
        tuple(name.removesuffix("V") for name in names if "." not in name),
        {title: values[is_whole_subtype] for title, values in column.items()},
    )


def template_names() -> tuple[str, ...]:
    """Return a label SUBTYPE-NUMBER, such as "L0-00", of each of the 365 templates, in order of subtype.

    Number 00 has the mean colours of the subtype; the others have random colours.
    """
    names, _ = _whole_subtypes()
    counts = [COUNT // len(names) + (k < COUNT % len(names)) for k in range(len(names))]
    return tuple(f"{name}-{m:02d}" for name, count in zip(names, counts, strict=True) for m in range(count))


@dataclass(frozen=True, slots=True)
class Templates:
    """Properties of the 365 templates of L and T dwarfs.

    Attributes
    ----------
    subtype : int array, shape (365,)
        Index of the subtype, 0 (L0) to 18 (T8).
    teff : float array, shape (365,)
        Effective temperature in K.
    abs_mag_j, abs_mag_h : float array, shape (365,)
        Absolute magnitudes in J and H (Vega).
    """

    subtype: Int
    teff: Float
    abs_mag_j: Float
    abs_mag_h: Float


def templates() -> Templates:
    """Return the properties of the 365 templates. All templates of a subtype have the same temperature and M_J."""
    types = subtypes()
    labels = [name.partition("-")[::2] for name in template_names()]
    subtype = np.array([types.names.index(name) for name, _ in labels])
    jh = -types.colors[subtype] - np.stack([_scatter(name, int(number)) for name, number in labels])
    abs_mag_j = types.abs_mag_j[subtype]
    return Templates(
        subtype, types.teff[subtype], abs_mag_j, abs_mag_j - jh[:, _J + 1] + _vega("twomass_j") - _vega("twomass_h")
    )


def spectra() -> Float:
    """Return f_lambda of the 365 templates at 600 to 24000 A in steps of 1 A, float64[365, 23401].

    The mean f_lambda between 5450 and 5550 A is 1. Colours differ from the required ones by at most 1e-4 mag.
    """
    grid, types = passbands.grid(), subtypes()
    bands = [passbands.load(name) for name in _BANDS]
    response = np.zeros((len(grid), len(bands)))
    for k, band in enumerate(bands):
        response[band.first : band.first + len(band.wavelength), k] = passbands.weights(band)
    pivots = np.log([passbands.pivot_wavelength(band) for band in bands])
    out, mean = [], np.zeros(len(bands))
    for name in template_names():
        subtype, _, number = name.partition("-")
        k = types.names.index(subtype)
        start = stellar.planck(grid, types.teff[k]) * _band_transmission(grid, k / (len(types.names) - 1.0))
        colors = types.colors[k] + _scatter(subtype, int(number))
        correction = stellar.color_correction(np.log(grid), start, response, pivots, colors, _J, _TOLERANCE, mean)
        if number == "00":
            mean = correction
        out.append(stellar.apply_correction(np.log(grid), start, pivots, correction))
    return stellar.normalise(grid, np.stack(out))


def _scatter(subtype: str, number: int) -> Float:
    """Return random offsets (mag) from the mean colours m_band - m_J, for template `number` of a subtype: float64[5].

    The bands are i, z, J, H and Ks; only H and Ks have offsets. Template 0 has no offsets, because it has the mean
    colours.
    """
    if number == 0:
        return np.zeros(len(_BANDS))
    jh, hk = _SCATTER * stream("brown dwarfs", subtype, number).standard_normal(2)
    return np.array([0.0, 0.0, 0.0, -jh, -jh - hk])


def _band_transmission(wavelength: Float, position: float) -> Float:
    """Return the transmission of water and methane bands, in the shape of `wavelength` (A).

    `position` is the place in the sequence of subtypes, from 0 at L0 to 1 at T8. Water absorbs everywhere in the
    sequence, methane above 0.5.
    """
    transmission = np.ones_like(wavelength)
    for bands, strength in ((_WATER, 0.5 + 0.5 * position), (_METHANE, max(2.0 * position - 1.0, 0.0))):
        for centre, width, depth in bands:
            transmission *= 1.0 - strength * depth * np.exp(-0.5 * ((wavelength - centre) / width) ** 2)
    return transmission


@cache
def _vega(band: str) -> float:
    # Import here to avoid an import cycle.
    from truesky.fluxes.libraries.vega import vega_magnitude

    return vega_magnitude(passbands.load(band))
