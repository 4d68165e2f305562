"""Write the WCS of a file's images as text for SExtractor, SCAMP and SWarp, which do not support SIP.

These tools read a file with the name of the image and the ending .head next to it. It contains the cards of each image
in turn, which replace those in the image. The distortion is written as TPV.

References
----------
SCAMP and SWarp, "external headers"
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from lake_schema.fits import images
from lake_schema.fits.images import Card, Image
from truesky.render.camera import tpv

# WCS keywords that a head file contains.
_WCS_KEYWORDS = ("RADESYS", "CTYPE", "CUNIT", "CRVAL", "CRPIX", "CD", "PV")


def head_path(path: str) -> str:
    """Return the path of the head file of an image."""
    return str(PurePosixPath(path).with_suffix(".head"))


def text(units: Sequence[Image]) -> str:
    """Return the cards of each two-dimensional image in file order, or "" if no image has a WCS."""
    return "".join(_image_text(unit) for unit in units if unit.data is not None and unit.data.ndim == 2)


def write(texts: Iterable[str], path: Path) -> None:
    """Write the texts of a file's images one after another."""
    path.write_text("".join(texts), encoding="ascii")


def first_cards(path: Path) -> tuple[Card, ...]:
    """Return the WCS cards of the first image from the head file of an image, or () if there is no head file."""
    head_file = path.with_suffix(".head")
    if not head_file.is_file():
        return ()
    return tuple(
        card for card in images.cards_from_text(head_file.read_text("ascii").split("END\n")[0]) if is_wcs(card[0])
    )


def is_wcs(keyword: str) -> bool:
    """Return True if a keyword belongs to the WCS."""
    return keyword.rstrip("0123456789_") in _WCS_KEYWORDS


def _image_text(unit: Image) -> str:
    cards = [card for card in tpv.from_sip(unit.cards) if is_wcs(card[0])]
    if not cards:
        return ""
    # These tools have no ICRS; J2000 is the closest system.
    return f"{images.cards_to_text([('EQUINOX', 2000.0, 'mean equinox'), *cards])}END\n"
