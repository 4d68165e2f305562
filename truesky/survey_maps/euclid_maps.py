"""Write the table `depth` with the columns of Euclid's HEALPix maps of visibility masks (VMPZ): PIXEL and WEIGHT.

A file has one band and one quantity: a binary table of nested pixels with explicit indices.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.tables.survey.depth import DEPTH, ORDER
from truesky.survey_maps.depth_lookup import choose_bands, read_blocks

# Columns of the table that a map can have as WEIGHT, with the kinds of Euclid's products to which they correspond.
QUANTITIES = {
    "depth_point": "DEPTH",
    "depth_aperture": "DEPTH",
    "covered": "COVERAGE",
    "exposures": "EXPOSURES",
    "exposure_time_s": "EXPOSURE TIME",
    "sky": "BACKGROUND",
    "seeing": "PSF",
    "psf_area": "PSF",
    "a_v": "EXTINCTION",
    "mask": "BITMASK",
}


def write(version: read.Version, path: Path, band: str, column: str = "depth_point") -> Path:
    """Write one column of the table `depth` for one band as a FITS file.

    Parameters
    ----------
    version : Version
        A version of the table `depth`.
    path : Path
        File to write. It appears when it is complete.
    band : str
        Name of the passband.
    column : str
        Name of the column, one of `QUANTITIES`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    BadInput
        If the table has no such band, or the column cannot be a map.
    """
    from lake_schema.fits.tables import write_partial_map

    if column not in QUANTITIES:
        raise BadInput(f"column {column} of table depth is not one of {', '.join(QUANTITIES)}")
    choose_bands(version, [band])
    pixels, values = (np.concatenate(arrays) for arrays in zip(*read_blocks(version, band, column), strict=True))
    cards = (
        ("PIXTYPE", "HEALPIX", "pixels of the sky"),
        ("ORDERING", "NEST", "nested numbers of the pixels"),
        ("NSIDE", 1 << ORDER, "resolution of the pixels"),
        ("INDXSCHM", "EXPLICIT", "column PIXEL has the number of each row"),
        ("OBJECT", "PARTIAL", "part of the sky"),
        ("COORDSYS", "C", "equatorial, ICRS"),
        ("FILTER", band, "passband"),
        ("MAPTYPE", QUANTITIES[column], "kind of the map"),
        ("QUANTITY", column, "column of the table depth"),
        ("TUNIT2", DEPTH.column(column).unit, "unit of WEIGHT"),
    )
    write_partial_map(path, pixels, values, cards)
    return path
