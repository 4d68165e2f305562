"""Run all checks of a lake: catalogues and single frames in parallel processes, then all frames together."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import pyarrow as pa
from tqdm import tqdm

from lake_schema.store import read
from lake_schema.tables.rendered_truth import RENDERED_TRUTH
from truesky.validation.lake.measure import frame_context, references
from truesky.validation.lake.measure.frame_context import PartnerFrame, Result
from truesky.validation.lake.measure.frames import Instrument
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.lake.suite import checks, inventory
from truesky.validation.lake.suite.inventory import LakeContents, ScienceFile


@dataclass(frozen=True, slots=True)
class FrameTask:
    """Inputs for the checks of one frame (one detector of an exposure), which are sent to another process.

    Attributes
    ----------
    products : Version
        Published table `products`, in whose folder the image files are.
    path : str
        Path of the raw FITS file relative to this folder.
    place : Place
        Channel, band, exposure number and detector.
    sources : Reference
        Known sources of the frame.
    spectra : Table, optional
        Rows of the table `rendered_spectra` for the frame; None without spectra.
    instrument : Instrument, optional
        Nonlinearity, vignetting and pixel response of the camera; None for a linear detector without vignetting.
    partner : (str, int, Reference), optional
        Path, exposure number and known sources of a second frame of the detector, with which the gain is measured.
    """

    products: read.Version
    path: str
    place: Place
    sources: Reference
    spectra: pa.Table | None
    instrument: Instrument | None
    partner: tuple[str, int, Reference] | None = None


@dataclass(frozen=True, slots=True)
class LakeResults:
    """Results of all checks of a lake.

    Attributes
    ----------
    rows : list of Row
        Measured values with expected values and verdicts, of all checks.
    frame_results, catalogue_results : list of Result
        Results of each frame, and of each check of catalogues, with arrays for plots.
    """

    rows: list[Row]
    frame_results: list[Result]
    catalogue_results: list[Result] = field(default_factory=list)


def run_checks(contents: LakeContents, processes: int = 2) -> LakeResults:
    """Run all checks of a lake in parallel processes, or in this process if `processes` is 1 or less.

    A check of catalogues without the required tables, and a check that cannot be applied to a frame, return a row with
    the verdict "not_applicable". Without images there are no rows of the checks of images.
    """
    if processes <= 1:
        catalogues, results = (
            [*map(run_catalogue_check, _catalogue_tasks(contents))],
            [*_with_progress_bar(map(check_frame, _frame_tasks(contents)), contents)],
        )
    else:
        with ProcessPoolExecutor(processes, multiprocessing.get_context("forkserver")) as pool:
            try:
                # Start the checks of catalogues first: they are few but long, and can run while `_frame_tasks` reads
                # the sources of the frames.
                futures = [
                    pool.submit(run_catalogue_check, catalogue_task) for catalogue_task in _catalogue_tasks(contents)
                ]
                results = [*_with_progress_bar(pool.map(check_frame, _frame_tasks(contents)), contents)]
                catalogues = [future.result() for future in futures]
            except BaseException:
                # Cancel the checks that have not started, so that the error is reported at once.
                pool.shutdown(cancel_futures=True)
                raise
    rows = [row for result in results for row in result.rows]
    combined_rows = [row for check in checks.EXPOSURE_CHECKS for row in check.rows(results)]
    return LakeResults(
        [*rows, *combined_rows, *(row for result in catalogues for row in result.rows)], results, catalogues
    )


def _with_progress_bar(results: Iterator[Result], contents: LakeContents) -> Iterator[Result]:
    """Return an iterator over `results` that shows a progress bar with one step per image in `contents`."""
    return iter(tqdm(results, total=len(contents.science_files), unit="detector", desc="validation", disable=None))


def _catalogue_tasks(contents: LakeContents) -> list[tuple[int, tuple[read.Version | None, ...]]]:
    """Return the arguments of `run_catalogue_check` for each check of catalogues.

    The arguments are the index of the check in CATALOGUE_CHECKS, and the tables that the check requires (None for a
    table that the lake does not have).
    """
    return [(n, tuple(map(contents.tables.get, check.tables))) for n, check in enumerate(checks.CATALOGUE_CHECKS)]


def run_catalogue_check(catalogue_task: tuple[int, tuple[read.Version | None, ...]]) -> Result:
    """Run one check of catalogues, given as (index in CATALOGUE_CHECKS, required tables).

    If a table is None, the result is a row with the verdict "not_applicable" that names the missing tables.
    """
    number, versions = catalogue_task
    check = checks.CATALOGUE_CHECKS[number]
    missing = [name for name, version in zip(check.tables, versions, strict=True) if version is None]
    if not missing:
        return check.measure(*versions)
    why = f"the lake has no table {' and '.join(missing)}"
    return Result(Place(), [not_applicable(check.name, Place(), why, check.source, check.tables[0])], {})


def _frame_tasks(contents: LakeContents) -> Sequence[FrameTask]:
    if not contents.science_files:
        return []
    truth, spectra = inventory.truth(contents), inventory.spectra(contents)
    stars, cameras = inventory.star_catalogue(contents, truth), inventory.instruments(contents)
    partners, out = inventory.gain_partners(contents.science_files), []

    def find_sources(file: ScienceFile) -> Reference:
        key = (int(file.place.exposure_id or 0), str(file.place.detector))
        rows, row = truth.get(key, RENDERED_TRUTH.empty()), file.exposure
        return references.build_reference(rows, stars, str(row["band"]), float(row["mjd"]))

    for file in contents.science_files:
        key = (int(file.place.exposure_id or 0), str(file.place.detector))
        camera, partner_file = str(file.exposure["camera"]), partners.get(file.path)
        partner = (
            None
            if partner_file is None
            else (partner_file.path, int(partner_file.place.exposure_id or 0), find_sources(partner_file))
        )
        products, frame_spectra = contents.tables["products"], spectra.get(key)
        out.append(
            FrameTask(products, file.path, file.place, find_sources(file), frame_spectra, cameras.get(camera), partner)
        )
    return out


def _find_frame(products: read.Version, path: str) -> Path:
    """Return the file of a frame, next to its head file with the true WCS, after comparing the sha256 of both."""
    head = str(PurePosixPath(path).with_suffix(".head"))
    return products.sidecar_paths([path, head] if products.has_file(head) else [path])[0]


def check_frame(task: FrameTask) -> Result:
    """Open a frame, run all checks of single frames, and return their rows with verdicts and arrays for plots."""
    path = _find_frame(task.products, task.path)
    context = frame_context.measure_frame(path, task.place, task.sources, task.spectra, task.instrument)
    if task.partner is not None:
        partner_path, exposure_id, partner_sources = task.partner
        context.partner = PartnerFrame(_find_frame(task.products, partner_path), exposure_id, partner_sources)
    rows = frame_context.all_rows(checks.FRAME_CHECKS, context)
    return Result(task.place, rows, context.series)
