"""Find sentences and names that a reader who is new to the project cannot understand at first reading.

    python -m scripts.plain_words                        # the whole project: rates, worst files, names
    python -m scripts.plain_words truesky/render --list  # every place: path:line: rule: text -> advice
    python -m scripts.plain_words --check                # exit status 1 above a limit or above the recorded counts

The rules and limits are in plain_words.toml. plain_words.json records the places of each file. `--check` allows no file
to have more places than recorded; `--record` replaces the recorded counts by the present ones. The texts are
docstrings, comments, messages of `raise`, help texts of commands, comments in JavaScript, and Markdown. Code in
backquotes is ignored, and so are texts whose first line contains `plain-words: off`. The rules find unidiomatic forms,
not obscurity: a sentence without a hit may still be unclear.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
COUNTS = Path(__file__).with_suffix(".json")
# Folders and files of the project that are read by default.
PATHS = (
    "truesky", "lake_schema", "jobs", "scripts", "benchmarks", "docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md",
    "SECURITY.md",
)  # fmt: skip
# Only files with at least this number of words have a rate (number of odd phrases per 1,000 words).
LONG_FILE = 200
MESSAGE = "message"
HELP_ARGUMENTS = ("help", "description", "epilog")


class Text(NamedTuple):
    """A piece of prose in a file.

    `line` is the line on which it begins. `kind` is "docstring", "comment", "message" or "markdown".
    """

    line: int
    kind: str
    text: str


class Hit(NamedTuple):
    """A place in a file at which a rule finds an odd phrase, or a vague name.

    `kind` is the kind of the text ("docstring", "comment", ...), or "functions" or "variables" for a name. `text` is
    the phrase with its surroundings, or the name.
    """

    path: str
    line: int
    kind: str
    rule: str
    text: str
    advice: str


@dataclass(frozen=True)
class Rule:
    """A form of phrase to avoid: a regular expression that finds it, and advice for a better form."""

    name: str
    problem: str
    advice: str
    pattern: re.Pattern[str]


@dataclass(frozen=True)
class Settings:
    """Content of plain_words.toml.

    `vague` contains words that say too little as a name, `good` single-word participles that are allowed as names of
    functions, and `limits` the largest allowed rates by name.
    """

    rules: tuple[Rule, ...]
    vague: frozenset[str]
    good: frozenset[str]
    limits: dict[str, float]


def read_settings() -> Settings:
    """Read the rules, names and limits from plain_words.toml."""
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    rules = []
    for rule in table["rule"]:
        # A pattern may have several lines: a backslash at the end of a line joins it with the next one.
        pattern = rule["pattern"].replace("\\\n", "").format(clause=table["clause"], end=table["end"])
        rules.append(Rule(rule["name"], rule["problem"], rule["advice"], re.compile(pattern, re.MULTILINE)))
    words = {key: frozenset(text.split()) for key, text in table["names"].items()}
    return Settings(tuple(rules), words["vague"], words["good"], table["limits"])


def read_prose(path: Path) -> Iterator[Text]:
    """Yield the pieces of prose in a Python (.py), JavaScript (.js) or Markdown file: docstrings, comments and so on.

    SyntaxError is raised if a Python file cannot be parsed.
    """
    source = path.read_text()
    if path.suffix == ".py":
        tree = ast.parse(source)
        yield from _docstrings(tree)
        yield from _messages(tree)
        yield from _comments(source)
    elif path.suffix == ".js":
        for number, line in enumerate(source.splitlines(), 1):
            if match := re.search(r"(?:^|\s)(?://|/?\*+)\s(.*)", line):
                yield Text(number, "comment", match[1])
    else:
        yield from _paragraphs(source)


def _docstrings(tree: ast.AST) -> Iterator[Text]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            for paragraph in re.split(r"\n\s*\n", ast.get_docstring(node) or ""):
                if paragraph and not re.match(r"\s*(>>>|\.\. |::)", paragraph):
                    yield Text(node.body[0].lineno, "docstring", paragraph)


def _messages(tree: ast.AST) -> Iterator[Text]:
    """Yield the texts of a Python program that its users see: messages of `raise`, and help texts of commands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            values = node.exc.args
        elif isinstance(node, ast.Call):
            values = [keyword.value for keyword in node.keywords if keyword.arg in HELP_ARGUMENTS]
        else:
            continue
        for value in values:
            text = constant_text(value)
            if " " in text.strip():
                yield Text(value.lineno, MESSAGE, text)


