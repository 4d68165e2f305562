"""Divide the planned exposures of a request into chunks, each of which becomes one partition of the stored plan.

The plan consists of the tables `exposures` and `tasks` (one row per detector of an exposure). A worker can make a chunk
without any other chunk: the limits of chunks and the numbers of exposures follow from counts of exposures and
detectors.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store.plan import Json, Task
from lake_schema.store.read import Version
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors
from truesky.render.exposure import persistence
from truesky.render.planning import planned_exposures, preconditions, survey
from truesky.render.planning.planned_exposures import Exposure
from truesky.render.planning.survey import ExposureBlock, ExposureWithMission
from truesky.render.planning.tasks import TaskSelection, sort_by_cost
from truesky.request.schema import Request

# Default of the largest number of tasks (detectors of exposures) in a chunk (exposures that one process plans).
# Planning this many tasks takes seconds and 200 MB of memory.
MAX_TASKS_PER_CHUNK = 100_000
# File name of the partition of a plan that is small enough to be stored in a single partition.
_SINGLE_FILE = "all.parquet"
# Dictionary key of the first and last exposure number of a partition, in its facts (recorded dictionary of its inputs).
_NUMBERS = "exposures"
# Dictionary key of the first and last MJD of a partition, in its facts (recorded dictionary of its inputs).
_DATES = "mjd"
# Columns of the table `tasks` (one row per detector of an exposure) that render jobs read.
_TASK_COLUMNS = ("exposure_id", "detector", "channel", "ra", "dec", "radius", "cells", "seconds")


@dataclass(frozen=True, slots=True)
class ExposureRange:
    """Exposures `first` to `last - 1` (from 0) of a block: the exposures of one pointing or observation of a request.

    `block` is the index of the block in the list of all blocks of the request.
    """

    block: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive exposures of a plan that are stored in one partition; its length is the number of exposures.

    Attributes
    ----------
    first : int
        Number of the first exposure, counted from 1 over all chunks.
    ranges : tuple of ExposureRange
        The exposures of the chunk.
    previous : tuple of ExposureRange
        Exposures of earlier chunks that begin in the same range of dates. Some may be the same as exposures of this
        chunk except for their noise, and must be counted to number such repetitions.
    start_mjd, end_mjd : float
        MJDs between which all exposures of the chunk begin. For Euclid fields, the range may be wider than necessary.
    """

    first: int
    ranges: tuple[ExposureRange, ...]
    previous: tuple[ExposureRange, ...]
    start_mjd: float
    end_mjd: float

    def __len__(self) -> int:
        return sum(exposure_range.last - exposure_range.first for exposure_range in self.ranges)


