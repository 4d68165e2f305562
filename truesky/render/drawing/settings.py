"""Settings of drawing for a requested accuracy, from the measured table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from truesky.request import accuracy
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits for the light of a source that is neglected when it is drawn.

    Attributes
    ----------
    edge : float
        Largest light at the edge of a stamp, from the source and the spikes of its PSF, as a fraction of the pixel
        noise.
    aliased : float
        Largest fraction of a source's flux that is aliased into its aperture, since a stamp is periodic.
    floor : float
        Fourier samples below this are neglected, relative to the sample at k = 0.
    min_size_arcsec : float
        Smallest side of a stamp, arcsec, to which the PSF of a source is cut.
    positions : int
        Number of PSF positions on a detector, one of `euclid.DEGREES`.
    colours : int
        Number of colours of the PSF, a divisor of `sub_bands.N_SUB_BANDS`.
    """

    edge: float
    aliased: float
    floor: float
    min_size_arcsec: float
    positions: int
    colours: int = 8


def settings_for(requested: Accuracy) -> Settings:
    """Return the fastest settings whose measured errors are within an accuracy, or raise BadInput."""
    return from_row(accuracy.fastest_row(requested))


def from_row(row: Mapping[str, float]) -> Settings:
    """Return the settings in a row of the measured table."""
    integers = {name: int(row[name]) for name in ("positions", "colours")}
    return Settings(row["edge"], row["aliased"], row["floor"], row["min_size_arcsec"], **integers)


def seconds_for(requested: Accuracy) -> float:
    """Measured CPU time for the sources of a VIS detector with the fastest settings for an accuracy, s."""
    return accuracy.fastest_row(requested)["seconds"]
