"""Forecast the cost of running a request on this machine: rows, images, CPU and wall time, disc, cache and memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from lake_schema.texts.amounts import format_duration, format_size
from truesky.render.forecasting import catalogue_forecast, preparation
from truesky.render.forecasting.catalogue_forecast import WORKERS
from truesky.render.forecasting.image_costs import ImageCosts, run_costs
from truesky.render.forecasting.preparation import Item
from truesky.render.forecasting.speed import Speed
from truesky.request.schema import Request

# Items of preparation that take less wall time (s) on this machine are not listed separately.
_SHORT_S = 0.5


@dataclass(frozen=True, slots=True)
class JobCost:
    """Forecast of one job of a run, without products that are computed once.

    Attributes
    ----------
    job : str
        Name of the job, "start" for the start of Spark and its workers, or "pictures" for the pictures of a run.
    rows : float
        Number of rows of the catalogues, or of images.
    cpu_s, wall_s : float
        CPU and wall time in s.
    bytes : float
        Size of the files that the job writes.
    memory_gb : float
        Peak memory of one worker in GB.
    """

    job: str
    rows: float
    cpu_s: float
    wall_s: float
    bytes: float
    memory_gb: float


@dataclass(frozen=True, slots=True)
class RequestCost:
    """Forecast of `truesky run` for a request in a new lake, with the cache as it is now.

    Attributes
    ----------
    jobs : tuple of JobCost
        The jobs in the order in which they run.
    items : tuple of Item
        Products that are computed once and kept in the cache.
    rows : float
        Number of rows of the catalogues and their fluxes.
    detectors : int
        Number of images of detectors.
    cpu_s, wall_s : float
        CPU and wall time in s, including the items that the cache lacks.
    lake_bytes, cache_bytes : float
        Size of the lake, and of the items that are added to the cache.
    worker_gb, total_gb : float
        Peak memory in GB of one worker, and of all processes together.
    speed : str
        How the speed of this machine was found.
    sky : tuple of str
        One line per camera and band about the sky of the exposures; () if it was not computed.
    """

    jobs: tuple[JobCost, ...]
    items: tuple[Item, ...]
    rows: float
    detectors: int
    cpu_s: float
    wall_s: float
    lake_bytes: float
    cache_bytes: float
    worker_gb: float
    total_gb: float
    speed: str
    sky: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return all values as JSON values by name."""
        return asdict(self)


def forecast(request: Request, images: ImageCosts, machine: Speed) -> RequestCost:
    """Forecast the cost of running a request in a new lake on this machine.

    Parameters
    ----------
    request : Request
        The request.
    images : ImageCosts
        Sums over the plan of its images; without images, a new object.
    machine : Speed
        Speed of this machine.

    Returns
    -------
    RequestCost
        The forecast. Products that the cache contains already cost nothing. The user's catalogues of galaxies and stars
        are not included, because their number of rows is not known.
    """
    items = preparation.items(request, images.psfs() if images.detectors else (), images.channels, machine.factor)
    jobs = job_costs(request, images, machine.factor)
    worker_gb = max(job.memory_gb for job in jobs)
    memory = run_costs()["memory"]
    return RequestCost(
        jobs=tuple(jobs),
        items=tuple(items),
        rows=sum(job.rows for job in jobs if job.job.startswith(("build_", "compute_"))),
        detectors=images.detectors,
        cpu_s=sum(job.cpu_s for job in jobs) + sum(item.cpu_s for item in items),
        wall_s=sum(job.wall_s for job in jobs) + sum(item.wall_s for item in items),
        lake_bytes=sum(job.bytes for job in jobs),
        cache_bytes=sum(item.bytes for item in items),
        worker_gb=worker_gb,
        total_gb=memory["driver_gb"] + max(WORKERS * worker_gb, *(item.memory_gb for item in items)),
        speed=machine.source,
    )


def job_costs(request: Request, images: ImageCosts, factor: float = 1.0) -> list[JobCost]:
    """Forecast the jobs of a run, without products that are computed once.

    Parameters
    ----------
    request : Request
        The request.
    images : ImageCosts
        Sums over the plan of its images.
    factor : float, optional
        CPU time of this machine relative to the reference machine.

    Returns
    -------
    list of JobCost
        One entry per job, in the order in which they run; the first is the start of Spark.
    """
    jobs = [*_catalogue_jobs(request, factor)]
    if images.detectors:
        jobs += _image_jobs(images, factor)
    # The wall time in which a job waits for Spark and for the disc.
    waiting = factor / float(run_costs()["machine_factor"]) * run_costs()["session"]["job_wall_s"]
    return [_start(factor), *(replace(job, wall_s=job.wall_s + waiting) for job in jobs)]


