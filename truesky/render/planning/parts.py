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
from lake_schema.store.plan import Json, Part
from lake_schema.store.read import Version
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors
from truesky.render.exposure import persistence
from truesky.render.planning import planned_exposures, preconditions, survey
from truesky.render.planning.planned_exposures import Exposure
from truesky.render.planning.survey import Stretch, Taken
from truesky.render.planning.tasks import Narrowed, in_order
from truesky.request.schema import Request

# So many detectors take seconds and 200 MB; a plan that has no more is one part.
TASKS_A_PART = 100_000
_WHOLE = "all.parquet"
# Facts of a part: its first and last exposure; MJD before which none of them begins, and after which none does.
_NUMBERS, _DATES = "exposures", "mjd"
# Columns of `tasks` that say what is rendered, and when.
_TASK = ("exposure_id", "detector", "channel", "ra", "dec", "radius", "cells", "seconds")


@dataclass(frozen=True, slots=True)
class Run:
    """Exposures of a stretch, from the first to before the last."""

    stretch: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Piece:
    """One part of a plan.

    first  : number of its first exposure
    runs   : its exposures;  before : those of earlier parts that may differ from them in their noise alone
    since, until : MJD before which none of them begins, and after which none does
    """

    first: int
    runs: tuple[Run, ...]
    before: tuple[Run, ...]
    since: float
    until: float

    def __len__(self) -> int:
        return sum(run.last - run.first for run in self.runs)


@dataclass(frozen=True, slots=True)
class Layout:
    """What a request takes, cut into parts; it goes to whoever makes one of them."""

    stretches: tuple[Stretch, ...]
    pieces: tuple[Piece, ...]

    @classmethod
    def of(cls, request: Request, mission: MissionConfiguration, most: int = TASKS_A_PART) -> Layout:
        """The layout of a request; most : detectors of a part, unless a field has more.  Errors: as survey.stretches"""
        found = survey.stretches(request, mission)
        return cls(tuple(found), tuple(_pieces(found, most)))

    def parts(self) -> tuple[Part, ...]:
        """The parts of a table of the plan."""
        if len(self.pieces) == 1:
            return (Part(_WHOLE, {}),)
        return tuple(
            Part(
                f"{piece.first:09d}.parquet",
                {_NUMBERS: [piece.first, piece.first + len(piece) - 1], _DATES: [piece.since, piece.until]},
            )
            for piece in self.pieces
        )

    def piece(self, facts: Json) -> Piece:
        """The piece of a part, by its facts."""
        if _NUMBERS not in facts:
            return self.pieces[0]
        return next(piece for piece in self.pieces if piece.first == facts[_NUMBERS][0])

    def exposures(self, piece: Piece, own: Mapping[str, Passband], seed: int) -> pa.Table:
        """Rows of the table `exposures`; own, seed : as planned_exposures.table has them."""
        taken = list(self._taken(piece.runs))
        before = (exposure for exposure, _ in self._taken(piece.before))
        return planned_exposures.table(
            [exposure for exposure, _ in taken], [mission for _, mission in taken], own, seed, piece.first, before
        )

    def wanted(self, piece: Piece) -> list[tuple[str, ...]]:
        """The detectors that are wanted of each exposure of a part, () = all."""
        return [names for run in piece.runs for names in self.stretches[run.stretch].wanted(run.first, run.last)]

    def about(self, piece: Piece, days: float) -> Iterator[Exposure]:
        """Exposures that begin while those of a part do, or up to so many days before, and some others."""
        for stretch in self.stretches:
            for run in stretch.about(piece.since - days, piece.until, len(stretch)):
                yield from (exposure for exposure, _ in stretch.exposures(*run))

    def standing(self) -> Iterator[Taken]:
        """An exposure of every kind there is: of fields those of the first."""
        return chain.from_iterable(
            stretch.exposures(0, len(stretch.taken) * stretch.times) for stretch in self.stretches
        )

    def _taken(self, runs: Iterable[Run]) -> Iterator[Taken]:
        return chain.from_iterable(self.stretches[run.stretch].exposures(run.first, run.last) for run in runs)


