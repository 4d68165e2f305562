"""Band fluxes of many sources by direct integration over the wavelengths that the bands see.

galaxies   f_nu of the rows of `galaxies`
stars      f_nu of the rows of `stars`

The same sums as spectra.band_fluxes of whole spectra, in blocks that stay in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema import units
from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import BadInput
from truesky.fluxes import passbands
from truesky.fluxes.calibration import continuum_scale, star_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import Galaxies, Stars
from truesky.fluxes.spectra import extinction, lines
from truesky.fluxes.spectra.continuum import REFERENCE_BAND, amplitudes, dust_of, observed_shape
from truesky.numerics import sums

# Samples (rows times wavelengths) of a block: half a MB a temporary array, which the allocator then keeps.
_BLOCK = 60_000
# Bands closer than this are integrated as one stretch, A.
_GAP = 300
# Galaxies whose lines are drawn together.
_LINE_ROWS = 128


@dataclass(frozen=True, slots=True)
class Stretch:
    """Neighbouring wavelengths that some band sees.

    first     : wavelength of the first sample, A
    weights   : float64[w, n_band] of every band here, 0 where it is blind
    milky_way : float32[w] A(lambda) / A(V)
    reference : which samples the reference band sees (from, to), None if it lies elsewhere
    """

    first: int
    weights: Float
    milky_way: Float32
    reference: tuple[int, int] | None

    def __len__(self) -> int:
        return len(self.milky_way)


def galaxies(rows: Galaxies, bands: Sequence[Passband], library: Library) -> Float:
    """f_nu, float64[n, n_band] microjansky: internal dust, lines, magnification and the Milky Way included.

    Error: 1e-7 relative to the whole spectra's (tests/truesky/fluxes/test_integration.py)
    """
    reference, dust = passbands.load(REFERENCE_BAND), dust_of(library)
    stretches, reference_weights = _stretches(bands, reference), passbands.weights(reference)
    # Neighbours in redshift share the width of their windows.
    order = np.argsort(rows.mix.z_obs, kind="stable")
    seen, observed = np.zeros((len(rows), len(bands))), np.zeros(len(rows))
    for part in _blocks(order, len(reference.wavelength)):
        block = rows.rows(part)
        amplitude = amplitudes(block.mix, reference, library, dust)
        # Of order 1 whatever the units, so that single precision does not underflow.
        amplitude /= amplitude.sum(0)
        for stretch in stretches:
            for inner in _blocks(np.arange(len(part)), len(stretch)):
                mix, a_v = block.mix.rows(inner), block.a_v[inner]
                shape = observed_shape(mix, amplitude[:, inner], library, dust, stretch.first, len(stretch))
                if stretch.reference is not None:
                    low, high = stretch.reference
                    observed[part[inner]] = sums.product(shape[:, low:high], reference_weights)
                shape *= extinction.transmitted(stretch.milky_way, a_v.astype(np.float32)[:, None])
                seen[part[inner]] += sums.product(shape, stretch.weights)
    scale = continuum_scale(rows.mag_r01, observed)
    f_nu = units.ujy_of_cgs(seen * scale[:, None]) + _line_fluxes(rows, order, bands)
    return np.asarray(f_nu * rows.magnification[:, None])


def stars(rows: Stars, bands: Sequence[Passband], library: Library) -> Float:
    """f_nu, float64[n, n_band] microjansky, behind the dust on the way to each star."""
    scale = star_scale(rows, library)
    f_nu = np.zeros((len(rows), len(bands)))
    for stretch in _stretches(bands, None):
        low = stretch.first - int(library.wavelength[0])
        spectra = np.ascontiguousarray(library.flux[:, low : low + len(stretch)])
        for part in _blocks(np.arange(len(rows)), len(stretch)):
            dimmed = extinction.transmitted(stretch.milky_way, rows.a_v[part].astype(np.float32)[:, None])
            mixed = np.zeros_like(dimmed)
            for sed, share in zip(rows.sed, rows.frac, strict=True):
                mixed += spectra[sed[part]] * share[part].astype(np.float32)[:, None]
            f_nu[part] += sums.product(dimmed * mixed, stretch.weights)
    return units.ujy_of_cgs(f_nu * scale[:, None])


def _blocks(rows: Int, width: int) -> Iterator[Int]:
    step = max(_BLOCK // width, 1)
    return (rows[start : start + step] for start in range(0, len(rows), step))


def _line_fluxes(rows: Galaxies, order: Int, bands: Sequence[Passband]) -> Float:
    """f_nu that the lines add, microjansky, behind the Milky Way but not magnified: float64[n, n_band]."""
    out = np.zeros((len(rows), len(bands)))
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    for medium in sorted({band.medium for band in bands}):
        seen = np.array([k for k, band in enumerate(bands) if band.medium == medium])
        limits = min(bands[k].wavelength[0] for k in seen), max(bands[k].wavelength[-1] for k in seen)
        table = _full_weights([bands[k] for k in seen])
        for start in range(0, len(order), _LINE_ROWS):
            part = order[start : start + _LINE_ROWS]
            block = rows.rows(part)
            found = lines.profiles(block.lines, block.mix.z_obs, sigma[part], medium, *limits)
            out[np.ix_(part, seen)] = _line_block(found, block, table)
    return units.ujy_of_cgs(out)


def _line_block(found: lines.Profiles, rows: Galaxies, table: Float) -> Float:
    index = found.first[:, None] - passbands.GRID_FIRST + np.arange(found.f_lambda.shape[1])
    np.clip(index, 0, len(table) - 1, out=index)
    dust = extinction.transmitted(table[:, -1][index], rows.a_v[found.row][:, None])
    each = np.einsum("ij,ijk->ik", found.f_lambda * dust, table[:, :-1][index])
    return np.stack([np.bincount(found.row, each[:, k], minlength=len(rows)) for k in range(each.shape[1])], 1)


def _full_weights(bands: Sequence[Passband]) -> Float:
    """float64[23401, n_band + 1]: each band's weights on the grid, 0 at its ends; last, A(lambda) / A(V)."""
    grid = passbands.grid()
    table = np.zeros((len(grid), len(bands) + 1))
    for k, band in enumerate(bands):
        table[band.first : band.first + len(band.wavelength), k] = passbands.weights(band)
    table[[0, -1]] = 0.0
    table[:, -1] = extinction.milky_way(grid)
    return table