def format_table(cost: RequestCost) -> Iterator[str]:
    """Yield the forecast as lines of a small text table, which fits 80 columns."""
    yield f"{'cost of this request':34} {'rows':>12} {'CPU':>9} {'wall':>9} {'disc':>9}"
    for job in cost.jobs:
        yield _row(job.job, f"{job.rows:,.0f}" if job.rows else "", job.cpu_s, job.wall_s, job.bytes)
    missing = [item for item in cost.items if item.cached < item.count]
    long = [item for item in missing if item.wall_s >= _SHORT_S]
    for item in long:
        note = f"once, {item.count - item.cached} of {item.count}" if item.cached else "once"
        yield _row(item.name, note, item.cpu_s, item.wall_s, 0.0)
    if short := [item for item in missing if item.wall_s < _SHORT_S]:
        cpu, wall = sum(item.cpu_s for item in short), sum(item.wall_s for item in short)
        yield _row("other products", "once", cpu, wall, 0.0)
    yield _row("all", "", cost.cpu_s, cost.wall_s, cost.lake_bytes)
    yield (
        f"images of detectors: {cost.detectors:,}; new in the cache: {format_size(cost.cache_bytes)}; peak memory: "
        f"{cost.worker_gb:.1f} GB per worker, {cost.total_gb:.1f} GB in all"
    )
    yield f"times are for {WORKERS} workers on this machine, {cost.speed}"


def _row(name: str, note: str, cpu_s: float, wall_s: float, size: float) -> str:
    disc = format_size(size) if size else ""
    return f"{name:34} {note:>12} {format_duration(cpu_s):>9} {format_duration(wall_s):>9} {disc:>9}".rstrip()


def summary(cost: RequestCost) -> str:
    """Return the sums of the forecast in one line."""
    return (
        f"{cost.rows:,.0f} rows, {cost.detectors:,} images, {format_duration(cost.cpu_s)} of CPU time, "
        f"{format_duration(cost.wall_s)} on {WORKERS} workers, {format_size(cost.lake_bytes)} on disc, "
        f"{format_size(cost.cache_bytes)} new in the cache, {cost.total_gb:.1f} GB of memory"
    )


def _start(factor: float) -> JobCost:
    cost = run_costs()["session"]
    times = factor / float(run_costs()["machine_factor"])
    cpu = cost["command_s"] + cost["start_s"] + WORKERS * cost["worker_s"]
    wall = cost["command_s"] + cost["start_wall_s"] + cost["worker_s"]
    return JobCost("start", 0.0, times * cpu, times * wall, 0.0, 0.0)


def _catalogue_jobs(request: Request, factor: float) -> Iterator[JobCost]:
    memory = run_costs()["memory"]
    for line in catalogue_forecast.for_request(request, factor):
        yield JobCost(line.job, line.rows, line.seconds, line.wall_s, 1e9 * line.gb, memory[line.job])


def _image_jobs(images: ImageCosts, factor: float) -> Iterator[JobCost]:
    cost, n = run_costs()["images"], images.detectors
    times = factor / float(run_costs()["machine_factor"])
    cpu = times * (cost["plan_start_s"] + cost["plan_exposure_s"] * images.exposures + cost["plan_s"] * images.planned)
    yield JobCost("plan_exposures", images.planned, cpu, cpu, cost["plan_bytes"] * images.planned, 0.0)
    rendering = render_job(n, images.seconds, images.bytes, factor, images.longest_s)
    yield replace(rendering, memory_gb=images.memory_gb)
    pictures = times * (cost["pictures_s"] + cost["picture_s"] * min(n, cost["max_pictures"]))
    yield JobCost("pictures", min(n, cost["max_pictures"]), pictures, pictures, 0.0, 0.0)


def render_job(detectors: int, seconds: float, size: float, factor: float, longest_s: float = 0.0) -> JobCost:
    """Forecast the job that renders images.

    Parameters
    ----------
    detectors : int
        Number of images.
    seconds : float
        Sum of the column `seconds` of the table `tasks`: CPU seconds of the reference machine.
    size : float
        Size of the files in bytes.
    factor : float
        CPU time of this machine relative to the reference machine.
    longest_s : float, optional
        Largest value of the column `seconds`.

    Returns
    -------
    JobCost
        The forecast, with the start of the job and of its workers. The memory is 0.
    """
    cost = run_costs()["images"]
    times = factor / float(run_costs()["machine_factor"])
    used = max(1, min(WORKERS, detectors))
    # Workers that render at the same time share the memory of the machine, which makes each of them slower.
    shared = factor * (cost["shared_factor"] if used > 1 else 1.0)
    in_workers = shared * seconds + times * (used * cost["worker_s"] + detectors * cost["task_s"])
    serial = times * (cost["start_s"] + detectors * cost["publish_s"])
    longest = shared * longest_s + times * (cost["worker_s"] + cost["task_s"])
    wall = serial + max(in_workers / used, longest)
    return JobCost("render_exposures", detectors, serial + in_workers, wall, size, 0.0)