def _pieces(stretches: list[Stretch], most: int) -> Iterator[Piece]:
    runs: list[Run] = []
    first, size = 1, 0
    for number, stretch in enumerate(stretches):
        start = 0
        for end, tasks in _units(stretch):
            if size and size + tasks > most:
                piece = _piece(stretches, first, [*runs, *_some(number, start, end - stretch.unit)])
                yield piece
                first, runs, size, start = first + len(piece), [], 0, end - stretch.unit
            size += tasks
        runs += _some(number, start, len(stretch))
    yield _piece(stretches, first, runs)


def _some(number: int, start: int, end: int) -> list[Run]:
    return [Run(number, start, end)] if end > start else []


def _units(stretch: Stretch) -> Iterator[tuple[int, int]]:
    """After each unit of a stretch: how many exposures have been taken; detectors of the unit."""
    every = {camera: len(detectors.detectors(camera, mission)) for camera, mission in _cameras(stretch)}
    tasks = [len(dict.fromkeys(exposure.detectors)) or every[exposure.camera] for exposure in stretch.taken]
    if stretch.lay is not None:
        tasks = [sum(tasks)] * len(stretch.fields)
    for i, some in enumerate(tasks, start=1):
        yield i * stretch.unit, some * stretch.times


def _cameras(stretch: Stretch) -> Iterator[tuple[str, MissionConfiguration]]:
    for exposure in stretch.taken:
        yield exposure.camera, stretch.settled_of(exposure).mission


def _piece(stretches: list[Stretch], first: int, runs: list[Run]) -> Piece:
    dates = [stretches[run.stretch].times_of(run.first, run.last) for run in runs]
    since, until = min((low for low, _ in dates), default=0.0), max((high for _, high in dates), default=0.0)
    before: list[Run] = []
    if runs:
        for number in range(runs[0].stretch + 1):
            end = runs[0].first if number == runs[0].stretch else len(stretches[number])
            before += [Run(number, *run) for run in stretches[number].about(since, until, end)]
    return Piece(first, tuple(runs), tuple(before), since, until)


def holding(version: Version, numbers: Iterable[int] = (), dates: tuple[float, float] | None = None) -> list[str]:
    """Names of the parts of a published `exposures` or `tasks` that hold some exposures, or some of a time.

    numbers : of exposures;  dates : MJD from and to
    """
    wanted, found = np.unique(np.fromiter(numbers, np.int64)), []
    for part in version.manifest["parts"]:
        facts = part.get("facts", {})
        if _NUMBERS not in facts:
            found.append(part["name"])
            continue
        first, last = facts[_NUMBERS]
        since, until = facts[_DATES]
        at_the_time = dates is not None and since <= dates[1] and until >= dates[0]
        if at_the_time or np.searchsorted(wanted, first) < np.searchsorted(wanted, last, "right"):
            found.append(part["name"])
    return found


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
    return version.rows(columns, holding(version, numbers, dates), where)


def of_exposures(version: Version, numbers: Collection[int], columns: Sequence[str] | None = None) -> pa.Table:
    """Rows of some exposures of a published `exposures` or `tasks`, and no others; columns : names, None = all."""
    return rows(version, numbers, where=_one_of(numbers), columns=columns)


def _one_of(numbers: Collection[int]) -> ds.Expression:
    return pc.field("exposure_id").isin(pa.array([*numbers], pa.int64()))


def each(
    version: Version, columns: Sequence[str] | None = None, where: ds.Expression | None = None
) -> Iterator[pa.Table]:
    """Rows of a published `exposures` or `tasks`, a part after the other: of a plan however large one is in memory."""
    return (version.rows(columns, [part], where) for part in version.parts)


# ------------------------------------------------------------------------------------------------ to be rendered


@dataclass(frozen=True, slots=True)
class Chosen:
    """What of a published plan a run has to do with, and no more: a plan may be larger than memory.

    exposures : rows of those that hold its detectors
    tasks     : of the detectors that are asked for, and of the exposures that the request has images of; longest first
    asked     : of those that are asked for
    planned   : how many detectors that can be rendered each of its exposures has
    """

    exposures: pa.Table
    tasks: Sequence[Json]
    asked: Sequence[Json]
    planned: Mapping[int, int]


