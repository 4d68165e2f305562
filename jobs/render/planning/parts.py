"""A plan in parts: which exposures each holds, so that it is made by itself, wherever that is.

Where a plan is cut depends on the request alone, and so do the numbers of its exposures, which are counted, not laid
out.

Layout       what a request takes, cut into parts
holding      names of the parts of a published plan that hold some exposures
rows         rows of some exposures of a published plan, of whose parts no others are opened
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds

from jobs.fluxes.passbands import Passband
from jobs.render.camera import detectors
from jobs.render.planning import planned_exposures, survey
from jobs.render.planning.survey import Stretch, Taken
from jobs.request.schema import Request
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store.plan import Json, Part
from lake_schema.store.read import Version

# So many detectors take seconds and 200 MB; a plan that has no more is one part.
TASKS_A_PART = 100_000
_WHOLE = "all.parquet"
# Facts of a part: its first and last exposure; MJD before which none of them begins, and after which none does.
_NUMBERS, _DATES = "exposures", "mjd"


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
) -> pa.Table:
    """Rows of the parts of a published `exposures` or `tasks` that hold some exposures, or some of a time.

    version : of the table;  numbers : of exposures;  dates : MJD from and to;  where : an Arrow filter, None = all
    """
    return version.rows(parts=holding(version, numbers, dates), where=where)
