"""Where a file's images are on the sky, as text for source-extractor, SCAMP and SWarp, which pass over SIP.

They read it where it lies beside the image under the image's name, with the ending .head: cards of each image in turn,
in place of those in the file.

beside     path of an image -> path of its text
text       images of a file -> cards, the distortion as TPV
write      the same into a file
first      such a file -> cards of its first image

Ref : SCAMP and SWarp, "external headers"
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from lake_schema.fits import images
from lake_schema.fits.images import Card, Image
from truesky.render.camera import tpv

# Of a header, what stands in such a text: the WCS.
_WCS_KEYWORDS = ("RADESYS", "CTYPE", "CUNIT", "CRVAL", "CRPIX", "CD", "PV")


def head_path(path: str) -> str:
    """Path of an image -> of what lies beside it."""
    return str(PurePosixPath(path).with_suffix(".head"))


def text(units: Sequence[Image]) -> str:
    """Cards of each image of two axes, in the order of the file; "" where none has a place on the sky."""
    return "".join(_image_text(unit) for unit in units if unit.data is not None and unit.data.ndim == 2)


def write(texts: Iterable[str], path: Path) -> None:
    """Texts of one file's images, one after the other."""
    path.write_text("".join(texts), encoding="ascii")


def first_cards(path: Path) -> tuple[Card, ...]:
    """Of an image's file, what the text beside it says of its first image; nothing where there is none."""
    head_file = path.with_suffix(".head")
    if not head_file.is_file():
        return ()
    return tuple(
        card for card in images.cards_from_text(head_file.read_text("ascii").split("END\n")[0]) if is_wcs(card[0])
    )


def is_wcs(keyword: str) -> bool:
    """Whether a card is of the WCS."""
    return keyword.rstrip("0123456789_") in _WCS_KEYWORDS


def _image_text(unit: Image) -> str:
    cards = [card for card in tpv.from_sip(unit.cards) if is_wcs(card[0])]
    if not cards:
        return ""
    # J2000 is as near to ICRS as these tools tell.
    return f"{images.cards_to_text([('EQUINOX', 2000.0, 'mean equinox'), *cards])}END\n"