@dataclass(frozen=True, slots=True)
class Layout:
    """All planned exposures of a request, in two divisions: blocks and chunks.

    A block has the exposures of one pointing or observation of the request. A chunk has consecutive exposures that one
    process plans; it becomes one partition of the stored plan. The Spark driver sends this object to each worker that
    plans a chunk.
    """

    blocks: tuple[ExposureBlock, ...]
    chunks: tuple[Chunk, ...]

    @classmethod
    def from_request(
        cls, request: Request, mission: MissionConfiguration, max_tasks: int = MAX_TASKS_PER_CHUNK
    ) -> Layout:
        """Plan the exposures of a request and divide them into chunks (consecutive exposures stored in one partition).

        Parameters
        ----------
        request : Request
            The user's request.
        mission : MissionConfiguration
            Mission database: parameters of the telescopes, cameras and survey.
        max_tasks : int
            Largest number of detectors per chunk, summed over its exposures. A chunk with a single Euclid field, or
            with a single exposure and its repetitions, may have more.

        Returns
        -------
        Layout
            All exposures in blocks (pointings and observations of the request), and their division into chunks.

        Notes
        -----
        BadInput is raised by `survey.exposure_blocks`, for example if the Sun constraints forbid an exposure.
        """
        blocks = survey.exposure_blocks(request, mission)
        return cls(tuple(blocks), tuple(_chunks(blocks, max_tasks)))

    def parts(self) -> tuple[Task, ...]:
        """Return the partitions of the table `exposures` or `tasks`: one per chunk, with its file name and its facts.

        The facts (recorded dictionary) have the first and last exposure number and MJD of the chunk, from which
        `find_chunk` finds the chunk. They are {} if there is only one chunk.
        """
        if len(self.chunks) == 1:
            return (Task(_SINGLE_FILE, {}),)
        return tuple(
            Task(
                f"{chunk.first:09d}.parquet",
                {_NUMBERS: [chunk.first, chunk.first + len(chunk) - 1], _DATES: [chunk.start_mjd, chunk.end_mjd]},
            )
            for chunk in self.chunks
        )

    def find_chunk(self, facts: Json) -> Chunk:
        """Return the chunk (consecutive exposures) that belongs to a partition of the table `exposures` or `tasks`.

        `facts` is the dictionary that `parts` returns for the partition; {} gives the first chunk. Raises StopIteration
        if no chunk begins with the first exposure number in `facts`.
        """
        if _NUMBERS not in facts:
            return self.chunks[0]
        return next(chunk for chunk in self.chunks if chunk.first == facts[_NUMBERS][0])

    def exposures(self, chunk: Chunk, user_passbands: Mapping[str, Passband], seed: int) -> pa.Table:
        """Return the rows of the table `exposures` for a chunk (consecutive exposures that one process plans).

        Parameters
        ----------
        chunk : Chunk
            One of the chunks into which the exposures of the request are divided.
        user_passbands : mapping of str to Passband
            The user's passbands by name, in addition to the passbands of truesky.
        seed : int
            Seed of the request, used to draw the seeing of ground cameras.

        Returns
        -------
        pyarrow.Table
            One row per exposure.
        """
        planned = list(self._exposures_in(chunk.ranges))
        previous = (exposure for exposure, _ in self._exposures_in(chunk.previous))
        return planned_exposures.table(
            [exposure for exposure, _ in planned],
            [mission for _, mission in planned],
            user_passbands,
            seed,
            chunk.first,
            previous,
        )

    def requested_detectors(self, chunk: Chunk) -> list[tuple[str, ...]]:
        """Return for each exposure of a chunk the names of the detectors that the request selects; () means all.

        A chunk has consecutive exposures of the plan; the result is in their order.
        """
        return [
            names
            for exposure_range in chunk.ranges
            for names in self.blocks[exposure_range.block].requested_detectors(
                exposure_range.first, exposure_range.last
            )
        ]

    def exposures_near_in_time(self, chunk: Chunk, days_before: float) -> Iterator[Exposure]:
        """Generate all exposures that begin during a chunk (consecutive exposures) or up to `days_before` days earlier.

        Some exposures outside this range may also be generated.
        """
        for block in self.blocks:
            for exposure_range in block.ranges_between_dates(chunk.start_mjd - days_before, chunk.end_mjd, len(block)):
                yield from (exposure for exposure, _ in block.exposures(*exposure_range))

    def representative_exposures(self) -> Iterator[ExposureWithMission]:
        """Generate exposures that represent the whole request, for checks that do not need every exposure.

        The first field of a Euclid survey represents all its fields. All other exposures are generated.
        """
        return chain.from_iterable(
            block.exposures(0, len(block.base_exposures) * block.repetitions) for block in self.blocks
        )

    def _exposures_in(self, ranges: Iterable[ExposureRange]) -> Iterator[ExposureWithMission]:
        return chain.from_iterable(
            self.blocks[exposure_range.block].exposures(exposure_range.first, exposure_range.last)
            for exposure_range in ranges
        )


def _chunks(blocks: list[ExposureBlock], max_tasks: int) -> Iterator[Chunk]:
    ranges: list[ExposureRange] = []
    first, size = 1, 0
    for number, block in enumerate(blocks):
        start = 0
        for end, tasks in _units(block):
            if size and size + tasks > max_tasks:
                chunk = _make_chunk(blocks, first, [*ranges, *_nonempty_range(number, start, end - block.unit)])
                yield chunk
                first, ranges, size, start = first + len(chunk), [], 0, end - block.unit
            size += tasks
        ranges += _nonempty_range(number, start, len(block))
    yield _make_chunk(blocks, first, ranges)


