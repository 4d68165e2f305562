"""Turn error messages of DuckDB into one sentence, without names of error classes and extracts of the query."""

from __future__ import annotations

import re

from lake_schema.texts import spelling

# End of a message: "LINE 1: SELECT ... " and a line with carets below the wrong word.
_EXTRACT = re.compile(r"\s*\n(?P<line>LINE \d+: [^\n]*)\n(?P<blanks> *)(?P<carets>\^+)\s*\Z")
_ERROR_CLASS = re.compile(r"\A(?:[A-Z][\w-]* ?){1,4}Error: ")
_UNKNOWN_FUNCTION = re.compile(
    r'Function with name (?P<name>.+?) does not exist!(?:\s*Did you mean "(?P<other>.+?)"\?)?'
)
# Messages of DuckDB, as patterns that match the beginning, and sentences that replace them.
_SENTENCES = (
    (
        r'column "(.+?)" must appear in the GROUP BY clause',
        r"column \1 must be in GROUP BY, or in an aggregate function such as any_value(\1)",
    ),
    (
        r"WHERE clause cannot contain aggregates",
        "WHERE cannot contain aggregate functions such as avg: write this condition in HAVING, after GROUP BY",
    ),
    (
        r"WHERE clause cannot contain window functions",
        "WHERE cannot contain window functions: write this condition in QUALIFY, after WHERE and GROUP BY",
    ),
    (
        r"Could not convert string '([^\n]*?)' to (?:FLOAT|DOUBLE|U?INT\d*|DECIMAL\S*)",
        r"'\1' is text where a number is required",
    ),
    (r'Referenced table "(.+?)" not found!\s*Candidate tables: ([^\n]*)', r"FROM has no table or alias \1; it has \2"),
    (
        r"No function matches the given name and argument types '(.+?)\((.*?)\)'",
        r"\1 does not accept arguments of type \2",
    ),
    (r'Macro "?(\w+)[^\n]* does not support the supplied arguments.*Candidate macros:\s*([^\n]*)', r"write \2 for \1"),
    (r'syntax error at or near "(.+?)"', r"syntax error near \1"),
)
# Largest number of characters of the wrong word.
_MAX_WORD = 60


def plain_message(message: str) -> str:
    """Return a message of DuckDB as one plain sentence; a message of another origin changes little or not at all.

    Parameters
    ----------
    message : str
        The message, perhaps with an extract of the query that has carets below the wrong word.

    Returns
    -------
    str
        The sentence. The wrong word of the query is at its end if the message does not contain it.
    """
    extract = _EXTRACT.search(message)
    body = _ERROR_CLASS.sub("", message[: extract.start()] if extract else message)
    if unknown := _UNKNOWN_FUNCTION.search(body):
        question = spelling.did_you_mean(unknown["name"], filter(None, [unknown["other"]]))
        return f"function {unknown['name']} does not exist{question and f'; {question}'}"
    for pattern, sentence in _SENTENCES:
        if match := re.match(pattern, body, re.DOTALL):
            return match.expand(sentence).replace("_LITERAL", "").replace('"', "").strip()
    word = _wrong_word(extract) if extract else ""
    place = f" (near {word})" if word and word not in body else ""
    return body.strip().rstrip("!") + place


def _wrong_word(extract: re.Match[str]) -> str:
    start = len(extract["blanks"])
    return extract["line"][start : start + len(extract["carets"])].strip()[:_MAX_WORD]
