"""What emission lines add to the light of a galaxy in one passband: part of the magnitude that a catalogue is cut at.

added       mean f_nu of the lines in a band
brightened  magnitudes with it

Error: lines are taken as narrow, and their wavelengths as in vacuum: of no account but at the edges of a band
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jobs.fluxes import passbands
from jobs.fluxes.passbands import Passband
from jobs.fluxes.spectra import lines
from lake_schema.arrays import Float
from lake_schema.units import AB_CGS


def added(band: Passband, z_obs: Float, fluxes: Mapping[str, Float]) -> Float:
    """f_nu[n] erg s-1 cm-2 Hz-1, averaged over the band, of all lines.

    band : that they are seen through;  z_obs : float[n];  fluxes : float[n] erg s-1 cm-2 by column of table `galaxies`
    """
    weights = np.pad(passbands.weights(band), 1)
    total = np.zeros(z_obs.size)
    for line in lines.line_list():
        # The flux of a line falls into bins of 1 A; beyond the band there is none.
        at = line.vacuum * (1.0 + z_obs) - band.wavelength[0] + 1.0
        place = np.clip(at, 0.0, weights.size - 1.0)
        below = np.minimum(place.astype(np.int64), weights.size - 2)
        seen = weights[below] + (place - below) * (weights[below + 1] - weights[below])
        total += line.ratio * fluxes[line.column] * seen
    return total


def brightened(magnitude: Float, light: Float) -> Float:
    """AB magnitudes[n] of sources with more light.

    magnitude : float[n] AB, without it;  light : float[n] f_nu, erg s-1 cm-2 Hz-1
    """
    return np.asarray(magnitude - 2.5 * np.log10(1.0 + light * 10.0 ** (0.4 * (magnitude + AB_CGS))))
