"""Run all jobs of a request in one process with one Spark session: the child process of `truesky run`.

The session and its workers start in a thread while the request is checked and planned.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from lake_schema import command
from truesky.commands import submit
from truesky.running import supervise

# Modules that workers import while they wait for the first tasks.
_WORKER_MODULES = (
    "truesky.catalogue.build_galaxies",
    "truesky.catalogue.build_stars",
    "truesky.fluxes.compute_fluxes",
    "truesky.render.render_exposures",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `truesky run` in this process with the given arguments (by default sys.argv), and return its exit status."""
    supervise.end_with_parent()
    return command.run("truesky", lambda: _run(sys.argv[1:] if argv is None else argv))


def _run(arguments: Sequence[str]) -> int:
    submit.use_environment()
    # Import here, because the import of PySpark takes 0.2 s and is not needed if Java is missing.
    from truesky.running import session

    session.start_in_background("truesky", _WORKER_MODULES)
    from truesky.commands import run
    from truesky.running import submitted_job

    def start(module: str, job_arguments: Sequence[str]) -> int:
        return submitted_job.main(import_module(module).JOB, job_arguments)

    return run.main(arguments, start)


if __name__ == "__main__":
    command.exit_with_status(main)
