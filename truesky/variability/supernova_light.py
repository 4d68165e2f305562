"""Compute fluxes and spectra of supernovae at any date.

A spectrum is that of the template at the phase of the date, with the dust (or intrinsic colour) of the supernova, its
distance, the magnification by lenses and the dust of the Milky Way. Fluxes are integrals of these spectra over a band,
without tables: there are only few supernovae in a field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from lake_schema.units import UJY_CGS
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction
from truesky.numerics import matrices
from truesky.variability import supernova_templates
from truesky.variability.supernova_templates import Template

# First wavelength (A) of the extinction law of the host, and number of wavelengths in steps of 1 A.
_LAW_FIRST, _LAW_COUNT = 900, 23101
_LAW_WAVELENGTH = np.arange(_LAW_FIRST, _LAW_FIRST + _LAW_COUNT, dtype=float)


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
    weights = passbands.weights(band) / UJY_CGS
    milky_way = extinction.milky_way_table(int(band.wavelength[0]), len(band.wavelength))
    out = np.zeros(dates.shape)
    for i, kind in enumerate(supernovae.kind):
        template, z = templates[int(kind)], float(supernovae.z[i])
        row, share = template.at_phases(_phases(supernovae, i, dates[i]))
        if not share.any():
            continue
        dust = extinction.transmission(milky_way, supernovae.a_v[i])
        first, node_weights = _weights_of_nodes(template.wavelength, band.wavelength / (1.0 + z), weights * dust)
        nodes = slice(first, first + len(node_weights))
        node_weights = node_weights * _colour(template.wavelength[nodes], float(supernovae.ebv[i]))
        rows = slice(int(row.min()), int(row.max()) + 2)
        curve = matrices.matmul(np.ascontiguousarray(template.flux[rows, nodes]), node_weights) * _scale(supernovae, i)
        row_before = row - rows.start
        out[i] = share[:, 0] * curve[row_before] + share[:, 1] * curve[row_before + 1]
    return out


def spectra(supernovae: Supernovae, wavelength: Float, mjd: float, templates: Mapping[int, Template]) -> Float:
    """Return the spectra of supernovae at one date.

    Parameters
    ----------
    supernovae : Supernovae
        The n supernovae.
    wavelength : float array, shape (w,)
        Observed wavelengths, A, in steps of 1 A from a whole number.
    mjd : float
        The date, MJD.
    templates : mapping of int to Template
        Spectra by kind.

    Returns
    -------
    float array, shape (n, w)
        f_lambda in erg s-1 cm-2 A-1.
    """
    milky_way = extinction.milky_way_table(int(wavelength[0]), len(wavelength))
    out = np.zeros((len(supernovae), len(wavelength)))
    for i, kind in enumerate(supernovae.kind):
        template, rest = templates[int(kind)], wavelength / (1.0 + supernovae.z[i])
        (row,), ((row_before, next_weight),) = template.at_phases(_phases(supernovae, i, np.array([mjd])))
        spectrum = row_before * template.flux[row] + next_weight * template.flux[row + 1]
        spectrum = spectrum * _colour(template.wavelength, float(supernovae.ebv[i]))
        observed = np.interp(rest, template.wavelength, spectrum, left=0.0, right=0.0)
        out[i] = observed * extinction.transmission(milky_way, supernovae.a_v[i]) * _scale(supernovae, i)
    return out


def _phases(supernovae: Supernovae, i: int, mjd: Float) -> Float:
    """Return the phases of the template of supernova `i` at these dates, days in the rest frame."""
    slow = (1.0 + supernovae.z[i]) * supernovae.stretch[i]
    return np.asarray((mjd - supernovae.peak_mjd[i]) / slow, float)


def _scale(supernovae: Supernovae, i: int) -> float:
    """Return the factor from the f_lambda of the template to the observed f_lambda.

    The wavelengths of a redshifted spectrum are stretched, so that f_lambda falls by 1 + z.
    """
    distance = 10.0 ** (-0.4 * float(supernovae.magnitude[i])) / (1.0 + float(supernovae.z[i]))
    return float(supernovae.magnification[i] * distance)


def _colour(wavelength: Float, ebv: float) -> Float:
    """Return the change of a spectrum by dust in the host, relative to the change in the middle of `PEAK_BAND`.

    The law is that of the Milky Way, at rest-frame wavelengths in A.
    """
    if ebv == 0.0:
        return np.ones(len(wavelength))
    middle = passbands.pivot_wavelength(passbands.load(supernova_templates.PEAK_BAND))
    table = extinction.milky_way_table(_LAW_FIRST, _LAW_COUNT)
    k = np.interp(wavelength, _LAW_WAVELENGTH, table)
    k_middle = float(table[round(middle) - _LAW_FIRST])
    return np.asarray(extinction.transmission(extinction.MILKY_WAY_R_V * (k - k_middle), ebv))


def _weights_of_nodes(nodes: Float, wavelength: Float, weights: Float) -> tuple[int, Float]:
    """Return weights of the points of a spectrum, from weights at wavelengths between which it is interpolated.

    Parameters
    ----------
    nodes : float array, shape (w,)
        Wavelengths of the points, A, in equal steps.
    wavelength : float array, shape (b,)
        Wavelengths with weights, A. Those outside the points are left out.
    weights : float array, shape (b,)
        Weights.

    Returns
    -------
    (int, float array, shape (k,))
        Index of the first of the k points with a weight, and their weights; k is 0 if no wavelength is inside.
    """
    place = (wavelength - nodes[0]) / (nodes[1] - nodes[0])
    inside = (place >= 0.0) & (place <= len(nodes) - 1)
    if not inside.any():
        return 0, np.zeros(0)
    place, weights = place[inside], weights[inside]
    row_before = np.minimum(place.astype(np.int64), len(nodes) - 2)
    share, first = place - row_before, int(row_before[0])
    count = int(row_before[-1]) - first + 2
    out = np.bincount(row_before - first, weights * (1.0 - share), count)
    return first, np.asarray(out + np.bincount(row_before - first + 1, weights * share, count), float)
