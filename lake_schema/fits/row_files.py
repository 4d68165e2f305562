"""Write rows of numbers, which may be larger than the memory, as a FITS binary table with a description per column."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array
from lake_schema.columns import Table
from lake_schema.fits.images import Card

# Codes of column formats in FITS, by declared type.
_CODES = {"int64": "K", "int32": "J", "int16": "I", "float64": "D", "float32": "E"}
# Number of bytes of a block of a FITS file; headers and data end at a multiple of it.
_BLOCK = 2880


def write(path: Path, declared: Table, batches: Iterable[Mapping[str, Array]], cards: Iterable[Card] = ()) -> int:
    """Write batches of rows to a FITS file with one binary table, which is replaced in one rename.

    Parameters
    ----------
    path : Path
        The file.
    declared : Table
        Columns of the file, all integers of 16 to 64 bits or floating-point numbers. Units become TUNIT, UCDs TUCD, and
        descriptions TCOMM.
    batches : iterable of mapping of str to array, shape (n,)
        Values by name of the column. A floating-point column may be missing; it is NaN, the null value of FITS.
    cards : iterable of (str, object, str), optional
        Keyword, value and comment of further header cards.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    KeyError
        If a column of integers is missing.
    """
    record = np.dtype([(column.name, np.dtype(column.type).newbyteorder(">")) for column in declared.columns])
    listed, count = tuple(cards), 0
    with user_files.replace_atomically(path) as temporary, temporary.open("wb") as stream:
        # The number of rows is known at the end, when the header, whose length it does not change, is written again.
        stream.write(_header(declared, record.itemsize, count, listed))
        for batch in batches:
            rows = np.empty(len(next(iter(batch.values()))), record)
            for column in declared.columns:
                missing = np.nan if column.is_float and column.name not in batch else None
                rows[column.name] = batch[column.name] if missing is None else missing
            stream.write(rows.tobytes())
            count += len(rows)
        stream.write(bytes(-(count * record.itemsize) % _BLOCK))
        stream.seek(0)
        stream.write(_header(declared, record.itemsize, count, listed))
    return count


def _header(declared: Table, width: int, rows: int, cards: tuple[Card, ...]) -> bytes:
    """Return the bytes of an empty primary unit and of the header of a table with `rows` rows of `width` bytes."""
    from astropy.io import fits

    from lake_schema.fits.tables import fits_unit

    columns = [
        fits.Column(column.name, _CODES[column.type], **({"unit": fits_unit(column.unit)} if column.unit else {}))
        for column in declared.columns
    ]
    header = fits.BinTableHDU.from_columns(columns, name=declared.name.upper()).header
    header["NAXIS1"], header["NAXIS2"] = width, rows
    for number, column in enumerate(declared.columns, start=1):
        if column.ucd:
            header[f"TUCD{number}"] = (column.ucd, "IVOA UCD")
        header[f"TCOMM{number}"] = column.doc
    for keyword, value, comment in cards:
        header[keyword] = (value, comment)
    text: str = fits.PrimaryHDU().header.tostring() + header.tostring()
    return text.encode("ascii")
