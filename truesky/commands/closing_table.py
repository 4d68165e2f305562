"""Print what a run has made: a table of the catalogues, a table of the images, and pictures of some images."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.texts import text_tables
from truesky.render.forecasting import speed
from truesky.request.area import Area
from truesky.request.schema import Request
from truesky.running import submitted_job

# Largest number of pictures of detectors. Each takes about 3 s to draw.
_MAX_PICTURES = 12


class Stage(Protocol):
    """A job of a run, with the tables that it makes."""

    @property
    def name(self) -> str:
        """Return the name of the job."""

    @property
    def tables(self) -> tuple[str, ...]:
        """Return the names of the tables that the job makes."""


def print_catalogues(root: Path, request: Request, stages: Sequence[tuple[Stage, float]], seconds: float) -> None:
    """Print a line per table of a run, and the area that the catalogues cover.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    request : Request
        The request.
    stages : sequence of (Stage, float)
        The jobs that have run, with the time that each took in seconds.
    seconds : float
        Time of the whole run in seconds.
    """
    rows = []
    for stage, stage_seconds in stages:
        for number, name in enumerate(stage.tables):
            version = read.version(root, name, request=request.name)
            size = sum(entry["bytes"] for entry in version.manifest["files"]) / 1e6
            is_first = number == 0
            cells = (stage.name if is_first else "", name, f"{version.num_rows:,}", f"{size:,.1f}")
            rows.append((*cells, f"{stage_seconds:,.1f}" if is_first else ""))
    rows.append(("all", "", "", "", f"{seconds:,.1f}"))
    print()
    for line in text_tables.format_table(
        ("job", "table", "rows", "size, MB", "time, s"), rows, ("rows", "size, MB", "time, s")
    ):
        print(line)
    print()
    if request.sources is None:
        print(f"{describe_area(request.area)}\n")


def describe_area(area: Area) -> str:
    """Return a sentence with the size of an area, and the size of the whole HEALPix cells that its catalogues cover."""
    number = len(area.cells())
    covered = number * sky.cell_area(GENERATION_ORDER)
    return (
        f"area: {area.square_degrees():.3g} deg2 are requested; the catalogues cover {covered:.3g} deg2 "
        f"({number:,} whole HEALPix cells). In SQL, WHERE in_area(ra, dec) selects the requested area"
    )


def print_images(root: Path, pictures_folder: Path, request: str) -> None:
    """Print a table of the rendered images of a request, draw pictures of twelve images, and print their paths.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    pictures_folder : Path
        Folder for the pictures.
    request : str
        Name of the request.
    """
    # Import here, because importing the renderer takes seconds and runs without images do not need it.
    from truesky.render.forecasting import actual_costs
    from truesky.render.products import preview, same_sky

    for line in actual_costs.format_table(actual_costs.summarise(root, request, speed.estimate_speed(root).factor)):
        print(line)
    print()
    draw = partial(preview.draw, root=root, out=pictures_folder, request=request)
    pictures = submitted_job.map_in_workers(draw, preview.rows_to_draw(root, _MAX_PICTURES, request))
    for picture in (*pictures, *same_sky.draw(root, pictures_folder, request)):
        print(picture)
