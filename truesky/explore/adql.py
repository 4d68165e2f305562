"""Translate ADQL, the query language of the Virtual Observatory, to DuckDB's SQL.

The translation changes TOP, which becomes LIMIT at the end of its SELECT; names of functions; and geometry: POINT,
CIRCLE, POLYGON, CONTAINS, INTERSECTS, DISTANCE, COORD1, COORD2, and columns of STC-S polygons. Other geometry raises an
error with its name. Quoted text does not change. The guard decides if the resulting query may run.

If a query selects the rows of a catalogue in a circle, the translation also selects the HEALPix cells that the circle
touches. Files and row groups without these cells are then not read.

References
----------
IVOA Recommendation ADQL 2.1
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from lake_schema import sky
from lake_schema.errors import BadInput

# Vertices are lists of ra, dec, ra, dec ... in deg. A side is positive if the position lies to its left.
MACROS = (
    """CREATE MACRO adql_side(a1, d1, a2, d2, a, d) AS
       cos(radians(d1)) * cos(radians(a1)) * (cos(radians(d2)) * sin(radians(a2)) * sin(radians(d))
         - sin(radians(d2)) * cos(radians(d)) * sin(radians(a)))
       - cos(radians(d1)) * sin(radians(a1)) * (cos(radians(d2)) * cos(radians(a2)) * sin(radians(d))
         - sin(radians(d2)) * cos(radians(d)) * cos(radians(a)))
       + sin(radians(d1)) * (cos(radians(d2)) * cos(radians(a2)) * cos(radians(d)) * sin(radians(a))
         - cos(radians(d2)) * sin(radians(a2)) * cos(radians(d)) * cos(radians(a)))""",
    """CREATE MACRO adql_sides(ra, dec, v) AS
       [adql_side(v[i], v[i + 1], v[(i + 1) % len(v) + 1], v[(i + 2) % len(v) + 1], ra, dec)
        for i in range(1, len(v), 2)]""",
    """CREATE MACRO adql_cosine(a1, d1, a2, d2) AS
       sin(radians(d1)) * sin(radians(d2)) + cos(radians(d1)) * cos(radians(d2)) * cos(radians(a1 - a2))""",
    # Winding angle of the sides around a position, in radians: for concave polygons the signs of sides are not enough.
    """CREATE MACRO adql_turn(a1, d1, a2, d2, a, d) AS
       atan2(adql_side(a1, d1, a2, d2, a, d),
             adql_cosine(a1, d1, a2, d2) - adql_cosine(a1, d1, a, d) * adql_cosine(a2, d2, a, d))""",
    """CREATE MACRO adql_turns(ra, dec, v) AS
       list_sum([adql_turn(v[i], v[i + 1], v[(i + 1) % len(v) + 1], v[(i + 2) % len(v) + 1], ra, dec)
                 for i in range(1, len(v), 2)])""",
    # Positions on a side of a convex polygon are inside.
    """CREATE MACRO adql_in_polygon(ra, dec, v) AS (separation(ra, dec, v[1], v[2]) < 90
       AND (list_min(adql_sides(ra, dec, v)) >= 0 OR list_max(adql_sides(ra, dec, v)) <= 0
            OR abs(adql_turns(ra, dec, v)) > pi()))""",
    # Distance in deg from a position to an arc: to its great circle, or to an end if this is nearest.
    """CREATE MACRO adql_from_arc(a1, d1, a2, d2, a, d) AS
       CASE WHEN adql_cosine(a2, d2, a, d) > adql_cosine(a1, d1, a, d) * adql_cosine(a1, d1, a2, d2)
             AND adql_cosine(a1, d1, a, d) > adql_cosine(a2, d2, a, d) * adql_cosine(a1, d1, a2, d2)
             AND separation(a1, d1, a2, d2) > 0
            THEN degrees(asin(least(1.0,
                 abs(adql_side(a1, d1, a2, d2, a, d)) / sin(radians(separation(a1, d1, a2, d2))))))
            ELSE least(separation(a1, d1, a, d), separation(a2, d2, a, d)) END""",
    """CREATE MACRO adql_meets_circle(ra, dec, radius, v) AS (adql_in_polygon(ra, dec, v) OR
       list_min([adql_from_arc(v[i], v[i + 1], v[(i + 1) % len(v) + 1], v[(i + 2) % len(v) + 1], ra, dec)
                 for i in range(1, len(v), 2)]) <= radius)""",
    """CREATE MACRO adql_vertices(region) AS
       [try_cast(x AS DOUBLE)
        for x in string_split(regexp_replace(trim(region), '^POLYGON (ICRS )?', '', 'i'), ' ')]""",
)
_TOKEN = re.compile(
    r"""\s+|--[^\n]*|/\*.*?\*/|'(?:[^']|'')*'|"(?:[^"]|"")*"|[A-Za-z_][A-Za-z0-9_]*"""
    r"""|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|<>|!=|<=|>=|\|\||.""",
    re.DOTALL,
)
# LOG is the natural logarithm in ADQL, but the logarithm to base 10 in DuckDB.
_RENAMED = {"LOG": "ln", "RAND": "random", "TRUNCATE": "trunc"}
_REGIONS = {"CIRCLE", "POLYGON"}
_GEOMETRY = {"CONTAINS", "INTERSECTS", "DISTANCE", "COORD1", "COORD2"}
_REFUSED = {"AREA", "BOX", "CENTROID", "COORDSYS", "REGION"}
_SET = {"UNION", "INTERSECT", "EXCEPT"}
_MAX_LENGTH = 50_000
_CLAUSES = {"SELECT", "FROM", "WHERE", "GROUP", "HAVING", "ORDER", "ON"}
# A comparison between these tokens is a complete condition.
_CONDITION_STARTS, _CONDITION_ENDS = (
    {"WHERE", "ON", "AND", "OR", "NOT", "("},
    {"AND", "OR", ")", "GROUP", "ORDER", "LIMIT", "OFFSET", ""},
)
# Tokens after the name of a table that are not an alias.
_NO_NAMES = {*_CLAUSES, *_SET, "JOIN", "INNER", "LEFT", "RIGHT", "FULL", "CROSS", "NATURAL", "USING", "LIMIT", "OFFSET"}
# Cells per radius of a circle, largest number of cell ranges, largest radius, and margin for rounding.
_CELLS_A_RADIUS, _MAX_RANGES, _MAX_RADIUS_DEG, _ROUNDING_DEG = 4, 24, 60.0, 1e-7


