"""Division of a passband into sub-bands, in each of which the PSF is treated as independent of wavelength."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from truesky.fluxes.passbands import Passband

# Default number of sub-bands into which a passband is divided, each with one PSF. With eight, the second moments of a
# PSF that varies continuously with wavelength are reproduced with a relative error of 2e-4 (benchmarks/render.py).
N_SUB_BANDS = 8


@lru_cache(maxsize=32)
def sub_bands(band: Passband, count: int = N_SUB_BANDS) -> tuple[Passband, ...]:
    """Divide a passband into `count` sub-bands, from blue to red, which do not overlap.

    For a source with constant f_nu, all sub-bands contain nearly equal numbers of photons. The samples of the passband
    are distributed among the sub-bands, so it must have many more samples than `count`; this is not checked.
    """
    photons = band.response / band.wavelength
    rank = (np.cumsum(photons) - 0.5 * photons) / photons.sum()
    part = np.minimum((rank * count).astype(int), count - 1)
    return tuple(
        Passband(f"{band.name}_{i}", band.wavelength[part == i], band.response[part == i], band.medium)
        for i in range(count)
    )
