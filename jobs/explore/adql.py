"""ADQL, the query language of the Virtual Observatory, in DuckDB's SQL.

in_sql      a query in ADQL -> the same in SQL, with the macros of `MACROS`

What differs is TOP, which becomes LIMIT at the end of its SELECT; names of functions; and geometry: POINT, CIRCLE,
POLYGON, CONTAINS, INTERSECTS, DISTANCE, COORD1, COORD2, and columns of STC-S polygons. Other geometry is refused by
name.
Whatever stands in quotes stays as it is; whether the result may run is the guard's to say.

Ref: IVOA Recommendation ADQL 2.1
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from lake_schema.errors import BadInput

# Vertices are lists of ra, dec, ra, dec ... deg; a side is positive where the place lies to the left of it.
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
    # How often the sides go round a place, in radians: of a polygon with notches the sides themselves tell too little.
    """CREATE MACRO adql_turn(a1, d1, a2, d2, a, d) AS
       atan2(adql_side(a1, d1, a2, d2, a, d),
             adql_cosine(a1, d1, a2, d2) - adql_cosine(a1, d1, a, d) * adql_cosine(a2, d2, a, d))""",
    """CREATE MACRO adql_turns(ra, dec, v) AS
       list_sum([adql_turn(v[i], v[i + 1], v[(i + 1) % len(v) + 1], v[(i + 2) % len(v) + 1], ra, dec)
                 for i in range(1, len(v), 2)])""",
    # Places on a side of one without notches are inside.
    """CREATE MACRO adql_in_polygon(ra, dec, v) AS (separation(ra, dec, v[1], v[2]) < 90
       AND (list_min(adql_sides(ra, dec, v)) >= 0 OR list_max(adql_sides(ra, dec, v)) <= 0
            OR abs(adql_turns(ra, dec, v)) > pi()))""",
    # Degrees from a place to an arc: to its great circle, or where that is nearest beyond its ends, to an end.
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
# ADQL's LOG is the natural logarithm, DuckDB's that to base 10.
_RENAMED = {"LOG": "ln", "RAND": "random", "TRUNCATE": "trunc"}
_REGIONS = {"CIRCLE", "POLYGON"}
_GEOMETRY = {"CONTAINS", "INTERSECTS", "DISTANCE", "COORD1", "COORD2"}
_REFUSED = {"AREA", "BOX", "CENTROID", "COORDSYS", "REGION"}
_SET = {"UNION", "INTERSECT", "EXCEPT"}
_LONGEST = 50_000


def in_sql(text: str) -> str:
    """The query in DuckDB's SQL.  Errors: BadInput names what of ADQL is not understood."""
    if len(text) > _LONGEST:
        raise BadInput(f"ADQL: a query has at most {_LONGEST} characters")
    tokens = [token for token in _TOKEN.findall(text) if not token.startswith(("--", "/*"))]
    while tokens and (tokens[-1].isspace() or tokens[-1] == ";"):
        tokens.pop()
    return "".join(_limited(_functions(tokens)))


# ------------------------------------------------------------------------------------------------ TOP


def _limited(tokens: Sequence[str]) -> list[str]:
    """TOP n of every SELECT as LIMIT n where that SELECT ends: at its bracket, at OFFSET, or at the end."""
    out: list[str] = []
    # A SELECT's depth of brackets and its limit, innermost last.
    open_: list[tuple[int, str]] = []
    depth, at = 0, 0
    while at < len(tokens):
        token = tokens[at]
        word = token.upper()
        if token == "(":
            depth += 1
        ends = open_ and open_[-1][0] == depth
        if (token == ")" or word == "OFFSET") and ends:
            out.append(f" LIMIT {open_.pop()[1]} ")
        elif word in _SET and ends:
            raise BadInput(f"ADQL: TOP in a part of {word} is not possible: put that part in a subquery")
        if token == ")":
            depth -= 1
        out.append(token)
        at += 1
        if word == "SELECT":
            at, limit = _top(tokens, at, out)
            if limit is not None:
                open_.append((depth, limit))
    out += [f" LIMIT {limit}" for _, limit in reversed(open_)]
    return out


def _top(tokens: Sequence[str], at: int, out: list[str]) -> tuple[int, str | None]:
    """Pass over [DISTINCT | ALL] TOP n behind a SELECT; what stays goes to `out`."""
    ahead = [k for k in range(at, min(at + 8, len(tokens))) if not tokens[k].isspace()]
    if ahead and tokens[ahead[0]].upper() in ("DISTINCT", "ALL"):
        out += tokens[at : ahead[0] + 1]
        at, ahead = ahead[0] + 1, ahead[1:]
    if len(ahead) > 1 and tokens[ahead[0]].upper() == "TOP" and tokens[ahead[1]].isdigit():
        return ahead[1] + 1, tokens[ahead[1]]
    return at, None


# ------------------------------------------------------------------------------------------------ functions


