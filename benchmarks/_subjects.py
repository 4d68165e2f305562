"""Kinds of work whose CPU time is compared between two processes, for example of two commits.

Each function prepares one kind of work in an existing folder, and returns a function without arguments that does it.
With `quick`, it is little work, for tests. Functions import what they need themselves, because loading the modules of
all kinds of work would take seconds.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

Work = Callable[[], Any]

_GALAXIES, _GENERATION_CELLS = 200_000, 4


def _vis(folder: Path, quick: bool, accuracy: str = "survey") -> Work:
    from benchmarks import _detectors, vis
    from truesky.request.accuracy import preset

    request = replace(vis.demo_request(quick), accuracy=preset(accuracy))
    root = _detectors.make_lake(folder, request)
    facts = _detectors.plan_detector(root, vis.with_all_effects(request) if accuracy == "survey" else request)
    return lambda: _detectors.measure_render(root, facts, folder)


def _nisp_p(folder: Path, quick: bool) -> Work:
    from benchmarks import _detectors, nisp_p

    request = nisp_p.parse_text(folder, nisp_p.request_text(quick))
    root = _detectors.make_lake(folder, request)
    facts = _detectors.plan_detector(root, nisp_p.with_all_effects(request))
    return lambda: _detectors.measure_render(root, facts, folder)


def _nisp_p_chain(folder: Path, quick: bool) -> Work:
    """Prepare the last of sixteen exposures, in order of time: the map of the last but one is not in memory."""
    from benchmarks import _detectors, nisp_p

    request = nisp_p.parse_text(folder, nisp_p.sequence_text(quick))
    root = _detectors.make_lake(folder, request)
    previous, last = _detectors.plan_tasks(root, nisp_p.with_all_effects(request))[-2:]
    try:
        from truesky.render.previous_exposures import DEFAULT_LIMIT_MB, ChargeMaps
    except ImportError:
        # An earlier version of the package keeps no charge maps.
        return lambda: _detectors.measure_render(root, last, folder)
    charge_maps = ChargeMaps(DEFAULT_LIMIT_MB)
    _detectors.measure_render(root, previous, folder, charge_maps)
    earlier_maps = dict(charge_maps._maps)

    def work() -> None:
        charge_maps._maps = dict(earlier_maps)
        _detectors.measure_render(root, last, folder, charge_maps)

    return work


def _nisp_s(folder: Path, quick: bool, selection: int = 0) -> Work:
    from benchmarks import _detectors, nisp_s
    from truesky.request.from_toml import parse

    file = folder / "request.toml"
    file.write_text(nisp_s.request_text(quick, selection=selection), encoding="utf-8")
    plain = parse(file)
    root = _detectors.make_lake(folder, plain)
    facts = _detectors.plan_detector(root, nisp_s.with_all_effects(plain))
    return lambda: _detectors.measure_render(root, facts, folder)


def _ground(folder: Path, quick: bool, camera: str) -> Work:
    from benchmarks import _detectors, ext
    from truesky.request.from_toml import parse

    file = folder / "request.toml"
    file.write_text(ext.one_detector_text(camera, quick), encoding="utf-8")
    request = parse(file)
    root = _detectors.make_lake(folder, request)
    facts = _detectors.plan_detector(root, ext.with_all_effects(request))
    return lambda: _detectors.measure_render(root, facts, folder)


def _fluxes(folder: Path, quick: bool) -> Work:
    from benchmarks import fluxes
    from truesky.fluxes.libraries import templates
    from truesky.fluxes.sources import galaxies_from_table
    from truesky.request.accuracy import SURVEY

    library = templates.galaxy_library()
    rows = galaxies_from_table(fluxes.sample(1000 if quick else _GALAXIES, 3), library)
    return lambda: fluxes._interpolate(rows, library, SURVEY)


def _catalogue(folder: Path, quick: bool) -> Work:
    from benchmarks import catalogue

    settings = catalogue.universe_settings(quick=True)
    return lambda: catalogue.make_cell(catalogue.CELL, 1 if quick else _GENERATION_CELLS, settings)


SUBJECTS: Mapping[str, Callable[[Path, bool], Work]] = {
    "vis": _vis,
    "vis_draft": partial(_vis, accuracy="draft"),
    "vis_quicklook": partial(_vis, accuracy="quicklook"),
    "nisp_p": _nisp_p,
    "nisp_p_chain": _nisp_p_chain,
    "nisp_s": _nisp_s,
    "nisp_s_flux_limits": partial(_nisp_s, selection=1),
    **{name: partial(_ground, camera=name) for name in ("lsst", "decam", "gpc1", "jpcam")},
    "fluxes": _fluxes,
    "catalogue": _catalogue,
}
NOTES = {
    "vis": "a VIS detector at survey accuracy with all effects, from the catalogue to the file",
    "vis_draft": "the same at draft accuracy with the effects that it selects",
    "vis_quicklook": "the same at quicklook accuracy",
    "nisp_p": "a NISP-P detector with all effects",
    "nisp_p_chain": "the same after fifteen exposures of the detector, in order of time",
    "nisp_s": "a NISP-S detector with all effects and the default selection of sources",
    "nisp_s_flux_limits": "the same with sources above flux limits only",
    "lsst": "a detector of LSSTCam with all effects; decam, gpc1 and jpcam are the same for other cameras",
    "fluxes": f"{_GALAXIES:,} galaxies in 22 bands from tables",
    "catalogue": "halos and galaxies of a sixteenth of an order-5 cell",
}


def serve(subject: str, quick: bool) -> None:
    """Do one kind of work once for each line on stdin, and print the CPU time in s after each.

    `subject` is a key of SUBJECTS. The work is also done once before the first line, without a measurement.
    """
    with tempfile.TemporaryDirectory() as folder:
        run_subject = SUBJECTS[subject](Path(folder), quick)
        run_subject()
        for _ in sys.stdin:
            started = time.process_time()
            run_subject()
            print(f"seconds {time.process_time() - started}", flush=True)


def start(subject: str, quick: bool, environment: Mapping[str, str], folder: Path | None = None) -> Any:
    """Start a process that does a kind of work when `ask` is called.

    Parameters
    ----------
    subject : str
        Key of SUBJECTS.
    quick : bool
        If True, the process does little work.
    environment : mapping of str to str
        Environment variables of the process.
    folder : Path, optional
        Current folder of the process, from which it imports its modules. The default is that of this process.

    Returns
    -------
    subprocess.Popen
        The process, a context manager.
    """
    command = [sys.executable, "-m", "benchmarks._subjects", subject, *["--quick"] * quick]
    return subprocess.Popen(
        command, env={"OMP_NUM_THREADS": "1", **environment}, cwd=folder, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip


def ask(process: subprocess.Popen[str]) -> float:
    """Let a process of `start` do its work once, and return the CPU time in seconds.

    SystemExit is raised if the process has ended.
    """
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write("\n")
        process.stdin.flush()
    except BrokenPipeError:
        # Its status is reported below.
        pass
    while line := process.stdout.readline():
        if line.startswith("seconds "):
            return float(line.split()[1])
    raise SystemExit(f"{' '.join(map(str, process.args))} ended with status {process.wait()}")


def alternate(processes: Sequence[subprocess.Popen[str]], repeats: int) -> list[list[float]]:
    """Return CPU times (s) of processes of `start` that work in turn, as one list of `repeats` times for each process.

    The order of the processes is reversed from one repeat to the next.
    """
    seconds: list[list[float]] = [[] for _ in processes]
    for number in range(repeats):
        for index in list(range(len(processes)))[:: 1 if number % 2 else -1]:
            seconds[index].append(ask(processes[index]))
    for process in processes:
        process.communicate()
    return seconds


def summarize_ratios(subject: str, numerators: Sequence[float], denominators: Sequence[float]) -> dict[str, float]:
    """Return median, minimum and maximum of ratios as `<subject>_ratio`, `_ratio_min` and `_ratio_max`.

    Each time (s) in `numerators` is divided by the one in `denominators` that was measured next to it.
    """
    ratios = [numerator / denominator for numerator, denominator in zip(numerators, denominators, strict=True)]
    return {
        f"{subject}_ratio": statistics.median(ratios),
        f"{subject}_ratio_min": min(ratios),
        f"{subject}_ratio_max": max(ratios),
    }


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    serve(sys.argv[1], "--quick" in sys.argv[2:])
