"""All checks of a lake: of its catalogues and of each frame in several processes, then what needs frames together.

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

from lake_schema.store import read
from lake_schema.tables.rendered_truth import RENDERED_TRUTH
from truesky.validation.lake.measure import references, seen
from truesky.validation.lake.measure.frames import Instrument
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.measure.seen import Before, Result
from truesky.validation.lake.suite import checks, inventory
from truesky.validation.lake.suite.inventory import Held, Shot


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
    """Run all checks that a lake has something for; processes : at a time, for frames and checks of catalogues."""
    if processes <= 1:
        catalogues, results = [*map(of_catalogues, _catalogued(held))], [*_shown(map(of_frame, _tasks(held)), held)]
    else:
        with ProcessPoolExecutor(processes, multiprocessing.get_context("forkserver")) as pool:
            try:
                # A few that take long: begun while the frames' sources are looked up.
                begun = [pool.submit(of_catalogues, one) for one in _catalogued(held)]
                results = [*_shown(pool.map(of_frame, _tasks(held)), held)]
                catalogues = [one.result() for one in begun]
            except BaseException:
                # Of what has not begun nothing begins.
                pool.shutdown(cancel_futures=True)
                raise
    rows = [row for result in results for row in result.rows]
    together = [row for check in checks.OF_SEVERAL for row in check.rows(results)]
    return Found([*rows, *together, *(row for result in catalogues for row in result.rows)], results, catalogues)


def _shown(results: Iterator[Result], held: Held) -> Iterator[Result]:
    """The results of frames, under a bar that counts them."""
    return iter(tqdm(results, total=len(held.shots), unit="detector", desc="validation", disable=None))


def _catalogued(held: Held) -> list[tuple[int, tuple[read.Version | None, ...]]]:
    """Each check of catalogues by its number, and the tables that it wants, None where the lake has not one."""
    return [(n, tuple(map(held.tables.get, check.tables))) for n, check in enumerate(checks.OF_CATALOGUES)]


def of_catalogues(wanted: tuple[int, tuple[read.Version | None, ...]]) -> Result:
    """What a check of catalogues measures; a row that says what is missing where it has not its tables."""
    number, versions = wanted
    check = checks.OF_CATALOGUES[number]
    missing = [name for name, version in zip(check.tables, versions, strict=True) if version is None]
    if not missing:
        return check.measured(*versions)
    why = f"the lake has no table {' and '.join(missing)}"
    return Result(Place(), [not_applicable(check.name, Place(), why, check.source, check.tables[0])], {})


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