def _nonempty_range(number: int, start: int, end: int) -> list[ExposureRange]:
    return [ExposureRange(number, start, end)] if end > start else []


def _units(block: ExposureBlock) -> Iterator[tuple[int, int]]:
    """Yield for each unit of a block (exposures that must stay in one chunk) its end and its number of detectors.

    A unit has all exposures of a Euclid field, or one exposure with its repetitions. Its end is the index (in the
    block) of the first exposure after the unit. The detectors of all exposures in the unit are summed.
    """
    camera_sizes = {camera: len(detectors.detectors(camera, mission)) for camera, mission in _cameras(block)}
    tasks = [
        len(dict.fromkeys(exposure.detectors)) or camera_sizes[exposure.camera] for exposure in block.base_exposures
    ]
    if block.make_exposures is not None:
        tasks = [sum(tasks)] * len(block.fields)
    for i, n_tasks in enumerate(tasks, start=1):
        yield i * block.unit, n_tasks * block.repetitions


def _cameras(block: ExposureBlock) -> Iterator[tuple[str, MissionConfiguration]]:
    for exposure in block.base_exposures:
        yield exposure.camera, block.settings_for(exposure).mission


def _make_chunk(blocks: list[ExposureBlock], first: int, ranges: list[ExposureRange]) -> Chunk:
    dates = [
        blocks[exposure_range.block].date_range(exposure_range.first, exposure_range.last) for exposure_range in ranges
    ]
    start_mjd, end_mjd = min((low for low, _ in dates), default=0.0), max((high for _, high in dates), default=0.0)
    previous: list[ExposureRange] = []
    if ranges:
        for number in range(ranges[0].block + 1):
            end = ranges[0].first if number == ranges[0].block else len(blocks[number])
            previous += [
                ExposureRange(number, *exposure_range)
                for exposure_range in blocks[number].ranges_between_dates(start_mjd, end_mjd, end)
            ]
    return Chunk(first, tuple(ranges), tuple(previous), start_mjd, end_mjd)


def partition_names(
    version: Version, numbers: Iterable[int] = (), dates: tuple[float, float] | None = None
) -> list[str]:
    """Return the names of the partitions of a table that may contain given exposures or overlap a range of dates.

    Parameters
    ----------
    version : Version
        Stored version of the table `exposures` or `tasks`.
    numbers : iterable of int
        Exposure numbers; () selects no partition by number.
    dates : tuple of float, optional
        First and last MJD; None selects no partition by date.

    Returns
    -------
    list of str
        Names of the partitions in stored order. The only partition of a small plan is always included.
    """
    sorted_numbers, names = np.unique(np.fromiter(numbers, np.int64)), []
    for part in version.manifest["parts"]:
        facts = part.get("facts", {})
        if _NUMBERS not in facts:
            names.append(part["name"])
            continue
        first, last = facts[_NUMBERS]
        start_mjd, end_mjd = facts[_DATES]
        at_the_time = dates is not None and start_mjd <= dates[1] and end_mjd >= dates[0]
        if at_the_time or np.searchsorted(sorted_numbers, first) < np.searchsorted(sorted_numbers, last, "right"):
            names.append(part["name"])
    return names


def rows(
    version: Version,
    numbers: Iterable[int] = (),
    dates: tuple[float, float] | None = None,
    where: ds.Expression | None = None,
    columns: Sequence[str] | None = None,
) -> pa.Table:
    """Return rows of those partitions of a table that may contain given exposures or overlap a range of dates.

    Parameters
    ----------
    version : Version
        Stored version of the table `exposures` or `tasks`.
    numbers : iterable of int
        Exposure numbers that select partitions.
    dates : tuple of float, optional
        First and last MJD that select partitions, in addition to those selected by number.
    where : pyarrow.dataset.Expression, optional
        Filter of the rows; None selects all rows of these partitions, including those of other exposures and dates.
    columns : sequence of str, optional
        Names of columns; None selects all columns.

    Returns
    -------
    pyarrow.Table
        The selected rows.
    """
    return version.rows(columns, partition_names(version, numbers, dates), where)


