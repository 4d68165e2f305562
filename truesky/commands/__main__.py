"""truesky COMMAND ...: simulate the Euclid sky, and read, check and reduce the results.

The commands and their arguments are declared in `truesky.command_line`. `truesky --help` lists them.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

from lake_schema import __version__, command
from lake_schema.pandas_import import hide_pandas
from truesky.command_line import commands, simulation

# Options of a job with which it does not need Spark, so that it runs in this process.
_FORECAST = "--dry-run"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the subcommand in the arguments (by default sys.argv), and return its exit status.

    It is 2 if there is no such subcommand. Without arguments, the help text is printed.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    is_local = arguments[:1] == ["--local"]
    name, *words = arguments[is_local:] or ["--help"]
    if name in ("-h", "--help", "--version"):
        text = f"truesky {__version__}" if name == "--version" else commands.help_text()
        # Print inside `command.run`, which handles the error if the reader of a pipe closes it after the first lines.
        return command.run("truesky", lambda: print(text) or 0)
    if name not in commands.COMMANDS:
        return command.print_error("truesky", commands.unknown_command(name), 2)
    if name == "run" or commands.COMMANDS[name].is_job:
        return _job_command(name, words, is_local)
    return _module_command(name, words)


def _module_command(name: str, words: Sequence[str]) -> int:
    """Run a command that is not a job, and return its exit status, or 2 if an optional package is missing."""
    declared = commands.COMMANDS[name]
    # Parse the arguments before the import, so that help and mistakes need no time.
    options = commands.parse(name, words)
    try:
        module = import_module(declared.modules[0])
        return commands.run_parsed(name, module.run_command, options)
    except ModuleNotFoundError as error:
        if not declared.extra or (error.name or "").startswith(("truesky", "lake_schema")):
            raise
        remedy = f"pip install 'truesky[{declared.extra}]'"
        return command.print_error(
            "truesky", f"{name} requires the package {error.name}, which is not installed: {remedy}", 2
        )


def _job_command(name: str, words: Sequence[str], is_local: bool) -> int:
    """Run `truesky run` or the jobs of a command, and return the exit status. Options after -- are for spark-submit."""
    separator = words.index("--") if "--" in words else len(words)
    job_words, spark_options = words[:separator], words[separator + 1 :]
    options = commands.parse(name, job_words)
    if is_local and spark_options:
        return command.print_error(
            "truesky", f"--local does not call spark-submit, so its option {spark_options[0]} is not allowed", 2
        )
    if name == "run" and not spark_options and not options.dry_run:
        # Import here, because the module imports rich, which help and mistakes do not need.
        from truesky.running import supervise

        program = ["-m", "truesky.commands.local_run", *job_words]
        return supervise.supervise("truesky run", program, shlex.join(["truesky", "run", *job_words]))
    is_local = is_local or _FORECAST in job_words
    # Import here, because help and mistakes do not need these modules.
    from truesky.commands import submit

    def start(module: str, arguments: Sequence[str]) -> int:
        return submit.run_in_process(module, arguments) if is_local else submit.submit(module, arguments, spark_options)

    with submit.stop_on_signal("truesky"):
        if name == "run":
            from truesky.commands import run

            return command.run("truesky run", lambda: run.run_command(options, start))
        modules = commands.COMMANDS[name].modules
        return command.run(f"truesky {name}", lambda: _run_in_order(start, modules, simulation.job_words(options)))


def _run_in_order(start: Callable[[str, Sequence[str]], int], modules: Sequence[str], arguments: Sequence[str]) -> int:
    """Run jobs in order, all with the same arguments, until one fails; return its exit status, or 0 if none fails.

    `start` runs the job of a module with command-line arguments and returns its exit status.
    """
    return next((status for module in modules if (status := start(module, arguments))), 0)


def entry() -> NoReturn:
    """Run the installed command `truesky` with the arguments in sys.argv, and end the process with its exit status."""
    if sys.argv[1:2] == ["check"]:
        hide_pandas()
    command.exit_with_status(main)


if __name__ == "__main__":
    entry()
