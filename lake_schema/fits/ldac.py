"""Write a table in the form FITS_LDAC, which SCAMP and SExtractor exchange."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from lake_schema.arrays import Array
from lake_schema.fits import images
from lake_schema.fits import write as fits_file
from lake_schema.fits.images import Card

# Name, code of the FITS type, unit ("" for none) and values of a column.
ColumnData = tuple[str, str, str, Array]
_CARD, _BLOCK = 80, 2880


def write(
    path: Path, columns: Sequence[ColumnData], cards: Sequence[Card] = (), shape: tuple[int, ...] | None = None
) -> None:
    """Write a table to a file, which is replaced in one rename.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of ColumnData
        Columns of the table LDAC_OBJECTS.
    cards : sequence of Card, optional
        Cards of the image in which the rows were found, stored in LDAC_IMHEAD.
    shape : tuple of int, optional
        Shape (ny, nx) of that image.
    """
    objects = fits.BinTableHDU.from_columns([_column(*column) for column in columns], name="LDAC_OBJECTS")
    fits_file.write_atomically(path, fits.HDUList([fits.PrimaryHDU(), _header(cards, shape or ()), objects]))


def _column(name: str, code: str, unit: str, values: Array) -> fits.Column:
    return fits.Column(name, code, array=values, **({"unit": unit} if unit else {}))


def _header(image_cards: Sequence[Card], shape: tuple[int, ...]) -> fits.BinTableHDU:
    """Return the table LDAC_IMHEAD, which contains the cards of a field's header as one text."""
    structure: tuple[Card, ...] = (
        ("SIMPLE", True, ""), ("BITPIX", -32 if shape else 8, ""), ("NAXIS", len(shape), ""),
        *((f"NAXIS{i}", n, "") for i, n in enumerate(reversed(shape), start=1)),
    )  # fmt: skip
    lines = [*images.cards_to_text([*structure, *image_cards]).splitlines(), "END"]
    # A long text continues in the next cards.
    cards = b"".join(line.ljust(-(-len(line) // _CARD) * _CARD).encode("ascii") for line in lines)
    column = fits.Column("Field Header Card", f"{len(cards)}A", array=np.array([cards]))
    hdu = fits.BinTableHDU.from_columns([column], name="LDAC_IMHEAD")
    hdu.header["TDIM1"] = f"({_CARD}, {len(cards) // _CARD})"
    # astropy would replace trailing spaces of the text by zeros after computing the checksum. Bytes avoid that.
    stored = hdu.header.tostring().encode("ascii") + cards + bytes(-len(cards) % _BLOCK)
    return fits.BinTableHDU.fromstring(stored)
