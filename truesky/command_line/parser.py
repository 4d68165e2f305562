"""Parser of the options of a command: errors in one line, and suggestions for misspelt words."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from lake_schema import command
from lake_schema.texts import spelling


def suggestion(word: str, names: Iterable[str]) -> str:
    """Return '; did you mean "NAME"?' with the name that is most similar to a word, or "" if none is similar."""
    matches = spelling.closest_names(word, names, 1)
    return f'; did you mean "{matches[0]}"?' if matches else ""


class Parser(argparse.ArgumentParser):
    """ArgumentParser without abbreviated options, whose errors are one line with a suggestion.

    The request and the lake are positional arguments. The options --request FILE and --lake LAKE are also accepted for
    them, as the scripts of spark-submit have these options.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._names_of_positions: list[str] = []

    def add_request(self, help_text: str = "simulation request, a TOML file") -> None:
        """Add the positional argument REQUEST, whose value is a text."""
        self._names_of_positions.append("--request")
        self.add_argument("request", metavar="REQUEST", help=help_text)

    def add_lake(self, help_text: str = "folder of the lake", is_optional: bool = False) -> None:
        """Add the positional argument LAKE, whose value is a text, or None if it is optional and missing."""
        self._names_of_positions.append("--lake")
        self.add_argument("lake", metavar="LAKE", nargs="?" if is_optional else None, help=help_text)

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments, by default those of the process, and refuse unknown options.

        Parameters
        ----------
        args : sequence of str, optional
            Arguments of the command.
        namespace : argparse.Namespace, optional
            Object that gets the values.

        Returns
        -------
        namespace : argparse.Namespace
            Values of all arguments.
        rest : list of str
            Further words, which are not options.
        """
        words = self._move_to_positions(list(sys.argv[1:] if args is None else args))
        parsed, rest = super().parse_known_args(words, namespace)
        if unknown := next((word for word in rest if word.startswith("-")), None):
            name = unknown.partition("=")[0]
            self.error(f"there is no option {name}{suggestion(name, self._option_string_actions)}")
        return parsed, rest

    def _move_to_positions(self, words: list[str]) -> list[str]:
        """Replace the options --request FILE and --lake LAKE by positional arguments; the last of equal options counts.

        The value of the first positional argument moves to the front, and that of the second one to the end.
        """
        end = words.index("--") if "--" in words else len(words)
        words, rest = words[:end], words[end:]
        for name in self._names_of_positions:
            value = None
            while (at := next((i for i, word in enumerate(words) if word.partition("=")[0] == name), None)) is not None:
                next_word = at + 1 if "=" in words[at] else at + 2
                if next_word > len(words):
                    return words + rest
                value, words = words[next_word - 1].removeprefix(f"{name}="), words[:at] + words[next_word:]
            if value is not None and name == self._names_of_positions[0]:
                words = [value, *words]
            elif value is not None:
                rest = [*(rest or ["--"]), value]
        return words + rest

    def error(self, message: str) -> NoReturn:
        """End the process with status 2 after one line on stderr."""
        hint = "" if message.endswith("?") else f"; see {self.prog} --help"
        raise SystemExit(command.print_error(self.prog, f"{message}{hint}", 2))