def rows_of_exposures(version: Version, numbers: Collection[int], columns: Sequence[str] | None = None) -> pa.Table:
    """Return the rows of given exposures in a table of the plan, and no other rows.

    Parameters
    ----------
    version : Version
        Stored version of the table `exposures` or `tasks`.
    numbers : collection of int
        Exposure numbers. Numbers that the table does not have are ignored.
    columns : sequence of str, optional
        Names of columns; None selects all columns.

    Returns
    -------
    pyarrow.Table
        The selected rows.
    """
    return rows(version, numbers, where=_exposure_filter(numbers), columns=columns)


def _exposure_filter(numbers: Collection[int]) -> ds.Expression:
    return pc.field("exposure_id").isin(pa.array([*numbers], pa.int64()))


def rows_by_partition(
    version: Version, columns: Sequence[str] | None = None, where: ds.Expression | None = None
) -> Iterator[pa.Table]:
    """Read a table of planned exposures one partition at a time, so that a large table is never in memory as a whole.

    Parameters
    ----------
    version : Version
        Stored version of the table `exposures` or `tasks`.
    columns : sequence of str, optional
        Names of columns; None selects all columns.
    where : pyarrow.dataset.Expression, optional
        Filter of the rows; None selects all rows.

    Returns
    -------
    iterator of pyarrow.Table
        One table per partition.
    """
    return (version.rows(columns, [part], where) for part in version.partitions)


@dataclass(frozen=True, slots=True)
class RenderSelection:
    """Rows of a stored plan that a render job needs; the whole plan may be larger than memory.

    Attributes
    ----------
    exposures : pyarrow.Table
        Rows of the table `exposures` to which `tasks` belong.
    tasks : sequence of dict
        Rows of the table `tasks` (one per detector of an exposure) that the request selects. If it restricts detectors
        or their number, also all rows of exposures of which images exist. Sorted by estimated time, longest first.
    requested : sequence of dict
        The requested rows of the table `tasks` only, longest first.
    detector_counts : mapping of int to int
        Number of detectors that the plan has for each exposure of `tasks`, by exposure number.
    """

    exposures: pa.Table
    tasks: Sequence[Json]
    requested: Sequence[Json]
    detector_counts: Mapping[int, int]


def select_for_rendering(
    exposures: Version, tasks: Version, request: Request, rendered: Collection[int]
) -> RenderSelection:
    """Select the detectors to render from a stored plan, and the detectors of which images may already exist.

    Parameters
    ----------
    exposures, tasks : Version
        Stored versions of the tables `exposures` and `tasks` (one row per detector of an exposure).
    request : Request
        The user's request; may restrict the names of detectors, or the number of images.
    rendered : collection of int
        Numbers of the exposures of which the request already has images.

    Returns
    -------
    RenderSelection
        The selected rows.

    Raises
    ------
    BadInput
        If truesky can render none of the planned image types. Also if the request names a detector that is not planned,
        or if its limit on the number of images is below 1.
    """
    renderable = preconditions.renderable_exposures(exposures.rows(["exposure_id", "channel", "image_type"]))
    task_selection, rendered_partitions, rendered_numbers = (
        TaskSelection(request),
        {*partition_names(tasks, rendered)},
        pa.array([*rendered], pa.int64()),
    )
    requested_tables, rendered_tables = [], []
    detector_counts: dict[int, int] = {}
    for part in tasks.partitions:
        if task_selection.is_done and part not in rendered_partitions:
            continue
        partition_tasks = tasks.rows(_TASK_COLUMNS, [part])
        partition_tasks = (
            partition_tasks
            if renderable is None
            else partition_tasks.filter(pc.is_in(partition_tasks["exposure_id"], renderable))
        )
        requested_tables.append(task_selection.select(partition_tasks))
        rendered_tables.append(
            partition_tasks.filter(pc.is_in(partition_tasks["exposure_id"], rendered_numbers))
            if task_selection.is_restricted
            else partition_tasks.slice(0, 0)
        )
        selected_numbers = {
            number
            for selected in (requested_tables[-1], rendered_tables[-1])
            for number in selected["exposure_id"].unique().to_pylist()
        }
        counts = partition_tasks["exposure_id"].value_counts()
        detector_counts |= {
            entry["values"]: entry["counts"] for entry in counts.to_pylist() if entry["values"] in selected_numbers
        }
    task_selection.refuse_unknown()
    requested_tasks: list[Json] = (
        sort_by_cost(pa.concat_tables(requested_tables)).to_pylist() if requested_tables else []
    )
    all_tasks = _merge_tasks(requested_tasks, pa.concat_tables(rendered_tables).to_pylist() if rendered_tables else [])
    return RenderSelection(rows_of_exposures(exposures, detector_counts), all_tasks, requested_tasks, detector_counts)


