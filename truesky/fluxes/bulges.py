"""How much of a galaxy's light is its bulge's, by band: bulges are redder than their discs.

in_band   rows of `galaxies` with the bulge's share of the light in a band for their bulge_fraction
in_bins   the same share in each of several stretches of the rest frame
ladder    templates from blue to red

The ratio of bulge to disc in the rest-frame reference band is that of `bulge_fraction`. Elsewhere it is times what a
template that is redder by `bulge_color` in 0.1(g - r) has of the light there, over what the galaxy's own has: the
sequence of templates, logarithms of light interpolated between neighbours. At the reddest both are the same, and so
are bulge and disc. A ratio times a positive number leaves both components positive at every wavelength, and their sum
is the galaxy's spectrum, whatever the numbers are.

Error : dust lies before both, and what it changes within a band is left out: 5 % of the ratio at E(B-V) = 0.4;
        emission lines are shared like the continuum
Ref   : Kennedy et al. 2016, MNRAS 460, 3458 (colours of bulges and discs)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Float, Int
from truesky.fluxes import passbands
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import GALAXY_KINDS
from truesky.fluxes.spectra import intergalactic
from truesky.fluxes.spectra.continuum import COMPONENTS, REFERENCE_BAND
from truesky.numerics import matrices

FRACTION, COLOUR = "bulge_fraction", "bulge_color"
# What is read of a row besides.
COLUMNS = (COLOUR, "z_obs", *(f"{name}_{k}" for k in COMPONENTS for name in ("sed", "frac")))
_BLUE_BAND = "sdss_g01"
# Nodes of the table of a band in ln(1 + z), and wavelengths of the band at each: 1e-3 of a share.
_FIRST, _LAST, _STEP, _SAMPLES = np.log(0.97), np.log(8.0), 0.01, 500
# Templates of equal colour are apart by this.
_COLOUR_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ColourSequence:
    """Templates from blue to red.

    colour : float64[m] 0.1(g - r), rising;  of : int64[m] template;  rank : int64[template]
    light  : float64[m] f_nu in the reference band
    """

    colour: Float
    template: Int
    rank: Int
    light: Float


@lru_cache(maxsize=4)
def colour_sequence(library: Library) -> ColourSequence:
    """Of a library's templates, without dust."""
    blue, light = (_rest_frame_light(library, passbands.load(name)) for name in (_BLUE_BAND, REFERENCE_BAND))
    colour = -2.5 * np.log10(blue / light)
    order = np.argsort(colour, kind="stable")
    rising = np.maximum.accumulate(colour[order]) + _COLOUR_STEP * np.arange(order.size)
    return ColourSequence(rising, order, np.argsort(order, kind="stable"), light[order])


def with_fractions_in_band(rows: pa.Table, band: Passband, library: Library) -> pa.Table:
    """Rows of `galaxies`, those with a colour of the bulge with its share of the light in a band as bulge_fraction.

    rows    : with `COLUMNS`; without them, or without a colour, a row stays as it is
    library : what sed_1 and sed_2 count
    """
    share, indices, redness, components = _read_rows(rows, library)
    if not indices.size:
        return rows
    z = rows["z_obs"].to_numpy().astype(float)[indices]
    position = np.clip((np.log1p(z) - _FIRST) / _STEP, 0.0, (_LAST - _FIRST) / _STEP - 1e-9)
    node = position.astype(np.int64)
    weight, table, sequence = position - node, _band_table(band, library), colour_sequence(library)
    ratio = np.zeros(indices.size)
    for sed, frac in components:
        rank, bluer, fraction = _neighbour_ranks(sequence, sed, redness)
        low, high = (
            _log_light_ratio(fraction, *(table[z, index] for index in (bluer, bluer + 1, rank)))
            for z in (node, node + 1)
        )
        ratio += frac * np.exp(low + weight * (high - low))
    share[indices] = _bulge_share(share[indices], ratio)
    index = rows.schema.get_field_index(FRACTION)
    return rows.set_column(index, FRACTION, pa.array(share, rows.schema.field(FRACTION).type))


def fractions_in_bins(rows: pa.Table, light: Float, library: Library) -> Float:
    """The bulge's share of the light in each bin, float64[n, bins].

    rows  : of `galaxies`;  library : what sed_1 and sed_2 count
    light : float64[template, bins] of each template in bins of the rest frame
    """
    share, indices, redness, components = _read_rows(rows, library)
    sequence, out = colour_sequence(library), np.repeat(share[:, None], light.shape[1], axis=1)
    table = _logarithm(light[sequence.template]) - np.log(sequence.light)[:, None]
    ratio = np.zeros((indices.size, light.shape[1]))
    for sed, frac in components:
        rank, bluer, fraction = _neighbour_ranks(sequence, sed, redness)
        ratio += frac[:, None] * np.exp(
            _log_light_ratio(fraction[:, None], *(table[index] for index in (bluer, bluer + 1, rank)))
        )
    out[indices] = _bulge_share(share[indices, None], ratio)
    return out


