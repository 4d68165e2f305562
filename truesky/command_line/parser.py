"""Parser of the options of a command: errors in one line, and suggestions for misspelt words."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from lake_schema import command
from lake_schema.texts import spelling

# Names of the option for a forecast of the cost.
_FORECASTS = ("--dry-run", "--forecast", "--simulate")
# Options with the same meaning in different commands or in other programs.
_SYNONYMS = (
    ("--delete", "--prune", "--remove", "--clean", "--clear"),
    ("--out", "--output"),
    _FORECASTS,
    ("--bands", "--filters"),
    ("--detectors", "--ccds", "--chips"),
    ("--processes", "--threads", "--workers", "--jobs"),
)
# Messages of argparse, as patterns, and sentences that replace them.
_SENTENCES = (
    (r"argument (\S+): invalid int value: ('\d+(?:,\d*)+')", r"\1: write numbers without commas, got \2"),
    (r"argument (\S+): invalid int value: (.*)", r"\1 must be a whole number, for example \1 3, got \2"),
    (r"argument (\S+): invalid float value: (.*)", r"\1 must be a number, for example \1 2.5, got \2"),
    (r"argument (\S+): expected one argument", r"\1 requires a value"),
    (r"argument (\S+): expected at least one argument", r"\1 requires at least one value"),
    (r"argument (\S+): ignored explicit argument (.*)", r"\1 takes no value, got \2"),
    (r"argument (\S+): not allowed with argument (\S+)", r"\1 must not be used with \2"),
    (r"unrecognized arguments: (\S+)$", r"unexpected argument \1"),
    (r"unrecognized arguments: (.*)", r"unexpected arguments \1"),
)
_MISSING = "the following arguments are required: "
_CHOICE = re.compile(r"argument (?P<name>\S+): invalid choice: '(?P<value>.*)' \(choose from (?P<choices>.*)\)")
_REQUEST_ENDING = ".toml"
_TABLE_ENDINGS = (".csv", ".parquet", ".parq", ".hdf5", ".h5")
_QUERY = re.compile(r"\s*(?:SELECT|WITH|FROM)\s", re.IGNORECASE)


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
        # Words of the command, in which the values of positional arguments have no options.
        self._words: list[str] = []

    def add_request(self, help_text: str = "simulation request, a TOML file") -> None:
        """Add the positional argument REQUEST, whose value is a text."""
        self._names_of_positions.append("--request")
        self.add_argument("request", metavar="REQUEST", help=help_text)

    def add_choice(self, name: str, choices: Iterable[str], help_text: str) -> None:
        """Add a positional argument with a fixed set of values, which precedes the lake.

        Parameters
        ----------
        name : str
            Name of the attribute with the value, such as "what"; in capital letters in the help.
        choices : iterable of str
            Allowed values.
        help_text : str
            Text of the help.
        """
        self._names_of_positions.append(f"--{name}")
        self.add_argument(name, metavar=name.upper(), choices=tuple(choices), help=help_text)

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
        self._words = words
        parsed, rest = super().parse_known_args(words, namespace)
        # argparse returns "--" and the lake after it as the rest if it has already taken an optional LAKE as missing.
        if rest[:1] == ["--"] and len(rest) == 2 and getattr(parsed, "lake", "") is None:
            parsed.lake, rest = rest[1], []
        if unknown := next((word for word in rest if word.startswith("-")), None):
            name = unknown.partition("=")[0]
            self.error(f"there is no option {name}{self._similar_option(name)}")
        self._fill_positions(parsed, rest)
        self._refuse_commas(parsed)
        self._refuse_swapped(parsed)
        self._refuse_swapped_query(parsed)
        self._refuse_swapped_table(parsed)
        self._refuse_open_query(parsed, rest)
        self._refuse_needless_lake(parsed, rest)
        return parsed, rest

    def _fill_positions(self, parsed: argparse.Namespace, rest: list[str]) -> None:
        """Move words that follow options to optional positional arguments, which argparse fills only before options."""
        for action in self._actions:
            is_optional = not action.option_strings and action.nargs == "?"
            if is_optional and rest and getattr(parsed, action.dest, None) == action.default:
                setattr(parsed, action.dest, rest.pop(0))

    def _similar_option(self, name: str) -> str:
        """Return the suggestion of an option with a similar name or with the same meaning, or ""."""
        existing = self._option_string_actions
        meant = [option for names in _SYNONYMS if name in names for option in names if option in existing]
        if name in _FORECASTS and not meant and self._names_of_positions == ["--request", "--lake"]:
            return "; truesky plan REQUEST LAKE --dry-run prints a forecast"
        return f'; did you mean "{meant[0]}"?' if meant else suggestion(name, existing)

    def _refuse_commas(self, parsed: argparse.Namespace) -> None:
        """End the process if a list of names has commas, because names are separated by blanks."""
        for action in self._actions:
            is_list = action.nargs == "+" and action.option_strings
            values = [str(value) for value in getattr(parsed, action.dest, None) or ()] if is_list else []
            if any("," in value for value in values):
                names = " ".join(part for value in values for part in value.split(",") if part)
                option = action.option_strings[0]
                self._stop(f"{option}: names are separated by blanks, not by commas: write {option} {names}")

    def _refuse_swapped(self, parsed: argparse.Namespace) -> None:
        """End the process if the lake is a request file."""
        request, lake = (
            str(getattr(parsed, name.strip("-"), None) or "") if name in self._names_of_positions else ""
            for name in ("--request", "--lake")
        )
        is_request_file = lake.endswith(_REQUEST_ENDING) and not os.path.isdir(lake)
        if is_request_file and request and not request.endswith(_REQUEST_ENDING):
            self._stop(f"the request comes before the lake: write {self._call([lake, request])}")
        if is_request_file:
            self._stop(f"LAKE must be the folder of a lake, but {lake} is a request: truesky run {lake} LAKE makes one")

    def _refuse_swapped_query(self, parsed: argparse.Namespace) -> None:
        """End the process if the lake is a query."""
        lake, query = (str(getattr(parsed, name, None) or "") for name in ("lake", "sql"))
        if _QUERY.match(lake) and not os.path.isdir(lake):
            call = self._call([query or "LAKE", f'"{lake}"'], [query, lake])
            self._stop(f"the lake comes before the query: write {call}")

    def _refuse_swapped_table(self, parsed: argparse.Namespace) -> None:
        """End the process if a table of places or sources is before the lake or the image to which it belongs."""
        for first, second in (("lake", "places"), ("image", "rows")):
            given, table = (str(getattr(parsed, name, None) or "") for name in (first, second))
            is_table = given.lower().endswith(_TABLE_ENDINGS) and not os.path.isdir(given)
            is_swapped = is_table and not table.lower().endswith(_TABLE_ENDINGS)
            if table and (is_swapped or (os.path.isfile(given) and os.path.isdir(table))):
                call = self._call([table, given, str(parsed.out)])
                self._stop(f"the {first} comes before the {second}: write {call}")

    def _refuse_open_query(self, parsed: argparse.Namespace, rest: Sequence[str]) -> None:
        """End the process if a query has no quotes, so that its words are several arguments."""
        if hasattr(parsed, "sql") and rest and _QUERY.match(f"{parsed.sql} "):
            query = " ".join([parsed.sql, *rest])
            call = self._call([parsed.lake, f'"{query}"'], [parsed.lake, parsed.sql, *rest])
            self._stop(f"the query must be in quotes: write {call}")

    def _refuse_needless_lake(self, parsed: argparse.Namespace, rest: Sequence[str]) -> None:
        """End the process if a command with only a request gets a folder before or after it."""
        words = [str(parsed.request), *rest] if self._names_of_positions == ["--request"] else []
        folders = [word for word in words if os.path.isdir(word)]
        requests = [word for word in words if word not in folders]
        if folders and requests:
            call = self._call(requests[:1], words)
            self._stop(f"{folders[0]} is a folder, but the command needs only a request: write {call}")

    def _call(self, positions: Sequence[str], given: Sequence[str] = ()) -> str:
        """Return the command with other positional arguments and with the options that the user gave.

        `given` are the positional arguments that the user gave, by default those of `positions`.
        """
        options = [word for word in self._words if word != "--"]
        for word in given or positions:
            if word in options:
                options.remove(word)
        return " ".join([self.prog, *positions, *map(shlex.quote, options)])

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
        text, needs_example = _plain_message(message)
        example = (self.epilog or "").partition("Example: ")[2]
        hint = f"; for example: {example}" if needs_example and example else f"; see {self.prog} --help"
        self._stop(text if text.endswith("?") else text + hint)

    def _stop(self, text: str) -> NoReturn:
        raise SystemExit(command.print_error(self.prog, text, 2))


def _plain_message(message: str) -> tuple[str, bool]:
    """Return a message of argparse as a plain sentence, and True if an example of the command explains it.

    Other messages are returned unchanged.
    """
    if message.startswith(_MISSING):
        names = [spelling.join_words(name.split("|")) for name in message.removeprefix(_MISSING).split(", ")]
        return f"{spelling.join_words(names, 'and')} {'is' if len(names) == 1 else 'are'} missing", True
    if match := _CHOICE.fullmatch(message):
        names = re.findall(r"'([^']*)'", match["choices"])
        subject = "ACTION" if "|" in match["name"] else match["name"]
        problem = f"{subject} must be {spelling.join_words(names)}, got '{match['value']}'"
        return f"{problem}{suggestion(match['value'], names)}", True
    for pattern, sentence in _SENTENCES:
        if match := re.fullmatch(pattern, message, re.DOTALL):
            is_unexpected = pattern.startswith("unrecognized arguments")
            return re.sub(r"(?<!\S)-\w/(?=--)", "", match.expand(sentence)), is_unexpected
    return message, False