def _stretches(bands: Sequence[Passband], reference: Passband | None) -> list[Stretch]:
    """The wavelengths that any band (or the reference) sees."""
    everyone = [*bands, *([reference] if reference is not None else [])]
    if not bands:
        raise BadInput("no passband is asked for")
    ends = sorted((int(band.wavelength[0]), int(band.wavelength[-1])) for band in everyone)
    merged = [ends[0]]
    for first, last in ends[1:]:
        if first - merged[-1][1] <= _GAP:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    return [_stretch(first, last, bands, reference) for first, last in merged]


def _stretch(first: int, last: int, bands: Sequence[Passband], reference: Passband | None) -> Stretch:
    weights = np.zeros((last - first + 1, len(bands)))
    for k, band in enumerate(bands):
        if (place := _place(band, first, last)) is not None:
            weights[slice(*place), k] = passbands.weights(band)
    milky_way = extinction.milky_way(np.arange(first, last + 1.0)).astype(np.float32)
    return Stretch(first, weights, milky_way, _place(reference, first, last) if reference is not None else None)


def _place(band: Passband, first: int, last: int) -> tuple[int, int] | None:
    """Where a band lies in a stretch; it lies in one as a whole or not at all."""
    low = int(band.wavelength[0]) - first
    return (low, low + len(band.wavelength)) if 0 <= low <= last - first else None
