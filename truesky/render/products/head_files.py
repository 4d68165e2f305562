"""Write and read head files: the true WCS of the images in a FITS file as text, for SExtractor, SCAMP and SWarp.

These tools do not support the SIP distortion of the FITS headers. They read a text file with the name of the FITS file
and the ending .head next to it. It has the cards of each image in turn, which replace those in the FITS file. The
distortion is written as TPV.

References
----------
SCAMP and SWarp, "external headers"
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath

from lake_schema.fits import images
from lake_schema.fits.images import Card, Image
from truesky.render.camera import tpv

# Last line of the cards of each image.
_END = "END\n"
# WCS keywords in a head file, without the digits and underscores at their end.
_WCS_KEYWORDS = ("RADESYS", "CTYPE", "CUNIT", "CRVAL", "CRPIX", "CD", "PV")


def head_path(path: str) -> str:
    """Return the path of the head file that belongs to a FITS file: the same with the ending .head."""
    return str(PurePosixPath(path).with_suffix(".head"))


def text(units: Sequence[Image]) -> str:
    """Return the text of a head file: the WCS cards of each two-dimensional image in file order.

    Images without a WCS are skipped; the text is "" if no image has one.
    """
    return "".join(_image_text(unit) for unit in units if unit.data is not None and unit.data.ndim == 2)


def write(texts: Iterable[str], path: Path) -> None:
    """Write the texts of head files one after another to one head file `path`."""
    path.write_text("".join(texts), encoding="ascii")


def change_images(head_text: str, changes: Sequence[Callable[[Sequence[Card]], Iterable[Card]]]) -> str:
    """Return the text of a head file in which the cards of each image are replaced by a function of them.

    `changes` has the functions of the images, in file order.
    """
    texts = head_text.split(_END)[:-1]
    changed = (change(images.cards_from_text(image_text)) for image_text, change in zip(texts, changes, strict=True))
    return "".join(f"{images.cards_to_text(tuple(cards))}{_END}" for cards in changed)


def first_cards(path: Path) -> tuple[Card, ...]:
    """Return the WCS cards of the first image in the head file of a FITS file `path`, or () without a head file.

    Damaged is raised if the head file is not a text of FITS cards.
    """
    head_file = path.with_suffix(".head")
    if not head_file.is_file():
        return ()
    return tuple(card for card in images.read_head_file(head_file) if is_wcs(card[0]))


def is_wcs(keyword: str) -> bool:
    """Return True if a FITS keyword belongs to the WCS cards of head files, such as CRVAL1, CD1_1 or PV1_4."""
    return keyword.rstrip("0123456789_") in _WCS_KEYWORDS


def _image_text(unit: Image) -> str:
    cards = [card for card in tpv.from_sip(unit.cards) if is_wcs(card[0])]
    if not cards:
        return ""
    # SExtractor, SCAMP and SWarp do not know ICRS. J2000 is the closest system.
    return f"{images.cards_to_text([('EQUINOX', 2000.0, 'mean equinox'), *cards])}{_END}"
