"""The settings of drawing that an accuracy asks for, from the measured tables.

settings_for, seconds_for   what an accuracy takes, from the measured table
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from truesky.request import accuracy
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Settings:
    """What decides how much of a source is drawn.

    edge  : largest light at a stamp's edge, of a pixel's noise: the source's own, and of the PSF's spikes there
    aliased : largest fraction of a source's flux that is aliased into its own aperture: a stamp is periodic
    floor : Fourier samples of less than this are left out, 1 at k = 0
    least : smallest side of a stamp, arcsec: what of the PSF a source keeps
    positions : of the PSF on a detector, one of euclid.DEGREES
    colours : that the PSF is made of, a divisor of sub_bands.PARTS
    """

    edge: float
    aliased: float
    floor: float
    min_size_arcsec: float
    positions: int
    colours: int = 8


def settings_for(requested: Accuracy) -> Settings:
    """The cheapest settings whose measured errors are within an accuracy; BadInput where none are."""
    return from_row(accuracy.fastest_row(requested))


def from_row(row: Mapping[str, float]) -> Settings:
    """Settings of a row of the measured table."""
    integers = {name: int(row[name]) for name in ("positions", "colours")}
    return Settings(row["edge"], row["aliased"], row["floor"], row["min_size_arcsec"], **integers)


def seconds_for(requested: Accuracy) -> float:
    """CPU s of the sources of a VIS detector, measured with these settings."""
    return accuracy.fastest_row(requested)["seconds"]
