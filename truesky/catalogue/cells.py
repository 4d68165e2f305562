"""Generation cells and the files that hold them: draws are by whole order-8 cells, files by larger ones.

parts      one file an order-5 cell
by_number  files of about as many rows, in cells of whatever order that takes
rows       what a file holds
in_order   rows of a cell as files hold them

A generation cell is always drawn whole, so that its rows are the same bytes in every request that touches it, and in
whichever file it lies.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import sky
from lake_schema.columns import Table
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import layout
from lake_schema.store.plan import Json, Part
from truesky.request.area import Area


def parts(area: Area) -> tuple[Part, ...]:
    """One part an order-5 cell, with the generation cells of it that the area touches."""
    touched: dict[int, list[int]] = defaultdict(list)
    for cell in area.cells(GENERATION_ORDER):
        touched[cell >> 2 * (GENERATION_ORDER - FILE_ORDER)].append(cell)
    return tuple(
        Part(layout.cell_file(FILE_ORDER, file), {"generation_cells": own}) for file, own in sorted(touched.items())
    )


def by_number(generation_cells: Sequence[int], numbers: npt.ArrayLike, most: float, order: int) -> tuple[Part, ...]:
    """The largest cells that hold at most so many rows, along the order of _healpix_29.

    generation_cells : distinct; numbers : [n] rows expected in each
    most             : of a file, though no generation cell is split
    order            : lowest order of a file
    """
    todo = np.sort(np.asarray(generation_cells, np.int64))
    expected = np.asarray(numbers, float)[np.argsort(generation_cells)]
    found = []
    for level in range(order, GENERATION_ORDER + 1):
        files, which = np.unique(sky.parent(todo, GENERATION_ORDER, level), return_inverse=True)
        fits = np.bincount(which, expected, files.size) <= most
        fits |= level == GENERATION_ORDER
        bounds = np.searchsorted(which, np.arange(files.size + 1))
        for file in np.flatnonzero(fits):
            found.append((level, int(files[file]), todo[bounds[file] : bounds[file + 1]].tolist()))
        todo, expected = todo[~fits[which]], expected[~fits[which]]
    found.sort(key=lambda part: part[2][0])
    return tuple(Part(layout.cell_file(level, file), {"generation_cells": own}) for level, file, own in found)


def rows(facts: Json, table: Table, draw: Callable[[int], pa.Table]) -> pa.Table:
    """Rows of a part: its generation cells one after another, which is the order of _healpix_29."""
    return pa.concat_tables([table.empty(), *(draw(cell) for cell in sorted(facts["generation_cells"]))])


def in_order(drawn: pa.Table) -> pa.Table:
    """Rows by _healpix_29, those of one place by identifier."""
    return drawn.take(np.lexsort((drawn["id"].to_numpy(), drawn["_healpix_29"].to_numpy())))
