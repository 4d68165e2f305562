"""A table in the form FITS_LDAC, which SCAMP and SExtractor exchange.

write   columns -> a file: an empty field's header, and the table LDAC_OBJECTS
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from lake_schema.arrays import Array
from lake_schema.fits import write as whole

# Name, code of the FITS type, unit ("" = none), values of a column.
Values = tuple[str, str, str, Array]
_CARD = 80


def write(path: Path, columns: Sequence[Values]) -> None:
    """Replaced in one rename."""
    objects = fits.BinTableHDU.from_columns([_column(*column) for column in columns], name="LDAC_OBJECTS")
    whole.write_staged(path, fits.HDUList([fits.PrimaryHDU(), _header(), objects]))


def _column(name: str, code: str, unit: str, values: Array) -> fits.Column:
    return fits.Column(name, code, array=values, **({"unit": unit} if unit else {}))


def _header() -> fits.BinTableHDU:
    """The cards of a field's header as one text, as the form wants them: here none but the end."""
    cards = b"".join(
        text.ljust(_CARD)
        for text in (
            b"SIMPLE  =                    T",
            b"BITPIX  =                    8",
            b"NAXIS   =                    0",
            b"END",
        )
    )
    column = fits.Column("Field Header Card", f"{len(cards)}A", array=np.array([cards]))
    unit = fits.BinTableHDU.from_columns([column], name="LDAC_IMHEAD")
    unit.header["TDIM1"] = f"({_CARD}, {len(cards) // _CARD})"
    return unit
