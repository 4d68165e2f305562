"""Print a script with which a shell completes the commands and options of `truesky`: truesky completion SHELL."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import shtab

from truesky.command_line import commands

# Names of arguments whose values are files, and of arguments whose values are folders.
_FILES = {"request", "images", "report", "results"}
_FOLDERS = {"lake", "folder", "pictures", "masters", "figures"}


def run_command(options: argparse.Namespace) -> int:
    """Print the script for the shell in the options, and return 0."""
    parser = commands.complete_parser()
    for action in _actions(parser):
        if action.dest in _FILES or action.metavar == "FILE":
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif action.dest in _FOLDERS or action.metavar == "FOLDER":
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the arguments of a parser and of all its subparsers."""
    for action in parser._actions:
        yield action
        if isinstance(action.choices, dict):
            for subparser in action.choices.values():
                yield from _actions(subparser)
