"""Compute fluxes and spectra of supernovae at any date.

A spectrum is that of the template at the phase of the date, with the dust (or intrinsic colour) of the supernova, its
distance, the magnification by lenses and the dust of the Milky Way. Fluxes are integrals of these spectra over a band,
without tables: there are only few supernovae in a field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float, Int
from lake_schema.units import UJY_CGS
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, milky_way
from truesky.numerics import matrices
from truesky.variability import supernova_templates
from truesky.variability.supernova_templates import Template

# Number of wavelengths of a template in a block, and number of parts of a band, for upper limits of fluxes.
_BLOCK, _PARTS = 8, 8
# Number of points of light curves whose phases are computed at a time.
_POINTS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Supernovae:
    """Properties of n supernovae on which their light depends. All are arrays of shape (n,).

    Attributes
    ----------
    kind : int array
        Codes of `supernova_templates.KINDS`.
    z : float array
        Observed redshift.
    peak_mjd : float array
        Observed date of the peak in the rest-frame band `PEAK_BAND`.
    magnitude : float array
        Apparent AB magnitude at the peak in the redshifted `PEAK_BAND`: absolute magnitude, with the dust of the host,
        plus distance modulus.
    stretch : float array
        Factor by which the phases of the template are multiplied.
    ebv : float array
        E(B-V) in the host, mag. It changes the colour of the template; `magnitude` includes the dust already. It is
        negative for supernovae that are bluer than the template.
    magnification : float array
        Factor of the flux by lensing.
    a_v : float array
        A(V) of the Milky Way, mag.
    """

    kind: Int
    z: Float
    peak_mjd: Float
    magnitude: Float
    stretch: Float
    ebv: Float
    magnification: Float
    a_v: Float

    def __len__(self) -> int:
        return len(self.kind)

    def select(self, chosen: Int | Bool) -> Supernovae:
        """Return the supernovae with these indices, or all for which the mask is True."""
        return Supernovae(*(getattr(self, column.name)[chosen] for column in fields(self)))


def first_and_last_day(supernovae: Supernovae, templates: Mapping[int, Template]) -> tuple[Float, Float]:
    """Return the dates (MJD) of the first and the last light of supernovae, two arrays of shape (n,)."""
    first, last = (np.array([templates[int(kind)].phase[edge] for kind in supernovae.kind], float) for edge in (0, -1))
    slow = supernovae.stretch * (1.0 + supernovae.z)
    return supernovae.peak_mjd + first * slow, supernovae.peak_mjd + last * slow


def fluxes(supernovae: Supernovae, band: Passband, mjd: Float, templates: Mapping[int, Template]) -> Float:
    """Return the band-averaged fluxes of supernovae.

    Parameters
    ----------
    supernovae : Supernovae
        The n supernovae.
    band : Passband
        The passband.
    mjd : float array, shape (n, m)
        Dates of each supernova, MJD; shape (1, m) for the same dates.
    templates : mapping of int to Template
        Spectra by kind.

    Returns
    -------
    float array, shape (n, m)
        f_nu in microjansky; 0 before the first and after the last phase of the template.

    Notes
    -----
    The response of the band is integrated over the spectrum, which is linear in wavelength and in phase between the
    points of the template.
    """
    dates = np.broadcast_to(mjd, (len(supernovae), np.shape(mjd)[-1]))
    out, block = np.zeros(dates.shape), max(_POINTS // max(dates.shape[1], 1), 1)
    for kind in np.unique(supernovae.kind):
        members, template = np.flatnonzero(supernovae.kind == kind), templates[int(kind)]
        for group in np.split(members, range(block, members.size, block)):
            row, share = template.at_phases(_phases(supernovae.select(group), dates[group]))
            for i, own_row, own_share in zip(group.tolist(), row, share, strict=True):
                if own_share.any():
                    out[i] = _light_curve(supernovae, i, band, template, (own_row, own_share))
    return out


def _light_curve(supernovae: Supernovae, i: int, band: Passband, template: Template, place: tuple[Int, Float]) -> Float:
    """Return the fluxes of supernova `i` in microjansky, shape (m,).

    `place` are rows of the template before m phases, and weights of this and of the next row (`Template.at_phases`).
    """
    row, share = place
    nodes, weights = _weights_of_nodes(template.wavelength * (1.0 + supernovae.z[i]), band)
    weights = weights * _factors(supernovae, i, template, nodes)
    rows = slice(int(row.min()), int(row.max()) + 2)
    curve = matrices.matmul(np.ascontiguousarray(template.flux[rows, nodes]), weights)
    row_before = row - rows.start
    return np.asarray(share[:, 0] * curve[row_before] + share[:, 1] * curve[row_before + 1])


def upper_limits(supernovae: Supernovae, band: Passband, mjd: float, templates: Mapping[int, Template]) -> Float:
    """Return upper limits of the fluxes of supernovae at one date, which take less time than the fluxes.

    Parameters
    ----------
    supernovae : Supernovae
        The n supernovae.
    band : Passband
        The passband.
    mjd : float
        The date, MJD.
    templates : mapping of int to Template
        Spectra by kind.

    Returns
    -------
    float array, shape (n,)
        f_nu in microjansky; 0 before the first and after the last phase of the template.
    """
    out = np.zeros(len(supernovae))
    for kind in np.unique(supernovae.kind):
        members, template = np.flatnonzero(supernovae.kind == kind), templates[int(kind)]
        chosen = supernovae.select(members)
        row, share = template.at_phases(_phases(chosen, mjd)[:, 0])
        first, last, flux, least_dust, most_dust = _blocks(template)
        # Dust of the Milky Way, which is left out, makes fluxes smaller.
        dust = np.where(chosen.ebv[:, None] > 0.0, least_dust, most_dust)
        largest = np.maximum(flux[row], flux[row + 1]) * extinction.transmission(dust, chosen.ebv[:, None])
        stretch, limit = (1.0 + chosen.z)[:, None], np.zeros(len(members))
        for blue, red, weight in _parts(band):
            limit += np.where((last * stretch >= blue) & (first * stretch <= red), largest, 0.0).max(axis=1) * weight
        scale = chosen.magnification * 10.0 ** (-0.4 * chosen.magnitude) / (1.0 + chosen.z)
        out[members] = np.where(share.any(axis=1), limit * scale, 0.0)
    return out


@lru_cache(maxsize=16)
def _blocks(template: Template) -> tuple[Float, Float, Float, Float, Float]:
    """Divide the wavelengths of a template into b blocks, for upper limits of its flux.

    Returns
    -------
    (float array, float array, float array, float array, float array)
        First and last wavelength, A, shape (b,); largest f_lambda by phase, shape (p, b); smallest and largest
        A(lambda) / E(B-V) in the host (`_host_dust`), shape (b,). A block shares its last wavelength with the next.
    """
    start = np.arange(0, len(template.wavelength) - 1, _BLOCK)
    end = np.minimum(start + _BLOCK, len(template.wavelength) - 1)
    pieces = [slice(low, high + 1) for low, high in zip(start, end, strict=True)]
    dust = _host_dust(template)
    return (
        template.wavelength[start],
        template.wavelength[end],
        np.stack([template.flux[:, piece].max(axis=1) for piece in pieces], axis=1),
        np.array([dust[piece].min() for piece in pieces]),
        np.array([dust[piece].max() for piece in pieces]),
    )


@lru_cache(maxsize=32)
def _parts(band: Passband) -> tuple[tuple[float, float, float], ...]:
    """Divide a band into parts of equal weight, and return the first and last wavelength (A) and the weight of each."""
    at, weights = band.wavelength, passbands.weights(band) / UJY_CGS
    total = np.cumsum(weights)
    part = np.minimum((total / total[-1] * _PARTS).astype(int), _PARTS - 1)
    groups = [np.flatnonzero(part == i) for i in np.unique(part)]
    return tuple((at[group[0]], at[group[-1]], float(weights[group].sum())) for group in groups)


def spectra(supernovae: Supernovae, wavelength: Float, mjd: float, templates: Mapping[int, Template]) -> Float:
    """Return the spectra of supernovae at one date.

    Parameters
    ----------
    supernovae : Supernovae
        The n supernovae.
    wavelength : float array, shape (w,)
        Observed wavelengths, A, increasing.
    mjd : float
        The date, MJD.
    templates : mapping of int to Template
        Spectra by kind.

    Returns
    -------
    float array, shape (n, w)
        f_lambda in erg s-1 cm-2 A-1.
    """
    out = np.zeros((len(supernovae), len(wavelength)))
    for i, kind in enumerate(supernovae.kind):
        template = templates[int(kind)]
        (row,), ((row_before, next_weight),) = template.at_phases(_phases(supernovae.select(np.array([i])), mjd)[0])
        observed = template.wavelength * (1.0 + supernovae.z[i])
        nodes = _nodes_around(observed, wavelength)
        spectrum = row_before * template.flux[row, nodes] + next_weight * template.flux[row + 1, nodes]
        spectrum = spectrum * _factors(supernovae, i, template, nodes)
        out[i] = np.interp(wavelength, observed[nodes], spectrum, left=0.0, right=0.0)
    return out


def _phases(supernovae: Supernovae, mjd: npt.ArrayLike) -> Float:
    """Return the phases of the templates of n supernovae, days in the rest frame, shape (n, m).

    `mjd` are dates of shape (n, m), or one date.
    """
    slow = (1.0 + supernovae.z) * supernovae.stretch
    return np.asarray((np.asarray(mjd, float) - supernovae.peak_mjd[:, None]) / slow[:, None], float)


def _factors(supernovae: Supernovae, i: int, template: Template, nodes: slice) -> Float:
    """Return the factors from the f_lambda of a template to the observed f_lambda of supernova `i`.

    They are for the wavelengths of the template with the indices `nodes`, and contain distance, magnification and dust.
    The wavelengths of a redshifted spectrum are stretched, so that f_lambda falls by 1 + z.
    """
    stretch = 1.0 + float(supernovae.z[i])
    scale = float(supernovae.magnification[i]) * 10.0 ** (-0.4 * float(supernovae.magnitude[i])) / stretch
    foreground = milky_way.law(template.wavelength[nodes] * stretch)
    dust = float(supernovae.a_v[i]) * foreground + float(supernovae.ebv[i]) * _host_dust(template)[nodes]
    return np.asarray(scale * extinction.transmission(dust, 1.0))


@lru_cache(maxsize=16)
def _host_dust(template: Template) -> Float:
    """Return A(lambda) / E(B-V) minus its value in the middle of `PEAK_BAND`, at the wavelengths of a template.

    The law is that of the Milky Way.
    """
    middle = passbands.pivot_wavelength(passbands.load(supernova_templates.PEAK_BAND))
    k, k_middle = milky_way.law(template.wavelength), milky_way.law(np.array([middle]))
    return np.asarray(extinction.MILKY_WAY_R_V * (k - k_middle))


def _nodes_around(nodes: Float, wavelength: Float) -> slice:
    """Return the indices of increasing `nodes` in the range of increasing wavelengths, with one on each side."""
    first, last = np.searchsorted(nodes, wavelength[0]), np.searchsorted(nodes, wavelength[-1], side="right")
    return slice(max(int(first) - 1, 0), min(int(last) + 1, len(nodes)))


def _weights_of_nodes(nodes: Float, band: Passband) -> tuple[slice, Float]:
    """Return weights of the points of a spectrum: the sum of weights times f_lambda is the band-averaged flux.

    Parameters
    ----------
    nodes : float array, shape (w,)
        Wavelengths of the points, A, in equal steps. The spectrum is linear between them, and 0 outside.
    band : Passband
        The passband.

    Returns
    -------
    (slice, float array, shape (k,))
        Indices of the k points around the band, and their weights for f_lambda in erg s-1 cm-2 A-1 and a flux in
        microjansky.
    """
    chosen, step = _nodes_around(nodes, band.wavelength), nodes[1] - nodes[0]
    weights, moments = _weights_and_moments(band)
    at = nodes[chosen] - band.wavelength[0]
    if len(at) < 2:
        return chosen, np.zeros(len(at))
    # Each interval between two points contains the wavelengths from its first point to before its last. Only the last
    # interval contains both of its points.
    start = np.append(np.ceil(at[:-1]), np.floor(at[-1]) + 1.0)
    start = np.clip(start, 0, len(band.wavelength)).astype(np.int64)
    is_empty = start[1:] == start[:-1]
    total, moment = (np.where(is_empty, 0.0, np.add.reduceat(values, start)[:-1]) for values in (weights, moments))
    of_next = (moment - at[:-1] * total) / step
    out = np.zeros(len(at))
    out[:-1] = total - of_next
    out[1:] += of_next
    return chosen, out


@lru_cache(maxsize=32)
def _weights_and_moments(band: Passband) -> tuple[Float, Float]:
    """Return the weights of a band's wavelengths, and their products with the distance to the first wavelength.

    Both have an additional 0 at the end. The weights are for f_lambda in erg s-1 cm-2 A-1 and a flux in microjansky.
    """
    weights = passbands.weights(band) / UJY_CGS
    return np.append(weights, 0.0), np.append(weights * (band.wavelength - band.wavelength[0]), 0.0)
