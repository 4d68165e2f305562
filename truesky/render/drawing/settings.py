"""Limits with which sources are drawn, chosen from a table of measured errors for the accuracy that a request names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from truesky.request import accuracy
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits for the light that is neglected when a source is drawn on a stamp (a square image around the source).

    Attributes
    ----------
    edge : float
        Largest light of the source, including diffraction spikes, that is allowed in a pixel at the edge of its stamp,
        as a fraction of the noise of a pixel.
    aliased : float
        Largest fraction of a source's flux that may be aliased into the aperture in which the source is measured. Light
        is aliased because a stamp drawn by a Fourier transform is periodic.
    floor : float
        Samples of the source's Fourier transform below this fraction of the sample at k = 0 are neglected.
    min_size_arcsec : float
        Smallest side of a stamp, arcsec. The PSF is cut to the stamp.
    positions : int
        Number of positions on a detector at which the PSF is computed, one of `euclid.DEGREES` (1, 4, 9 or 25). The PSF
        varies as a polynomial between them.
    colours : int
        Largest number of wavelengths in a passband with separate PSF images, a divisor of `sub_bands.N_SUB_BANDS` (8).
        If the PSF was computed at more wavelengths, images of neighbouring wavelengths are averaged.
    """

    edge: float
    aliased: float
    floor: float
    min_size_arcsec: float
    positions: int
    colours: int = 8


def settings_for(requested: Accuracy) -> Settings:
    """Return the fastest settings whose measured errors are within the requested accuracy.

    Raises
    ------
    BadInput
        If no settings in the table are that accurate.
    """
    return from_row(accuracy.fastest_row(requested))


def from_row(row: Mapping[str, float]) -> Settings:
    """Return the settings in a row of the table of measured errors.

    `row` maps column names to numbers. It must have the names of all attributes of `Settings`; others are ignored.
    """
    integers = {name: int(row[name]) for name in ("positions", "colours")}
    return Settings(row["edge"], row["aliased"], row["floor"], row["min_size_arcsec"], **integers)


def seconds_for(requested: Accuracy) -> float:
    """Return the measured CPU time, s, for drawing the sources of one VIS detector with the requested accuracy.

    The time is that of the fastest settings which are accurate enough, as in `settings_for`.

    Raises
    ------
    BadInput
        If no settings in the table are that accurate.
    """
    return accuracy.fastest_row(requested)["seconds"]