def constant_text(node: ast.AST) -> str:
    """Return the text of a string, an f-string or a sum of them, with {} for each inserted value.

    The result is "" for other expressions.
    """
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(constant_text(part) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    if isinstance(node, ast.BinOp):
        return constant_text(node.left) + constant_text(node.right)
    return ""


def _comments(source: str) -> Iterator[Text]:
    """Yield the comments of a Python program; comments on consecutive lines are one text.

    Instructions for tools, such as "noqa" or "type:", are left out.
    """
    block, first = list[str](), 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        text = token.string.lstrip("#").strip()
        if token.type != tokenize.COMMENT or re.match(r"(noqa|type:|fmt:|pragma|ruff|!|plain-words)", text):
            continue
        if block and token.start[0] != first + len(block):
            yield Text(first, "comment", " ".join(block))
            block = []
        if not block:
            first = token.start[0]
        block.append(text)
    if block:
        yield Text(first, "comment", " ".join(block))


def _paragraphs(source: str) -> Iterator[Text]:
    text = re.sub(r"```.*?```", lambda match: "\n" * match[0].count("\n"), source, flags=re.DOTALL)
    line = 1
    for block in re.split(r"(\n\s*\n)", text):
        if block.strip() and not block.lstrip().startswith(("|--", ".. ", "    ", "<")):
            yield Text(line, "markdown", " ".join(block.split()))
        line += block.count("\n")


def find_hits(path: Path, settings: Settings) -> tuple[list[Hit], Counter[str]]:
    """Return the odd phrases in the prose of a file, and its number of words by kind of text ("docstring", ...)."""
    lines, hits, words = path.read_text().splitlines(), [], Counter[str]()
    for line, kind, text in read_prose(path):
        words[kind] += len(re.findall(r"[A-Za-z][A-Za-z']+", text))
        if "plain-words: off" in lines[min(line, len(lines)) - 1]:
            continue
        prose = re.sub(r"``[^`]*``|`[^`]*`", "`x`", text)
        for rule in settings.rules:
            for match in rule.pattern.finditer(prose):
                excerpt = prose[max(match.start() - 40, 0) : match.end() + 50].replace("\n", " ").strip()
                hits.append(Hit(str(path), line, kind, rule.name, excerpt, rule.advice))
    return hits, words


def find_vague_names(path: Path, settings: Settings) -> tuple[list[Hit], Counter[str]]:
    """Return the vague names in a Python file, and its numbers of names of "functions" and of "variables".

    Parameters count as variables.
    """
    hits, count = list[Hit](), Counter[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if not node.name.startswith("__"):
                count["functions"] += 1
                if _is_vague_function(node.name, settings):
                    hits.append(_vague(path, node.lineno, "functions", node.name))
            arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
            names = [argument.arg for argument in arguments if argument.arg not in ("self", "cls")]
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names = [node.id]
        else:
            continue
        count["variables"] += len(names)
        hits += [_vague(path, node.lineno, "variables", name) for name in names if name in settings.vague]
    return hits, count


def _is_vague_function(name: str, settings: Settings) -> bool:
    bare = name.lstrip("_")
    participle = re.fullmatch(r"[a-z]+(?:ed|en|ing)", bare) and bare not in settings.good
    return "_" not in bare and (bare in settings.vague or bool(participle))


def _vague(path: Path, line: int, kind: str, name: str) -> Hit:
    return Hit(str(path), line, kind, "names", name, "name the thing it is, or the action it takes")


@dataclass
class Report:
    """Result for all files: places that were found, and sizes.

    `words` contains the number of words by file and by kind of text. `names` contains the numbers of names of
    "functions" and of "variables".
    """

    hits: list[Hit]
    words: dict[str, Counter[str]]
    names: Counter[str]

    def rates(self) -> dict[str, float]:
        """Return the rates that have a limit, by name.

        `words`, `messages` and `file` are odd phrases per 1,000 words: in all texts, in messages and help texts, and in
        the worst file. `functions` and `variables` are percentages of vague names.
        """
        in_prose = [hit for hit in self.hits if hit.rule != "names"]
        by_name = Counter(hit.kind for hit in self.hits if hit.rule == "names")
        words = sum((Counter(count) for count in self.words.values()), Counter[str]())
        messages = sum(hit.kind == MESSAGE for hit in in_prose)
        return {
            "words": 1000.0 * len(in_prose) / max(words.total(), 1),
            "messages": 1000.0 * messages / max(words[MESSAGE], 1),
            "file": max(self.file_rates().values(), default=0.0),
            "functions": 100.0 * by_name["functions"] / max(self.names["functions"], 1),
            "variables": 100.0 * by_name["variables"] / max(self.names["variables"], 1),
        }

    def file_rates(self) -> dict[str, float]:
        """Return the number of odd phrases per 1,000 words of each file with at least 200 words, by path."""
        hit_counts = Counter(hit.path for hit in self.hits if hit.rule != "names")
        totals = {path: words.total() for path, words in self.words.items()}
        return {path: 1000.0 * hit_counts[path] / total for path, total in totals.items() if total >= LONG_FILE}

    def counts(self) -> dict[str, int]:
        """Return the number of odd phrases and vague names in each file that has any, by path."""
        hit_counts = Counter(hit.path for hit in self.hits)
        return {path: hit_counts[path] for path in sorted(hit_counts)}


def read_files(paths: list[Path], settings: Settings) -> Report:
    """Examine all Python, Markdown and JavaScript files at or below some paths, and return the result."""
    report = Report([], defaultdict(Counter), Counter())
    for top in paths:
        files = [top] if top.is_file() else sorted(top.rglob("*"))
        for path in files:
            if path.suffix not in (".py", ".md", ".js"):
                continue
            hits, report.words[str(path)] = find_hits(path, settings)
            report.hits += hits
            if path.suffix == ".py":
                names, count = find_vague_names(path, settings)
                report.hits += names
                report.names += count
    return report


def print_report(report: Report, settings: Settings, rows: int = 10) -> None:
    """Print the number of odd phrases by rule, the files with the highest rates, and the rates with their limits.

    Parameters
    ----------
    report : Report
        Counts and places of odd phrases and vague names.
    settings : Settings
        Rules and limits.
    rows : int
        Number of files to print.
    """
    hit_counts, words = Counter(hit.rule for hit in report.hits), sum(c.total() for c in report.words.values())
    for rule in settings.rules:
        rate = 1000.0 * hit_counts[rule.name] / max(words, 1)
        print(f"{hit_counts[rule.name]:6d} {rate:6.2f}  {rule.name}: {rule.problem}")
    by_file = report.file_rates()
    for path in sorted(by_file, key=lambda name: -by_file[name])[:rows]:
        print(f"{by_file[path]:13.1f}  {path}")
    units = {"words": f"per 1,000 of {words} words", "messages": "per 1,000 words of messages and help"}
    units |= {"file": "per 1,000 words of the worst file", "functions": "% of functions", "variables": "% of variables"}
    for name, rate in report.rates().items():
        print(f"{rate:6.2f} {units[name]} (limit {settings.limits[name]:g})")


def find_failures(report: Report, settings: Settings, recorded: dict[str, int]) -> list[str]:
    """Return one line for each rate above its limit, and for each file with more places than recorded.

    Parameters
    ----------
    report : Report
        Counts and places of odd phrases and vague names.
    settings : Settings
        Rules and limits.
    recorded : mapping of str to int
        Allowed number of places by file; 0 for a file that is not named.

    Returns
    -------
    list of str
        The lines. The places of a file follow its line. The list is empty if nothing is wrong.
    """
    rates = report.rates()
    failures = [
        f"{name}: {rates[name]:.2f} > {limit:g}" for name, limit in settings.limits.items() if rates[name] > limit
    ]
    for path, count in report.counts().items():
        if count > recorded.get(path, 0):
            places = [hit for hit in report.hits if hit.path == path]
            failures.append(f"{path}: {count} places, at most {recorded.get(path, 0)} are allowed")
            failures += [f"  {hit.path}:{hit.line}: {hit.rule}: {hit.text} -> {hit.advice}" for hit in places]
    return failures


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit status: 1 if --check finds that the texts became worse, else 0.

    `arguments` is the list of options; None means the command line.
    """
    parser = argparse.ArgumentParser(
        prog="python -m scripts.plain_words", description="Find odd phrases and vague names."
    )
    parser.add_argument("paths", nargs="*", type=Path, help="files and folders (default: the project)")
    parser.add_argument("--list", action="store_true", help="print every place")
    parser.add_argument("--check", action="store_true", help="exit with status 1 above a limit or a recorded count")
    parser.add_argument("--record", action="store_true", help="record the counts of the project")
    options = parser.parse_args(arguments)
    settings = read_settings()
    if (options.check or options.record) and (options.paths or Path.cwd() != ROOT):
        parser.error(f"--check and --record read the whole project: run them in {ROOT} without paths")
    report = read_files(options.paths or [Path(path) for path in PATHS], settings)
    if options.list:
        for hit in report.hits:
            print(f"{hit.path}:{hit.line}: {hit.rule}: {hit.text} -> {hit.advice}")
    if options.record:
        COUNTS.write_text(json.dumps(report.counts(), indent=0) + "\n")
    if options.check:
        failures = find_failures(report, settings, json.loads(COUNTS.read_text()))
        print(*failures, sep="\n", end="\n" * bool(failures), file=sys.stderr)
        return int(bool(failures))
    print_report(report, settings)
    return 0


if __name__ == "__main__":
    sys.exit(main())