def to_sql(text: str, catalogues: Collection[str] = ()) -> str:
    """Translate a query from ADQL to DuckDB's SQL with the macros of MACROS.

    Parameters
    ----------
    text : str
        The query in ADQL.
    catalogues : collection of str
        Tables, in lower case, whose column `_healpix_29` is the index of ra and dec.

    Returns
    -------
    str
        The query in SQL.

    Raises
    ------
    BadInput
        If the query is too long or uses ADQL that cannot be translated; the message names it.
    """
    if len(text) > _MAX_LENGTH:
        raise BadInput(f"ADQL: a query has at most {_MAX_LENGTH} characters")
    tokens = [token for token in _TOKEN.findall(text) if not token.startswith(("--", "/*"))]
    while tokens and (tokens[-1].isspace() or tokens[-1] == ";"):
        tokens.pop()
    return "".join(_top_to_limit(_translate_functions(tokens, _indices(tokens, catalogues))))


def cone_condition(column: str, ra: float, dec: float, radius: float) -> str:
    """Return the SQL condition that an order-29 index lies in cells that a circle touches, as a few ranges.

    Parameters
    ----------
    column : str
        Column of the index.
    ra, dec, radius : float
        Centre and radius of the circle, deg.

    Returns
    -------
    str
        Condition in SQL; it can also be true for cells outside the circle.
    """
    order = int(np.clip(np.ceil(np.log2(np.sqrt(sky.cell_area(0)) * _CELLS_A_RADIUS / max(radius, 1e-6))), 0, 20))
    cells = sky.cells_in_cone(ra, dec, min(radius + _ROUNDING_DEG, 180.0), order)
    gaps = np.diff(cells)
    cuts = np.flatnonzero(gaps > 1)
    if len(cuts) >= _MAX_RANGES:
        # Only the widest gaps are kept, so narrow gaps between cells are included in the ranges.
        cuts = np.sort(cuts[np.argsort(gaps[cuts])[-_MAX_RANGES + 1 :]])
    firsts, lasts = cells[np.append(0, cuts + 1)], cells[np.append(cuts, len(cells) - 1)]
    ranges = [(sky.cell_range(order, a)[0], sky.cell_range(order, b)[1]) for a, b in zip(firsts, lasts, strict=True)]
    return f"({' OR '.join(f'({column} >= {first} AND {column} < {last})' for first, last in ranges)})"


