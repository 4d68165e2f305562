"""Sub-bands of a passband in which the PSF is treated as constant."""

from __future__ import annotations

import numpy as np

from truesky.fluxes.passbands import Passband

# Eight sub-bands reproduce the second moments of a PSF of continuous colour to 2e-4 (benchmarks/render.py).
N_SUB_BANDS = 8


def sub_bands(band: Passband, count: int = N_SUB_BANDS) -> tuple[Passband, ...]:
    """Divide a band into sub-bands with equal numbers of photons for flat f_nu, from blue to red."""
    photons = band.response / band.wavelength
    rank = (np.cumsum(photons) - 0.5 * photons) / photons.sum()
    part = np.minimum((rank * count).astype(int), count - 1)
    return tuple(
        Passband(f"{band.name}_{i}", band.wavelength[part == i], band.response[part == i], band.medium)
        for i in range(count)
    )
