"""A whole field on one machine: the five jobs of a request one after another, then a table and pictures.

    python -m jobs.demo [--request requests/demo.toml] [--out out/demo]

Each job is the same `spark-submit` that a cluster would be given; nothing here does anything but call them and look.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from jobs.render import plan_exposures
from jobs.request.from_toml import parse
from lake_schema import __version__, command
from lake_schema.errors import BadInput
from lake_schema.store import layout, read

_ROOT = Path(__file__).resolve().parents[1]
JOBS = (
    ("jobs/catalogue/build_galaxies.py", ("galaxies",)),
    ("jobs/catalogue/build_stars.py", ("stars",)),
    ("jobs/fluxes/compute_fluxes.py", ("galaxy_fluxes", "star_fluxes")),
    ("jobs/render/plan_exposures.py", ("exposures", "tasks")),
    ("jobs/render/render_exposures.py", ("products",)),
)
_STOPPING = (signal.SIGINT, signal.SIGTERM)


def main(argv: list[str] | None = None) -> int:
    """Run the jobs; the exit status is 0, or that of the first job that fails; 130/143 stopped."""
    parser = argparse.ArgumentParser(
        prog="python -m jobs.demo",
        description="Simulate a field: five jobs, a table, pictures.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("--request", type=Path, default=_ROOT / "requests" / "demo.toml", help="simulation request")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder of the lake and the pictures")
    options = parser.parse_args(argv)
    before = {number: signal.signal(number, _stop) for number in _STOPPING}
    try:
        return command.status("demo", lambda: _demonstrated(options.out, options.request))
    except KeyboardInterrupt as stopped:
        print("demo: stopped; a second run continues where this one ended", file=sys.stderr)
        return 128 + int(stopped.args[0])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _demonstrated(out: Path, request: Path) -> int:
    # Whatever is wrong with the folder or the pointings is said before the first job runs.
    root = layout.lake(layout.lake(out) / "lake")
    plan_exposures.plan(root, parse(request))
    status = _run_all(root, request)
    if status == 0:
        _show(root, out)
    return status


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)


def _run_all(root: Path, request: Path) -> int:
    submit = shutil.which("spark-submit", path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if submit is None:
        raise BadInput("no spark-submit on PATH: activate the environment that `make` made (. .venv/bin/activate)")
    rows, start = [], time.perf_counter()
    for script, tables in JOBS:
        began = time.perf_counter()
        print(f"{Path(script).stem} ...", flush=True)
        call = [submit, str(_ROOT / script), "--lake", str(root), "--request", str(request)]
        if status := _call(call):
            return status
        rows.append((Path(script).stem, tables, time.perf_counter() - began))
    _table(root, rows, time.perf_counter() - start)
    return 0


def _call(command: Sequence[str]) -> int:
    """Exit status of a job; it is stopped where we are."""
    # A signal that arrives while the job is started is answered when there is a job to stop.
    early: list[int] = []
    handlers = {number: signal.signal(number, lambda n, _: early.append(n)) for number in _STOPPING}
    with subprocess.Popen(command) as job:
        try:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if early:
                raise KeyboardInterrupt(early[0])
            return job.wait()
        except BaseException:
            job.terminate()
            raise


def _table(root: Path, stages: Sequence[tuple[str, Sequence[str], float]], total: float) -> None:
    print(f"\n{'stage':18} {'table':14} {'rows':>10} {'rows/s':>10} {'MB':>8} {'seconds':>8}")
    for stage, tables, seconds in stages:
        versions = [read.version(root, name) for name in tables]
        rows = sum(version.num_rows for version in versions)
        for i, version in enumerate(versions):
            size = sum(entry["bytes"] for entry in version.manifest["files"]) / 1e6
            pace = f"{rows / seconds:10,.1f} {size:8.1f} {seconds:8.1f}" if i == 0 else f"{'':10} {size:8.1f}"
            print(f"{stage if i == 0 else '':18} {version.table:14} {version.num_rows:10,} {pace}")
    print(f"{'all':18} {'':14} {'':10} {'':10} {'':8} {total:8.1f}\n")


def _show(root: Path, out: Path) -> None:
    # All that renders: seconds that the first job need not wait for.
    from jobs.render.products import preview

    for picture in preview.previews(root, out):
        print(picture)


if __name__ == "__main__":
    sys.exit(main())
