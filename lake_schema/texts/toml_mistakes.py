"""Explain syntax errors of TOML files in plain words, with the line and its text."""

from __future__ import annotations

import re
from collections.abc import Sequence

# Place at the end of an error message of tomllib.
_PLACE = re.compile(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
# Largest number of characters of a line in a message.
_MAX_LINE_LENGTH = 120
# Words of other languages for values of TOML, in lower case.
_VALUES = {
    "true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false",
    "none": "", "null": "", "nil": "",
}  # fmt: skip
_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]]+?)\s*\]")
# Beginnings of messages of tomllib about a missing quote, with the quote.
_MISSING_QUOTES = (
    ("Illegal character '\\n'", '"'), ("Unterminated", '"'), ("Expected \"'\"", "'"), ("Expected '\"'", '"'),
)  # fmt: skip
_NAME_RULE = "a key has only letters, digits, _ and -, or is in quotes"


def explain(source: str, error: ValueError) -> str:
    """Return the message of an error of tomllib with an explanation, the number of the line, and its text.

    Parameters
    ----------
    source : str
        The TOML text.
    error : ValueError
        Error of tomllib, or another error, whose message is returned unchanged.

    Returns
    -------
    str
        Text such as "line 19: write false, in small letters and without quotes (the line is: short = False)".
    """
    match = _PLACE.fullmatch(str(error))
    if match is None:
        return " ".join(str(error).split())
    lines = source.split("\n")
    if match[2]:
        number, column = int(match[2]), int(match[3])
    else:
        # The error is at the end of the document: the last line that is not empty ends there.
        number = max((i for i, line in enumerate(lines, start=1) if line.strip()), default=1)
        column = len(lines[number - 1]) + 1
    problem, number = _explain(match[1], lines, number, column)
    place = f"line {number}" if problem else f"line {number}, column {column}"
    line = lines[number - 1].strip()
    excerpt = line if len(line) <= _MAX_LINE_LENGTH else f"{line[: _MAX_LINE_LENGTH - 3]}..."
    return f"{place}: {problem or ' '.join(match[1].split())} (the line is: {excerpt})"


def _explain(message: str, lines: Sequence[str], number: int, column: int) -> tuple[str, int]:
    """Return an explanation of tomllib's message, or "", and the number of the line with the mistake."""
    line = lines[number - 1]
    head, rest = line[: column - 1], line[column - 1 :]
    if message.startswith(("Cannot", "Duplicate")):
        return _explain_repeated(message, lines, number)
    if message == "Unclosed array" and (not rest.strip("# ") or re.match(r"\s*([\w.\"-]+\s*=|\[)", rest)):
        opening = next((n for n in range(number, 0, -1) if lines[n - 1].count("[") > lines[n - 1].count("]")), number)
        return "the bracket [ is not closed by ]", opening
    if mark := next((mark for start, mark in _MISSING_QUOTES if message.startswith(start)), ""):
        quoted = (n for n in range(1, number + 1) if lines[n - 1].partition("#")[0].count(mark) % 2)
        return f"the quote {mark} is not closed", next(quoted, number) if rest == "" else number
    return _explain_line(message, head, rest), number


