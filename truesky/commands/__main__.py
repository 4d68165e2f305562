"""truesky COMMAND ...: simulate the Euclid sky, and read, check and reduce the results.

    truesky run REQUEST --lake LAKE         run all jobs of a request, then print a table and draw pictures
    truesky check REQUEST                   check that a request is valid and can be rendered
    truesky build | fluxes | lenses | gaia | plan | render  --lake LAKE --request REQUEST
                                            run one job: catalogues, fluxes, strong lenses, Gaia stars, plan, images
    truesky page LAKE                       show a lake in the browser, with a TAP service for other tools
    truesky sql QUERY --lake LAKE           run a SELECT over the tables of a lake
    truesky list | verify | gc | describe LAKE
                                            list the tables, check the files, delete unused versions, show columns
    truesky push LAKE s3://BUCKET/PREFIX    copy a lake to object storage, where it can be read
    truesky masters | reduce | stack        make master frames, calibrated images with their sources, stacks of dithers
    truesky report LAKE                     compare time, memory and size of all runs with the forecast
    truesky validate --lake LAKE            compare the products with their expected values: a table and a report
    truesky mission ...                     show and change the mission database
    truesky examples FOLDER                 copy example requests and notebooks

Each command has its own options: truesky COMMAND --help. Jobs run under spark-submit. Options after -- are passed to
spark-submit (truesky render ... -- --master spark://HEAD:7077). `truesky --local COMMAND ...` runs the jobs in this
Python process instead.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

from lake_schema import __version__, command
from truesky.commands import submit

# Modules that define the jobs (programs that make tables, with Spark) of each command, in the order in which they run.
JOBS = {
    "build": ("truesky.catalogue.build_galaxies", "truesky.catalogue.build_stars"),
    "fluxes": ("truesky.fluxes.compute_fluxes",),
    "lenses": ("truesky.catalogue.build_strong_lenses",),
    "gaia": ("truesky.catalogue.build_gaia",),
    "plan": ("truesky.commands.plan",),
    "render": ("truesky.render.render_exposures",),
}
# Commands that are not jobs: the module whose `main` runs the command, and True if `main` requires the name of the
# command as first argument.
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
# Extra of the package (name of a group of optional dependencies) that must be installed for a command.
EXTRAS = {"masters": "reduction", "page": "page", "push": "s3", "reduce": "reduction", "stack": "reduction"}
EXTRAS |= {"validate": "reduction"}
# Options with which a job does not need Spark, so that it runs in this process.
_OPTIONS_WITHOUT_SPARK = {"-h", "--help", "--dry-run"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the subcommand in the arguments (by default sys.argv), and return its exit status.

    It is 2 if there is no such subcommand. Without arguments, the help text is printed.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    is_local = arguments[:1] == ["--local"]
    command_name, *rest = arguments[is_local:] or ["--help"]
    if command_name in ("-h", "--help", "--version"):
        text = f"truesky {__version__}" if command_name == "--version" else f"{__doc__}\ntruesky {__version__}"
        # Print inside `command.run`, which handles the error if the reader of a pipe closes it after the first lines.
        return command.run("truesky", lambda: print(text) or 0)
    if command_name in MODULES:
        return _module_command(command_name, rest)
    if command_name not in JOBS and command_name != "run":
        command_names = ", ".join(sorted({"run", *JOBS, *MODULES}))
        return command.print_error(
            "truesky", f"{command_name} is not a command; use one of {command_names}, or see truesky --help", 2
        )
    separator = rest.index("--") if "--" in rest else len(rest)
    job_arguments, spark_options = rest[:separator], rest[separator + 1 :]
    if is_local and spark_options:
        return command.print_error(
            "truesky", f"--local does not call spark-submit, so its option {spark_options[0]} is not allowed", 2
        )
    return _run_jobs(
        command_name, job_arguments, spark_options, is_local or not _OPTIONS_WITHOUT_SPARK.isdisjoint(job_arguments)
    )


def _module_command(command_name: str, arguments: Sequence[str]) -> int:
    """Run one of the commands in `MODULES` and return its exit status, or 2 if an optional package is missing."""
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
    """Run jobs in order, all with the same arguments, until one fails; return its exit status, or 0 if none fails.

    `start` runs the job of a module with command-line arguments and returns its exit status.
    """
    # Accept the request as first argument without --request, as `truesky run` and `truesky check` do.
    job_arguments = (
        ["--request", *job_arguments] if job_arguments and not job_arguments[0].startswith("-") else job_arguments
    )
    return next((status for module in modules if (status := start(module, job_arguments))), 0)


def entry() -> NoReturn:
    """Run the installed command `truesky` with the arguments in sys.argv, and end the process with its exit status."""
    command.exit_with_status(main)


if __name__ == "__main__":
    entry()
