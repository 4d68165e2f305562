"""The subcommands of `truesky`: groups, summaries, examples, and the modules that run them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lake_schema import __version__, command
from lake_schema.errors import PartOfLake
from truesky.command_line import exports, injection, lakes, mission, reduction, simulation
from truesky.command_line.parser import Parser, suggestion

# Groups of commands in the help, with their titles.
GROUPS = {
    "simulate": "Simulate",
    "look": "Look at a lake",
    "check": "Check",
    "reduce": "Reduce images",
    "manage": "Manage",
}
_USAGE = "truesky [--local] COMMAND ..."
_NOTES = (
    "truesky COMMAND --help prints the options of a command. Jobs run under\n"
    "spark-submit, and options after -- are passed to it: truesky render REQUEST\n"
    "LAKE -- --master spark://HEAD:7077. truesky --local COMMAND ... runs the jobs\n"
    "in this Python process instead. truesky --version prints the version."
)


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand of `truesky`.

    Attributes
    ----------
    group : str
        Key of `GROUPS`.
    positions : str
        Positional arguments, as the help lists them.
    summary : str
        What the command does, at most 60 characters.
    example : str
        Arguments of an example, without "truesky" and the name of the command.
    add_arguments : callable
        Function that declares the arguments of the command in its parser.
    modules : tuple of str
        Module whose function `run_command` runs the command with the parsed arguments. For a job: the modules that
        define jobs as `JOB`, in the order in which they run.
    is_job : bool
        True if the command runs jobs: programs that make tables, with Spark.
    extra : str
        Extra of the package (name of a group of optional dependencies) that must be installed, or "".
    """

    group: str
    positions: str
    summary: str
    example: str
    add_arguments: Callable[[Parser], None]
    modules: tuple[str, ...]
    is_job: bool = False
    extra: str = ""