def _explain_line(message: str, head: str, rest: str) -> str:
    """Return an explanation of a mistake between the texts `head` and `rest` of a line, or ""."""
    match = re.match(r"[^\s,\]}#=]*", rest.lstrip())
    word = match[0] if match is not None else ""
    if comma := re.search(r"([-+]?\d+),(\d+)\s*$", head) or re.search(r"([-+]?\d+)(?=$)", head):
        fraction = comma[2] if comma.lastindex == 2 else (re.match(r",(\d+)", rest) or ["", ""])[1]
        if fraction:
            return f"write a decimal point in place of the comma, {comma[1]}.{fraction}"
    if message == "Invalid value":
        return _explain_value(rest)
    if message.startswith("Expected newline"):
        return _explain_rest(head, rest, word)
    if message.startswith("Expected '='"):
        if rest.lstrip().startswith(":"):
            return "write an equals sign in place of the colon, key = value"
        return f"an equals sign is missing, key = value ({_NAME_RULE})"
    if message.startswith("Unclosed"):
        if (start := re.search(r"[\w.]+$", head)) and re.match(r"[-_\w]", rest):
            return f'write text in quotes, "{start[0]}{word}"'
        if word:
            return f"a comma is missing before {word}"
        return "a table { .. } must end with } on the same line"
    if message.startswith("Expected ']"):
        return f"{message.partition(chr(39))[2].partition(chr(39))[0]} is missing after the name of the section"
    if message.startswith("Invalid initial character"):
        if rest.startswith("}"):
            return "remove the comma before }"
        return _NAME_RULE if word else "a table { .. } must end with } on the same line"
    if message == "Invalid statement":
        return "the key before the equals sign is missing" if rest.startswith("=") else _NAME_RULE
    if message.startswith("Unescaped"):
        return r"write \\ for \ between double quotes, or put the text in single quotes"
    return "there is no such date or time" if message.startswith("Invalid date") else ""


def _explain_value(rest: str) -> str:
    value = re.match(r"[^,\]}#]*", rest)
    text = value[0].strip() if value is not None else ""
    if not text:
        return "the value after the equals sign is missing"
    if text.lower() in _VALUES:
        replacement = _VALUES[text.lower()]
        return (
            f"write {replacement}, in small letters and without quotes" if replacement else "remove a key without value"
        )
    if text[0] in "\u201c\u201d\u201e\u2018\u2019\u00ab\u00bb":
        return "write straight quotes"
    if re.fullmatch(r"[-+]?\.\d+", text):
        return f"write a digit before the decimal point, {text.replace('.', '0.', 1)}"
    if text.startswith("="):
        return "write only one equals sign"
    return f'write text in quotes, "{text[:60]}"' if re.match(r"[\w~/.]", text) else ""


def _explain_rest(head: str, rest: str, word: str) -> str:
    """Return an explanation of a text `rest` that follows a complete value, or ""."""
    if rest.startswith((",", ";")):
        return "write each key = value in a line of its own"
    if rest.startswith(("]", "}")):
        return f"there is no open bracket for {rest[0]}"
    if re.search(r"\d$", head) and re.fullmatch(r"\.\s*(#.*)?", rest):
        return "write a digit after the decimal point"
    if re.search(r"=\s*[-+]?0$", head) and word.isdigit():
        return "a number must not begin with 0"
    if re.search(r"\d\s*$", head):
        return f"write a number without {word}, or text in quotes"
    return f"there is text after the value, {rest.strip()[:60]}"


def _explain_repeated(message: str, lines: Sequence[str], number: int) -> tuple[str, int]:
    """Return which key or section is given twice, and in which line it is first, if this is known.

    Return also the number of the line with the mistake.
    """
    line = lines[number - 1]
    if header := _HEADER.match(line):
        name = f"{header[1]}{header[2]}{']' * len(header[1])}"
        earlier = [n for n in range(1, number) if (m := _HEADER.match(lines[n - 1])) and m[2] == header[2]]
        single = [n for n in (*earlier, number) if "[[" not in lines[n - 1]]
        if earlier and 0 < len(single) <= len(earlier):
            return f"write [[{header[2]}]] in place of [{header[2]}] for a list of tables", single[0]
        return f"{name} is given twice{_first_line(earlier)}: give its keys once, in one place", number
    if message.startswith("Duplicate"):
        return f"{message.removeprefix('Duplicate inline table key ').strip(chr(39))} is given twice", number
    key = line.partition("=")[0].strip()
    first = max((n for n in range(1, number) if _HEADER.match(lines[n - 1])), default=0)
    section = _HEADER.match(lines[first - 1]) if first else None
    earlier = [n for n in range(first + 1, number) if lines[n - 1].partition("=")[0].strip() == key]
    return f"{section[2] + '.' if section else ''}{key} is given twice{_first_line(earlier)}", number


def _first_line(earlier: Sequence[int]) -> str:
    return f", first in line {earlier[0]}" if earlier else ""
