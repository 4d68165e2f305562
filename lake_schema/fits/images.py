"""Write and read FITS files of images with checksums; equal images and header cards give equal bytes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Damaged
from lake_schema.fits import write
from lake_schema.fits.write import MAX_BYTES

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes half a second.
    import pyarrow as pa
    from astropy.io import fits

# Number of rows of an image per compressed tile. With one row per tile, astropy takes twice as long to write and three
# times as long to read.
_ROWS_PER_TILE = 16
# Header card: keyword, value and comment.
Card = tuple[str, str | int | float | bool, str]
# Structural keywords, which the writer sets; a card of an Image must not have one of them.
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
    """One header-data unit of a FITS file, with image data or no data.

    Attributes
    ----------
    data : array, shape (ny, nx) or (n, ny, nx), or None
        Pixels of type uint8, int16, uint16, int32, float32 or float64; None for a header without data.
    cards : tuple of (str, str or int or float or bool, str)
        Keyword, value and comment of each header card in order, without structural keywords such as NAXIS.
    name : str
        Name of the extension (EXTNAME), "" for none.
    """

    data: Array | None
    cards: tuple[Card, ...] = ()
    name: str = ""


def cards_to_text(cards: Sequence[Card]) -> str:
    """Return header cards as text, one line in FITS format per card; `cards_from_text` reads the text."""
    return "".join(_card_line(*card, repr(card[1])) for card in cards)


@lru_cache(maxsize=4096, typed=True)
def _card_line(keyword: str, value: Any, comment: str, value_text: str) -> str:
    """Return a header card as a line of text in FITS format, with a line end.

    Lines are cached, because most cards occur in many images. `value_text` is the repr of the value: as part of the
    cache key, it distinguishes values that compare equal, such as 0.0 and -0.0.
    """
    from astropy.io import fits

    return f"{str(fits.Card(keyword, value, comment)).rstrip()}\n"


def cards_from_text(lines: str) -> tuple[Card, ...]:
    """Return the header cards in a text from `cards_to_text`: keyword, value and comment of each line."""
    from astropy.io import fits

    return tuple((card.keyword, card.value, card.comment) for card in map(fits.Card.fromstring, lines.splitlines()))


def read_head_file(path: Path) -> tuple[Card, ...]:
    """Return the cards of the first image in a head file, the text file with the true WCS of a FITS file.

    Damaged is raised if the file is not a text of FITS cards.
    """
    with write.errors_as_damaged(path):
        return cards_from_text(path.read_text("ascii").split("END\n")[0])


def write_images(path: Path, images: Sequence[Image], rice: bool = False) -> None:
    """Write images to one FITS file, which replaces `path` in one rename.

    Parameters
    ----------
    path : Path
        The file.
    images : sequence of Image
        At least one image. The first one becomes the primary unit, the others become extensions.
    rice : bool, optional
        True to compress integer images without loss (RICE_1 of FITS standard 4.0, section 10), in tiles of 16 rows. A
        compressed image must be an extension, so a primary unit without pixels precedes a compressed first image.

    Raises
    ------
    BadInput
        If there are no images, or an image or a card cannot be stored in FITS.
    """
    from astropy.io import fits

    if not images:
        raise BadInput(f"{path}: a FITS file must have at least one image")
    make_hdu = [compressed_hdu if rice and _has_integers(image) else image_hdu for image in images]
    if make_hdu[0] is compressed_hdu:
        first, remaining = [fits.PrimaryHDU()], zip(make_hdu, images, strict=True)
    else:
        first, remaining = [primary_hdu(images[0])], zip(make_hdu[1:], images[1:], strict=True)
    write.write_atomically(path, fits.HDUList([*first, *(make(image) for make, image in remaining)]))


def write_images_and_table(
    path: Path, units: Sequence[Image], name: str, columns: Mapping[str, pa.ChunkedArray]
) -> None:
    """Write images and one table to a FITS file, which is replaced in one rename.

    Parameters
    ----------
    path : Path
        The file.
    units : sequence of Image
        Images; the first one is the primary unit.
    name : str
        Name of the extension with the table, which is the last one.
    columns : mapping of str to pyarrow.ChunkedArray
        Columns of numbers by name. Missing values become NaN.

    Raises
    ------
    BadInput
        If FITS cannot store an image or a card.
    """
    from astropy.io import fits
    from astropy.table import Table

    primary, *extensions = units
    table = Table({title: np.asarray(column.to_pandas()) for title, column in columns.items()})
    hdus = [primary_hdu(primary), *map(image_hdu, extensions), fits.BinTableHDU(table, name=name)]
    write.write_atomically(path, fits.HDUList(hdus))


def read_images(path: Path, max_bytes: int = MAX_BYTES) -> list[Image]:
    """Read all images of a FITS file that `write_images` wrote, and verify CHECKSUM and DATASUM of each unit.

    Parameters
    ----------
    path : Path
        The file.
    max_bytes : int, optional
        Largest size of the data in bytes, stored or decompressed; by default 8 GB. It is compared with the size that
        the headers give, before the data are read.

    Returns
    -------
    list of Image
        The images, without an empty primary unit that precedes a compressed first image.

    Raises
    ------
    Damaged
        If a checksum is wrong or missing, the file is cut short, or astropy cannot read it.
    BadInput
        If the data exceed `max_bytes`.

    Notes
    -----
    The checksums detect any single changed byte, but may miss exchanged bytes. For a file of a published table,
    `Version.sidecar_path` compares the sha256 instead.
    """
    from astropy.io import fits

    with write.errors_as_damaged(path):
        # Turn RuntimeWarnings into errors: astropy emits them if damaged scaling keywords make values overflow.
        warnings.simplefilter("error", RuntimeWarning)
        write.check_headers(path)
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


# ------------------------------------- conversion between Image and the header-data units of astropy


def primary_hdu(image: Image) -> fits.PrimaryHDU:
    """Return an image as a primary header-data unit of astropy.

    Raise BadInput if the data are not numbers in two or three dimensions, or FITS cannot store a card.
    """
    from astropy.io import fits

    hdu = fits.PrimaryHDU(data=None if image.data is None else _check_array(image.data))
    return _add_cards(hdu, image)


def image_hdu(image: Image) -> fits.ImageHDU:
    """Return an image as an image extension of astropy.

    Raise BadInput if the data are not numbers in two or three dimensions, or FITS cannot store a card.
    """
    from astropy.io import fits

    return _add_cards(fits.ImageHDU(data=None if image.data is None else _check_array(image.data)), image)


def compressed_hdu(image: Image) -> fits.BinTableHDU:
    """Return an image of integers as the binary table in which FITS stores it with the compression RICE_1."""
    from astropy.io import fits

    data = _check_array(np.asarray(image.data))
    tile = (*(1 for _ in data.shape[:-2]), min(_ROWS_PER_TILE, data.shape[-2]), data.shape[-1])
    hdu = _add_cards(fits.CompImageHDU(data=data, compression_type="RICE_1", tile_shape=tile), image)
    # Return the binary table in which FITS stores the compressed image, not the image, because the checksums must be
    # those of the table.
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(stream)
    # Do not close the file in memory: astropy reads the rows of the table from it when the unit is written.
    return fits.open(io.BytesIO(stream.getvalue()), disable_image_compression=True)[1]


def _has_integers(image: Image) -> bool:
    return image.data is not None and image.data.dtype.kind in "iu" and image.data.size > 0


def _is_empty_primary(hdu: Any) -> bool:
    """Return True if a primary unit has no data and only structural cards, such as SIMPLE and NAXIS."""
    return hdu.header["NAXIS"] == 0 and all(card.keyword in STRUCTURE for card in hdu.header.cards)


def _add_cards(hdu: Any, image: Image) -> Any:
    for keyword, value, comment in image.cards:
        # The header may change its cards, so it gets a copy.
        hdu.header.append(copy(_header_card(keyword, value, comment, repr(value))), end=True)
    if image.name:
        hdu.header["EXTNAME"] = image.name
    return hdu


@lru_cache(maxsize=4096, typed=True)
def _header_card(keyword: str, value: Any, comment: str, value_text: str) -> fits.Card:
    """Return a header card of astropy, which contains its formatted text.

    Cards are cached as in `_card_line`, because astropy reads its settings several times for each new card. Copy the
    result before changing it. BadInput is raised if FITS cannot store the card.
    """
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyUserWarning

    if keyword.upper() in STRUCTURE:
        raise BadInput(f"FITS card {keyword} is set by the writer")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyUserWarning)
            card = fits.Card(keyword, value, comment)
            # Format the card, also to check it: astropy warns if it must cut a long comment, and the filter above turns
            # the warning into an error.
            str(card)
    except (ValueError, AstropyUserWarning) as error:
        raise BadInput(f"FITS card {keyword}: {' '.join(str(error).split())}") from None
    return card


def _check_array(data: Array) -> Array:
    if data.ndim not in (2, 3) or data.dtype.kind not in "fiu" or data.dtype.itemsize > 8:
        raise BadInput(f"a FITS image must be numbers in 2 or 3 dimensions, got {data.dtype}{list(data.shape)}")
    return np.ascontiguousarray(data)


def image_from_hdu(hdu: Any) -> Image:
    """Return a header-data unit of astropy as an Image, with data in the byte order of this machine."""
    data = None if hdu.data is None else np.asarray(hdu.data)
    if data is not None:
        data = data.astype(data.dtype.newbyteorder("="), copy=False)
    cards = tuple(
        (card.keyword, card.value, card.comment) for card in hdu.header.cards if card.keyword not in STRUCTURE
    )
    return Image(data, cards, hdu.header.get("EXTNAME", ""))
