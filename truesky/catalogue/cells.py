"""Divide the sky into cells in which rows are drawn (generation cells), and into the files that store the rows.

A generation cell is a HEALPix cell of order 8. Each file contains the generation cells of one larger cell. A generation
cell is always drawn completely, so its rows are identical in every request that touches it and in files of any size.
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
from truesky.numerics import activity
from truesky.request.area import Area


def tasks_of_area(area: Area) -> tuple[Task, ...]:
    """Return the files of a table in an area, with the generation cells (HEALPix cells of order 8) that each contains.

    There is one task (the name and the contents of a file) per order-5 cell. It lists the order-8 cells inside the
    order-5 cell that the area touches.
    """
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
    """Divide generation cells (HEALPix cells of order 8) into files that contain at most `max_rows` rows.

    Parameters
    ----------
    generation_cells : sequence of int
        Nested indices of distinct order-8 cells.
    row_counts : float array, shape (n,)
        Expected number of rows of each cell.
    max_rows : float
        Largest expected number of rows per file. A generation cell with more rows is not divided: it gets a separate
        file.
    min_order : int
        HEALPix order of the largest cell that a file may cover, at most 8.

    Returns
    -------
    tuple of Task
        One task (name of the file and list of its generation cells) per file, in the order of position (nested index).
        Each file covers the largest HEALPix cell that has at most `max_rows` rows.
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
    """Draw the rows of a file, one generation cell (HEALPix cell of order 8) after another.

    Parameters
    ----------
    facts : dict
        Parameters from which the file is made. Only `generation_cells` is used, the list of nested indices of the cells
        to draw.
    table : Table
        Schema of the rows.
    draw : callable
        Function that returns the rows of the generation cell with a nested index, sorted as by `sort_rows`.

    Returns
    -------
    Table
        Rows of all cells, sorted as by `sort_rows`.
    """
    generation_cells = activity.track(sorted(facts["generation_cells"]), f"{table.name}, cell")
    return pa.concat_tables([table.empty(), *(draw(cell) for cell in generation_cells)])


def sort_rows(rows: pa.Table) -> pa.Table:
    """Sort rows by `_healpix_29` (HEALPix cell of order 29), and rows in the same cell by `id`."""
    return rows.take(np.lexsort((rows["id"].to_numpy(), rows["_healpix_29"].to_numpy())))
