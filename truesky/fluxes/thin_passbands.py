"""Integrate smooth spectra over a passband with a quarter of its wavelengths."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lake_schema.arrays import Float
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband

# Number of neighbouring wavelengths that are replaced by one, and smallest number of wavelengths of a band for this: a
# single emission line may have most of the light in a narrower band.
_STEP, _FEWEST = 4, 1000


@lru_cache(maxsize=64)
def weights(band: Passband, all_below: float = 0.0) -> tuple[Float, Float]:
    """Return some of the wavelengths of a band, and weights like those of `passbands.weights`.

    In bands with at least 1000 wavelengths (1000 A), one stands for four neighbouring ones and is their mean, weighted
    by photons. The flux of a spectrum that is linear over 4 A is exact. Fluxes of quasars redward of Lyman alpha are
    right within 1e-4.

    Parameters
    ----------
    band : Passband
        The passband.
    all_below : float, optional
        Wavelength in A below which all wavelengths of the band are kept.

    Returns
    -------
    (float array, shape (k,), float array, shape (k,))
        Wavelengths in A, and weights: the band-averaged f_nu is weights @ f_lambda(wavelengths).
    """
    at, weight = band.wavelength, passbands.weights(band)
    unchanged_count = int(np.searchsorted(at, all_below)) if len(at) >= _FEWEST else len(at)
    start = np.concatenate([np.arange(unchanged_count), np.arange(unchanged_count, len(at), _STEP)])
    total, first = np.add.reduceat(weight, start), at[start]
    moment = np.add.reduceat(weight * (at - np.repeat(first, np.diff(np.append(start, len(at))))), start)
    return first + np.divide(moment, total, out=np.zeros(len(total)), where=total > 0.0), total
