"""Read the photometric calibration of a frame from its FITS header: zero point, gain and saturation level."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lake_schema import arguments
from lake_schema.errors import BadInput, Mistakes

# Header cards with the AB magnitude of one count of the image, in the order in which they are searched.
_COUNT_CARDS = ("MAGZERO", "PHOTZP")
# Header cards with the AB magnitude of one count per second, in the order in which they are searched.
_RATE_CARDS = ("MAGZPT", "ZEROPNT")
# Endings of the unit of an image (BUNIT) in counts per second, without spaces and in lower case.
_PER_SECOND = ("/s", "/sec", "/second", "s-1", "s^-1", "s**-1")
# Smallest and largest zero point, mag.
_ZERO_POINTS = (-50.0, 80.0)
# Smallest and largest gain, electrons per count.
_GAINS = (1e-12, 1e15)
# Largest exposure time, s.
_MAX_SECONDS = 1e9


@dataclass(frozen=True, slots=True)
class Calibration:
    """Conversion between magnitudes, counts of an image and electrons.

    Attributes
    ----------
    zero_point : float
        AB magnitude of a source that adds one count to the image.
    gain : float
        Electrons per count.
    saturation : float
        Level from which on a pixel is saturated, counts; infinite if no level is known.
    """

    zero_point: float
    gain: float
    saturation: float

    def counts(self, mag: Any) -> Any:
        """Return the counts of sources with the AB magnitudes `mag`, a number or an array."""
        return 10.0 ** (0.4 * (self.zero_point - mag))


def read_calibration(
    place: str,
    headers: Sequence[Mapping[str, Any]],
    zero_point: float | None = None,
    gain: float | None = None,
    saturation: float | None = None,
) -> Calibration:
    """Return the calibration of a frame; header cards are used for arguments that are None.

    Parameters
    ----------
    place : str
        Name of the file, for error messages.
    headers : sequence of mapping
        Headers (values by keyword). A card of an earlier header has priority.
    zero_point : float, optional
        AB magnitude of one count. By default the card MAGZERO or PHOTZP; or MAGZPT or ZEROPNT, which are the magnitude
        of one count per second, with the exposure time EXPTIME unless BUNIT is a unit per second.
    gain : float, optional
        Electrons per count, by default the card GAIN.
    saturation : float, optional
        Level of saturated pixels, counts, by default the card SATURATE. Without this card, no pixel is saturated.

    Returns
    -------
    Calibration
        The calibration.

    Raises
    ------
    BadInput
        If zero point or gain are missing, or a number is not allowed. There is one message for each.
    """
    with Mistakes() as mistakes:
        values = (
            mistakes.read(_choose, zero_point, "zero_point", *_ZERO_POINTS, lambda: _zero_point(place, headers)),
            mistakes.read(_choose, gain, "gain", *_GAINS, lambda: _gain(place, headers)),
            mistakes.read(_choose, saturation, "saturation", 1e-300, math.inf, lambda: _saturation(place, headers)),
        )
    return Calibration(*values)


def _choose(value: float | None, name: str, lo: float, hi: float, from_header: Callable[[], float]) -> float:
    return from_header() if value is None else arguments.check_number(name, value, lo, hi)


def _zero_point(place: str, headers: Sequence[Mapping[str, Any]]) -> float:
    for card in _COUNT_CARDS:
        if (value := _find(headers, card)) is not None:
            return _number(place, card, value, *_ZERO_POINTS)
    for card in _RATE_CARDS:
        if (value := _find(headers, card)) is not None:
            return _number(place, card, value, *_ZERO_POINTS) + _count_offset(place, card, headers)
    cards = ", ".join((*_COUNT_CARDS, *_RATE_CARDS))
    raise BadInput(f"{place}: has none of the cards {cards}: give zero_point, the AB magnitude of one count")


def _count_offset(place: str, card: str, headers: Sequence[Mapping[str, Any]]) -> float:
    """Return the difference between the zero points of counts and of counts per second, mag: 0 for a rate image."""
    unit = str(_find(headers, "BUNIT") or "").replace(" ", "").lower()
    if unit.endswith(_PER_SECOND):
        return 0.0
    seconds = _find(headers, "EXPTIME")
    if seconds is None:
        problem = f"{card} is the magnitude of one count per second, but there is no card EXPTIME"
        raise BadInput(f"{place}: {problem}: give zero_point, the AB magnitude of one count")
    return 2.5 * math.log10(_number(place, "EXPTIME", seconds, 1e-9, _MAX_SECONDS))


def _gain(place: str, headers: Sequence[Mapping[str, Any]]) -> float:
    value = _find(headers, "GAIN")
    if value is None:
        raise BadInput(f"{place}: has no card GAIN: give gain, the electrons per count")
    return _number(place, "GAIN", value, *_GAINS)


def _saturation(place: str, headers: Sequence[Mapping[str, Any]]) -> float:
    value = _find(headers, "SATURATE")
    return math.inf if value is None else _number(place, "SATURATE", value, 1e-300, math.inf)


def _find(headers: Sequence[Mapping[str, Any]], card: str) -> Any:
    """Return the value of a card in the first header that has it, or None."""
    return next((header[card] for header in headers if card in header), None)


def _number(place: str, card: str, value: object, lo: float, hi: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not lo <= value <= hi:
        raise BadInput(f"{place}: {card} = {value!r} must be a number in [{lo:g}, {hi:g}]")
    return float(value)
