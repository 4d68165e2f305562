"""Check that a catalogue has no repeated identifiers or positions, and no HEALPix cell with far too many sources."""

from __future__ import annotations

import numpy as np

from lake_schema.ids import GENERATION_ORDER
from lake_schema.sky import MAX_ORDER
from lake_schema.store import read
from truesky.validation.lake.measure.rows import Place, Row, not_applicable

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "duplicates"
# Reason why no duplicates are expected, for the column `source` of the table `validation`.
SOURCE = "a source has one identifier and one place"
# Allowed excess of the number of galaxies in the densest HEALPix cell over the median of all cells, as a fraction of
# the median. Galaxy counts in 0.05 deg2 vary by 20 %.
_DENSITY_TOLERANCE = 0.6


def rows(catalogue: read.Version) -> list[Row]:
    """Check the table `galaxies` or `stars` for repeated identifiers, repeated positions and too dense cells.

    Returns rows (measured values with expected values and verdicts). The density is checked only for galaxies in four
    or more cells. The only row is "not_applicable" if the table has no rows.
    """
    table = catalogue.rows(["id", "ra", "dec", "_healpix_29"])
    if not table.num_rows:
        return [not_applicable(NAME, Place(), f"table {catalogue.table} has no rows", SOURCE, catalogue.table)]
    ids, ra, dec = (table[name].to_numpy() for name in ("id", "ra", "dec"))
    place = np.stack([ra, dec], axis=1).view(np.complex128).ravel()
    out = [
        Row(NAME, f"{catalogue.table}_{name}", Place(), float(len(values) - len(np.unique(values))), 0.0, 0.0, 0.0,
            "", SOURCE, note=f"{len(ids)} rows")
        for name, values in (("ids", ids), ("places", place))
    ]  # fmt: skip
    cell = table["_healpix_29"].to_numpy() >> 2 * (MAX_ORDER - GENERATION_ORDER)
    drawn = [c for part in catalogue.manifest["parts"] for c in part["facts"].get("generation_cells", ())]
    _, count = np.unique(cell, return_counts=True)
    if len(count) >= 4 and catalogue.table == "galaxies":
        middle = float(np.median(count))
        densest = float(count.max()) / middle
        out.append(
            Row(
                NAME,
                f"{catalogue.table}_densest_cell",
                Place(),
                densest,
                1.0 / np.sqrt(middle),
                1.0,
                _DENSITY_TOLERANCE,
                "",
                SOURCE,
                note=f"{len(count)} of {len(set(drawn)) or len(count)} cells with sources",
            )
        )
    return out
