"""Generation cells and the files that hold them: draws are by whole order-8 cells, files by order-5 cells.

A generation cell is always drawn whole, so that its rows are the same bytes in every request that touches it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

import pyarrow as pa

from jobs.request import Area
from lake_schema import layout
from lake_schema.columns import Table
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.publish import Json, Part


def parts(area: Area) -> tuple[Part, ...]:
    """One part an order-5 cell, with the generation cells of it that the area touches."""
    touched: dict[int, list[int]] = defaultdict(list)
    for cell in area.cells(GENERATION_ORDER):
        touched[cell >> 2 * (GENERATION_ORDER - FILE_ORDER)].append(cell)
    return tuple(
        Part(layout.cell_file(FILE_ORDER, file), {"generation_cells": own}) for file, own in sorted(touched.items())
    )


def rows(facts: Json, table: Table, draw: Callable[[int], pa.Table]) -> pa.Table:
    """Rows of a part: its generation cells one after another, which is the order of _healpix_29."""
    return pa.concat_tables([table.empty(), *(draw(cell) for cell in sorted(facts["generation_cells"]))])
