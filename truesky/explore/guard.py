"""Check that the SQL of a user is a single SELECT that reads only tables of the lake.

Queries must not read files or settings, call functions that change the session, or change data. DuckDB parses the text
into the syntax tree that it would run. The tree is checked and not the text, so a trick in the text cannot hide
anything.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import duckdb

from lake_schema import tables as declarations
from lake_schema.errors import BadInput
from truesky.explore.suggestions import CIRCLE, plain_message, suggest_tables

# Largest number of characters of a query.
_MAX_CHARACTERS = 100_000
TOO_LARGE = "SQL: the query or its result needs more memory than its limit: ask for less"
# Longer messages of DuckDB are cut at this number of characters.
_MAX_LENGTH = 500
_QUERIES = {"SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE"}
_SOURCES = {"BASE_TABLE", "JOIN", "SUBQUERY", "EMPTY", "EXPRESSION_LIST", "TABLE_FUNCTION"}
_TABLE_FUNCTIONS = {"range", "generate_series", "unnest"}
# Functions that a query must not call: they read or change settings of the session, wait, or run a text as SQL.
# json_serialize_plan binds and optimizes a text, so its plan contains the values of settings.
_FUNCTIONS = {
    "current_query", "current_setting", "currval", "format_type", "get_block_size", "getenv", "getvariable", "nextval",
    "query", "query_table", "setseed", "setval", "sleep_ms", "write_log",
}  # fmt: skip
_FUNCTION_PREFIXES = ("pg_", "duckdb_", "read_", "json_execute", "json_serialize", "json_deserialize")
# Functions of ADQL for geometry, which the TAP service translates. DuckDB has none with these names.
_GEOMETRY = {"area", "box", "centroid", "circle", "coord1", "coord2", "distance", "intersects", "point", "polygon"}
# Functions of ADQL and other databases that make a point or a circle from numbers.
_POINTS = {"circle", "point", "st_makepoint", "st_point"}
# Functions of other databases: distances between two positions, conditions that a distance is below a radius (deg),
# names that users try for such conditions, table functions with a position and a radius (arcmin), and percentiles.
_DISTANCES = {
    "angdist", "angsep", "angular_distance", "angular_separation", "angulardistance", "greatcircleangle", "q3c_dist",
    "sphdist", "sphere_distance", "st_distance", "st_distancesphere", "st_distance_sphere",
}  # fmt: skip
_IN_CIRCLE = {"q3c_join", "q3c_radial_query", "st_dwithin"}
_CONES = {"cone", "cone_search", "conesearch", "in_circle", "in_cone"}
_AROUND = {"fgetnearbyobjalleq", "fgetnearbyobjeq", "fgetnearestobjalleq", "fgetnearestobjeq"}
_PERCENTILES = {"approx_percentile", "percentile", "percentile_approx"}
# TOP of ADQL, which DuckDB cannot parse.
_TOP = re.compile(r"\bSELECT\s+(?:(?:DISTINCT|ALL)\s+)?TOP\s+(\d+)\b", re.IGNORECASE)

# Quantity and relative size of units that a user may write after a number; " is arcsec.
_UNITS = {
    "deg": ("angle", 3600.0), "degree": ("angle", 3600.0), "degrees": ("angle", 3600.0), "arcmin": ("angle", 60.0),
    "arcsec": ("angle", 1.0), "arcseconds": ("angle", 1.0), "as": ("angle", 1.0), '"': ("angle", 1.0),
    "mas": ("angle", 1e-3), "pc": ("distance", 1.0), "kpc": ("distance", 1e3), "mpc": ("distance", 1e6),
    "ujy": ("flux", 1.0), "njy": ("flux", 1e-3), "jy": ("flux", 1e6), "mag": ("magnitude", 1.0),
    "s": ("time", 1.0), "sec": ("time", 1.0), "min": ("time", 60.0), "h": ("time", 3600.0), "d": ("time", 86400.0),
    "k": ("temperature", 1.0), "um": ("length", 1e4), "nm": ("length", 10.0), "angstrom": ("length", 1.0),
    "pix": ("pixels", 1.0), "pixel": ("pixels", 1.0), "pixels": ("pixels", 1.0),
}  # fmt: skip
# A comparison of a column or function with a number that has a unit; {} is the unit.
_WITH_UNIT = (
    r"(?P<name>[\w.]+)\s*(?:\((?:[^()]|\([^()]*\))*\)\s*)?(?:<>|!=|[<>]=?|=|between\b|between\s+\S+\s+and\b)\s*"
    r"(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*{}(?!\w)"
)

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Origins:
    """Set of the names of result columns that are unchanged copies of a table's column with the same name.

    Such columns keep the unit and the description of the table's column. Names are in lower case.

    Attributes
    ----------
    names : frozenset of str, optional
        Names of unchanged columns. None means that every column of a table is unchanged, as after SELECT *.
    other : frozenset of str
        Names that a computed or renamed column has; they are not in the set, even if they are in `names`.
    """

    names: frozenset[str] | None
    other: frozenset[str] = frozenset()

    def __contains__(self, name: str) -> bool:
        return name not in self.other and (self.names is None or name in self.names)


_NO_ORIGINS = Origins(frozenset())


@dataclass(frozen=True, slots=True)
class Query:
    """A query that `check_query` has accepted.

    Attributes
    ----------
    text : str
        SQL of the query.
    tables : tuple of str
        Sorted names of the tables of the lake that the query reads.
    columns : Origins
        Names of the result's columns that are unchanged columns of these tables.
    tree : dict
        Syntax tree of the query, from DuckDB.
    """

    text: str
    tables: tuple[str, ...]
    columns: Origins
    tree: Tree


def check_query(text: str, table_names: Collection[str], connection: duckdb.DuckDBPyConnection | None = None) -> Query:
    """Check that a query is a single SELECT that reads only tables of the lake.

    In FROM a query may use these tables, subqueries, joins, VALUES, the names of its WITH clauses, and the functions
    range, generate_series and unnest. It may call all scalar functions but those that read or change the session, wait,
    or run a text as SQL.

    Parameters
    ----------
    text : str
        SQL of the query.
    table_names : collection of str
        Names of the lake's tables, in lower case, such as "galaxies" or "demo.galaxies".
    connection : DuckDBPyConnection, optional
        Connection to DuckDB that parses the text, see `parser`; by default a new one.

    Returns
    -------
    Query
        The query, the tables that it reads, and the names of unchanged columns.

    Raises
    ------
    BadInput
        If the text has more than 100,000 characters or contains NUL, cannot be parsed, is not a single SELECT, or uses
        another table or function. The message names the problem.
    """
    if len(text) > _MAX_CHARACTERS or "\0" in text:
        raise BadInput(f"SQL: a query has at most {_MAX_CHARACTERS} characters and no NUL")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise BadInput(f"SQL: {one_line(error)}") from None
    if (name := text.strip().rstrip(";").lower()) in table_names:
        raise BadInput(f"SQL: {name} is a table: write SELECT * FROM {name}")
    tree = _parse(text, connection)
    used: set[str] = set()
    for node, visible in _nodes(tree):
        if "cte_map" in node and node.get("type") not in _QUERIES:
            raise BadInput(f"SQL: only SELECT is possible, not {_words(node)}")
        if {"type", "alias", "sample"} <= node.keys():
            if node["type"] == "TABLE_FUNCTION":
                _refuse_foreign(node["function"], text.encode())
            used |= _source(node, table_names, visible)
        if node.get("class") == "FUNCTION":
            _refuse_function(node, text.encode())
    return Query(text, tuple(sorted(used)), _origins(tree, used, {}), tree)


def check_expression(text: str, connection: duckdb.DuckDBPyConnection | None = None) -> None:
    """Check that a text is exactly one SQL expression, so that it can be inserted into a query in brackets.

    Other texts, such as "x) FROM t --", could change the rest of the query.

    Parameters
    ----------
    text : str
        SQL expression.
    connection : DuckDBPyConnection, optional
        Connection to DuckDB that parses the text, see `parser`; by default a new one.

    Raises
    ------
    BadInput
        If the text is empty, has more than 100,000 characters, contains NUL, or is not exactly one expression.
    """
    if not 0 < len(text.strip()) <= _MAX_CHARACTERS or "\0" in text:
        raise BadInput(f"SQL: an expression has 1 to {_MAX_CHARACTERS} characters and no NUL")
    tree = _parse(f"SELECT ({text}\n)", connection)
    is_single = (
        tree.get("type") == "SELECT_NODE" and len(tree["select_list"]) == 1 and not tree["select_list"][0]["alias"]
    )
    other_clauses = ("where_clause", "group_expressions", "having", "qualify", "sample", "modifiers")
    if not is_single or tree["from_table"]["type"] != "EMPTY" or any(tree.get(key) for key in other_clauses):
        raise BadInput(f"SQL: {one_line(text)[:100]!r} is not one expression")


def parser() -> duckdb.DuckDBPyConnection:
    """Return a connection to an empty DuckDB database, with which queries can be parsed.

    Use one connection for many queries: opening it takes a hundred times as long as parsing a query.
    """
    return duckdb.connect(":memory:", config={"threads": 1, "enable_external_access": False})


def _parse(text: str, connection: duckdb.DuckDBPyConnection | None) -> Tree:
    with contextlib.nullcontext(connection) if connection is not None else parser() as database:
        try:
            statement_types = [statement.type for statement in database.extract_statements(text)]
            if statement_types != [duckdb.StatementType.SELECT]:
                raise BadInput(f"SQL: {_describe_statements(statement_types)}")
            row = database.execute("SELECT json_serialize_sql($text::VARCHAR)", {"text": text}).fetchone()
        except duckdb.ParserException as error:
            if top := _TOP.search(text):
                problem = f"TOP is possible only in TAP queries: write LIMIT {top[1]} at the end of the query"
                raise BadInput(f"SQL: {one_line(problem)}") from None
            if problem := _explain_unit(text, str(error)):
                raise BadInput(f"SQL: {one_line(problem)}") from None
            raise BadInput(f"SQL: {one_line(plain_message(str(error), text))}") from None
        except (duckdb.Error, UnicodeError) as error:
            raise BadInput(f"SQL: {one_line(plain_message(str(error), text))}") from None
    try:
        answer: Tree = json.loads(row[0]) if row else {"error": True}
    except RecursionError:
        raise BadInput("SQL: nested too deeply") from None
    if answer.get("error") or len(answer["statements"]) != 1:
        raise BadInput(f"SQL: {one_line(answer.get('error_message', 'cannot be parsed'))}")
    return answer["statements"][0]["node"]  # type: ignore[no-any-return]


def _explain_unit(text: str, message: str) -> str:
    """Return a message about a number with a unit in a query, such as 0.5 arcsec, or "" for another syntax error.

    Parameters
    ----------
    text : str
        SQL of the query.
    message : str
        Message of DuckDB, which contains the word that it does not understand.
    """
    word = re.search(r'at or near "(\w+)"', message)
    unit = word[1] if word else '"' if "unterminated quoted identifier" in message else ""
    size = _UNITS.get(unit.lower())
    if size is None or not (match := re.search(_WITH_UNIT.format(re.escape(unit)), text, re.IGNORECASE)):
        return ""
    blank = " " if unit.isalpha() else ""
    problem = f"{match['number']}{blank}{unit} is not possible, because SQL takes plain numbers"
    name = match["name"].rpartition(".")[2].lower()
    if name == "separation" or re.search(
        rf"\bseparation\s*\(.*\)\s*(?:as\s+)?{re.escape(name)}\b", text, re.IGNORECASE
    ):
        column_unit, owner = "deg", f"{name} is in deg"
    else:
        words = dict.fromkeys(re.findall(r"\w+", text.lower()))
        used = [table for word in words if (table := declarations.find_table(word, [name]))]
        units = {table.column(name).unit for table in used if name in table.names}
        if len(units) != 1:
            return f"{problem}: truesky describe LAKE TABLE prints the units of the columns"
        (column_unit,) = units
        owner = f"the unit of column {name} is {column_unit}" if column_unit else f"column {name} has no unit"
    if (base := _UNITS.get(column_unit.lower())) and base[0] == size[0]:
        number = f"{float(match['number']) * size[1] / base[1]:.6g}"
        return f"{problem}: write {match['number'] if size == base else number}, because {owner}"
    return f"{problem}: {owner}"


def _describe_statements(types: Sequence[duckdb.StatementType]) -> str:
    """Return the message for a text that is not a single SELECT; `types` are the types of its statements."""
    names = [str(kind).rpartition(".")[2] for kind in types]
    if len(names) == 1:
        return f"{names[0]} is not possible: write a SELECT, because the tables can only be read"
    contents = (
        f"the text contains {len(names)} statements ({', '.join(names)[:100]})" if names else "the query is empty"
    )
    return f"{contents}: write a single SELECT"


def one_line(error: BaseException | str) -> str:
    """Return a text, or the message of an error, on one line of at most 500 characters."""
    return " ".join(str(error).split())[:_MAX_LENGTH]


def _nodes(tree: Any) -> Iterator[tuple[Tree, frozenset[str]]]:
    """Yield every node of a syntax tree with the names, in lower case, of the WITH clauses that can be used there.

    Any other name that is not a table of the lake could refer to an internal table of DuckDB.
    """
    stack: list[tuple[Any, frozenset[str]]] = [(tree, frozenset())]
    while stack:
        node, visible = stack.pop()
        if isinstance(node, dict):
            yield node, visible
            rest = {key: value for key, value in node.items() if key != "cte_map"}
            for entry in node.get("cte_map", {}).get("map", ()):
                # A WITH clause can use the clauses before it, but not itself.
                stack.append((entry["value"], visible))
                visible |= {str(entry["key"]).lower()}
            # The name of a WITH clause can also be used in the second half of a recursive clause ("right"), and in the
            # query after a materialised clause ("child").
            inner_visible = visible | {str(node["cte_name"]).lower()} if "cte_name" in node else visible
            stack += [(value, inner_visible if key in ("right", "child") else visible) for key, value in rest.items()]
        elif isinstance(node, list):
            stack += [(value, visible) for value in node]


def _words(node: Tree) -> str:
    return str(node.get("type")).removesuffix("_NODE").removesuffix("_QUERY").replace("_", " ")


def _source(node: Tree, table_names: Collection[str], with_names: Collection[str]) -> set[str]:
    """Return the name of the lake's table that an entry of FROM reads, as a set of one name.

    The set is empty for other allowed entries, such as a join or a subquery. `with_names` contains the names of the
    WITH clauses that can be used there. BadInput is raised for entries that are not allowed.
    """
    kind = node["type"]
    if kind == "SHOW_REF":
        remedy = "truesky sql LAKE lists the tables, and truesky describe LAKE TABLE the columns"
        raise BadInput(f"SQL: SHOW and DESCRIBE are not possible: {remedy} (in Python lake.tables, lake.columns)")
    if kind not in _SOURCES:
        raise BadInput(f"SQL: {_words(node)} is not possible here")
    if kind == "TABLE_FUNCTION" and node["function"].get("function_name", "").lower() not in _TABLE_FUNCTIONS:
        name = node["function"].get("function_name", "this")
        raise BadInput(f"SQL: {one_line(name)}() is not a table of the lake ({', '.join(sorted(table_names))})")
    if kind != "BASE_TABLE":
        return set()
    name = _table_name(node)
    if not node.get("catalog_name") and name in table_names:
        return {name}
    if not node.get("catalog_name") and name in with_names:
        return set()
    problem = f"SQL: {one_line(repr(name))} is not a table of the lake"
    if suggested := suggest_tables(name, table_names):
        raise BadInput(f"{problem}; did you mean {' or '.join(suggested)}?")
    raise BadInput(f"{problem} ({', '.join(sorted(table_names))})")


def _refuse_function(node: Tree, data: bytes) -> None:
    """Raise BadInput if a query must not call a function; `data` is the query in UTF-8."""
    name = str(node["function_name"]).lower()
    _refuse_foreign(node, data)
    if name in _FUNCTIONS or name.startswith(_FUNCTION_PREFIXES):
        raise BadInput(f"SQL: the function {one_line(name)} is not possible here")
    # DuckDB's function `contains` is about texts and lists.
    has_region = name == "contains" and any(_name(argument) in _GEOMETRY for argument in _arguments(node))
    if name in _GEOMETRY or has_region:
        is_distance = name == "distance"
        numbers = [*_flat_arguments(node, data)]
        circle = _replace_function("st_distance", numbers) if is_distance else _circle_condition(numbers)
        remedy = (
            f"write {circle}"
            if is_distance
            else f"write {circle} for a circle, or in_area(ra, dec) for the area of the request"
        )
        raise BadInput(f"SQL: the function {name.upper()} is possible only in TAP queries: {remedy}")


def _refuse_foreign(node: Tree, data: bytes) -> None:
    """Raise BadInput with the SQL to write if a function is one that other databases have; `data` is the query."""
    name = _name(node)
    if remedy := _replace_function(name, [*_flat_arguments(node, data)]):
        raise BadInput(f"SQL: function {one_line(name)} does not exist: write {one_line(remedy)}")


def _name(node: Tree) -> str:
    return str(node.get("function_name", "")).lower()


def _arguments(node: Tree) -> list[Tree]:
    return [argument["expression"] for argument in node.get("arguments", ())]


def _flat_arguments(node: Tree, data: bytes) -> Iterator[str]:
    """Yield the SQL of the arguments of a function, in which points and circles are replaced by their numbers.

    The numbers of a circle come last. Texts, such as the name of a system of coordinates, are left out.
    """
    for argument in sorted(_arguments(node), key=lambda argument: _name(argument) == "circle"):
        if _name(argument) in _POINTS:
            yield from _flat_arguments(argument, data)
        elif argument.get("literal", {}).get("kind") != "STRING":
            start = argument["query_location"]
            yield data[start : start + argument["query_location_length"]].decode(errors="replace")


def _origins(node: Tree, tables: Collection[str], outer: Mapping[str, Origins]) -> Origins:
    """Return the names of the result's columns that are unchanged columns of the lake's tables.

    `node` is the syntax tree of the query, and `tables` contains the names of the lake's tables. `outer` contains, for
    each WITH clause around the query, which of its columns are unchanged. Subqueries are followed to any depth.
    """
    visible = dict(outer)
    for entry in node.get("cte_map", {}).get("map", ()):
        clause = entry["value"]
        query = {} if clause.get("aliases") else clause.get("query_node", {})
        visible[str(entry["key"]).lower()] = _origins(query, tables, visible)
    if node.get("type") != "SELECT_NODE":
        return _NO_ORIGINS
    source_origins = _source_origins(node["from_table"], tables, visible)
    names, other, everything = set[str](), set(source_origins.other), False
    for entry in node["select_list"]:
        if entry["class"] == "STAR" and not (
            entry.get("replace_list") or entry.get("rename_list") or entry.get("columns")
        ):
            everything = True
        elif entry["class"] == "COLUMN_REF" and not entry["alias"]:
            *within, name = (str(part).lower() for part in entry["column_names"])
            # In "s.name", s may be a structure that a subquery creates, and name a field of it. Such a field is not a
            # column of a table.
            (other if source_origins.other & set(within) else names).add(name)
        else:
            other.add(str(entry["alias"]).lower())
    if everything:
        return Origins(source_origins.names, frozenset(other))
    return Origins(frozenset(names if source_origins.names is None else names & source_origins.names), frozenset(other))


def _source_origins(source: Tree, tables: Collection[str], visible: Mapping[str, Origins]) -> Origins:
    """Return the names of the columns of a FROM clause that are unchanged columns of the lake's tables.

    `tables` contains the names of the lake's tables. `visible` contains, for each WITH clause that the FROM clause can
    use, which of its columns are unchanged.
    """
    if source.get("column_name_alias"):
        return _NO_ORIGINS
    if source["type"] == "JOIN":
        left_origins, right_origins = (_source_origins(source[side], tables, visible) for side in ("left", "right"))
        names = (
            None
            if left_origins.names is None or right_origins.names is None
            else left_origins.names | right_origins.names
        )
        return (
            Origins(names, left_origins.other | right_origins.other)
            if _NO_ORIGINS not in (left_origins, right_origins)
            else _NO_ORIGINS
        )
    if source["type"] == "SUBQUERY":
        return _origins(source["subquery"]["node"], tables, visible)
    if source["type"] == "BASE_TABLE":
        name = _table_name(source)
        return visible.get(name, Origins(None) if name in tables else _NO_ORIGINS)
    return _NO_ORIGINS


def _table_name(source: Tree) -> str:
    """Return the name of a table in FROM, in lower case: "galaxies", or "demo.galaxies" with the name of a request."""
    return ".".join(str(source[key]).lower() for key in ("schema_name", "table_name") if source.get(key))


def _replace_function(name: str, arguments: Sequence[str]) -> str:
    """Return the SQL for a function of another database, or "" if the function is not known.

    Parameters
    ----------
    name : str
        Name of the function in lower case.
    arguments : sequence of str
        SQL of its arguments, in which numbers replace points and circles. If their number is wrong, the result is an
        example.

    Returns
    -------
    str
        Text such as "separation(ra, dec, 53.1, -27.8) < 0.1 (deg)".
    """
    if name in _DISTANCES:
        return f"separation({', '.join(arguments if len(arguments) == 4 else ('ra', 'dec', 'RA', 'DEC'))}) (deg)"
    if name in _IN_CIRCLE:
        return _circle_condition(arguments)
    if name in _CONES:
        # A radius after a position only may be in any unit.
        return _circle_condition(("ra", "dec", *arguments[:2], "RADIUS") if len(arguments) == 3 else arguments)
    if name in _AROUND:
        position = ("ra", "dec", *arguments[:2])
        is_complete = len(arguments) == 3
        condition = _circle_condition((*position, _divide(arguments[2], 60)) if is_complete else ())
        return f"FROM galaxies WHERE {condition}"
    if name in _PERCENTILES and len(arguments) >= 2:
        column, percent = arguments[:2]
        # Some databases have fractions in place of percent.
        is_fraction = (number := _number(percent)) is not None and number <= 1.0
        return f"quantile_cont({column}, {percent if is_fraction else _divide(percent, 100)})"
    return "quantile_cont(z_obs, 0.5)" if name in _PERCENTILES else ""


def _circle_condition(arguments: Sequence[str]) -> str:
    """Return the condition that a position is in a circle; `arguments` are ra, dec, the centre and the radius, in SQL.

    With another number of arguments, an example is returned.
    """
    if len(arguments) != 5:
        return CIRCLE
    *positions, radius = arguments
    return f"separation({', '.join(positions)}) < {radius} (deg)"


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _divide(text: str, divisor: int) -> str:
    number = _number(text)
    return f"{text} / {divisor}" if number is None else f"{number / divisor:.6g}"
