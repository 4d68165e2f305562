"""Translate ADQL, the query language of the Virtual Observatory, to DuckDB's SQL.

Three things change: TOP becomes LIMIT at the end of its SELECT, some functions get another name, and geometry becomes
SQL. The geometry is POINT, CIRCLE, POLYGON, CONTAINS, INTERSECTS, DISTANCE, COORD1, COORD2, and columns that contain
polygons as STC-S text. Other geometry, such as BOX, raises BadInput. Quoted text does not change. The translation does
not decide if the query is allowed; `truesky.explore.guard` checks the resulting SQL.

If a query selects the rows of a catalogue in a circle, the translation adds a condition on the HEALPix cells that the
circle touches. DuckDB then skips Parquet files and row groups without these cells.

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

# Macros of DuckDB for geometry on the sphere; all angles are in deg unless a comment says otherwise. The argument v is
# the list of a polygon's vertices: ra, dec, ra, dec, ... The macro adql_side is positive if the position (a, d) lies to
# the left of the great circle from (a1, d1) to (a2, d2).
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
    # adql_turn: angle in radians under which a side of the polygon is seen from the position (a, d), signed. The sum of
    # these angles is +-2 pi if the position is inside, also for concave polygons, where the signs of adql_side are not
    # enough.
    """CREATE MACRO adql_turn(a1, d1, a2, d2, a, d) AS
       atan2(adql_side(a1, d1, a2, d2, a, d),
             adql_cosine(a1, d1, a2, d2) - adql_cosine(a1, d1, a, d) * adql_cosine(a2, d2, a, d))""",
    """CREATE MACRO adql_turns(ra, dec, v) AS
       list_sum([adql_turn(v[i], v[i + 1], v[(i + 1) % len(v) + 1], v[(i + 2) % len(v) + 1], ra, dec)
                 for i in range(1, len(v), 2)])""",
    # adql_in_polygon: true if the position is inside the polygon. Positions on a side of a convex polygon are inside.
    # The first vertex must be less than 90 deg from the position.
    """CREATE MACRO adql_in_polygon(ra, dec, v) AS (separation(ra, dec, v[1], v[2]) < 90
       AND (list_min(adql_sides(ra, dec, v)) >= 0 OR list_max(adql_sides(ra, dec, v)) <= 0
            OR abs(adql_turns(ra, dec, v)) > pi()))""",
    # adql_from_arc: distance in deg from the position (a, d) to the arc between two vertices. It is the distance to the
    # great circle through the arc if the nearest point lies on the arc, else the distance to the nearer end.
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
# DuckDB's names of ADQL functions. LOG is the natural logarithm in ADQL, but the logarithm to base 10 in DuckDB.
_RENAMED = {"LOG": "ln", "RAND": "random", "TRUNCATE": "trunc"}
_REGIONS = {"CIRCLE", "POLYGON"}
_GEOMETRY = {"CONTAINS", "INTERSECTS", "DISTANCE", "COORD1", "COORD2"}
_REFUSED = {"AREA", "BOX", "CENTROID", "COORDSYS", "REGION"}
_SET = {"UNION", "INTERSECT", "EXCEPT"}
_MAX_LENGTH = 50_000
_CLAUSES = {"SELECT", "FROM", "WHERE", "GROUP", "HAVING", "ORDER", "ON"}
# A comparison is a complete condition, not a part of a longer expression, if the token before it is in
# _CONDITION_STARTS and the token after it is in _CONDITION_ENDS ("" is the end of the query).
_CONDITION_STARTS, _CONDITION_ENDS = (
    {"WHERE", "ON", "AND", "OR", "NOT", "("},
    {"AND", "OR", ")", "GROUP", "ORDER", "LIMIT", "OFFSET", ""},
)
# Keywords that can follow the name of a table in FROM, so they are not its alias.
_NO_NAMES = {*_CLAUSES, *_SET, "JOIN", "INNER", "LEFT", "RIGHT", "FULL", "CROSS", "NATURAL", "USING", "LIMIT", "OFFSET"}
# The HEALPix cells that cover a circle are at least this many times smaller than its radius. Their order is at most
# 20, so this does not hold for radii below 0.8 arcsec.
_CELLS_A_RADIUS = 4
# Largest number of ranges of cells in a condition for a circle.
_MAX_RANGES = 24
# Circles with a larger radius (deg) get no condition on HEALPix cells.
_MAX_RADIUS_DEG = 60.0
# The radius is increased by this angle (deg), so that rounding errors do not exclude a cell.
_ROUNDING_DEG = 1e-7


def to_sql(text: str, catalogues: Collection[str] = ()) -> str:
    """Translate a query from ADQL to DuckDB's SQL.

    The result uses the macros MACROS of this module, which the DuckDB session must have created.

    Parameters
    ----------
    text : str
        The query in ADQL.
    catalogues : collection of str, optional
        Names, in lower case, of the tables whose column `_healpix_29` is the order-29 nested HEALPix index of the
        columns `ra` and `dec`. Searches in circles are faster in these tables.

    Returns
    -------
    str
        The query in SQL.

    Raises
    ------
    BadInput
        If the query has more than 50,000 characters, or contains a construct that cannot be translated. The message
        names the construct.
    """
    if len(text) > _MAX_LENGTH:
        raise BadInput(f"ADQL: a query has at most {_MAX_LENGTH} characters")
    # A comment separates words, as a space does.
    tokens = [" " if token.startswith(("--", "/*")) else token for token in _TOKEN.findall(text)]
    while tokens and (tokens[-1].isspace() or tokens[-1] == ";"):
        tokens.pop()
    return "".join(_top_to_limit(_translate_functions(tokens, _indices(tokens, catalogues))))


def cone_condition(column: str, ra: float, dec: float, radius: float) -> str:
    """Return an SQL condition that selects the HEALPix cells that a circle touches, as at most 24 ranges of the index.

    Parameters
    ----------
    column : str
        Name of the column with the order-29 nested HEALPix index.
    ra, dec, radius : float
        Centre and radius of the circle, deg. The radius is 0 to 180.

    Returns
    -------
    str
        Condition in SQL. It is true for all positions in the circle, and for some positions outside it.
    """
    order = int(np.clip(np.ceil(np.log2(np.sqrt(sky.cell_area(0)) * _CELLS_A_RADIUS / max(radius, 1e-6))), 0, 20))
    cells = sky.cells_in_cone(ra, dec, min(radius + _ROUNDING_DEG, 180.0), order)
    gaps = np.diff(cells)
    cuts = np.flatnonzero(gaps > 1)
    if len(cuts) >= _MAX_RANGES:
        # There would be too many ranges of cells. Split them only at the widest gaps in the index; cells in narrower
        # gaps are then selected, too, although they do not touch the circle.
        cuts = np.sort(cuts[np.argsort(gaps[cuts])[-_MAX_RANGES + 1 :]])
    firsts, lasts = cells[np.append(0, cuts + 1)], cells[np.append(cuts, len(cells) - 1)]
    ranges = [(sky.cell_range(order, a)[0], sky.cell_range(order, b)[1]) for a, b in zip(firsts, lasts, strict=True)]
    return f"({' OR '.join(f'({column} >= {first} AND {column} < {last})' for first, last in ranges)})"


def _indices(tokens: Sequence[str], catalogues: Collection[str]) -> Mapping[str, str]:
    """Return the HEALPix column of each catalogue in a query, by the prefix with which the query can name its columns.

    For example {"": "_healpix_29", "g.": "g._healpix_29"} for "SELECT ... FROM galaxies AS g": both `ra` and `g.ra`
    refer to the catalogue. A prefix that may also refer to another table or subquery is left out. The result is empty
    if the query has a WITH clause.
    """
    words = [token for token in tokens if not token.isspace()]
    upper = [word.upper() for word in words]
    if not catalogues or "WITH" in upper:
        return {}
    named_tables: list[tuple[str, bool]] = []
    for k, word in enumerate(upper):
        # Only names after FROM and JOIN are found here. A comma after a table means that more tables follow, which are
        # not found, so such a table does not count as a catalogue.
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
    # A word after a closing bracket may be the alias of a subquery. A table with the same name is then not returned,
    # because its prefix could mean the subquery.
    behind_brackets = " ".join(upper).replace(") AS ", ") ").split(") ")[1:]
    hidden = {text.partition(" ")[0].lower() for text in behind_brackets}
    names = [name for name, _ in named_tables]
    catalogue_names = {
        name for name, is_known in named_tables if is_known and names.count(name) == 1 and name not in hidden
    }
    unqualified = {"": "_healpix_29"} if len(named_tables) == 1 and catalogue_names else {}
    return unqualified | {f"{name}.": f"{name}._healpix_29" for name in catalogue_names if name.isidentifier()}


def _top_to_limit(tokens: Sequence[str]) -> list[str]:
    """Replace TOP n of every SELECT by LIMIT n at the end of the same SELECT, and return all tokens.

    A SELECT ends before its OFFSET, at the closing bracket of its subquery, or at the end of the query. If it is a part
    of UNION, INTERSECT or EXCEPT, it ends before the next of these words or ORDER. It is then put in brackets, because
    LIMIT would else apply to the whole set.
    """
    set_parts = _set_parts(tokens)
    out: list[str] = []
    # For each SELECT with TOP n whose end has not been reached, innermost last: bracket depth, the text at its end, and
    # True if it is a part of a set.
    open_selects: list[tuple[int, str, bool]] = []
    depth, at = 0, 0
    while at < len(tokens):
        token = tokens[at]
        word = token.upper()
        depth += token == "("
        if open_selects and open_selects[-1][0] == depth:
            _, end, ends_early = open_selects[-1]
            if token == ")" or word == "OFFSET" or (ends_early and word in _SET | {"ORDER"}):
                out.append(f"{end} ")
                open_selects.pop()
        depth -= token == ")"
        start, is_part = len(out), at in set_parts
        out.append(token)
        at += 1
        if word == "SELECT":
            at, limit = _top(tokens, at, out)
            if limit is not None:
                open_selects.append((depth, f" LIMIT {limit}" + ")" * is_part, is_part))
                if is_part:
                    out.insert(start, "(")
    out += [end for _, end, _ in reversed(open_selects)]
    return out


def _set_parts(tokens: Sequence[str]) -> set[int]:
    """Return the indices of all tokens SELECT whose query is a part of UNION, INTERSECT or EXCEPT."""
    parts: set[int] = set()
    # For each open bracket: the indices of SELECT directly in it, and True if there is a word such as UNION.
    groups: list[tuple[list[int], bool]] = [([], False)]
    for at, token in enumerate([*tokens, *[")"] * (tokens.count("(") + 1)]):
        word = token.upper()
        selects, is_set = groups[-1]
        if token == "(":
            groups.append(([], False))
        elif token == ")":
            parts.update(selects if is_set else ())
            groups = groups[:-1] or [([], False)]
        elif word == "SELECT":
            selects.append(at)
        elif word in _SET:
            groups[-1] = (selects, True)
    return parts


def _top(tokens: Sequence[str], at: int, out: list[str]) -> tuple[int, str | None]:
    """Read the optional DISTINCT, ALL and TOP n after a SELECT.

    `at` is the index of the token after SELECT. DISTINCT or ALL is appended to `out`, and TOP n is not. Return the
    index of the next token, and n as text, or None if there is no TOP.
    """
    ahead = [k for k in range(at, min(at + 8, len(tokens))) if not tokens[k].isspace()]
    if ahead and tokens[ahead[0]].upper() in ("DISTINCT", "ALL"):
        out += tokens[at : ahead[0] + 1]
        at, ahead = ahead[0] + 1, ahead[1:]
    if len(ahead) > 1 and tokens[ahead[0]].upper() == "TOP" and tokens[ahead[1]].isdigit():
        return ahead[1] + 1, tokens[ahead[1]]
    return at, None


def _translate_functions(tokens: Sequence[str], indices: Mapping[str, str]) -> list[str]:
    """Translate calls of functions that have another name or form in SQL, and return all tokens.

    `indices` contains the HEALPix column of each catalogue by the prefix of its columns ("" or "name."). BadInput is
    raised for geometry that cannot be translated.
    """
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
    """Return an SQL condition on HEALPix cells for a test that a catalogue's positions lie in a circle.

    `word` is the name of the called function. The result is "" unless the function is CONTAINS or INTERSECTS, the
    position is given by the columns `ra` and `dec` of a catalogue, and the circle by numbers with a radius of at most
    60 deg. `indices` contains the HEALPix column of each catalogue by the prefix of its columns ("" or "name.").
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
    """Return the index of the token after a comparison such as CONTAINS(...) = 1 or 1 = CONTAINS(...).

    None is returned if the call is not compared with 1, or if the comparison is only a part of a longer expression.
    `call_end` is the index of the token after the call. `out` contains the tokens before the call; a "1 =" at its end
    is removed.
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
    """Return the arguments of a call as lists of tokens, and the index of the token after its closing bracket.

    `bracket` is the index of the opening bracket. BadInput is raised if the bracket is not closed.
    """
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
    """Return the SQL condition that a position lies in a region.

    `ra` and `dec` are SQL expressions in deg. `region` contains the tokens of a CIRCLE, a POLYGON, or an expression
    for polygons as STC-S text. BadInput is raised for a POINT.
    """
    kind = _kind(region)
    if kind == "CIRCLE":
        ra0, dec0, radius = _circle(region)
        return f"separation({ra}, {dec}, {ra0}, {dec0}) <= {radius}"
    if kind == "POINT":
        raise BadInput("ADQL: a POINT contains nothing")
    return f"adql_in_polygon({ra}, {dec}, {_vertices(region)})"


def _vertices(region: list[str]) -> str:
    """Return SQL for the list of a polygon's vertices: ra, dec, ra, dec, ... in deg.

    `region` contains the tokens of a POLYGON, or of an expression for polygons as STC-S text. BadInput is raised if a
    POLYGON has fewer than three corners, or an odd number of coordinates.
    """
    if _kind(region) != "POLYGON":
        return f"adql_vertices({_sql(region)})"
    corners = [part for argument in _numbers(region) for part in argument]
    if len(corners) < 6 or len(corners) % 2:
        raise BadInput("ADQL: a POLYGON has three corners or more")
    return f"[{', '.join(corners)}]"


def _kind(tokens: list[str]) -> str:
    """Return CIRCLE, POLYGON or POINT if an argument is a call of this function, else "" (for example for a column).

    BadInput is raised for geometry that cannot be translated, such as BOX.
    """
    words = [token for token in tokens if not token.isspace()]
    word = words[0].upper() if len(words) > 1 and words[1] == "(" else ""
    if word in _REFUSED:
        raise BadInput(f"ADQL: {word} is not possible here")
    return word if word in _REGIONS | {"POINT"} else ""


def _numbers(tokens: list[str]) -> list[list[str]]:
    """Return the arguments of a call of POINT, CIRCLE or POLYGON as SQL, one list per argument.

    A list contains two expressions (ra, dec) if the argument is a POINT, else one. The coordinate frame, with which the
    arguments begin in ADQL 2.0 ('ICRS'), is left out.
    """
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
    # Single columns, numbers and texts need no brackets; other expressions are put in brackets.
    return text if re.fullmatch(r"'(?:[^']|'')*'|-?[\w.]+", text) else f"({text})"