def chosen(exposures: Version, planned: Version, request: Request, held: Collection[int]) -> Chosen:
    """What is to be rendered of a plan, and what of it there may be already.

    exposures, planned : versions of the tables `exposures` and `tasks`
    held   : exposures that the request has images of
    Errors : BadInput where no exposure has a simulator, or the request asks for what is not planned
    """
    drawn = preconditions.simulated(exposures.rows(["exposure_id", "channel", "image_type"]))
    narrowed, holders, has = Narrowed(request), {*holding(planned, held)}, pa.array([*held], pa.int64())
    asked, others = [], []
    numbers: dict[int, int] = {}
    for part in planned.parts:
        if narrowed.is_done and part not in holders:
            continue
        some = planned.rows(_TASK, [part])
        some = some if drawn is None else some.filter(pc.is_in(some["exposure_id"], drawn))
        asked.append(narrowed.of(some))
        others.append(some.filter(pc.is_in(some["exposure_id"], has)) if narrowed.is_narrow else some.slice(0, 0))
        own = {number for few in (asked[-1], others[-1]) for number in few["exposure_id"].unique().to_pylist()}
        counts = some["exposure_id"].value_counts()
        numbers |= {one["values"]: one["counts"] for one in counts.to_pylist() if one["values"] in own}
    narrowed.refuse_unknown()
    wanted: list[Json] = in_order(pa.concat_tables(asked)).to_pylist() if asked else []
    every = _with(wanted, pa.concat_tables(others).to_pylist() if others else [])
    return Chosen(of_exposures(exposures, numbers), every, wanted, numbers)


def _with(wanted: list[Json], others: list[Json]) -> list[Json]:
    """Tasks and others, each once, longest first."""
    there = {(task["exposure_id"], task["detector"]) for task in wanted}
    more = [task for task in others if (task["exposure_id"], task["detector"]) not in there]
    if not more:
        return wanted
    return sorted([*wanted, *more], key=lambda task: (-task["seconds"], task["exposure_id"], task["detector"]))


def before(
    inputs: Mapping[str, Version],
    exposures: pa.Table,
    some: Iterable[Json],
    own: Callable[[str | None], MissionConfiguration],
) -> tuple[pa.Table, dict[tuple[int, str], list[Json]]]:
    """What left something in the detectors of some tasks, also of exposures that nothing renders.

    inputs  : versions of the tables `exposures` and `tasks`;  own : an exposure's settings -> its mission database
    exposures, some : rows of the tables
    returns : rows of these exposures and of those before them; tasks before each, by exposure and detector
    """
    kept = [row for row in map(ExposureRow.of, exposures.to_pylist()) if persistence.remembers(row)]
    if not kept:
        return exposures, {}
    kinds = {(row.camera, row.settings) for row in kept}
    days = max(persistence.window(camera, own(settings)) for camera, settings in kinds)
    since, until = min(row.mjd for row in kept) - days, max(row.mjd for row in kept)
    near = (pc.field("mjd") >= since) & (pc.field("mjd") <= until)
    there = near & pc.field("camera").isin(sorted({camera for camera, _ in kinds}))
    found = rows(inputs["exposures"], dates=(since, until), where=there)
    numbers = found["exposure_id"].to_pylist()
    names = sorted({task["detector"] for task in some})
    here = _one_of(numbers) & pc.field("detector").isin(pa.array(names, pa.string()))
    left = rows(inputs["tasks"], numbers, where=here, columns=_TASK).to_pylist()
    earlier = persistence.earlier_of(
        left, {row.exposure_id: row for row in map(ExposureRow.of, found.to_pylist())}, own
    )
    others = found.filter(pc.invert(pc.is_in(found["exposure_id"], exposures["exposure_id"].combine_chunks())))
    return pa.concat_tables([exposures, others]), earlier