# ------------------------------------------------------------------------------------------------ places


def _indices(tokens: Sequence[str], catalogues: Collection[str]) -> Mapping[str, str]:
    """Index column for each table prefix ("" or "name.") of `ra` and `dec` in a query.

    Names that may refer to something other than a catalogue are left out.
    """
    words = [token for token in tokens if not token.isspace()]
    upper = [word.upper() for word in words]
    if not catalogues or "WITH" in upper:
        return {}
    named_tables: list[tuple[str, bool]] = []
    for k, word in enumerate(upper):
        # A comma also joins tables: a name counts as a catalogue only if no comma follows.
        if word in ("FROM", "JOIN"):
            name, at = "", k + 1
            while at < len(words) and not (upper[at] in _NO_NAMES or words[at] in ("(", ")", ",")):
                if words[at] != "." and words[at - 1] != "." and at > k + 1:
                    break
                name += words[at].strip('"').lower()
                at += 1
            at += at < len(words) and upper[at] == "AS"
            alias = words[at] if at < len(words) and words[at].isidentifier() and upper[at] not in _NO_NAMES else ""
            next_word = words[at + bool(alias)] if at + bool(alias) < len(words) else ""
            named_tables.append(
                (alias.lower() or name.rpartition(".")[2], name in catalogues and next_word not in ("(", ","))
            )
    # Aliases of subqueries follow a bracket.
    behind_brackets = " ".join(upper).replace(") AS ", ") ").split(") ")[1:]
    hidden = {text.partition(" ")[0].lower() for text in behind_brackets}
    names = [name for name, _ in named_tables]
    catalogue_names = {
        name for name, is_known in named_tables if is_known and names.count(name) == 1 and name not in hidden
    }
    unqualified = {"": "_healpix_29"} if len(named_tables) == 1 and catalogue_names else {}
    return unqualified | {f"{name}.": f"{name}._healpix_29" for name in catalogue_names if name.isidentifier()}


# ------------------------------------------------------------------------------------------------ TOP


def _top_to_limit(tokens: Sequence[str]) -> list[str]:
    """Move TOP n of every SELECT to LIMIT n at the end of this SELECT: at its bracket, at OFFSET, or at the end."""
    out: list[str] = []
    # Bracket depth and limit of each open SELECT, innermost last.
    open_selects: list[tuple[int, str]] = []
    depth, at = 0, 0
    while at < len(tokens):
        token = tokens[at]
        word = token.upper()
        if token == "(":
            depth += 1
        ends = open_selects and open_selects[-1][0] == depth
        if (token == ")" or word == "OFFSET") and ends:
            out.append(f" LIMIT {open_selects.pop()[1]} ")
        elif word in _SET and ends:
            raise BadInput(f"ADQL: TOP in a part of {word} is not possible: put that part in a subquery")
        if token == ")":
            depth -= 1
        out.append(token)
        at += 1
        if word == "SELECT":
            at, limit = _top(tokens, at, out)
            if limit is not None:
                open_selects.append((depth, limit))
    out += [f" LIMIT {limit}" for _, limit in reversed(open_selects)]
    return out


def _top(tokens: Sequence[str], at: int, out: list[str]) -> tuple[int, str | None]:
    """Skip [DISTINCT | ALL] TOP n after a SELECT; append the rest to `out`. Return the next index and n."""
    ahead = [k for k in range(at, min(at + 8, len(tokens))) if not tokens[k].isspace()]
    if ahead and tokens[ahead[0]].upper() in ("DISTINCT", "ALL"):
        out += tokens[at : ahead[0] + 1]
        at, ahead = ahead[0] + 1, ahead[1:]
    if len(ahead) > 1 and tokens[ahead[0]].upper() == "TOP" and tokens[ahead[1]].isdigit():
        return ahead[1] + 1, tokens[ahead[1]]
    return at, None


# ------------------------------------------------------------------------------------------------ functions