def _merge_tasks(requested: list[Json], rendered: list[Json]) -> list[Json]:
    """Merge rows of the table `tasks`: requested detectors, and detectors of which images already exist.

    The result has no duplicates and is sorted by estimated CPU time, longest first. `requested` must already be sorted
    in this way.
    """
    requested_keys = {(task["exposure_id"], task["detector"]) for task in requested}
    additional = [task for task in rendered if (task["exposure_id"], task["detector"]) not in requested_keys]
    if not additional:
        return requested
    return sorted([*requested, *additional], key=lambda task: (-task["seconds"], task["exposure_id"], task["detector"]))


def with_previous_exposures(
    inputs: Mapping[str, Version],
    exposures: pa.Table,
    tasks: Iterable[Json],
    mission_for: Callable[[str | None], MissionConfiguration],
) -> tuple[pa.Table, dict[tuple[int, str], list[Json]]]:
    """Find the earlier exposures that leave persistence in the detectors to be rendered.

    Parameters
    ----------
    inputs : mapping of str to Version
        Stored versions of the tables `exposures` and `tasks`, by table name.
    exposures : pyarrow.Table
        Rows of the table `exposures` for the images to be rendered.
    tasks : iterable of dict
        Rows of the table `tasks` (one per detector of an exposure) for these images.
    mission_for : callable
        Returns the mission database for the column `settings` of an exposure (JSON of changed parameters, or None).

    Returns
    -------
    exposures : pyarrow.Table
        The given rows, followed by those of all other exposures of the same cameras in the range of dates in which
        earlier exposures may leave persistence. These need not be rendered themselves.
    previous_tasks : dict
        Earlier rows of `tasks` for the same detector, in order of time, by (exposure number, detector name); {} if the
        exposures have no persistence.
    """
    affected = [row for row in map(ExposureRow.from_row, exposures.to_pylist()) if persistence.has_persistence(row)]
    if not affected:
        return exposures, {}
    camera_settings = {(row.camera, row.settings) for row in affected}
    days = max(persistence.window_days(camera, mission_for(settings)) for camera, settings in camera_settings)
    start_mjd, end_mjd = min(row.mjd for row in affected) - days, max(row.mjd for row in affected)
    in_window = (pc.field("mjd") >= start_mjd) & (pc.field("mjd") <= end_mjd)
    exposure_filter = in_window & pc.field("camera").isin(sorted({camera for camera, _ in camera_settings}))
    candidates = rows(inputs["exposures"], dates=(start_mjd, end_mjd), where=exposure_filter)
    numbers = candidates["exposure_id"].to_pylist()
    detector_names = sorted({task["detector"] for task in tasks})
    task_filter = _exposure_filter(numbers) & pc.field("detector").isin(pa.array(detector_names, pa.string()))
    candidate_tasks = rows(inputs["tasks"], numbers, where=task_filter, columns=_TASK_COLUMNS).to_pylist()
    previous_tasks = persistence.previous_tasks(
        candidate_tasks,
        {row.exposure_id: row for row in map(ExposureRow.from_row, candidates.to_pylist())},
        mission_for,
    )
    previous = candidates.filter(
        pc.invert(pc.is_in(candidates["exposure_id"], exposures["exposure_id"].combine_chunks()))
    )
    return pa.concat_tables([exposures, previous]), previous_tasks
