"""Compute the bulge's fraction of a galaxy's light in each band, since bulges are redder than their discs.

The column `bulge_fraction` is the fraction in the rest-frame reference band 0.1r (SDSS r, shifted to the blue by a
factor 1.1). The column `bulge_color` is how much redder in 0.1(g - r) the bulge is than the galaxy. In another band the
ratio of bulge to disc is multiplied by a ratio of two templates. The numerator is the light of a template that is
redder by `bulge_color`; the denominator is the light of the galaxy's template. Templates are ordered by colour, and the
logarithm of their light is interpolated between neighbours. A galaxy with the reddest template has a bulge and a disc
of equal colours. Since the ratio is positive, bulge and disc are positive at every wavelength. Their sum is always the
galaxy's spectrum.

Notes
-----
Dust in front of bulge and disc changes their ratio, because they have different spectra within a band. This change is
neglected: the error is 5 % of the ratio at E(B-V) = 0.4. Emission lines are divided like the continuum.

References
----------
Kennedy et al. 2016, MNRAS 460, 3458 (colours of bulges and discs).
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
# Columns of the table `galaxies` that are read in addition to `bulge_fraction`.
COLUMNS = (COLOUR, "z_obs", *(f"{name}_{k}" for k in COMPONENTS for name in ("sed", "frac")))
_BLUE_BAND = "sdss_g01"
# First and last redshift node, as ln(1 + z), of the table of the templates' light in a band (see `_compute_table`).
_FIRST, _LAST = np.log(0.97), np.log(8.0)
# Step of the redshift nodes in ln(1 + z). With this step the error of a bulge fraction is 1e-3.
_STEP = 0.01
# Approximate number of wavelengths at which a band is sampled.
_SAMPLES = 500
# Increment (mag) that is added from template to template, so that the sequence increases even if colours are equal.
_COLOUR_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ColourSequence:
    """The m galaxy templates of a library, in order from blue to red.

    Attributes
    ----------
    colour : float array, shape (m,)
        Rest-frame colour 0.1(g - r) in mag, increasing.
    template : int array, shape (m,)
        Index of each template in the library, in order of colour.
    rank : int array, shape (m,)
        Position in this sequence of each template of the library, in the order of the library.
    light : float array, shape (m,)
        Rest-frame f_nu in the reference band 0.1r, in order of colour; arbitrary unit.
    """

    colour: Float
    template: Int
    rank: Int
    light: Float


@lru_cache(maxsize=4)
def colour_sequence(library: Library) -> ColourSequence:
    """Return the templates of a galaxy library in order of their rest-frame colour without dust."""
    blue, light = (_rest_frame_light(library, passbands.load(name)) for name in (_BLUE_BAND, REFERENCE_BAND))
    colour = -2.5 * np.log10(blue / light)
    order = np.argsort(colour, kind="stable")
    rising = np.maximum.accumulate(colour[order]) + _COLOUR_STEP * np.arange(order.size)
    return ColourSequence(rising, order, np.argsort(order, kind="stable"), light[order])


def with_fractions_in_band(rows: pa.Table, band: Passband, library: Library) -> pa.Table:
    """Replace the column `bulge_fraction` by the bulge's fraction of the observed light in a band.

    Parameters
    ----------
    rows : pa.Table
        Rows of `galaxies`. A row stays unchanged if its `bulge_color` is null, NaN or 0, its fraction is 0 or 1, or its
        `kind` has no galaxy template. All rows stay unchanged if one of the columns `COLUMNS` is missing.
    band : Passband
        The passband.
    library : Library
        Templates to which the columns sed_1 and sed_2 refer.

    Returns
    -------
    pa.Table
        The rows with the new column `bulge_fraction`.
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
    """Return the bulge's fraction of the light in each bin of rest-frame wavelength.

    Parameters
    ----------
    rows : pa.Table
        Rows of `galaxies`. Rows without a bulge colour have the value of `bulge_fraction` in all bins.
    light : float array, shape (n_template, n_bin)
        Light of each template of the library in the bins, in the unit of f_nu in the library.
    library : Library
        Templates to which the columns sed_1 and sed_2 refer.

    Returns
    -------
    float array, shape (n, n_bin)
        Fractions from 0 to 1.
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
    """Find the templates for bulges that are redder than the templates `sed` by `redness` (mag).

    Returns three arrays of shape (n,): the position of `sed` in the sequence of colours, the position of the last
    template that is not redder than the bulge, and the fraction of the way from this template to the next one. The
    colour of a bulge is limited to the colours of the bluest and the reddest template.
    """
    rank = sequence.rank[sed]
    target_colour = np.clip(sequence.colour[rank] + redness, sequence.colour[0], sequence.colour[-1])
    bluer = np.clip(np.searchsorted(sequence.colour, target_colour, side="right") - 1, 0, sequence.colour.size - 2)
    return rank, bluer, (target_colour - sequence.colour[bluer]) / (sequence.colour[bluer + 1] - sequence.colour[bluer])


def _log_light_ratio(fraction: Float, low: Float, high: Float, galaxy: Float) -> Float:
    """Return ln(light of the bulge's template / light of the galaxy's template).

    All arguments but the first are ln(light). The bulge lies at `fraction` of the way from template `low` to `high`.
    """
    return np.asarray(low + fraction * (high - low) - galaxy)


def _read_rows(rows: pa.Table, library: Library) -> tuple[Float, Int, Float, list[tuple[Int, Float]]]:
    """Return the bulge fractions of all rows in the reference band, and the data of the rows with a bulge colour.

    These data are the indices of the rows, their bulge colours (mag), and for each of the two templates of a galaxy the
    pair (template, share of the light). They are empty if a column is missing.
    """
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
    """Return ln(light). Light below 1e-38 counts as 1e-38, since templates of old galaxies emit no far ultraviolet."""
    return np.asarray(np.log(np.maximum(light, np.finfo(np.float32).tiny)))


def _band_table(band: Passband, library: Library) -> Float:
    # Cache by the bytes of the curve: the passband is read again for each detector, so objects are never the same.
    return _compute_table(band.response.tobytes(), band.wavelength.tobytes(), library)


@lru_cache(maxsize=64)
def _compute_table(response: bytes, wavelength: bytes, library: Library) -> Float:
    """Return ln(observed flux in a band / rest-frame flux in the reference band), float64[n_z, m].

    The first axis is the redshift node, the second the template in order of colour. At each redshift, all templates
    have the same arbitrary offset, because only differences between templates are used. `response` and `wavelength` are
    the bytes of the passband's float64 arrays.
    """
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