def _functions(tokens: Sequence[str]) -> list[str]:
    """Calls of functions that have another name or form."""
    out: list[str] = []
    at = 0
    while at < len(tokens):
        word = tokens[at].upper()
        bracket = next((k for k in range(at + 1, len(tokens)) if not tokens[k].isspace()), len(tokens))
        is_call = bracket < len(tokens) and tokens[bracket] == "("
        if is_call and word in _REFUSED | _REGIONS | {"POINT"}:
            where = "alone" if word in _REGIONS | {"POINT"} else "here"
            raise BadInput(f"ADQL: {word} is not possible {where}")
        if is_call and word in _GEOMETRY:
            arguments, at = _arguments(tokens, bracket)
            out.append(_geometry(word, arguments))
        else:
            out.append(_RENAMED.get(word, tokens[at]) if is_call else tokens[at])
            at += 1
    return out


def _arguments(tokens: Sequence[str], bracket: int) -> tuple[list[list[str]], int]:
    """The arguments of a call whose bracket opens there, and the place behind it."""
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
        first, second = (_point(word, argument) for argument in _so_many(word, arguments, 2))
        return f"separation({first[0]}, {first[1]}, {second[0]}, {second[1]})"
    if word in ("COORD1", "COORD2"):
        (argument,) = _so_many(word, arguments, 1)
        return f"({_point(word, argument)[word == 'COORD2']})"
    first_argument, second_argument = _so_many(word, arguments, 2)
    kinds = _kind(first_argument), _kind(second_argument)
    if word == "INTERSECTS" and kinds == ("CIRCLE", "CIRCLE"):
        one, other = _circle(first_argument), _circle(second_argument)
        return f"CAST(separation({one[0]}, {one[1]}, {other[0]}, {other[1]}) <= {one[2]} + {other[2]} AS INTEGER)"
    if word == "INTERSECTS" and "CIRCLE" in kinds and "POINT" not in kinds:
        region, circle = (first_argument, second_argument)[:: 1 if kinds[1] == "CIRCLE" else -1]
        return f"CAST(adql_meets_circle({', '.join(_circle(circle))}, {_vertices(region)}) AS INTEGER)"
    if word == "INTERSECTS" and kinds[1] == "POINT":
        first_argument, second_argument = second_argument, first_argument
    ra, dec = _point(word, first_argument)
    return f"CAST({_inside(ra, dec, second_argument)} AS INTEGER)"


def _inside(ra: str, dec: str, region: list[str]) -> str:
    """The condition that a place lies in a region: a circle, a polygon, or a column of STC-S polygons."""
    kind = _kind(region)
    if kind == "CIRCLE":
        ra0, dec0, radius = _circle(region)
        return f"separation({ra}, {dec}, {ra0}, {dec0}) <= {radius}"
    if kind == "POINT":
        raise BadInput("ADQL: a POINT contains nothing")
    return f"adql_in_polygon({ra}, {dec}, {_vertices(region)})"


def _vertices(region: list[str]) -> str:
    """The corners of a polygon, or of a column of STC-S polygons."""
    if _kind(region) != "POLYGON":
        return f"adql_vertices({_sql(region)})"
    corners = [part for argument in _numbers(region) for part in argument]
    if len(corners) < 6 or len(corners) % 2:
        raise BadInput("ADQL: a POLYGON has three corners or more")
    return f"[{', '.join(corners)}]"


def _kind(tokens: list[str]) -> str:
    """The geometry that an argument calls, "" where it is something else, such as a column."""
    words = [token for token in tokens if not token.isspace()]
    word = words[0].upper() if len(words) > 1 and words[1] == "(" else ""
    if word in _REFUSED:
        raise BadInput(f"ADQL: {word} is not possible here")
    return word if word in _REGIONS | {"POINT"} else ""


def _numbers(tokens: list[str]) -> list[list[str]]:
    """The arguments of such a call, without the frame that ADQL 2.0 wants; points as two numbers."""
    arguments, _ = _arguments(tokens, tokens.index("("))
    found = []
    for number, argument in enumerate(arguments):
        if number == 0 and "".join(argument).strip().startswith("'"):
            continue
        found.append(_point("", argument) if _kind(argument) == "POINT" else [_sql(argument)])
    return found


def _point(word: str, tokens: list[str]) -> list[str]:
    if _kind(tokens) != "POINT":
        raise BadInput(f"ADQL: {word} wants a POINT")
    found = [part for argument in _numbers(tokens) for part in argument]
    if len(found) != 2:
        raise BadInput("ADQL: a POINT has two coordinates")
    return found


def _circle(tokens: list[str]) -> list[str]:
    found = [part for argument in _numbers(tokens) for part in argument]
    if len(found) != 3:
        raise BadInput("ADQL: a CIRCLE has two coordinates and a radius")
    return found


def _so_many(word: str, arguments: list[list[str]], number: int) -> list[list[str]]:
    if len(arguments) != number:
        raise BadInput(f"ADQL: {word} wants {number} arguments, got {len(arguments)}")
    return arguments


def _sql(tokens: list[str]) -> str:
    text = "".join(_functions(tokens)).strip()
    if not text:
        raise BadInput("ADQL: an argument is missing")
    # A column, a number or a text needs no brackets.
    return text if re.fullmatch(r"'(?:[^']|'')*'|-?[\w.]+", text) else f"({text})"