def _translate_functions(tokens: Sequence[str], indices: Mapping[str, str]) -> list[str]:
    """Translate calls of functions that have another name or form in SQL; `indices` come from `_indices`."""
    out: list[str] = []
    at, clauses = 0, [""]
    while at < len(tokens):
        word = tokens[at].upper()
        if word in _CLAUSES:
            clauses[-1] = word
        clauses = [*clauses, clauses[-1]] if word == "(" else clauses[:-1] if word == ")" and clauses[1:] else clauses
        bracket = next((k for k in range(at + 1, len(tokens)) if not tokens[k].isspace()), len(tokens))
        is_call = bracket < len(tokens) and tokens[bracket] == "("
        if is_call and word in _REFUSED | _REGIONS | {"POINT"}:
            where = "alone" if word in _REGIONS | {"POINT"} else "here"
            raise BadInput(f"ADQL: {word} is not possible {where}")
        if is_call and word in _GEOMETRY:
            arguments, call_end = _arguments(tokens, bracket)
            cells = _cone_cells(word, arguments, indices) if clauses[-1] in ("WHERE", "ON") else ""
            geometry, at = _geometry(word, arguments), call_end
            if cells and (end := _condition_end(tokens, call_end, out)) is not None:
                geometry, at = f"({cells} AND {geometry} = 1)", end
            out.append(geometry)
        else:
            out.append(_RENAMED.get(word, tokens[at]) if is_call else tokens[at])
            at += 1
    return out


def _cone_cells(word: str, arguments: list[list[str]], indices: Mapping[str, str]) -> str:
    """Condition on the cells of a circle if a call tests that catalogue positions lie in a circle, else "".

    This requires a position given as columns and a circle given as numbers.
    """
    if word not in ("CONTAINS", "INTERSECTS") or len(arguments) != 2:
        return ""
    if word == "INTERSECTS" and _kind(arguments[0]) == "CIRCLE":
        arguments = arguments[::-1]
    if (_kind(arguments[0]), _kind(arguments[1])) != ("POINT", "CIRCLE"):
        return ""
    ra, dec = (text.lower() for text in _point(word, arguments[0]))
    try:
        lon, lat, radius = (float("".join(text.split()).strip("()")) for text in _circle(arguments[1]))
    except ValueError:
        return ""
    column = indices.get(ra.removesuffix("ra"), "") if ra.endswith("ra") and ra[:-2] == dec[:-3] else ""
    is_circle = -1e6 < lon < 1e6 and -90.0 <= lat <= 90.0 and 0.0 <= radius <= _MAX_RADIUS_DEG
    return cone_condition(column, lon, lat, radius) if column and dec.endswith("dec") and is_circle else ""


def _condition_end(tokens: Sequence[str], call_end: int, out: list[str]) -> int | None:
    """Index after the comparison of a call with 1; None if the comparison is not a complete condition.

    `out` contains the tokens before the call; a "1 =" is removed from it.
    """
    following = [k for k in range(call_end, len(tokens)) if not tokens[k].isspace()][:3]
    preceding = [k for k in range(len(out)) if not out[k].isspace()][-3:]
    next_words, last_words = (
        [tokens[k].upper() for k in following] + [""] * 3,
        [""] * 3 + [out[k].upper() for k in preceding],
    )
    if next_words[:2] == ["=", "1"] and next_words[2] in _CONDITION_ENDS and last_words[-1] in _CONDITION_STARTS:
        return following[1] + 1
    if last_words[-2:] == ["1", "="] and next_words[0] in _CONDITION_ENDS and last_words[-3] in _CONDITION_STARTS:
        del out[preceding[-2] :]
        return call_end
    return None


def _arguments(tokens: Sequence[str], bracket: int) -> tuple[list[list[str]], int]:
    """Arguments of a call, and the index after its closing bracket."""
    arguments: list[list[str]] = [[]]
    depth = 0
    for at in range(bracket, len(tokens)):
        token = tokens[at]
        depth += (token == "(") - (token == ")")
        if depth == 0:
            return arguments, at + 1
        if token == "," and depth == 1:
            arguments.append([])
        elif at > bracket:
            arguments[-1].append(token)
    raise BadInput("ADQL: a bracket is not closed")


