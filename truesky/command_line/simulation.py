"""Arguments of the commands that simulate: run, check, the single jobs, and examples."""

from __future__ import annotations

import argparse
from pathlib import Path

from truesky.command_line.parser import Parser

# Options of jobs that replace a field of the request: name and help text. The options in LISTS have several texts as
# value, and the options in INTEGERS and NUMBERS one integer and one number.
FLUX_LISTS = (("bands", "passbands that replace those of the request"),)
RENDER_LISTS = (("detectors", "only these detectors of each exposure"),)
RENDER_INTEGERS = (("limit", "only this number of detectors, the first by exposure and name"),)
RANDOM_LISTS = (
    ("band", "passbands whose areas are filled (default: the only one)"),
    ("model", "files of truesky train, for the column `detection`"),
)
RANDOM_NUMBERS = (
    ("density", "random points per arcmin2 (default: 30)"),
    ("magnitude", "AB magnitude of the galaxies of `detection`"),
)
EMULATE_LISTS = (("model", "files of truesky train, one for each band"),)
EMULATE_FLAGS = (("extrapolate", "allow depths outside the range of a model, and flag them"),)
NEW_LAKE = "folder of the lake (created if it does not exist)"
_Options = tuple[tuple[str, str], ...]


def add_job_arguments(
    parser: Parser,
    lists: _Options = (),
    integers: _Options = (),
    can_forecast: bool = False,
    numbers: _Options = (),
    flags: _Options = (),
) -> None:
    """Declare the arguments of a job: the request, the lake, and options.

    Parameters
    ----------
    parser : Parser
        Parser of the job.
    lists, integers : tuple of (str, str)
        Name and help text of the options that replace a field of the request by texts or by an integer.
    can_forecast : bool
        True if the job has the options --dry-run and --json.
    numbers : tuple of (str, str)
        Name and help text of the options that replace a field of the request by a number.
    flags : tuple of (str, str)
        Name and help text of the options without a value that set a field of the request to True.
    """
    parser.add_request()
    parser.add_lake(NEW_LAKE)
    for name, text in lists:
        parser.add_argument(f"--{name}", nargs="+", action="extend", metavar="NAME", help=text)
    for name, text in integers:
        parser.add_argument(f"--{name}", type=int, metavar="N", help=text)
    for name, text in numbers:
        parser.add_argument(f"--{name}", type=float, metavar="X", help=text)
    for name, text in flags:
        parser.add_argument(f"--{name}", action="store_true", help=text)
    if can_forecast:
        parser.add_argument("--dry-run", action="store_true", help="print the forecast, write nothing")
        parser.add_argument("--json", action="store_true", help="with --dry-run: print the forecast as JSON")
    parser.add_argument("-v", "--verbose", action="store_true", help="print tracebacks and messages of Spark")


def job_words(options: argparse.Namespace) -> list[str]:
    """Return the arguments of a job, as the scripts of spark-submit expect them, for parsed options of its command."""
    words = ["--lake", options.lake, "--request", options.request]
    for name, value in vars(options).items():
        if name in ("command", "lake", "request") or value is None or value is False:
            continue
        values = value if isinstance(value, list) else [] if value is True else [value]
        words += [f"--{name.replace('_', '-')}", *map(str, values)]
    return words


def add_flux_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky fluxes`."""
    add_job_arguments(parser, FLUX_LISTS)


def add_plan_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky plan`."""
    add_job_arguments(parser, can_forecast=True)


def add_render_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky render`."""
    add_job_arguments(parser, RENDER_LISTS, RENDER_INTEGERS)


def add_randoms_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky randoms`."""
    add_job_arguments(parser, RANDOM_LISTS, numbers=RANDOM_NUMBERS)


def add_emulate_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky emulate`."""
    add_job_arguments(parser, EMULATE_LISTS, flags=EMULATE_FLAGS)


def add_run_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky run`."""
    parser.add_request()
    parser.add_lake(NEW_LAKE)
    parser.add_argument("--detectors", nargs="+", default=(), metavar="NAME", help="render only these detectors")
    parser.add_argument("--limit", type=int, metavar="N", help="render at most N detectors")
    parser.add_argument("--lenses", action="store_true", help="also make the table of strong lenses")
    parser.add_argument("--gaia", action="store_true", help="also make the table of stars as Gaia would list them")
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="folder for the pictures (default: LAKE/pictures)"
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="check the request, print the forecast, and write nothing"
    )


def add_check_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky check`."""
    parser.add_request()
    parser.add_argument("--plan", action="store_true", help="check only the plan of exposures, not the catalogues")
    parser.add_argument("--json", action="store_true", help="print the summary and the cost as JSON")


def add_examples_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky examples`."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="target folder (created if it does not exist)")


def add_completion_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky completion`."""
    parser.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="bash, zsh or fish")
