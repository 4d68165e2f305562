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
from lake_schema.store.plan import Json, Task
from truesky.request.area import Area


def tasks_of_area(area: Area) -> tuple[Task, ...]:
    """One part an order-5 cell, with the generation cells of it that the area touches."""
    cells_by_file: dict[int, list[int]] = defaultdict(list)
    for cell in area.cells(GENERATION_ORDER):
        cells_by_file[cell >> 2 * (GENERATION_ORDER - FILE_ORDER)].append(cell)
    return tuple(
        Task(layout.cell_file(FILE_ORDER, file_cell), {"generation_cells": touched_cells})
        for file_cell, touched_cells in sorted(cells_by_file.items())
    )


def tasks_by_row_count(
    generation_cells: Sequence[int], row_counts: npt.ArrayLike, max_rows: float, min_order: int
) -> tuple[Task, ...]:
    """The largest cells that hold at most so many rows, along the order of _healpix_29.

    generation_cells : distinct; numbers : [n] rows expected in each
    most             : of a file, though no generation cell is split
    order            : lowest order of a file
    """
    remaining = np.sort(np.asarray(generation_cells, np.int64))
    expected = np.asarray(row_counts, float)[np.argsort(generation_cells)]
    chosen_files = []
    for level in range(min_order, GENERATION_ORDER + 1):
        files, file_index = np.unique(sky.parent(remaining, GENERATION_ORDER, level), return_inverse=True)
        fits = np.bincount(file_index, expected, files.size) <= max_rows
        fits |= level == GENERATION_ORDER
        bounds = np.searchsorted(file_index, np.arange(files.size + 1))
        for file in np.flatnonzero(fits):
            chosen_files.append((level, int(files[file]), remaining[bounds[file] : bounds[file + 1]].tolist()))
        remaining, expected = remaining[~fits[file_index]], expected[~fits[file_index]]
    chosen_files.sort(key=lambda part: part[2][0])
    return tuple(
        Task(layout.cell_file(level, file), {"generation_cells": members}) for level, file, members in chosen_files
    )


def draw_rows(facts: Json, table: Table, draw: Callable[[int], pa.Table]) -> pa.Table:
    """Rows of a part: its generation cells one after another, which is the order of _healpix_29."""
    return pa.concat_tables([table.empty(), *(draw(cell) for cell in sorted(facts["generation_cells"]))])


def sort_rows(rows: pa.Table) -> pa.Table:
    """Rows by _healpix_29, those of one place by identifier."""
    return rows.take(np.lexsort((rows["id"].to_numpy(), rows["_healpix_29"].to_numpy())))
