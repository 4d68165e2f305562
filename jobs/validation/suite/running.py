"""All checks of a lake: frames in several processes, then what needs them together, then its catalogues.

validated   a lake -> rows and what figures are drawn of
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa
from tqdm import tqdm

from jobs.validation.measure import references, seen
from jobs.validation.measure.frames import Instrument
from jobs.validation.measure.references import Reference
from jobs.validation.measure.rows import Place, Row, not_applicable
from jobs.validation.measure.seen import Before, Result
from jobs.validation.suite import checks, inventory
from jobs.validation.suite.inventory import Held, Shot
from lake_schema.store import read
from lake_schema.tables.rendered_truth import RENDERED_TRUTH


@dataclass(frozen=True, slots=True)
class Task:
    """One frame: its file, what it is of, and what is known of its sources and its camera.

    before : the path in `products`, exposure and sources of another frame that its gain is told with
    """

    products: read.Version
    path: str
    place: Place
    known: Reference
    spectra: pa.Table | None
    instrument: Instrument | None
    before: tuple[str, int, Reference] | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """All rows of a lake, and the numbers of its frames and of its catalogues that figures are drawn of."""

    rows: list[Row]
    results: list[Result]
    catalogues: list[Result] = field(default_factory=list)


def validated(held: Held, processes: int = 2) -> Found:
    """Run all checks that a lake has something for; processes : that look at frames at a time."""
    results = list(_frames(held, processes))
    rows = [row for result in results for row in result.rows]
    together = [row for check in checks.OF_SEVERAL for row in check.rows(results)]
    catalogues = list(_catalogued(held))
    return Found([*rows, *together, *(row for result in catalogues for row in result.rows)], results, catalogues)


def _catalogued(held: Held) -> Iterator[Result]:
    """Of the catalogues; a row that says what is missing where a check has not its tables."""
    for check in checks.OF_CATALOGUES:
        missing = [name for name in check.tables if name not in held.tables]
        if missing:
            why = f"the lake has no table {' and '.join(missing)}"
            row = not_applicable(check.name, Place(), why, check.source, check.tables[0])
            yield Result(Place(), [row], {})
        else:
            yield check.measured(*(held.tables[name] for name in check.tables))


def _frames(held: Held, processes: int) -> Iterator[Result]:
    tasks = _tasks(held)
    bar = tqdm(total=len(tasks), unit="detector", desc="validation", disable=None)
    with bar:
        if processes <= 1 or len(tasks) <= 1:
            for task in tasks:
                yield of_frame(task)
                bar.update()
            return
        context = multiprocessing.get_context("forkserver")
        with ProcessPoolExecutor(min(processes, len(tasks)), context) as pool:
            for result in pool.map(of_frame, tasks):
                yield result
                bar.update()


def _tasks(held: Held) -> Sequence[Task]:
    if not held.shots:
        return []
    truth, spectra = inventory.truth(held), inventory.spectra(held)
    stars, cameras = inventory.stars_of(held, truth), inventory.instruments(held)
    partners, out = inventory.partners(held.shots), []

    def known(shot: Shot) -> Reference:
        key = (int(shot.place.exposure_id or 0), str(shot.place.detector))
        rows, row = truth.get(key, RENDERED_TRUTH.empty()), shot.exposure
        return references.reference(rows, stars, str(row["band"]), float(row["mjd"]))

    for shot in held.shots:
        key = (int(shot.place.exposure_id or 0), str(shot.place.detector))
        camera, other = str(shot.exposure["camera"]), partners.get(shot.path)
        before = None if other is None else (other.path, int(other.place.exposure_id or 0), known(other))
        products, own = held.tables["products"], spectra.get(key)
        out.append(Task(products, shot.path, shot.place, known(shot), own, cameras.get(camera), before))
    return out


def of_frame(task: Task) -> Result:
    """Rows of one frame."""
    path: Path = task.products.file(task.path)
    found = seen.seen(path, task.place, task.known, task.spectra, task.instrument)
    if task.before is not None:
        other, exposure_id, known = task.before
        found.before = Before(task.products.file(other), exposure_id, known)
    rows = seen.all_rows(checks.OF_FRAMES, found)
    return Result(task.place, rows, found.series)
