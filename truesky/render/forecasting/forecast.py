"""Add up the forecast costs of planned images before anything is rendered: core-hours, memory and storage."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from lake_schema.texts.amounts import format_duration, format_size
from truesky.render.forecasting.speed import Speed

# Columns of the table `tasks` that a forecast combines over detector images. The numbers of sources, CPU seconds and
# file bytes are added up. The largest value of the peak memory is taken.
SUMMED_COLUMNS = ("sources", "seconds", "bytes", "memory")
# Name in place of the survey in lines of the result that add up all surveys of a channel.
_ALL = "all"


@dataclass(frozen=True, slots=True)
class Line:
    """Forecast of CPU time, memory and file size for the exposures of a channel, survey and image type, or for sums.

    Attributes
    ----------
    channel, survey, image_type : str
        Channel, survey and image type. A line that adds up several groups has survey "all" and image type "", and the
        sum over everything also has channel "all".
    exposures, detectors, sources : int
        Numbers of exposures, of detector images, and of galaxies and stars on these images.
    core_hours : float
        CPU time in hours, for the machine to which the argument `factor` of `summarise` belongs.
    gigabytes : float
        Size of the image files in GB.
    memory_gb : float
        Largest peak memory for one detector image in GB.
    """

    channel: str
    survey: str
    image_type: str
    exposures: int
    detectors: int
    sources: int
    core_hours: float
    gigabytes: float
    memory_gb: float


def summarise(exposures: pa.Table, tasks: pa.Table, factor: float = 1.0) -> list[Line]:
    """Add up the estimated CPU time and file size of planned images, and find their largest memory.

    Parameters
    ----------
    exposures : pyarrow.Table
        Rows of the table `exposures`.
    tasks : pyarrow.Table
        Rows of the table `tasks` (one per detector of an exposure) for these exposures.
    factor : float, optional
        CPU time of this machine relative to the reference machine, for which `tasks` has the times; see
        `speed.estimate_speed`.

    Returns
    -------
    list of Line
        One line per channel, survey and image type, in this order; then one per channel; then one for everything.
    """
    exposure_columns = exposures.select(["exposure_id", "survey", "image_type"])
    joined = tasks.select(["exposure_id", "detector", "channel", *SUMMED_COLUMNS]).join(exposure_columns, "exposure_id")
    keys = ["channel", "survey", "image_type"]
    sums = joined.group_by(keys).aggregate(
        [
            ("exposure_id", "count_distinct"),
            ("detector", "count"),
            ("sources", "sum"),
            ("seconds", "sum"),
            ("bytes", "sum"),
            ("memory", "max"),
        ]
    )
    return _add_totals([_line(row, factor) for row in sums.to_pylist()])


def summarise_chunks(chunks: Iterable[tuple[pa.Table, pa.Table]], factor: float = 1.0) -> list[Line]:
    """Add up the estimated CPU time and file size of planned images as `summarise` does, from parts of a large plan.

    Each chunk (part of the plan) has some rows of the table `exposures` and all rows of the table `tasks` (one per
    detector of an exposure) that belong to them.
    """
    return _add_totals([line for chunk in chunks for line in summarise(*chunk, factor) if line.survey != _ALL])


def _add_totals(lines: list[Line]) -> list[Line]:
    lines_of_kind: dict[tuple[str, str, str], list[Line]] = defaultdict(list)
    for line in lines:
        lines_of_kind[line.channel, line.survey, line.image_type].append(line)
    kind_lines = [_sum(*key, group) for key, group in sorted(lines_of_kind.items())]
    channels = sorted({line.channel for line in kind_lines})
    channel_lines = [_sum(name, _ALL, "", [line for line in kind_lines if line.channel == name]) for name in channels]
    return [*kind_lines, *channel_lines, _sum("all", _ALL, "", kind_lines)]


def _sum(channel: str, survey: str, image_type: str, lines: list[Line]) -> Line:
    return Line(
        channel,
        survey,
        image_type,
        sum(line.exposures for line in lines),
        sum(line.detectors for line in lines),
        sum(line.sources for line in lines),
        sum(line.core_hours for line in lines),
        sum(line.gigabytes for line in lines),
        max((line.memory_gb for line in lines), default=0.0),
    )


def _line(row: dict[str, Any], factor: float) -> Line:
    return Line(
        row["channel"],
        row["survey"],
        row["image_type"],
        row["exposure_id_count_distinct"],
        row["detector_count"],
        row["sources_sum"],
        row["seconds_sum"] * factor / 3600.0,
        row["bytes_sum"] / 1e9,
        row["memory_max"],
    )


def format_table(lines: list[Line], speed: Speed) -> Iterator[str]:
    """Yield the forecast of CPU time, memory and storage as lines of a text table, beginning with a title.

    The last line tells how the speed of this machine, on which the CPU times depend, was estimated.
    """
    yield (
        f"{'channel':8} {'survey':12} {'image type':17} {'exposures':>10} {'detectors':>10} {'sources':>14} "
        f"{'CPU time':>9} {'size':>8} {'peak GB':>8}"
    )
    for line in lines:
        yield (
            f"{line.channel:8} {line.survey:12} {line.image_type:17} {line.exposures:10,} {line.detectors:10,} "
            f"{line.sources:14,} {format_duration(3600.0 * line.core_hours):>9} {format_size(1e9 * line.gigabytes):>8} "
            f"{line.memory_gb:8.2f}"
        )
    yield f"CPU times are for this machine, {speed.source}: {speed.factor:.2f} of the channels' costs"
