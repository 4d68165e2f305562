"""Functions for benchmarks that render images of single detectors.

They make a lake (folder with catalogues of sources and their fluxes), plan the image of a detector, measure the CPU
time and memory of its rendering, and time a whole Spark job.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema.store import layout, publish
from lake_schema.store.plan import Json
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.numerics import cache
from truesky.render import plan_exposures, render_exposures
from truesky.render.effects.effect import Effect
from truesky.request.from_toml import parse
from truesky.request.schema import Request
from truesky.running.task_metrics import peak_memory_gb, reset_peak_memory

if TYPE_CHECKING:
    # `benchmarks.compare` runs this module with earlier versions of the package, some of which lack the class.
    from truesky.render.previous_exposures import ChargeMaps

ROOT = Path(__file__).resolve().parents[1]
# Radius (deg) around the centre of an exposure of Euclid that contains all sources on its detectors.
FIELD_RADIUS = 0.62


def make_lake(folder: Path, request: Request) -> Path:
    """Compute the catalogues of galaxies and stars and their fluxes for a request, and return the folder of the lake.

    The lake is the new folder `lake` in `folder`.
    """
    root = layout.resolve_lake(folder / "lake")
    for module in (build_galaxies, build_stars, compute_fluxes):
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)
    return root


def request_head(quick: bool) -> str:
    """Return the beginning of requests/demo.toml, up to its first pointing, as TOML text.

    If `quick` is True, the magnitude limits are lowered to 19 (galaxies) and 14 (stars).
    """
    text = (ROOT / "requests" / "demo.toml").read_text(encoding="utf-8").split("[[pointing]]")[0]
    if quick:
        text = text.replace("galaxy_limit = 26.0", "galaxy_limit = 19.0").replace(
            "star_limit = 26.0", "star_limit = 14.0"
        )
    return text


def plan_detector(root: Path, request: Request, number: int = 0) -> Json:
    """Plan the exposures of a request, and return the description of one rendering task (the image of a detector).

    Parameters
    ----------
    root : Path
        Folder of a lake with the catalogues and fluxes of the request.
    request : Request
        Request with at least one exposure.
    number : int, optional
        Index of the detector image in order of exposures; negative values count from the end.

    Returns
    -------
    dict
        Description of the rendering task, an argument of `render_exposures.render_task`.
    """
    return plan_tasks(root, request)[number]


def plan_tasks(root: Path, request: Request) -> list[Json]:
    """Plan the exposures of a request, and return the descriptions of all rendering tasks, in order of exposures.

    `root` is the folder of a lake with the catalogues and fluxes of the request.
    """
    for step in plan_exposures.steps(root, request):
        publish.make_version(root, step.plan, step.run_task)
    step = render_exposures.steps(root, request)[0]
    tasks = sorted(step.plan.tasks, key=lambda task: (task.facts["exposure_id"], task.facts["detector"]))
    return [{**step.plan.facts, **task.facts} for task in tasks]


def measure_render(root: Path, facts: Json, folder: Path, charge_maps: ChargeMaps | None = None) -> tuple[float, float]:
    """Measure the rendering of a detector image, from reading the catalogues to writing the files.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    facts : dict
        Description of the rendering task, as `plan_detector` returns it.
    folder : Path
        Folder in which the image files are written; existing files are replaced.
    charge_maps : ChargeMaps, optional
        Memory for charge maps of earlier exposures. By default none are kept.

    Returns
    -------
    seconds : float
        CPU time in seconds.
    peak : float
        Peak memory of this process during the rendering, in GB.
    """
    reset_peak_memory()
    started = time.process_time()
    memory = {} if charge_maps is None else {"charge_maps": charge_maps}
    output = render_exposures.render_task(root, facts, **memory)
    for path, write in output.files.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        write(file)
    return time.process_time() - started, peak_memory_gb()


def time_cold_and_warm(root: Path, facts: Json, folder: Path, planes: str, repeats: int) -> dict[str, float]:
    """Time the rendering of a detector image without ("cold") and with ("warm") the images of the PSF in the cache.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    facts : dict
        Description of the rendering task, as `plan_detector` returns it.
    folder : Path
        Folder in which the image files are written.
    planes : str
        Pattern (glob) of the names of the cache folders that contain PSF images, for example "vis_psf-*".
    repeats : int
        Number of repeats; the shortest time counts.

    Returns
    -------
    dict of str to float
        `cold_s` and `warm_s` (CPU time in seconds), and `peak_gb` (peak memory in GB).
    """
    out = {"peak_gb": 0.0}
    for state in ("cold", "warm"):
        seconds = []
        for _ in range(repeats):
            if state == "cold":
                remove_planes(planes)
            used, peak = measure_render(root, facts, folder)
            seconds.append(used)
            out["peak_gb"] = max(out["peak_gb"], peak)
        out[f"{state}_s"] = min(seconds)
    return out


def remove_planes(pattern: str) -> None:
    """Delete the folders with PSF images in the cache whose names match a pattern (glob)."""
    for folder in cache.cache_dir().glob(pattern):
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()


def add_cpu_time(function: Callable[..., Any], name: str, seconds: dict[str, float]) -> Callable[..., Any]:
    """Wrap a function, so that the CPU time of each call is added to an entry of a dictionary.

    Parameters
    ----------
    function : callable
        The function.
    name : str
        Key of the entry, which must exist, or `seconds` must be a defaultdict.
    seconds : dict of str to float
        Sums of CPU times in seconds by name; it is changed in place.

    Returns
    -------
    callable
        The wrapped function.
    """

    def call_timed(*arguments: Any, **options: Any) -> Any:
        started = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            seconds[name] += time.process_time() - started

    return call_timed


def effect_seconds(
    effects: Mapping[str, tuple[Effect, ...]], untimed_effects: tuple[object, ...], render: Callable[[], object]
) -> dict[str, float]:
    """Measure the CPU time of each instrumental effect (such as cosmic rays) in one rendering of a science image.

    Parameters
    ----------
    effects : mapping of str to tuple of Effect
        Effects of a channel (such as VIS) by image type. The entry "science" is replaced during the measurement.
    untimed_effects : tuple of object
        Effects that are not measured: the channel compares them by identity, so they cannot be replaced by timed
        copies.
    render : callable
        Function without arguments that renders the image.

    Returns
    -------
    dict of str to float
        CPU time in seconds of each effect, by `effect_<name>_s`.
    """
    seconds: dict[str, float] = defaultdict(float)
    science_effects = effects["science"]
    timed_effects = tuple(
        e if e in untimed_effects else replace(e, apply=add_cpu_time(e.apply, f"effect_{e.name}_s", seconds))
        for e in science_effects
    )
    effects["science"] = timed_effects  # type: ignore[index]
    try:
        render()
    finally:
        effects["science"] = science_effects  # type: ignore[index]
    return seconds


def time_job(folder: Path, text: str) -> float:
    """Return the wall time (s) of the Spark job that renders all images of a request on 2 cores.

    `text` is the request as TOML. The catalogues and the plan are made before the clock starts, in the folder
    `exposure` in `folder`. CalledProcessError is raised if the job fails.
    """
    file = folder / "exposure.toml"
    file.write_text(text, encoding="utf-8")
    request = parse(file)
    root = make_lake(folder / "exposure", request)
    plan_detector(root, request)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = ["spark-submit", "--master", "local[2]", str(ROOT / "jobs" / "render" / "render_exposures.py")]
    started = time.perf_counter()
    subprocess.run([*command, "--lake", str(root), "--request", str(file)], check=True, env=environment)
    return time.perf_counter() - started
