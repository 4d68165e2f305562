"""A plan in parts: which exposures each holds, so that it is made by itself, wherever that is.

Where a plan is cut depends on the request alone, and so do the numbers of its exposures, which are counted, not laid
out.

Layout       what a request takes, cut into parts
holding      names of the parts of a published plan that hold some exposures
rows         rows of some exposures of a published plan, of whose parts no others are opened
each         rows of a published plan, a part after the other
chosen       what of a published plan is to be rendered, or is already
before       what left something in the detectors of some of it
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

# So many detectors take seconds and 200 MB; a plan that has no more is one part.
MAX_TASKS_PER_CHUNK = 100_000
_SINGLE_FILE = "all.parquet"
# Facts of a part: its first and last exposure; MJD before which none of them begins, and after which none does.
_NUMBERS, _DATES = "exposures", "mjd"
# Columns of `tasks` that say what is rendered, and when.
_TASK_COLUMNS = ("exposure_id", "detector", "channel", "ra", "dec", "radius", "cells", "seconds")


@dataclass(frozen=True, slots=True)
class ExposureRange:
    """Exposures of a stretch, from the first to before the last."""

    block: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Chunk:
    """One part of a plan.

    first  : number of its first exposure
    runs   : its exposures;  before : those of earlier parts that may differ from them in their noise alone
    since, until : MJD before which none of them begins, and after which none does
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
    """What a request takes, cut into parts; it goes to whoever makes one of them."""

    blocks: tuple[ExposureBlock, ...]
    chunks: tuple[Chunk, ...]

    @classmethod
    def from_request(
        cls, request: Request, mission: MissionConfiguration, max_tasks: int = MAX_TASKS_PER_CHUNK
    ) -> Layout:
        """The layout of a request; most : detectors of a part, unless a field has more.  Errors: as survey.stretches"""
        blocks = survey.exposure_blocks(request, mission)
        return cls(tuple(blocks), tuple(_chunks(blocks, max_tasks)))

    def parts(self) -> tuple[Task, ...]:
        """The parts of a table of the plan."""
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
        """The piece of a part, by its facts."""
        if _NUMBERS not in facts:
            return self.chunks[0]
        return next(chunk for chunk in self.chunks if chunk.first == facts[_NUMBERS][0])

    def exposures(self, chunk: Chunk, user_passbands: Mapping[str, Passband], seed: int) -> pa.Table:
        """Rows of the table `exposures`; own, seed : as planned_exposures.table has them."""
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
        """The detectors that are wanted of each exposure of a part, () = all."""
        return [
            names
            for exposure_range in chunk.ranges
            for names in self.blocks[exposure_range.block].requested_detectors(
                exposure_range.first, exposure_range.last
            )
        ]

    def exposures_near_in_time(self, chunk: Chunk, days_before: float) -> Iterator[Exposure]:
        """Exposures that begin while those of a part do, or up to so many days before, and some others."""
        for block in self.blocks:
            for exposure_range in block.ranges_between_dates(chunk.start_mjd - days_before, chunk.end_mjd, len(block)):
                yield from (exposure for exposure, _ in block.exposures(*exposure_range))

    def representative_exposures(self) -> Iterator[ExposureWithMission]:
        """An exposure of every kind there is: of fields those of the first."""
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
    """After each unit of a stretch: how many exposures have been taken; detectors of the unit."""
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
    """Names of the parts of a published `exposures` or `tasks` that hold some exposures, or some of a time.

    numbers : of exposures;  dates : MJD from and to
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
    """Rows of the parts of a published `exposures` or `tasks` that hold some exposures, or some of a time.

    version : of the table;  numbers : of exposures;  dates : MJD from and to;  where : an Arrow filter, None = all
    columns : names, None = all
    """
    return version.rows(columns, partition_names(version, numbers, dates), where)


def rows_of_exposures(version: Version, numbers: Collection[int], columns: Sequence[str] | None = None) -> pa.Table:
    """Rows of some exposures of a published `exposures` or `tasks`, and no others; columns : names, None = all."""
    return rows(version, numbers, where=_exposure_filter(numbers), columns=columns)


def _exposure_filter(numbers: Collection[int]) -> ds.Expression:
    return pc.field("exposure_id").isin(pa.array([*numbers], pa.int64()))


def rows_by_partition(
    version: Version, columns: Sequence[str] | None = None, where: ds.Expression | None = None
) -> Iterator[pa.Table]:
    """Rows of a published `exposures` or `tasks`, a part after the other: of a plan however large one is in memory."""
    return (version.rows(columns, [part], where) for part in version.partitions)


# ------------------------------------------------------------------------------------------------ to be rendered


@dataclass(frozen=True, slots=True)
class RenderSelection:
    """What of a published plan a run has to do with, and no more: a plan may be larger than memory.

    exposures : rows of those that hold its detectors
    tasks     : of the detectors that are asked for, and of the exposures that the request has images of; longest first
    asked     : of those that are asked for
    planned   : how many detectors that can be rendered each of its exposures has
    """

    exposures: pa.Table
    tasks: Sequence[Json]
    requested: Sequence[Json]
    detector_counts: Mapping[int, int]


def select_for_rendering(
    exposures: Version, tasks: Version, request: Request, rendered: Collection[int]
) -> RenderSelection:
    """What is to be rendered of a plan, and what of it there may be already.

    exposures, planned : versions of the tables `exposures` and `tasks`
    held   : exposures that the request has images of
    Errors : BadInput where no exposure has a simulator, or the request asks for what is not planned
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
    """Tasks and others, each once, longest first."""
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
    """What left something in the detectors of some tasks, also of exposures that nothing renders.

    inputs  : versions of the tables `exposures` and `tasks`;  own : an exposure's settings -> its mission database
    exposures, some : rows of the tables
    returns : rows of these exposures and of those before them; tasks before each, by exposure and detector
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