def _neighbour_ranks(sequence: ColourSequence, sed: Int, redness: Float) -> tuple[Int, Int, Float]:
    """Rank[n] of templates; that of the next bluer one than what is redder by `redness`, mag, and how far beyond."""
    rank = sequence.rank[sed]
    target_colour = np.clip(sequence.colour[rank] + redness, sequence.colour[0], sequence.colour[-1])
    bluer = np.clip(np.searchsorted(sequence.colour, target_colour, side="right") - 1, 0, sequence.colour.size - 2)
    return rank, bluer, (target_colour - sequence.colour[bluer]) / (sequence.colour[bluer + 1] - sequence.colour[bluer])


def _log_light_ratio(fraction: Float, low: Float, high: Float, galaxy: Float) -> Float:
    """ln of the light of what lies a part of the way from one template to the next, over that of the galaxy's own."""
    return np.asarray(low + fraction * (high - low) - galaxy)


def _read_rows(rows: pa.Table, library: Library) -> tuple[Float, Int, Float, list[tuple[Int, Float]]]:
    """Shares[n] in the reference band; which rows have a colour; it; their templates and fractions."""
    share = np.asarray(rows[FRACTION].to_numpy(), float).copy()
    if not set(COLUMNS) <= set(rows.column_names) or len(library) < 2:
        return share, np.zeros(0, np.int64), np.zeros(0), []
    redness = pc.fill_null(pc.cast(rows[COLOUR], pa.float64()), 0.0).to_numpy()
    is_selected = np.nan_to_num(redness) != 0.0
    if "kind" in rows.column_names:
        is_selected &= np.isin(rows["kind"].to_numpy(), GALAXY_KINDS)
    indices = np.flatnonzero(is_selected & (share > 0.0) & (share < 1.0))
    frac = np.stack([rows[f"frac_{k}"].to_numpy().astype(float)[indices] for k in COMPONENTS])
    frac /= frac.sum(0)
    sed = [rows[f"sed_{k}"].to_numpy().astype(np.int64)[indices] for k in COMPONENTS]
    return share, indices, redness[indices], list(zip(sed, frac, strict=True))


def _bulge_share(share: Float, ratio: Float) -> Float:
    bulge = share * ratio
    return np.asarray(bulge / (bulge + 1.0 - share))


def _rest_frame_light(library: Library, band: Passband) -> Float:
    first = int(band.wavelength[0] - library.wavelength[0])
    spectra = library.flux[:, first : first + len(band.wavelength)].astype(float)
    return np.asarray(matrices.matmul(spectra, passbands.weights(band)))


def _logarithm(light: Float) -> Float:
    """Old templates have no light in the far ultraviolet: as faint as single precision goes."""
    return np.asarray(np.log(np.maximum(light, np.finfo(np.float32).tiny)))


def _band_table(band: Passband, library: Library) -> Float:
    # By its contents: a passband is read anew for each detector.
    return _compute_table(band.response.tobytes(), band.wavelength.tobytes(), library)


@lru_cache(maxsize=64)
def _compute_table(response: bytes, wavelength: bytes, library: Library) -> Float:
    """ln of the light in the band over that in the reference band at rest: float64[z, m] of the ladder."""
    band = Passband("", np.frombuffer(wavelength), np.frombuffer(response), "")
    sequence, nodes = colour_sequence(library), np.exp(np.arange(_FIRST, _LAST + 2 * _STEP, _STEP))
    samples = slice(None, None, max(len(band.wavelength) // _SAMPLES, 1))
    sampled, weights = band.wavelength[samples], passbands.weights(band)[samples]
    out = np.empty((nodes.size, sequence.template.size))
    for row, stretch in enumerate(nodes.tolist()):
        index = np.rint(sampled / stretch - library.wavelength[0]).astype(np.int64)
        spectra = np.take(library.flux, np.clip(index, 0, library.flux.shape[1] - 1), axis=1)[sequence.template].astype(
            float
        )
        absorbed_weights = (
            weights * intergalactic.transmission(sampled, stretch - 1.0)[0] if library.intergalactic else weights
        )
        out[row] = _logarithm(matrices.matmul(spectra, absorbed_weights) / absorbed_weights.sum())
    return out - np.log(sequence.light)
