"""truesky COMMAND ...: every command is a job or a module of truesky, with the options that it has itself.

    truesky run REQUEST --lake LAKE         all that a request needs, then a table and pictures
    truesky check REQUEST                   whether a request is valid and all of it can be rendered
    truesky build | fluxes | lenses | gaia | plan | render  --lake LAKE --request REQUEST
                                            one job: catalogues, fluxes, strong lenses, Gaia's view, plan, images
    truesky page LAKE                       the lake in the browser, and a TAP service for other tools
    truesky sql QUERY --lake LAKE           a SELECT over the lake's tables
    truesky list | verify | gc | describe LAKE      what is there, whether it is whole, what no longer serves
    truesky push LAKE s3://BUCKET/PREFIX    puts a lake on object storage, from where it can be read
    truesky masters | reduce | stack        master frames, calibrated images and their sources, stacks of dithers
    truesky report LAKE                     what the runs took, beside the forecast
    truesky validate --lake LAKE            what the lake holds against what it should, a table and a report
    truesky mission ...                     the mission database
    truesky examples FOLDER                 copies requests and notebooks

Jobs run under spark-submit; what follows a -- goes to it (truesky render ... -- --master spark://HEAD:7077), and
`truesky --local COMMAND ...` runs them in this Python's own session.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

from lake_schema import __version__, command
from truesky.commands import submit

# Command -> the modules of its jobs, one after another.
JOBS = {
    "build": ("truesky.catalogue.build_galaxies", "truesky.catalogue.build_stars"),
    "fluxes": ("truesky.fluxes.compute_fluxes",),
    "lenses": ("truesky.catalogue.build_strong_lenses",),
    "gaia": ("truesky.catalogue.build_gaia",),
    "plan": ("truesky.commands.plan",),
    "render": ("truesky.render.render_exposures",),
}
# Command -> the module whose `main` it is, and whether that module wants the command's word, too.
MODULES = {
    "check": ("truesky.commands.check", False),
    "sql": ("truesky.explore.__main__", False),
    "list": ("lake_schema.__main__", True),
    "verify": ("lake_schema.__main__", True),
    "gc": ("lake_schema.__main__", True),
    "describe": ("lake_schema.__main__", True),
    "mission": ("lake_schema.__main__", True),
    "push": ("lake_schema.store.object_storage.push", False),
    "masters": ("truesky.reduction.masters", False),
    "reduce": ("truesky.reduction.reduce", False),
    "stack": ("truesky.reduction.stack", False),
    "report": ("truesky.commands.report", False),
    "validate": ("truesky.validation.__main__", False),
    "page": ("truesky.page.__main__", False),
    "examples": ("truesky.commands.examples", False),
}
# Command -> the extra of the package that it requires.
EXTRAS = {"masters": "reduction", "page": "page", "push": "s3", "reduce": "reduction", "stack": "reduction"}
EXTRAS |= {"validate": "reduction"}
# What a job answers without Spark.
_OPTIONS_WITHOUT_SPARK = {"-h", "--help", "--dry-run"}


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: the job's or module's own; 2 where there is no such command."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    is_local = arguments[:1] == ["--local"]
    command_name, *rest = arguments[is_local:] or ["--help"]
    if command_name in ("-h", "--help", "--version"):
        text = f"truesky {__version__}" if command_name == "--version" else f"{__doc__}\ntruesky {__version__}"
        # Whoever reads it may close the pipe after the first lines.
        return command.run("truesky", lambda: print(text) or 0)
    if command_name in MODULES:
        return _module_command(command_name, rest)
    if command_name not in JOBS and command_name != "run":
        command_names = ", ".join(sorted({"run", *JOBS, *MODULES}))
        return command.print_error(
            "truesky", f"{command_name} is no command of truesky: {command_names}; truesky --help says more", 2
        )
    separator = rest.index("--") if "--" in rest else len(rest)
    job_arguments, spark_options = rest[:separator], rest[separator + 1 :]
    if is_local and spark_options:
        return command.print_error(
            "truesky", f"--local: no spark-submit is called that could take {spark_options[0]}", 2
        )
    return _run_jobs(
        command_name, job_arguments, spark_options, is_local or not _OPTIONS_WITHOUT_SPARK.isdisjoint(job_arguments)
    )


def _module_command(command_name: str, arguments: Sequence[str]) -> int:
    """Run a command that is a module; returns its exit status, or 2 if an optional package is missing."""
    module, takes_command_name = MODULES[command_name]
    try:
        status: int = import_module(module).main([command_name, *arguments] if takes_command_name else arguments)
    except ModuleNotFoundError as error:
        if command_name not in EXTRAS or (error.name or "").startswith(("truesky", "lake_schema")):
            raise
        remedy = f"pip install 'truesky[{EXTRAS[command_name]}]'"
        return command.print_error(
            "truesky", f"{command_name} requires the package {error.name}, which is not installed: {remedy}", 2
        )
    return status


def _run_jobs(command_name: str, job_arguments: Sequence[str], spark_options: Sequence[str], is_local: bool) -> int:
    def start(module: str, arguments: Sequence[str]) -> int:
        return submit.run_in_process(module, arguments) if is_local else submit.submit(module, arguments, spark_options)

    with submit.stop_on_signal("truesky"):
        if command_name == "run":
            from truesky.commands import run

            return run.main(job_arguments, start)
        return command.run("truesky", lambda: _run_in_order(start, JOBS[command_name], job_arguments))


def _run_in_order(
    start: Callable[[str, Sequence[str]], int], modules: Sequence[str], job_arguments: Sequence[str]
) -> int:
    """Status of the first job that fails."""
    # The request may be given without its option, as `truesky run` and `truesky check` take it.
    job_arguments = (
        ["--request", *job_arguments] if job_arguments and not job_arguments[0].startswith("-") else job_arguments
    )
    return next((status for module in modules if (status := start(module, job_arguments))), 0)


def entry() -> NoReturn:
    """`truesky`, as it is installed."""
    command.exit_with_status(main)


if __name__ == "__main__":
    entry()
