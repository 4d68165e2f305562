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
from lake_schema.fits.write import MOST_BYTES

# Rows of an image that are packed together: of one at a time astropy takes twice as long to write, thrice to read.
_ROWS = 16
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


def text_of(cards: Sequence[Card]) -> str:
    """Header cards as lines of text."""
    return "".join(_line(*card, repr(card[1])) for card in cards)


@lru_cache(maxsize=4096, typed=True)
def _line(keyword: str, value: Any, comment: str, written: str) -> str:
    """A card, whose images of a file have most in common; written : of the value, as 0.0 and -0.0 are equal."""
    return f"{str(fits.Card(keyword, value, comment)).rstrip()}\n"


def cards_of_text(lines: str) -> tuple[Card, ...]:
    """What `text_of` wrote -> header cards."""
    return tuple((card.keyword, card.value, card.comment) for card in map(fits.Card.fromstring, lines.splitlines()))


def write_images(path: Path, images: Sequence[Image], rice: bool = False) -> None:
    """Write a file of images, the first as the primary one; replaces `path` in one rename.

    rice : whole numbers are packed, some rows together, without loss (FITS standard 4.0, section 10: RICE_1). A packed
           image is an extension: before a first one that has pixels there is then a primary unit without any
    """
    if not images:
        raise BadInput(f"{path}: a FITS file wants at least one image")
    make = [_packed if rice and _is_whole(image) else extension for image in images]
    if make[0] is _packed:
        first, rest = [fits.PrimaryHDU()], zip(make, images, strict=True)
    else:
        first, rest = [primary(images[0])], zip(make[1:], images[1:], strict=True)
    write.write_staged(path, fits.HDUList([*first, *(function(image) for function, image in rest)]))


def read_images(path: Path, most_bytes: int = MOST_BYTES) -> list[Image]:
    """Read every image of a file that `write_images` wrote.

    What is checked is what the file says of itself, CHECKSUM and DATASUM of each unit: any one changed byte is found,
    bytes that changed places may not be. Of a file of a lake, Version.file compares the sha256.

    most_bytes : refuse a file whose headers promise more data
    Errors     : Damaged for a bad or missing checksum and for a file that is cut short; BadInput for one too
                 large
    """
    with write.refusing(path):
        # Of the arithmetic of astropy's unpacking.
        warnings.simplefilter("error", RuntimeWarning)
        with fits.open(path, memmap=False, lazy_load_hdus=True, disable_image_compression=True) as units:
            write.check_size(path, units, most_bytes)
        with fits.open(path, memmap=False, checksum=True, disable_image_compression=True) as units:
            missing = [unit.name or "primary" for unit in units if "CHECKSUM" not in unit.header]
            if missing:
                raise Damaged(f"{path}: no checksum in {', '.join(missing)}")
            if not any(write.is_packed(unit) for unit in units):
                return [image_of(unit) for unit in units]
            hollow = write.is_packed(units[1]) and _is_hollow(units[0])
        with fits.open(path, memmap=False) as units:
            return [image_of(unit) for unit in units[hollow:]]


# ------------------------------------------------------------------------------------------------ writing


def primary(image: Image) -> fits.PrimaryHDU:
    unit = fits.PrimaryHDU(data=None if image.data is None else _big_enough(image.data))
    return _dressed(unit, image)


def extension(image: Image) -> fits.ImageHDU:
    return _dressed(fits.ImageHDU(data=None if image.data is None else _big_enough(image.data)), image)


def _packed(image: Image) -> fits.BinTableHDU:
    data = _big_enough(np.asarray(image.data))
    tile = (*(1 for _ in data.shape[:-2]), min(_ROWS, data.shape[-2]), data.shape[-1])
    unit = _dressed(fits.CompImageHDU(data=data, compression_type="RICE_1", tile_shape=tile), image)
    # Taken as the table that it is stored as, whose bytes the checksums are of.
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), unit]).writeto(stream)
    # Left open: its rows are copied from there when it is written.
    return fits.open(io.BytesIO(stream.getvalue()), disable_image_compression=True)[1]


def _is_whole(image: Image) -> bool:
    return image.data is not None and image.data.dtype.kind in "iu" and image.data.size > 0


def _is_hollow(unit: Any) -> bool:
    """Whether a primary unit stands there only because a file must begin with one."""
    return unit.header["NAXIS"] == 0 and all(card.keyword in STRUCTURE for card in unit.header.cards)


def _dressed(unit: Any, image: Image) -> Any:
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
        unit.header.append(card, end=True)
    if image.name:
        unit.header["EXTNAME"] = image.name
    return unit


def _big_enough(data: Array) -> Array:
    if data.ndim not in (2, 3) or data.dtype.kind not in "fiu" or data.dtype.itemsize > 8:
        raise BadInput(f"a FITS image wants numbers in two or three dimensions, got {data.dtype}{list(data.shape)}")
    return np.ascontiguousarray(data)


def image_of(unit: Any) -> Image:
    data = None if unit.data is None else np.asarray(unit.data)
    if data is not None:
        data = data.astype(data.dtype.newbyteorder("="), copy=False)
    cards = tuple(
        (card.keyword, card.value, card.comment) for card in unit.header.cards if card.keyword not in STRUCTURE
    )
    return Image(data, cards, unit.header.get("EXTNAME", ""))
