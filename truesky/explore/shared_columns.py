"""Resolve references to columns that a catalogue and its table of fluxes both have, such as `ra`.

The tables `galaxy_fluxes` and `star_fluxes` repeat the positions of `galaxies` and `stars`. DuckDB refuses a reference
to such a column as ambiguous if a query joins both tables. The values of both columns are equal in rows of the same
`id`, so this module puts the name of one of the tables before the column.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

Tree = dict[str, Any]
# Catalogue of each table of fluxes.
_CATALOGUES = {"galaxy_fluxes": "galaxies", "star_fluxes": "stars"}
_KEY = "id"
_SIGNS = {"COMPARE_EQUAL": "=", "COMPARE_NOTEQUAL": "<>"}
# Clauses of a SELECT in which the name of a result column takes precedence over the name of a table's column.
_ALIASES_FIRST = ("modifiers", "having")


@dataclass(frozen=True, slots=True)
class _Source:
    """An entry of FROM.

    Attributes
    ----------
    qualifier : str
        Text before the dot of a reference to a column of this entry, in double quotes where needed.
    table : str
        Name of the table of the lake, "" for a subquery.
    columns : collection of str or None
        Names of its columns in lower case; None if they are not known.
    is_optional : bool
        True if an outer join fills missing rows of this entry with NULL.
    """

    qualifier: str
    table: str
    columns: Collection[str] | None
    is_optional: bool = False


@dataclass(frozen=True, slots=True)
class _From:
    """A FROM clause: its entries, the pairs of qualifiers that are joined by `id`, and the columns of USING."""

    sources: tuple[_Source, ...]
    pairs: frozenset[frozenset[str]] = frozenset()
    merged: frozenset[str] = frozenset()


def qualify(text: str, tree: Tree, columns: Mapping[str, Collection[str]]) -> str:
    """Put the name of a table before each reference to a column that a catalogue and its fluxes both have.

    A reference changes only if it has no table, both tables are joined by `id`, and this name occurs in no other entry
    of FROM. DuckDB would refuse the query otherwise, so no query that works changes.

    Parameters
    ----------
    text : str
        SQL of the query.
    tree : dict
        Syntax tree of the query, from DuckDB.
    columns : mapping of str to collection of str
        Columns of the tables of the lake that the query reads, by the name of the table in lower case.

    Returns
    -------
    str
        SQL of the query.
    """
    inserts = dict(_inserts(tree, columns))
    data = text.encode()
    for place in sorted(inserts, reverse=True):
        data = data[:place] + inserts[place].encode() + data[place:]
    return data.decode()


def unrelated_fluxes(tables: Collection[str]) -> set[str]:
    """Return the tables of fluxes of the catalogues that a query does not read, an empty set if it reads no catalogue.

    `tables` are the names of the tables that the query reads, perhaps with the name of a request.
    """
    read = {name.rpartition(".")[2] for name in tables}
    if read.isdisjoint(_CATALOGUES.values()):
        return set()
    return {fluxes for fluxes, catalogue in _CATALOGUES.items() if catalogue not in read}


def entries_of_from(
    tree: Tree, columns: Mapping[str, Collection[str]]
) -> dict[str, tuple[str, Collection[str] | None]]:
    """Return the entries of all FROM clauses of a query by the names that references to their columns begin with.

    Parameters
    ----------
    tree : dict
        Syntax tree of the query, from DuckDB.
    columns : mapping of str to collection of str
        Columns of the tables of the lake that the query reads, by the name of the table in lower case.

    Returns
    -------
    dict of str to (str, collection of str or None)
        Name of the table of the lake, "" for a subquery, and the names of the columns of each entry, None if they are
        not known. A name that stands for several different entries is left out.
    """
    clauses = {
        str(clause["key"]).lower(): clause["value"]
        for node in _nodes(tree)
        for clause in (node.get("cte_map") or {}).get("map", ())
    }
    entries: dict[str, tuple[str, Collection[str] | None]] = {}
    repeated = set()
    kinds = ("BASE_TABLE", "SUBQUERY", "TABLE_FUNCTION")
    nodes = [node for node in _nodes(tree) if node.get("type") in kinds and "sample" in node]
    for node in sorted(nodes, key=lambda node: int(node["query_location"])):
        source = _read_source(node, columns)
        names, table = source.columns, str(node.get("table_name", "")).lower()
        if not source.table and table in clauses and not node["column_name_alias"] and not clauses[table]["aliases"]:
            names = _result_names(clauses[table]["query_node"])
        name = str(node["alias"]).lower() or table
        if name in entries and entries[name] != (source.table, names):
            repeated.add(name)
        entries[name] = (source.table, names)
    return {name: entry for name, entry in entries.items() if name and name not in repeated}


def unknown_columns(tree: Tree, columns: Mapping[str, Collection[str]]) -> list[tuple[str, str]]:
    """Return the references in a query to columns that do not exist, in lower case and in order, each once.

    Parameters
    ----------
    tree : dict
        Syntax tree of the query, from DuckDB.
    columns : mapping of str to collection of str
        Columns of the tables of the lake that the query reads, by the name of the table in lower case.

    Returns
    -------
    list of (str, str)
        Entry of FROM and name of the column: ("f", "galaxy_id") for f.galaxy_id. The entry is "" for a reference
        without one; a query with subqueries, WITH clauses or functions in FROM has no such items, because the columns
        are not known.
    """
    entries = entries_of_from(tree, columns)
    sources = _read_from(tree["from_table"], columns).sources if tree.get("type") == "SELECT_NODE" else ()
    is_single = [node.get("type") for node in _nodes(tree)].count("SELECT_NODE") == 1
    plain = _references({**tree, "type": ""}) if is_single and all(source.table for source in sources) else ()
    existing = {name.lower() for names in columns.values() for name in names}
    existing |= {str(node["alias"]).lower() for node in _nodes(tree) if node.get("alias")}
    unknown = [(node["query_location"], "", str(node["column_names"][0]).lower()) for node in plain]
    unknown = [reference for reference in unknown if reference[2] not in existing]
    for location, name, column in _qualified_references(tree, columns):
        if name in entries and (names := entries[name][1]) is not None and column not in names:
            unknown.append((location, name, column))
    return list(dict.fromkeys((name, column) for _, name, column in sorted(unknown)))


def unknown_entries(tree: Tree, columns: Mapping[str, Collection[str]]) -> list[tuple[str, str]]:
    """Return the references in a query to columns of entries that FROM does not have, as in `unknown_columns`."""
    existing = {str(node["alias"]).lower() for node in _nodes(tree) if node.get("alias")}
    existing |= {name.lower() for names in columns.values() for name in names} | {*entries_of_from(tree, columns)}
    references = sorted(_qualified_references(tree, columns))
    return list(dict.fromkeys((name, column) for _, name, column in references if name not in existing))


def _qualified_references(tree: Tree, columns: Mapping[str, Collection[str]]) -> Iterator[tuple[int, str, str]]:
    """Yield the place, the entry of FROM and the column of all references such as f.id, in lower case."""
    requests = {table.rpartition(".")[0] for table in columns}
    for node in _nodes(tree):
        if node.get("class") == "COLUMN_REF" and len(node["column_names"]) > 1:
            names = [str(name).lower() for name in node["column_names"]]
            if len(names) > 2 and names[0] in requests:
                del names[0]
            yield node["query_location"], names[0], names[1]


def quoted_texts(text: str, tree: Tree) -> list[str]:
    """Return the names in double quotes that a query compares with =, <>, IN or LIKE: they are probably texts.

    Names that are compared with a number are left out.

    Parameters
    ----------
    text : str
        SQL of the query.
    tree : dict
        Syntax tree of the query, from DuckDB.

    Returns
    -------
    list of str
        The names, without quotes.
    """
    data = text.encode()
    return [
        operand["column_names"][0]
        for node in _nodes(tree)
        for operand in _text_operands(node)
        if operand.get("class") == "COLUMN_REF"
        and len(operand["column_names"]) == 1
        and data[operand["query_location"] :].startswith(b'"')
    ]


def compared_columns(tree: Tree, text: str) -> Iterator[tuple[str, str]]:
    """Yield the columns that a query compares with a text, and the sign of the comparison, "=", "<>" or "" for others.

    The names of the columns are in lower case and without the name of a table.
    """
    for node in _nodes(tree):
        kind = str(node.get("type"))
        if kind in ("COMPARE_IN", "COMPARE_NOT_IN"):
            operands = node.get("children", [])
        else:
            keys = ("left", "right", "input", "lower", "upper") if kind.startswith("COMPARE_") else ()
            operands = [node.get(key) for key in keys]
        literals = [operand.get("literal", {}) for operand in operands if operand]
        if {"kind": "STRING", "text": text} in literals:
            for operand in operands:
                if operand and operand.get("class") == "COLUMN_REF":
                    yield str(operand["column_names"][-1]).lower(), _SIGNS.get(kind, "")


def _text_operands(node: Tree) -> list[Tree]:
    """Return the operands of a comparison that may be a text, [] for another node and if an operand is a number."""
    if node.get("type") in ("COMPARE_EQUAL", "COMPARE_NOTEQUAL"):
        operands = [node["left"], node["right"]]
    elif node.get("type") in ("COMPARE_IN", "COMPARE_NOT_IN"):
        operands = node.get("children", [])[1:]
    elif "~~" in str(node.get("function_name", "")):
        operands = [argument["expression"] for argument in node["arguments"][1:]]
    else:
        return []
    is_number = any(operand.get("literal", {}).get("kind", "STRING") != "STRING" for operand in operands)
    return [] if is_number else operands


def _nodes(tree: Tree) -> Iterator[Tree]:
    """Yield all nodes of a syntax tree."""
    stack: list[Any] = [tree]
    while stack:
        node = stack.pop()
        if isinstance(node, dict):
            yield node
            stack += node.values()
        elif isinstance(node, list):
            stack += node


def _inserts(tree: Tree, columns: Mapping[str, Collection[str]]) -> Iterator[tuple[int, str]]:
    """Yield the place (bytes from the start of the text) and the text of each insertion."""
    for node in _nodes(tree):
        if node.get("type") == "SELECT_NODE" and node["from_table"]["type"] == "JOIN":
            yield from _inserts_of_select(node, columns)


def _inserts_of_select(select: Tree, columns: Mapping[str, Collection[str]]) -> Iterator[tuple[int, str]]:
    source = _read_from(select["from_table"], columns)
    pairs = {frozenset(pair) for pair in _equal_keys(select["where_clause"])}
    qualifiers = _shared_columns(replace(source, pairs=source.pairs | pairs))
    if not qualifiers:
        return
    aliases = {str(entry["alias"]).lower() for entry in select["select_list"]}
    for name_of_clause, content in select.items():
        hidden = aliases if name_of_clause in _ALIASES_FIRST else frozenset[str]()
        if name_of_clause not in ("from_table", "cte_map"):
            for reference in _references(content):
                name = str(reference["column_names"][0]).lower()
                if name in qualifiers and name not in hidden:
                    yield reference["query_location"], f"{qualifiers[name]}."


def _references(content: Any) -> Iterator[Tree]:
    """Yield the references to columns without a table in a clause, except those in subqueries and lambda functions."""
    stack = [content]
    while stack:
        node = stack.pop()
        if isinstance(node, list):
            stack += node
        elif isinstance(node, dict) and node.get("class") != "LAMBDA" and node.get("type") != "SELECT_NODE":
            if node.get("class") == "COLUMN_REF" and len(node["column_names"]) == 1:
                yield node
            stack += node.values()


def _shared_columns(clause: _From) -> dict[str, str]:
    """Return the qualifier of each column that a catalogue and its fluxes in a FROM clause share."""
    if any(source.columns is None for source in clause.sources):
        return {}
    shared: dict[str, str] = {}
    for name in {name for source in clause.sources for name in source.columns or ()} - clause.merged:
        sources = [source for source in clause.sources if name in (source.columns or ())]
        present = [source for source in sources if not source.is_optional]
        if len(sources) == 2 and present and _are_related(sources[0], sources[1], clause.pairs):
            shared[name] = present[0].qualifier
    return shared


def _are_related(first: _Source, second: _Source, pairs: Collection[frozenset[str]]) -> bool:
    """Return True if two entries of FROM are a catalogue and its fluxes of the same request, joined by `id`."""
    (request, _, table), (other_request, _, other_table) = (source.table.rpartition(".") for source in (first, second))
    is_related = _CATALOGUES.get(table) == other_table or _CATALOGUES.get(other_table) == table
    return is_related and request == other_request and frozenset((first.qualifier, second.qualifier)) in pairs


def _read_from(node: Tree, columns: Mapping[str, Collection[str]]) -> _From:
    if node["type"] != "JOIN":
        return _From((_read_source(node, columns),))
    first, second = (_read_from(node[side], columns) for side in ("left", "right"))
    if node["join_type"] in ("SEMI", "ANTI"):
        return first
    if node["ref_type"] == "NATURAL":
        # Columns of both sides are merged, and not ambiguous.
        common = {name for source in first.sources for name in source.columns or ()}
        node = node | {"using_columns": [*common]}
    optional_sides = {"LEFT": (False, True), "RIGHT": (True, False), "OUTER": (True, True), "FULL": (True, True)}
    sources = tuple(
        replace(source, is_optional=source.is_optional or is_optional)
        for side, is_optional in zip(
            (first, second), optional_sides.get(node["join_type"], (False, False)), strict=True
        )
        for source in side.sources
    )
    names = frozenset(str(name).lower() for name in node["using_columns"])
    pairs = first.pairs | second.pairs
    if _KEY in names:
        joined = {frozenset((a.qualifier, b.qualifier)) for a in first.sources for b in second.sources}
    else:
        joined = {frozenset(pair) for pair in _equal_keys(node["condition"])}
    return _From(sources, pairs | joined, first.merged | second.merged | names)


def _equal_keys(condition: Any) -> Iterator[tuple[str, str]]:
    """Yield the qualifiers a and b of all conditions a.id = b.id that must hold for a join."""
    if not condition:
        return
    if condition["type"] == "CONJUNCTION_AND":
        for child in condition["children"]:
            yield from _equal_keys(child)
    elif condition["type"] == "COMPARE_EQUAL":
        sides = [[str(name) for name in condition[side].get("column_names", ())] for side in ("left", "right")]
        if all(len(names) > 1 and names[-1].lower() == _KEY for names in sides):
            first, second = (quote(names[:-1]) for names in sides)
            yield first, second


def _read_source(node: Tree, columns: Mapping[str, Collection[str]]) -> _Source:
    alias = str(node["alias"]).lower()
    if node["type"] == "BASE_TABLE" and not node["column_name_alias"]:
        names = [str(node[key]).lower() for key in ("schema_name", "table_name") if node.get(key)]
        table = ".".join(names)
        if table in columns:
            return _Source(quote([alias] if alias else names), table, {name.lower() for name in columns[table]})
    if node["type"] == "SUBQUERY" and not node.get("column_name_alias"):
        return _Source(quote([alias]), "", _result_names(node["subquery"]["node"]))
    return _Source(quote([alias]), "", None)


def _result_names(query: Tree) -> Collection[str] | None:
    """Return the names of the columns of a subquery, in lower case; None if a star stands for some columns."""
    entries: Sequence[Tree] = query.get("select_list", ())
    if query.get("type") != "SELECT_NODE" or any(entry["class"] == "STAR" for entry in entries):
        return None
    return {
        str(entry["alias"] or (entry["column_names"][-1] if entry["class"] == "COLUMN_REF" else "")).lower()
        for entry in entries
    }


def quote(names: Sequence[str]) -> str:
    """Return the parts of a name in lower case and in double quotes, joined by dots."""
    quoted = ('"' + name.lower().replace('"', '""') + '"' for name in names)
    return ".".join(quoted)