def _geometry(word: str, arguments: list[list[str]]) -> str:
    if word == "DISTANCE":
        if len(arguments) == 4:
            return f"separation({', '.join(_sql(argument) for argument in arguments)})"
        first, second = (_point(word, argument) for argument in _require_number(word, arguments, 2))
        return f"separation({first[0]}, {first[1]}, {second[0]}, {second[1]})"
    if word in ("COORD1", "COORD2"):
        (argument,) = _require_number(word, arguments, 1)
        return f"({_point(word, argument)[word == 'COORD2']})"
    first_argument, second_argument = _require_number(word, arguments, 2)
    shapes = _kind(first_argument), _kind(second_argument)
    if word == "INTERSECTS" and shapes == ("CIRCLE", "CIRCLE"):
        (ra_1, dec_1, radius_1), (ra_2, dec_2, radius_2) = _circle(first_argument), _circle(second_argument)
        return f"CAST(separation({ra_1}, {dec_1}, {ra_2}, {dec_2}) <= {radius_1} + {radius_2} AS INTEGER)"
    if word == "INTERSECTS" and "CIRCLE" in shapes and "POINT" not in shapes:
        region, circle = (first_argument, second_argument)[:: 1 if shapes[1] == "CIRCLE" else -1]
        return f"CAST(adql_meets_circle({', '.join(_circle(circle))}, {_vertices(region)}) AS INTEGER)"
    if word == "INTERSECTS" and shapes[1] == "POINT":
        first_argument, second_argument = second_argument, first_argument
    ra, dec = _point(word, first_argument)
    return f"CAST({_inside(ra, dec, second_argument)} AS INTEGER)"


def _inside(ra: str, dec: str, region: list[str]) -> str:
    """Condition that a position lies in a region: a circle, a polygon, or a column of STC-S polygons."""
    kind = _kind(region)
    if kind == "CIRCLE":
        ra0, dec0, radius = _circle(region)
        return f"separation({ra}, {dec}, {ra0}, {dec0}) <= {radius}"
    if kind == "POINT":
        raise BadInput("ADQL: a POINT contains nothing")
    return f"adql_in_polygon({ra}, {dec}, {_vertices(region)})"


def _vertices(region: list[str]) -> str:
    """Vertices of a polygon, or of a column of STC-S polygons."""
    if _kind(region) != "POLYGON":
        return f"adql_vertices({_sql(region)})"
    corners = [part for argument in _numbers(region) for part in argument]
    if len(corners) < 6 or len(corners) % 2:
        raise BadInput("ADQL: a POLYGON has three corners or more")
    return f"[{', '.join(corners)}]"


def _kind(tokens: list[str]) -> str:
    """Name of the geometry function that an argument calls, "" for other arguments such as columns."""
    words = [token for token in tokens if not token.isspace()]
    word = words[0].upper() if len(words) > 1 and words[1] == "(" else ""
    if word in _REFUSED:
        raise BadInput(f"ADQL: {word} is not possible here")
    return word if word in _REGIONS | {"POINT"} else ""


def _numbers(tokens: list[str]) -> list[list[str]]:
    """Arguments of a geometry call without the coordinate frame of ADQL 2.0; points are pairs of numbers."""
    arguments, _ = _arguments(tokens, tokens.index("("))
    numbers = []
    for number, argument in enumerate(arguments):
        if number == 0 and "".join(argument).strip().startswith("'"):
            continue
        numbers.append(_point("", argument) if _kind(argument) == "POINT" else [_sql(argument)])
    return numbers


def _point(word: str, tokens: list[str]) -> list[str]:
    if _kind(tokens) != "POINT":
        raise BadInput(f"ADQL: {word} requires a POINT")
    coordinates = [part for argument in _numbers(tokens) for part in argument]
    if len(coordinates) != 2:
        raise BadInput("ADQL: a POINT has two coordinates")
    return coordinates


def _circle(tokens: list[str]) -> list[str]:
    numbers = [part for argument in _numbers(tokens) for part in argument]
    if len(numbers) != 3:
        raise BadInput("ADQL: a CIRCLE has two coordinates and a radius")
    return numbers


def _require_number(word: str, arguments: list[list[str]], number: int) -> list[list[str]]:
    if len(arguments) != number:
        raise BadInput(f"ADQL: {word} requires {number} arguments, got {len(arguments)}")
    return arguments


def _sql(tokens: list[str]) -> str:
    text = "".join(_translate_functions(tokens, {})).strip()
    if not text:
        raise BadInput("ADQL: an argument is missing")
    # Columns, numbers and texts need no brackets.
    return text if re.fullmatch(r"'(?:[^']|'')*'|-?[\w.]+", text) else f"({text})"
