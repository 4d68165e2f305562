"""Read the table `depth` of a lake, and find the depth and mask at positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Array, Int
from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.tables.survey.depth import ORDER


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Depth and masks of one band in part of the sky.

    Attributes
    ----------
    band : str
        Name of the passband.
    pixels : int array, shape (n,)
        HEALPix pixels of order 14, nested, ascending.
    columns : dict of str to array, each of shape (n,)
        Other columns of the table `depth`, by name.
    """

    band: str
    pixels: Int
    columns: dict[str, Array]

    def rows_at(self, ra: npt.ArrayLike, dec: npt.ArrayLike) -> Int:
        """Return the index in `pixels` of each position (ra, dec) in deg, or -1 where the band has no exposure."""
        pixel = sky.cell_at(ra, dec, ORDER)
        if not len(self.pixels):
            return np.full(np.shape(pixel), -1)
        row = np.minimum(np.searchsorted(self.pixels, pixel), len(self.pixels) - 1)
        return np.where(self.pixels[row] == pixel, row, -1)


def read_depth_map(
    version: read.Version, band: str, columns: Sequence[str], partitions: Sequence[str] | None = None
) -> DepthMap:
    """Read the depth of one band.

    Parameters
    ----------
    version : Version
        A version of the table `depth`.
    band : str
        Name of the passband.
    columns : sequence of str
        Names of the columns to read, besides `pixel` and `band`.
    partitions : sequence of str, optional
        Names of the partitions (one per HEALPix cell) to read. None reads all.

    Returns
    -------
    DepthMap
        The rows of the band, in the order of their pixels.

    Raises
    ------
    BadInput
        If the table has no row of this band in these partitions.
    """
    depth = read_covered(version, band, columns, partitions)
    if not len(depth.pixels):
        where = "" if partitions is None else " in this part of the sky"
        existing = ", ".join(sorted(_bands(version, partitions)))
        raise BadInput(f"table depth has no band {band}{where}: it has {existing or 'no rows'}")
    return depth


def read_covered(
    version: read.Version, band: str, columns: Sequence[str], partitions: Sequence[str] | None = None
) -> DepthMap:
    """Read the depth of one band, like `read_depth_map`, but return a map without pixels where the band has no row.

    Parameters
    ----------
    version : Version
        A version of the table `depth`.
    band : str
        Name of the passband.
    columns : sequence of str
        Names of the columns to read, besides `pixel`.
    partitions : sequence of str, optional
        Names of the partitions (one per HEALPix cell) to read. None reads all.

    Returns
    -------
    DepthMap
        The rows of the band, in the order of their pixels.
    """
    rows = version.rows(["pixel", *columns], partitions, pc.field("band") == band).sort_by("pixel")
    return DepthMap(band, rows["pixel"].to_numpy(), {name: rows[name].to_numpy() for name in columns})


def choose_bands(version: read.Version, bands: Sequence[str] = ()) -> list[str]:
    """Return the given passbands, or all passbands of a version of the table `depth` in alphabetical order.

    Raises BadInput if the table does not have one of the given passbands.
    """
    existing = _bands(version)
    if unknown := [band for band in bands if band not in existing]:
        raise BadInput(f"table depth has no band {unknown[0]}: it has {', '.join(sorted(existing)) or 'no rows'}")
    return list(bands) or sorted(existing)


def _bands(version: read.Version, partitions: Sequence[str] | None = None) -> set[str]:
    """Return the names of the passbands in some partitions (None: all) of a version of the table `depth`."""
    bands: set[str] = set()
    for partition in version.partitions if partitions is None else partitions:
        bands |= set(pc.unique(version.rows(["band"], [partition])["band"]).to_pylist())
    return bands


def read_blocks(version: read.Version, band: str, column: str) -> Iterator[tuple[Int, Array]]:
    """Yield the pixels and the values of a column for a passband, one pair of arrays per partition with rows of it.

    Parameters
    ----------
    version : Version
        A version of the table `depth`.
    band : str
        Name of the passband.
    column : str
        Name of the column.

    Yields
    ------
    pixels : int64 array, shape (n,)
        HEALPix pixels of order 14, nested, ascending.
    values : array, shape (n,)
        Values of the column.
    """
    for partition in version.partitions:
        rows = version.rows(["pixel", column], [partition], pc.field("band") == band)
        if rows.num_rows:
            yield rows["pixel"].to_numpy(), rows[column].to_numpy()