# Options before the name of a command, and names of commands in other programs.
_OPTIONS = ("--help", "--local", "--version")
_SYNONYMS = {
    "forecast": "check", "ls": "list", "make": "run", "query": "sql", "select": "sql",
    "show": "describe", "simulate": "run", "view": "page",
}  # fmt: skip
_INSPECTION = ("lake_schema.inspection",)
COMMANDS = {
    "run": Command(
        "simulate", "REQUEST LAKE", "make everything a request needs, and draw pictures",
        "requests/demo.toml my_lake --dry-run", simulation.add_run_arguments, ("truesky.commands.run",),
    ),
    "examples": Command(
        "simulate", "FOLDER", "copy example requests and notebooks", ".", simulation.add_examples_arguments,
        ("truesky.commands.examples",),
    ),
    "build": Command(
        "simulate", "REQUEST LAKE", "make the catalogues of galaxies and stars only", "requests/demo.toml my_lake",
        simulation.add_job_arguments, ("truesky.catalogue.build_galaxies", "truesky.catalogue.build_stars"), True,
    ),
    "fluxes": Command(
        "simulate", "REQUEST LAKE", "compute the fluxes of the catalogues only",
        "requests/demo.toml my_lake --bands euclid_vis", simulation.add_flux_arguments,
        ("truesky.fluxes.compute_fluxes",), True,
    ),
    "lenses": Command(
        "simulate", "REQUEST LAKE", "make the table of strong lenses only", "requests/demo.toml my_lake",
        simulation.add_job_arguments, ("truesky.catalogue.build_strong_lenses",), True,
    ),
    "nuclei": Command(
        "simulate", "REQUEST LAKE", "make the table of active nuclei only", "requests/demo.toml my_lake",
        simulation.add_job_arguments, ("truesky.catalogue.build_active_nuclei",), True,
    ),
    "transients": Command(
        "simulate", "REQUEST LAKE", "make the table of supernovae only", "requests/demo.toml my_lake",
        simulation.add_job_arguments, ("truesky.catalogue.build_transients",), True,
    ),
    "lensed": Command(
        "simulate", "REQUEST LAKE", "make the table of lensed sources only",
        "requests/demo.toml my_lake",
        simulation.add_job_arguments, ("truesky.catalogue.build_lensed_images",), True,
    ),
    "gaia": Command(
        "simulate", "REQUEST LAKE", "make the table of stars as Gaia lists them only",
        "requests/demo.toml my_lake", simulation.add_job_arguments, ("truesky.catalogue.build_gaia",), True,
    ),
    "plan": Command(
        "simulate", "REQUEST LAKE", "plan the exposures only, or print a forecast",
        "requests/demo.toml my_lake --dry-run", simulation.add_plan_arguments, ("truesky.commands.plan",), True,
    ),
    "depth": Command(
        "simulate", "REQUEST LAKE", "make maps of depth and masks only",
        "requests/demo.toml my_lake", simulation.add_job_arguments, ("truesky.survey_maps.build_depth",), True,
    ),
    "light-curves": Command(
        "simulate", "REQUEST LAKE", "make the light curves in the planned exposures only",
        "requests/demo.toml my_lake", simulation.add_job_arguments,
        ("truesky.light_curve_tables.build_light_curves",), True,
    ),
    "render": Command(
        "simulate", "REQUEST LAKE", "render the planned images only", "requests/demo.toml my_lake --limit 1",
        simulation.add_render_arguments, ("truesky.render.render_exposures",), True,
    ),
    "randoms": Command(
        "simulate", "REQUEST LAKE", "make random points in the areas of bands",
        "requests/demo.toml my_lake --density 30 --band euclid_vis", simulation.add_randoms_arguments,
        ("truesky.emulator.build_randoms",), True,
    ),
    "emulate": Command(
        "simulate", "REQUEST LAKE", "draw an observed catalogue without images",
        "requests/demo.toml my_lake --model vis.parquet", simulation.add_emulate_arguments,
        ("truesky.emulator.build_observed",), True,
    ),
    "inject": Command(
        "simulate", "IMAGE ROWS OUT", "add sources to a calibrated frame of a telescope",
        "image.fits galaxies.csv injected.fits --psf image.psf", injection.add_inject_arguments,
        ("truesky.api.inject",),
    ),
    "stamps": Command(
        "simulate", "LAKE PLACES OUT", "draw images of many places on the sky",
        "my_lake places.csv stamps --size 10 --band euclid_vis", injection.add_stamps_arguments,
        ("truesky.api.stamps",),
    ),
    "page": Command(
        "look", "LAKE", "show a lake in the browser, with a TAP service", "my_lake --port 8000",
        lakes.add_page_arguments, ("truesky.page.__main__",), extra="page",
    ),
    "sql": Command(
        "look", "LAKE [QUERY]", "run a SELECT over the tables, or list the tables",
        'my_lake "SELECT count(*) FROM galaxies"', lakes.add_sql_arguments, ("truesky.explore.__main__",),
    ),
    "export": Command(
        "look", "WHAT LAKE", "write catalogues and maps for other programs",
        "galaxies my_lake --form euclid --out euclid_galaxies", exports.add_export_arguments,
        ("truesky.commands.export",), extra="maps",
    ),
    "list": Command(
        "look", "LAKE [TABLE]", "list the versions of the tables", "my_lake galaxies --json", lakes.add_list_arguments,
        _INSPECTION,
    ),
    "describe": Command(
        "look", "LAKE [TABLE]", "show the columns with units and meaning", "my_lake galaxies",
        lakes.add_describe_arguments, _INSPECTION,
    ),
    "report": Command(
        "look", "LAKE", "compare time, memory and size with the forecast", "my_lake --json",
        lakes.add_report_arguments, ("truesky.commands.report",),
    ),
    "tables": Command(
        "look", "", "describe all tables and columns as Markdown", "", lakes.add_no_arguments, _INSPECTION,
    ),
    "check": Command(
        "check", "REQUEST", "check a request without computing anything", "requests/demo.toml",
        simulation.add_check_arguments, ("truesky.commands.check",),
    ),
    "verify": Command(
        "check", "LAKE [TABLE]", "check that the files of a lake are complete", "my_lake --deep",
        lakes.add_verify_arguments, _INSPECTION,
    ),
    "validate": Command(
        "check", "[LAKE]", "compare the products with their expected values", "my_lake --report validation.html",
        lakes.add_validate_arguments, ("truesky.validation.__main__",), extra="reduction",
    ),
    "masters": Command(
        "reduce", "LAKE", "make master frames of the calibration frames", "my_lake --out masters",
        reduction.add_masters_arguments, ("truesky.reduction.masters",), extra="reduction",
    ),
    "reduce": Command(
        "reduce", "LAKE", "calibrate images, and find their sources", "my_lake --masters masters --out calibrated",
        reduction.add_reduce_arguments, ("truesky.reduction.reduce",), extra="reduction",
    ),
    "stack": Command(
        "reduce", "FILE ...", "stack calibrated images of one field", "calibrated/*.fits --out stack.fits",
        reduction.add_stack_arguments, ("truesky.reduction.stack",), extra="reduction",
    ),
    "train": Command(
        "reduce", "LAKE", "learn from images how sources are measured", "my_lake --out vis.parquet",
        reduction.add_train_arguments, ("truesky.emulator.train",), extra="reduction",
    ),
    "gc": Command(
        "manage", "LAKE [TABLE]", "list or remove versions that nothing uses", "my_lake --delete",
        lakes.add_gc_arguments, _INSPECTION,
    ),
    "push": Command(
        "manage", "LAKE s3://...", "copy a lake to object storage", "my_lake s3://bucket/lake",
        lakes.add_push_arguments, ("lake_schema.store.object_storage.push",), extra="s3",
    ),
    "mission": Command(
        "manage", "ACTION", "show the mission database, or make a new camera", 'list "vis.*gain*"',
        mission.add_mission_arguments, ("lake_schema.mission.commands",),
    ),
    "cache": Command(
        "manage", "", "list or remove results that are kept between runs", "--prune --kind lensing --all",
        lakes.add_cache_arguments, ("truesky.commands.cache",),
    ),
    "completion": Command(
        "manage", "SHELL", "print a script that completes commands and options",
        "bash > ~/.local/share/bash-completion/completions/truesky", simulation.add_completion_arguments,
        ("truesky.commands.completion",),
    ),
}  # fmt: skip


