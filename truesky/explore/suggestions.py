"""Suggest names of tables and columns for names in a query that do not exist.

A table of synonyms contains the names that other catalogues use, such as `redshift` for `z_obs` and `z_true`. Names of
passbands, such as `mag_vis`, lead to columns of fluxes. For all other names, the most similar names are suggested.
Other messages of DuckDB become plain sentences.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from lake_schema import tables as declarations
from lake_schema.texts import spelling
from lake_schema.texts.synonyms import Synonym, load_synonyms

# Messages of DuckDB about a column that does not exist. The named group is the name of the column.
_MISSING_COLUMN = (
    re.compile(r'Referenced column "(?P<name>.+?)" (?:was )?not found'),
    re.compile(r'does not have a column named "(?P<name>.+?)"'),
    re.compile(r'Column "(?P<name>.+?)" does not exist on \w+ side of join'),
    re.compile(r'Column "(?P<name>.+?)" in \w+ list not found'),
)
_QUOTED = re.compile(r'"([^"]+)"')
# Words before the list of all columns in a message.
LIST = "; use one of "
# Largest number of suggestions in a message.
_MAX_SUGGESTIONS = 3
# Smallest similarity of two names, as `difflib` measures it, from 0 to 1.
_MIN_SIMILARITY = 0.6
# The same for names of fluxes and magnitudes in a band: mag_r1 is mag_r01, but mag_g is not mag_h.
_MIN_BAND_SIMILARITY = 0.85
# The same for misspelt synonyms: redshfit is redshift, but high is not ha.
_MIN_SYNONYM_SIMILARITY = 0.8
# Parts of the name of a flux or magnitude that do not belong to the name of its passband. Names without an
# underscore belong to common filters, such as "gmag".
_FILTER = "[ubvgrizyjhkw]"
_FLUX_NAME = re.compile(
    r"^(?:f_nu|flux|magnitude|mag|f|m|ab_mag)_|_(?:mag|flux|magnitude|ab)$"
    rf"|(?:(?<=^{_FILTER})|(?<=^vis))(?:mag|flux)$|^(?:mag|flux)(?={_FILTER}$|vis$)"
)
_BAND_PREFIX = "f_nu_"
# Beginnings of the names of passbands.
_SURVEY = "bessell|cfis|des|euclid|gaia|hsc|jedis|lsst|lsst2016|nisp|ps1|sdss|twomass"
# Names of fluxes and magnitudes in a band, such as "f_nu_lsst_i", "lsst_i_flux" or "lsst_i".
_IN_BAND = re.compile(
    rf"^(?:f_nu|flux|mag|magnitude|{_SURVEY})_\w|\w_(?:flux|mag)$"
    rf"|^(?:{_FILTER}|vis)(?:mag|flux)$|^(?:mag|flux)(?:{_FILTER}|vis)$"
)
# End of a message: "LINE 1: SELECT ... " and a line with carets below the wrong word.
_EXTRACT = re.compile(r"\s*\n(?P<line>LINE \d+: [^\n]*)\n(?P<blanks> *)(?P<carets>\^+)\s*\Z")
_ERROR_CLASS = re.compile(r"\A(?:[A-Z][\w-]* ?){1,4}Error: ")
_AMBIGUOUS = re.compile(r'Ambiguous reference to column name "(?P<name>.+?)" \(use: (?P<names>.*?)\)', re.DOTALL)
_UNKNOWN_FUNCTION = re.compile(
    r'Function with name (?P<name>.+?) does not exist!(?:\s*Did you mean "(?P<other>.+?)"\?)?'
)
# Angle in hours or degrees, minutes and seconds: its sign and three numbers.
_SEXAGESIMAL = re.compile(r"([-+]?)(\d{1,3})\s*[:hd°\s]\s*(\d{1,2})(?:\s*[:m'\s]\s*(\d{1,2}(?:\.\d*)?)\s*[s\"]?)?")
_REFUSED_TEXT = r"Could not convert string '([^\n]*?)' to (?:FLOAT|DOUBLE|U?INT\d*|DECIMAL\S*)"
# Words that begin the parts of a query.
_KEYWORDS = ("SELECT", "FROM", "WHERE", "GROUP", "HAVING", "ORDER", "LIMIT", "JOIN", "DISTINCT")
# Words and signs that follow a condition, and words and signs that must come before a condition or a value.
_AFTER_CONDITION = ("AND", "OR", "ORDER", "GROUP", "HAVING", "LIMIT", "QUALIFY", "UNION", "WHERE", ")")
_BEFORE_CONDITION = re.compile(
    r"(?P<value>\bBETWEEN\s+\S+\s+)?(?P<word>\b(?:WHERE|AND|OR|NOT|HAVING|ON|QUALIFY)|[<>=]+)\s*\Z", re.IGNORECASE
)
# Functions of DuckDB for names that users know from other languages.
_FUNCTIONS = {"average": "avg", "mean": "avg", "std": "stddev", "stdev": "stddev", "len": "count"}
# Example of a condition for a circle.
CIRCLE = "separation(ra, dec, RA, DEC) < RADIUS (deg)"
# Messages of DuckDB, as patterns that match the beginning, and sentences that replace them.
_SENTENCES = (
    (
        r'column "(.+?)" must appear in the GROUP BY clause',
        r"column \1 must be in GROUP BY, or in an aggregate function such as any_value(\1)",
    ),
    (
        r"WHERE clause cannot contain aggregates",
        "WHERE cannot contain aggregate functions such as count: write this condition in HAVING, after GROUP BY",
    ),
    (r'Ambiguous reference to table "(.+?)"', r"FROM has \1 twice: give each table another alias, such as AS a"),
    (
        r"WHERE clause cannot contain window functions",
        "WHERE cannot contain window functions: write this condition in QUALIFY, after WHERE and GROUP BY",
    ),
    (
        _REFUSED_TEXT.replace(r"([^\n]*?)", r"([-+]?[\d.]+) ?([^\d\n]+?)"),
        r"'\1 \2' is text where a number is required: write \1, in the unit of the column",
    ),
    (
        _REFUSED_TEXT,
        r"'\1' is text where a number is required",
    ),
    (
        r"\* expression without FROM clause",
        "FROM is missing before the name of the table: SELECT * FROM galaxies",
    ),
    (r'Referenced table "(.+?)" not found!\s*Candidate tables: ([^\n]*)', r"FROM has no table or alias \1; it has \2"),
    (r"Cannot compare values of type (\S+) and type (\S+)", r"values of type \1 and \2 cannot be compared"),
    (
        r"No function matches the given name and argument types '(max|min)\([^)]*,.*",
        r"\1 accepts one column: the larger of two is greatest(a, b), the smaller is least(a, b)",
    ),
    (
        # The function has only one form.
        r"No function matches the given name and argument types '(.+?)\((.*?)\)'.*"
        r"Candidate functions:\s*(\S[^\n]*?\)) -> \S+\s*\Z",
        r"\1 does not accept arguments of type \2; write \3",
    ),
    (
        r"No function matches the given name and argument types '(.+?)\((.*?)\)'",
        r"\1 does not accept arguments of type \2",
    ),
    (
        r'Macro "?in_area[^\n]* does not support the supplied arguments',
        f"in_area(ra, dec) selects the area of the request; for a circle write {CIRCLE}",
    ),
    (r'Macro "?(\w+)[^\n]* does not support the supplied arguments.*Candidate macros:\s*([^\n]*)', r"write \2 for \1"),
)
# Largest number of characters of the wrong word.
_MAX_WORD = 60
_NO_ALIASES: Mapping[str, str] = {}


def missing_column(message: str) -> str | None:
    """Return the name of the column that does not exist according to a message of DuckDB, in lower case, else None."""
    matches = (pattern.search(message) for pattern in _MISSING_COLUMN)
    return next((match["name"].lower() for match in matches if match), None)


def missing_entry(message: str) -> str | None:
    """Return the table or alias that FROM does not have according to a message of DuckDB, else None."""
    match = re.search(r'Referenced table "(.+?)" not found', message)
    return match[1] if match else None


def refused_text(message: str) -> str | None:
    """Return the text in a query that a message of DuckDB refuses because a number is required, else None."""
    match = re.search(_REFUSED_TEXT, message)
    return match[1] if match else None


@dataclass(frozen=True, slots=True)
class MissingColumns:
    """Messages about the columns of a query that do not exist.

    Attributes
    ----------
    entries : mapping of str to (str, collection of str or None)
        Entries of FROM by name or alias: the table of the lake, "" for a subquery, and the columns, None if unknown.
    columns : mapping of str to collection of str
        Columns of each table that the query reads.
    other_tables : mapping of str to collection of str
        Columns of the other tables of the lake that may be suggested.
    message : str
        Message of DuckDB.
    """

    entries: Mapping[str, tuple[str, Collection[str] | None]]
    columns: Mapping[str, Collection[str]]
    other_tables: Mapping[str, Collection[str]]
    message: str

    def explain(self, name: str, entry: str) -> str:
        """Return a message about a column that an entry of FROM does not have; `entry` is "" if none is named."""
        aliases = self._aliases()
        if not entry:
            return explain_missing_column(name, self.columns, self.other_tables, self.message, aliases)
        table, names = self.entries[entry]
        if table:
            columns, other_tables = {table: self.columns[table]}, {**self.columns, **self.other_tables}
            of_query = {other: columns for other, columns in self.columns.items() if _targets(name, {other: columns})}
            return explain_missing_column(name, columns, of_query or other_tables, "", aliases, entry)
        existing = names or ()
        columns = {
            table: [column for column in all_names if column in existing] for table, all_names in self.columns.items()
        }
        return explain_missing_column(name, {**columns, "": existing}, {}, "", aliases, entry)

    def _aliases(self) -> dict[str, str]:
        """Return the first name that the query gives to each table."""
        return {table: alias for alias, (table, _) in reversed([*self.entries.items()]) if table}

    def explain_entries(self, references: Sequence[tuple[str, str]]) -> Iterator[str]:
        """Yield messages about references such as ("f", "id"), which stands for f.id, if FROM has no entry f."""
        aliases = self._aliases()
        listed = [alias if table in (alias, "") else f"{alias} ({table})" for alias, (table, _) in self.entries.items()]
        for entry, column in references:
            if entry in aliases:
                yield f"table {entry} has the alias {aliases[entry]} in this query: write {aliases[entry]}.{column}"
        if unknown := dict.fromkeys(entry for entry, _ in references if entry not in aliases):
            targets = [
                Synonym(entry, name, "") for entry, name in references if name in self.other_tables.get(entry, ())
            ]
            hint = _join_hint(targets, self.columns, self.other_tables) if len(targets) == len(unknown) else ""
            noun = f"table or alias {spelling.join_words([*unknown])}"
            yield f"FROM has no {noun}; it has {spelling.join_words(listed, 'and')}{hint}"


def explain_missing_column(
    name: str,
    columns: Mapping[str, Collection[str]],
    other_tables: Mapping[str, Collection[str]],
    message: str = "",
    aliases: Mapping[str, str] = _NO_ALIASES,
    entry: str = "",
) -> str:
    """Return a message about a column that does not exist, with the columns that can be used in its place.

    Parameters
    ----------
    name : str
        Name of the column in lower case.
    columns : mapping of str to collection of str
        Columns of each table that the query reads, or of the table of `entry`.
    other_tables : mapping of str to collection of str
        Columns of the other tables of the query and of the lake. A table may be suggested if it shares an identifier
        with a table of the query.
    message : str, optional
        Message of DuckDB about the column, which contains the names of columns of subqueries.
    aliases : mapping of str to str, optional
        Names that the query gives to tables.
    entry : str, optional
        Name of the entry of FROM before the column: "f" for f.galaxy_id.

    Returns
    -------
    str
        The message, one line.
    """
    qualifier = f"{entry}." if entry else ""
    problem = f"column {qualifier}{name} does not exist"
    keys = {column for names in columns.values() for column in names if column.endswith("id")}
    related = {table: names for table, names in other_tables.items() if table in aliases or keys & {*names}}
    prefixes = {table: f"{aliases.get(table, table)}." for table in (*columns, *other_tables)}
    if entry or len(columns) == 1:
        prefixes |= dict.fromkeys(columns, qualifier)
    if targets := _targets(name, columns):
        return f"{problem}; use {_as_text(targets, prefixes)}"
    if targets := _targets(name, related):
        hint = "" if {target.table for target in targets} & {*aliases} else _join_hint(targets, columns, other_tables)
        return f"{problem}; use {_as_text(targets, prefixes)}{hint}"
    # Names of columns of subqueries are in the message only.
    candidates = _QUOTED.findall(message.partition("Candidate bindings")[2].partition("LINE")[0])
    names = [*dict.fromkeys(column for table in columns.values() for column in table)]
    similar = _similar(name, [*candidates, *names])
    if not similar and (bands := _bands_for(name, columns) or _bands_for(name, other_tables)):
        listed = spelling.join_words(bands, "and")
        return f"{problem}: the lake has fluxes only in {listed}; fluxes.bands in the request adds other bands"
    if similar:
        return f"{problem}; did you mean {' or '.join(qualifier + other for other in similar)}?"
    for synonym in difflib.get_close_matches(name, load_synonyms(), _MAX_SUGGESTIONS, _MIN_SYNONYM_SIMILARITY):
        if targets := _targets(synonym, columns):
            return f"{problem}; use {_as_text(targets, prefixes)}"
    quotes = "" if entry else "; a text must be in single quotes"
    return f"{problem}{LIST}{', '.join(names)}{quotes}"


def _join_hint(
    targets: Sequence[Synonym], columns: Mapping[str, Collection[str]], other_tables: Mapping[str, Collection[str]]
) -> str:
    """Return the JOIN that a query needs for columns of one other table, "" for several tables or without an id."""
    tables = {target.table for target in targets}
    if len(tables) > 1 or not all("id" in names for names in columns.values()):
        return ""
    (table,) = tables
    return f"; add JOIN {table} USING (id)" if "id" in other_tables[table] else ""


def suggest_tables(name: str, table_names: Collection[str]) -> Sequence[str]:
    """Return the tables of a lake that can be meant by a name that is not a table; at most three, perhaps none.

    Parameters
    ----------
    name : str
        Name of the table in the query, perhaps with the name of a request before it: "demo.galaxy".
    table_names : collection of str
        Names of the lake's tables.

    Returns
    -------
    sequence of str
        Names of tables of the lake.
    """
    request, dot, table = name.rpartition(".")
    meant = dict.fromkeys(synonym.table for synonym in load_synonyms().get(table, ()) if not synonym.column)
    existing = [request + dot + target for target in meant if request + dot + target in table_names]
    return existing[:_MAX_SUGGESTIONS] or _similar(name, sorted(table_names))


def _targets(name: str, tables: Mapping[str, Collection[str]]) -> Sequence[Synonym]:
    """Return the columns of tables that a name can mean, by the name itself, a synonym or a passband."""
    targets: dict[tuple[str, str], Synonym] = {}
    for table, columns in tables.items():
        plain_name = table.rpartition(".")[2]
        meant = [synonym for synonym in load_synonyms().get(name, ()) if synonym.table == plain_name]
        for synonym in (*meant, *_same_name(name, plain_name, columns), *_band_columns(name, plain_name, columns)):
            if synonym.column in columns:
                targets.setdefault((synonym.table, synonym.column), Synonym(table, synonym.column, synonym.meaning))
    return list(targets.values())[:_MAX_SUGGESTIONS]


def _same_name(name: str, table: str, columns: Collection[str]) -> Iterator[Synonym]:
    declaration = declarations.find_table(table, list(columns))
    if name in columns and declaration is not None and name in declaration.names:
        yield Synonym(table, name, declaration.column(name).doc)


def _band_columns(name: str, table: str, columns: Collection[str]) -> Iterator[Synonym]:
    """Yield the columns f_nu_<band> of the passbands that a name such as "vis", "mag_r" or "lsst_r_flux" can mean."""
    band = _FLUX_NAME.sub("", name)
    for column in columns:
        if column.startswith(_BAND_PREFIX):
            full_name = column.removeprefix(_BAND_PREFIX)
            if band == full_name or full_name.endswith(f"_{band}"):
                yield Synonym(table, column, f"flux density, microjansky; mag_ab({column}) is its AB magnitude")


def _bands_for(name: str, tables: Mapping[str, Collection[str]]) -> list[str]:
    """Return the bands of the fluxes in tables if a name means a flux or magnitude in a band, else []."""
    columns = dict.fromkeys(column for names in tables.values() for column in names if column.startswith(_BAND_PREFIX))
    return [column.removeprefix(_BAND_PREFIX) for column in columns] if _IN_BAND.search(name) else []


def _similar(name: str, names: Sequence[str]) -> list[str]:
    """Return the most similar names, but no flux or magnitude in another band."""
    min_similarity = _MIN_BAND_SIMILARITY if _IN_BAND.search(name) else _MIN_SIMILARITY
    if _IN_BAND.search(name):
        band = _FLUX_NAME.sub("", name)
        if same := [other for other in names if _IN_BAND.search(other) and _FLUX_NAME.sub("", other) == band]:
            return list(dict.fromkeys(same))
    similar = difflib.get_close_matches(name, dict.fromkeys(names), _MAX_SUGGESTIONS, min_similarity)
    return [
        other
        for other in similar
        if not other.startswith(_BAND_PREFIX) or name.endswith(other.removeprefix(_BAND_PREFIX))
    ]


def _as_text(targets: Sequence[Synonym], prefixes: Mapping[str, str]) -> str:
    return " or ".join(f"{prefixes[target.table]}{target.column} ({target.meaning})" for target in targets)


def plain_message(message: str, query: str = "") -> str:
    """Return a message of DuckDB as one plain sentence; a message of another origin changes little or not at all.

    Parameters
    ----------
    message : str
        The message, perhaps with an extract of the query that has carets below the wrong word.
    query : str, optional
        Query to which the message refers. Without it, only the line in the message is known.

    Returns
    -------
    str
        The sentence. The wrong word of the query is at its end if the message does not contain it.
    """
    extract = _EXTRACT.search(message)
    body = _ERROR_CLASS.sub("", message[: extract.start()] if extract else message)
    if unknown := _UNKNOWN_FUNCTION.search(body):
        same = _FUNCTIONS.get(unknown["name"].lower())
        question = (
            f"did you mean {same}?"
            if same
            else spelling.did_you_mean(unknown["name"], filter(None, [unknown["other"]]))
        )
        return f"function {unknown['name']} does not exist{question and f'; {question}'}"
    if ambiguous := _AMBIGUOUS.match(body):
        names = ambiguous["names"].replace('"', "").replace("'", "")
        return f"several tables have a column {ambiguous['name']}: write {names} in place of {ambiguous['name']}"
    if syntax := re.match(r'syntax error at or near "(.+?)"', body):
        hint = _missing_condition(syntax[1], extract, query) or _syntax_hint(syntax[1], extract)
        return f"syntax error near {syntax[1]}: {hint}"
    if valueless := re.match(r"Values were not provided for the following parameters: ([^\n]*)", body):
        values = ", ".join(f"{name.strip()}=..." for name in valueless[1].split(","))
        return f"these parameters have no value: {valueless[1]}; in Python write lake.sql(query, {values})"
    for pattern, sentence in _SENTENCES:
        if match := re.match(pattern, body, re.DOTALL):
            return match.expand(sentence).replace("_LITERAL", "").replace('"', "").strip()
    word = _wrong_word(extract) if extract else ""
    place = f" (near {word})" if word and word not in body else ""
    return body.strip().rstrip("!") + place


def explain_code(column: str, sign: str, text: str, codes: str) -> str:
    """Return a message about a text that is compared with a column of numeric codes.

    Parameters
    ----------
    column : str
        Name of the column.
    sign : str
        Sign of the comparison, "=" or "<>"; "" for another comparison.
    text : str
        The text in the query.
    codes : str
        Codes and their meanings, such as "0 central galaxy; 1 satellite galaxy".

    Returns
    -------
    str
        The message, with the code whose meaning is most similar to the text.
    """
    numbers = {meaning: code for code, _, meaning in (entry.partition(" ") for entry in codes.split("; "))}
    meant = spelling.closest_names(text, numbers, 1)
    number = numbers[meant[0]] if meant else "one of these numbers"
    remedy = f"{column} {sign} {number}" if meant and sign else f"{number} in place of '{text}'"
    return f"column {column} contains numbers ({codes}): write {remedy}"


def explain_angle(column: str, text: str) -> str:
    """Return a message about a text such as '53:00:00' that is compared with a column in deg, "" for other texts."""
    match = _SEXAGESIMAL.fullmatch(text.strip())
    if match is None:
        return ""
    size = sum(float(part or 0.0) / 60.0**power for power, part in enumerate(match.groups()[1:]))
    problem = f"column {column} is in deg: write"
    if column.startswith("ra") and size < 24.0:
        return f"{problem} {15.0 * size:.7g} in place of '{text}', if this is in hours"
    return f"{problem} {match[1] if match[1] == '-' else ''}{size:.7g} in place of '{text}'"


def _missing_condition(word: str, extract: re.Match[str] | None, query: str) -> str:
    """Return a message that a condition is missing between a word of a query and the word before it, or ""."""
    if extract is None or word.upper() not in _AFTER_CONDITION:
        return ""
    number = int(re.sub(r"\D", "", extract["line"].partition(":")[0]))
    lines = [*query.splitlines()[: number - 1], extract["line"][: len(extract["blanks"])].partition(": ")[2]]
    match = _BEFORE_CONDITION.search(" ".join(lines))
    if match is None:
        return ""
    previous = match["word"].upper()
    missing = "a value" if match["value"] or previous[0] in "<>=" else "a condition"
    following = f"{word.upper()} BY" if word.upper() in ("ORDER", "GROUP") else word.upper()
    return f"{missing} is missing between {previous} and {following}"


def _syntax_hint(word: str, extract: re.Match[str] | None) -> str:
    """Return a remedy for a syntax error near a word of a query."""
    words = re.findall(r"[A-Za-z_]+", extract["line"].partition(": ")[2]) if extract else [word]
    for other in (word, *words):
        similar = spelling.closest_names(other, _KEYWORDS, 1)
        if similar and other.upper() not in _KEYWORDS:
            return f"did you mean {similar[0]} for {other}?"
    keywords = {other.upper() for other in words}
    if "BETWEEN" in keywords and word.upper() in ("TO", ","):
        return "write BETWEEN 1 AND 2"
    if word[0] in "<>=" and keywords & {"AND", "OR"}:
        return "write the column in each comparison, such as z_obs > 1 AND z_obs < 2"
    if word == "," and extract and re.search(r"\d,\d", extract["line"][len(extract["blanks"]) - 1 :][:3]):
        return "write a decimal point in place of the comma"
    if (ordering := keywords & {"ORDER", "GROUP"}) and "BY" not in keywords:
        return f"write {' and '.join(f'{other} BY' for other in sorted(ordering))}"
    if word.startswith("'") and "IS" in keywords:
        return f"write = {word} in place of IS {word}"
    if word.upper() == "WHERE" and keywords & {"GROUP", "ORDER", "LIMIT"}:
        return "WHERE comes before GROUP BY, ORDER BY and LIMIT"
    if word == ":":
        return "write positions in degrees, such as -27.8"
    if "JOIN" in keywords and not keywords & {"ON", "USING"}:
        return "JOIN must have ON or USING, such as JOIN galaxy_fluxes USING (id)"
    if extract and extract["line"].endswith(word, len(extract["blanks"])):
        return f"something is missing after {word}"
    return "columns are separated by commas, text is in single quotes, and every bracket must be closed"


def _wrong_word(extract: re.Match[str]) -> str:
    start = len(extract["blanks"])
    return extract["line"][start : start + len(extract["carets"])].strip()[:_MAX_WORD]
