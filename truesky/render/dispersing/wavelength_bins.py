"""Sum the light of a slitless spectrum at fewer wavelengths, which are faster to draw than every Angstrom.

The light of a wavelength is divided among the six nearest of these wavelengths, which are called bins. The weights
conserve the light, its mean place and its higher moments. Bins are a fraction of a pixel apart along the trace.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float, Float32
from truesky.numerics.compiling import jit

# Number of wavelength bins before the first wavelength of a spectrum, and after the last, to which `bin_electrons` adds
# light.
BINS_BEFORE, BINS_AFTER = 2, 3
# Largest number of wavelengths in a bin. Zeroth orders then have about a hundred bins.
_WIDEST_BIN = 64
# Number of positions along a trace between which its dispersion is measured.
_PLACES = 33


def bin_weights(width: int) -> Float:
    """Return the weights [6, width] with which `bin_electrons` divides the light of wavelengths among six bins.

    Row i belongs to the bin i - BINS_BEFORE, counted from the bin at the first of the `width` wavelengths. Two rows are
    negative.
    Lagrange's interpolation of fifth order has the same weights. The light, its mean wavelength and its central moments
    up to the fifth are therefore the same as without bins.
    """
    f, nodes = np.arange(width) / width, np.arange(-BINS_BEFORE, BINS_AFTER + 1)
    return np.stack(
        [np.prod([(f - other) / (node - other) for other in nodes if other != node], axis=0) for node in nodes]
    )


@jit
def bin_electrons(spectrum: Float32, factor: float, response: Float, weights: Float, out: Float) -> None:
    """Sum the electrons of a spectrum in bins of wavelength.

    Parameters
    ----------
    spectrum : float32 array, shape (w,)
        Spectrum of a source.
    factor : float
        Factor by which the spectrum is multiplied.
    response : float array, shape (w,)
        Electrons per unit of the multiplied spectrum, by wavelength.
    weights : float array, shape (6, width)
        Weights of the bins, from `bin_weights`.
    out : float array, shape (bins,)
        Result: electrons in bins of `width` wavelengths, to which this call adds. The bin BINS_BEFORE is at the first
        wavelength. There must be `bin_count` bins.

    Notes
    -----
    Some weights are negative, so that bins next to an emission line can have negative electrons.
    """
    width = weights.shape[1]
    w0, w1, w2, w3, w4, w5 = weights
    for k in range((len(response) + width - 1) // width):
        begin = k * width
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        for i in range(min(width, len(response) - begin)):
            light = float(spectrum[begin + i]) * response[begin + i]
            s0 += light * w0[i]
            s1 += light * w1[i]
            s2 += light * w2[i]
            s3 += light * w3[i]
            s4 += light * w4[i]
            s5 += light * w5[i]
        out[k] += factor * s0
        out[k + 1] += factor * s1
        out[k + 2] += factor * s2
        out[k + 3] += factor * s3
        out[k + 4] += factor * s4
        out[k + 5] += factor * s5


def bin_count(wavelengths: int, width: int) -> int:
    """Return the number of bins that `bin_electrons` fills, for a number of wavelengths and of wavelengths per bin."""
    return -(-wavelengths // width) + BINS_BEFORE + BINS_AFTER


@dataclass(frozen=True, slots=True)
class Bins:
    """Bins of wavelength of one spectral order, and the PSF in them.

    Attributes
    ----------
    response : float array, shape (w,)
        Electrons per unit of a source's spectrum, by wavelength.
    weights : float array, shape (6, width)
        Weights from `bin_weights` for bins of `width` wavelengths.
    share : float array, shape (b, bins)
        Weights that interpolate the PSF in each bin from the PSFs at b wavelengths.
    wave_share : float array, shape (w, b)
        The same weights at each wavelength of the spectrum.
    """

    response: Float
    weights: Float
    share: Float
    wave_share: Float

    @classmethod
    def from_trace(
        cls, along: Float, t: tuple[float, float], response: Float, wave_share: Float, pixels: float
    ) -> Bins:
        """Return the bins of one spectral order for a source at the first pixel of the detector.

        Parameters
        ----------
        along : float array, shape (i,)
            Coefficients of t^i (i from 0) of the displacement from the undispersed image in columns, pixels.
        t : (float, float)
            Value of t at the first wavelength of the spectrum, and step of t from one wavelength to the next.
        response, wave_share : float array, shape (w,) and (w, b)
            Attributes of the result.
        pixels : float
            Distance of the bins in columns where the dispersion is largest. If it is less than one wavelength, a bin is
            one wavelength.

        Returns
        -------
        Bins
            The bins.
        """
        # The dispersion varies along the traces of prisms, and spectra extend beyond the ends of the trace.
        places = np.linspace(-BINS_BEFORE, len(response) + BINS_AFTER, _PLACES)
        columns = np.polynomial.polynomial.polyval(t[0] + t[1] * places, along)
        fastest = float(np.abs(np.diff(columns) / np.diff(places)).max())
        width = int(min(max(pixels / max(fastest, 1e-9), 1.0), _WIDEST_BIN))
        wavelength = width * (np.arange(bin_count(len(response), width)) - BINS_BEFORE)
        share = np.ascontiguousarray(wave_share[np.clip(wavelength, 0, len(response) - 1)].T)
        return cls(response, bin_weights(width), share, wave_share)

    @property
    def width(self) -> int:
        """Number of wavelengths in a bin."""
        return int(self.weights.shape[1])

    def electrons(self, spectrum: Float32, factor: float) -> Float:
        """Return the electrons [bins] of a spectrum [w] that is multiplied by a factor, in bins of wavelength."""
        out = np.zeros(self.share.shape[1])
        bin_electrons(spectrum, factor, self.response, self.weights, out)
        return out