def command_parser(name: str) -> Parser:
    """Return the parser of the arguments of a command."""
    declared = COMMANDS[name]
    example = " ".join(filter(None, ("truesky", name, declared.example)))
    parser = Parser(prog=f"truesky {name}", description=_sentence(declared.summary), epilog=f"Example: {example}")
    declared.add_arguments(parser)
    return parser


def parse(name: str, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the arguments of a command, by default those of the process.

    Parameters
    ----------
    name : str
        Name of the command.
    argv : sequence of str, optional
        Arguments after the name of the command.

    Returns
    -------
    argparse.Namespace
        Values of the arguments; `command` is the name of the command. Wrong arguments end the process with status 2.
    """
    return command_parser(name).parse_args(argv, argparse.Namespace(command=name))


def run(name: str, body: Callable[[argparse.Namespace], int], argv: Sequence[str] | None = None) -> int:
    """Parse the arguments of a command, run its body, print errors in one line, and return the exit status.

    Parameters
    ----------
    name : str
        Name of the command.
    body : callable
        Function that runs the command with the parsed arguments, and returns its exit status.
    argv : sequence of str, optional
        Arguments after the name of the command, by default those of the process.

    Returns
    -------
    int
        Exit status, as `lake_schema.command.run` defines it.
    """
    return run_parsed(name, body, parse(name, argv))


def run_parsed(name: str, body: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run the body of a command with its parsed arguments, print errors in one line, and return the exit status.

    Parameters
    ----------
    name : str
        Name of the command.
    body : callable
        Function that runs the command with the parsed arguments, and returns its exit status.
    options : Namespace
        The parsed arguments.

    Returns
    -------
    int
        Exit status, as `lake_schema.command.run` defines it.
    """

    def run_body() -> int:
        try:
            return body(options)
        except PartOfLake as error:
            raise (error.with_option("--name {}") if hasattr(options, "name") else error) from None

    return command.run(f"truesky {name}", run_body)


def complete_parser() -> Parser:
    """Return a parser with all commands as subparsers, from which a shell's completion is made."""
    parser = Parser(prog="truesky", description="Simulate the Euclid sky, and read, check and reduce the results.")
    parser.add_argument("--version", action="version", version=f"truesky {__version__}")
    parser.add_argument("--local", action="store_true", help="run the jobs in this Python process")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, declared in COMMANDS.items():
        declared.add_arguments(subparsers.add_parser(name, help=declared.summary))
    return parser


def help_text() -> str:
    """Return the help of `truesky`: all commands in groups."""
    width = max(len(f"{name} {declared.positions}") for name, declared in COMMANDS.items())
    blocks = []
    for group, title in GROUPS.items():
        rows = [(name, declared) for name, declared in COMMANDS.items() if declared.group == group]
        lines = [f"  {f'{name} {declared.positions}':{width}}  {declared.summary}" for name, declared in rows]
        blocks.append("\n".join([f"{title}:", *lines]))
    head = f"usage: {_USAGE}\n\nSimulate the Euclid sky, and read, check and reduce the results."
    return "\n\n".join([head, *blocks, _NOTES, f"truesky {__version__}"])


def unknown_command(name: str) -> str:
    """Return the message for a name that is not a command, with a suggestion or the list of the commands."""
    if name.startswith("-"):
        return f"there is no option {name}{suggestion(name, _OPTIONS) or '; see truesky --help'}"
    similar = (
        suggestion(_SYNONYMS.get(name, name), COMMANDS)
        or f"; use one of {', '.join(sorted(COMMANDS))}, or see truesky --help"
    )
    return f"{name} is not a command{similar}"


def _sentence(summary: str) -> str:
    return f"{summary[:1].upper()}{summary[1:]}."
