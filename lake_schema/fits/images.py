"""FITS images: written and read with their checksums.

Image           an image with its header cards
write_images    images -> one file: checksums, the same bytes for the same input; whole numbers packed where wanted
text_of         header cards as lines of text;  cards_of_text : and back
read_images     a file -> images; checksums are demanded and verified, sizes checked before data
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Damaged
from lake_schema.fits import write
from lake_schema.fits.write import MAX_BYTES

# Rows of an image that are packed together: of one at a time astropy takes twice as long to write, thrice to read.
_ROWS_PER_TILE = 16
Card = tuple[str, str | int | float | bool, str]
STRUCTURE = {
    "SIMPLE",
    "XTENSION",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "NAXIS3",
    "EXTEND",
    "PCOUNT",
    "GCOUNT",
}
STRUCTURE |= {"BZERO", "BSCALE", "EXTNAME", "CHECKSUM", "DATASUM"}


@dataclass(frozen=True, slots=True)
class Image:
    """One header-data unit.

    data  : [ny, nx] or [n, ny, nx] uint8, int16, uint16, int32, float32 or float64; None = a header alone
    cards : (keyword, value, comment), in order, structural keywords left out
    """

    data: Array | None
    cards: tuple[Card, ...] = ()
    name: str = ""


def cards_to_text(cards: Sequence[Card]) -> str:
    """Header cards as lines of text."""
    return "".join(_card_line(*card, repr(card[1])) for card in cards)


@lru_cache(maxsize=4096, typed=True)
def _card_line(keyword: str, value: Any, comment: str, value_text: str) -> str:
    """A card, whose images of a file have most in common; written : of the value, as 0.0 and -0.0 are equal."""
    return f"{str(fits.Card(keyword, value, comment)).rstrip()}\n"


def cards_from_text(lines: str) -> tuple[Card, ...]:
    """What `text_of` wrote -> header cards."""
    return tuple((card.keyword, card.value, card.comment) for card in map(fits.Card.fromstring, lines.splitlines()))


def write_images(path: Path, images: Sequence[Image], rice: bool = False) -> None:
    """Write a file of images, the first as the primary one; replaces `path` in one rename.

    rice : whole numbers are packed, some rows together, without loss (FITS standard 4.0, section 10: RICE_1). A packed
           image is an extension: before a first one that has pixels there is then a primary unit without any
    """
    if not images:
        raise BadInput(f"{path}: a FITS file wants at least one image")
    make_hdu = [_compressed_hdu if rice and _has_integers(image) else image_hdu for image in images]
    if make_hdu[0] is _compressed_hdu:
        first, remaining = [fits.PrimaryHDU()], zip(make_hdu, images, strict=True)
    else:
        first, remaining = [primary_hdu(images[0])], zip(make_hdu[1:], images[1:], strict=True)
    write.write_atomically(path, fits.HDUList([*first, *(make(image) for make, image in remaining)]))


def read_images(path: Path, max_bytes: int = MAX_BYTES) -> list[Image]:
    """Read every image of a file that `write_images` wrote.

    What is checked is what the file says of itself, CHECKSUM and DATASUM of each unit: any one changed byte is found,
    bytes that changed places may not be. Of a file of a lake, Version.file compares the sha256.

    most_bytes : refuse a file whose headers promise more data
    Errors     : Damaged for a bad or missing checksum and for a file that is cut short; BadInput for one too
                 large
    """
    with write.errors_as_damaged(path):
        # Of the arithmetic of astropy's unpacking.
        warnings.simplefilter("error", RuntimeWarning)
        with fits.open(path, memmap=False, lazy_load_hdus=True, disable_image_compression=True) as hdus:
            write.check_size(path, hdus, max_bytes)
        with fits.open(path, memmap=False, checksum=True, disable_image_compression=True) as hdus:
            missing = [hdu.name or "primary" for hdu in hdus if "CHECKSUM" not in hdu.header]
            if missing:
                raise Damaged(f"{path}: no checksum in {', '.join(missing)}")
            if not any(write.is_compressed(hdu) for hdu in hdus):
                return [image_from_hdu(hdu) for hdu in hdus]
            skip_primary = write.is_compressed(hdus[1]) and _is_empty_primary(hdus[0])
        with fits.open(path, memmap=False) as hdus:
            return [image_from_hdu(hdu) for hdu in hdus[skip_primary:]]


# ------------------------------------------------------------------------------------------------ writing


def primary_hdu(image: Image) -> fits.PrimaryHDU:
    hdu = fits.PrimaryHDU(data=None if image.data is None else _check_array(image.data))
    return _add_cards(hdu, image)


def image_hdu(image: Image) -> fits.ImageHDU:
    return _add_cards(fits.ImageHDU(data=None if image.data is None else _check_array(image.data)), image)


def _compressed_hdu(image: Image) -> fits.BinTableHDU:
    data = _check_array(np.asarray(image.data))
    tile = (*(1 for _ in data.shape[:-2]), min(_ROWS_PER_TILE, data.shape[-2]), data.shape[-1])
    hdu = _add_cards(fits.CompImageHDU(data=data, compression_type="RICE_1", tile_shape=tile), image)
    # Taken as the table that it is stored as, whose bytes the checksums are of.
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(stream)
    # Left open: its rows are copied from there when it is written.
    return fits.open(io.BytesIO(stream.getvalue()), disable_image_compression=True)[1]


def _has_integers(image: Image) -> bool:
    return image.data is not None and image.data.dtype.kind in "iu" and image.data.size > 0


def _is_empty_primary(hdu: Any) -> bool:
    """Whether a primary unit stands there only because a file must begin with one."""
    return hdu.header["NAXIS"] == 0 and all(card.keyword in STRUCTURE for card in hdu.header.cards)


def _add_cards(hdu: Any, image: Image) -> Any:
    for keyword, value, comment in image.cards:
        if keyword.upper() in STRUCTURE:
            raise BadInput(f"FITS card {keyword} is set by the writer")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", AstropyUserWarning)
                card = fits.Card(keyword, value, comment)
                # A card is judged when it is formatted; astropy would cut a long comment and go on.
                str(card)
        except (ValueError, AstropyUserWarning) as error:
            raise BadInput(f"FITS card {keyword}: {' '.join(str(error).split())}") from None
        hdu.header.append(card, end=True)
    if image.name:
        hdu.header["EXTNAME"] = image.name
    return hdu


def _check_array(data: Array) -> Array:
    if data.ndim not in (2, 3) or data.dtype.kind not in "fiu" or data.dtype.itemsize > 8:
        raise BadInput(f"a FITS image wants numbers in two or three dimensions, got {data.dtype}{list(data.shape)}")
    return np.ascontiguousarray(data)


def image_from_hdu(hdu: Any) -> Image:
    data = None if hdu.data is None else np.asarray(hdu.data)
    if data is not None:
        data = data.astype(data.dtype.newbyteorder("="), copy=False)
    cards = tuple(
        (card.keyword, card.value, card.comment) for card in hdu.header.cards if card.keyword not in STRUCTURE
    )
    return Image(data, cards, hdu.header.get("EXTNAME", ""))
