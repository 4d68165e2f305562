"""Write a catalogue in the file format FITS_LDAC, in which SExtractor passes detected sources to SCAMP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lake_schema.arrays import Array
from lake_schema.fits import images
from lake_schema.fits import write as fits_file
from lake_schema.fits.images import Card

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes half a second.
    from astropy.io import fits

# Name, code of the FITS type, unit ("" for none) and values of a column.
ColumnData = tuple[str, str, str, Array]
# Number of bytes of a header card.
_CARD = 80
# Number of bytes of a block of a FITS file; headers and data end at a multiple of it.
_BLOCK = 2880


def write(
    path: Path, columns: Sequence[ColumnData], cards: Sequence[Card] = (), shape: tuple[int, ...] | None = None
) -> None:
    """Write a catalogue to a FITS_LDAC file, which is replaced in one rename.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of ColumnData
        Columns of the table LDAC_OBJECTS, of equal length.
    cards : sequence of Card, optional
        Header cards of the image in which the sources were found, stored in the table LDAC_IMHEAD.
    shape : tuple of int, optional
        Shape (ny, nx) of that image; by default its header has NAXIS = 0.
    """
    from astropy.io import fits

    objects = fits.BinTableHDU.from_columns([_column(*column) for column in columns], name="LDAC_OBJECTS")
    fits_file.write_atomically(path, fits.HDUList([fits.PrimaryHDU(), _header(cards, shape or ()), objects]))


def _column(name: str, code: str, unit: str, values: Array) -> fits.Column:
    from astropy.io import fits

    return fits.Column(name, code, array=values, **({"unit": unit} if unit else {}))


def _header(image_cards: Sequence[Card], shape: tuple[int, ...]) -> fits.BinTableHDU:
    """Return the table LDAC_IMHEAD, which contains the header of an image as one text of 80 characters per card."""
    from astropy.io import fits

    structure: tuple[Card, ...] = (
        ("SIMPLE", True, ""), ("BITPIX", -32 if shape else 8, ""), ("NAXIS", len(shape), ""),
        *((f"NAXIS{i}", n, "") for i, n in enumerate(reversed(shape), start=1)),
    )  # fmt: skip
    lines = [*images.cards_to_text([*structure, *image_cards]).splitlines(), "END"]
    # Pad each line to a multiple of 80 characters; a line with a long text takes several cards.
    cards = b"".join(line.ljust(-(-len(line) // _CARD) * _CARD).encode("ascii") for line in lines)
    column = fits.Column("Field Header Card", f"{len(cards)}A", array=np.array([cards]))
    hdu = fits.BinTableHDU.from_columns([column], name="LDAC_IMHEAD")
    hdu.header["TDIM1"] = f"({_CARD}, {len(cards) // _CARD})"
    # Make the unit from bytes: astropy would replace trailing spaces of the text by zero bytes when it writes the file,
    # and the checksum would be wrong.
    stored = hdu.header.tostring().encode("ascii") + cards + bytes(-len(cards) % _BLOCK)
    return fits.BinTableHDU.fromstring(stored)
