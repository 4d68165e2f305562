"""How deep a stack of frames goes: the noise of blank sky in the aperture that a source is measured in.

Of NISP a point of 5 sigma, by the noise-equivalent area of the stars' own profile; of VIS a galaxy of half-light radius
0.3" in an aperture of 1.3", S/N 10 at 24.5.
"""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.measure.seen import Check, Seen, wants_blank
from truesky.validation.verdicts import LEAST

SOURCE = "requirements named by Serrano et al. 2024: NISP 24 AB (point, 5 sigma), VIS S/N 10 at 24.5 (extended)"
# Exposures of a place, in the reference sequence.
_DITHERS = 4
_POINT, _POINT_SIGMA, _GALAXY = 24.0, 5.0, 24.5
# An exponential disc of 0.3": part of its light within 1.3" of diameter, with the PSF of VIS.
_HELD, _DIAMETER = 0.80, 1.3


def check(of: Seen) -> list[Row]:
    """Of four frames like this one."""
    assert of.tiles is not None
    spread = float(np.sqrt(np.mean((of.tiles.pixels - of.tiles.level[:, None, None])[of.tiles.blank] ** 2)))
    error = 1.0 / np.sqrt(2.0 * of.tiles.blank.sum())
    header, seconds = of.frame.header, of.frame.seconds
    if of.channel == "VIS":
        light = seconds * 10.0 ** (-0.4 * (_GALAXY - float(header["ZEROPNT"])))
        area = np.pi * (0.5 * _DIAMETER / of.frame.scale) ** 2
        ratio = np.sqrt(_DITHERS) * _HELD * light / np.sqrt(_HELD * light + area * spread**2)
        return [Row("requirement", "vis_snr_24.5", of.place, ratio, ratio * error, 10.0, 0.0, "", SOURCE, LEAST,
                    f"four frames, noise of blank sky {spread:.4g} e-")]  # fmt: skip
    sigma = float(header["PSFFWHM"]) / of.frame.scale / 2.3548
    noise = np.sqrt(4.0 * np.pi * sigma**2 * spread**2 / _DITHERS)
    depth = float(header["ZEROPNT"]) - 2.5 * np.log10(_POINT_SIGMA * noise / seconds)
    return [Row("requirement", "nisp_depth", of.place, depth, 1.0857 * error, _POINT, 0.0, "mag", SOURCE, LEAST,
                f"four frames, noise of blank sky {spread:.4g} e-")]  # fmt: skip


def _applies(of: Seen) -> str:
    return wants_blank(of) if of.channel in ("VIS", "NISP-P") else "no requirement of its depth"


DEPTH = Check("requirement", SOURCE, _applies, check)
