"""SQL function in_area(ra, dec), which selects the area of a request.

Catalogues cover whole HEALPix cells, so that they contain sources outside the area that the request asks for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import Damaged
from lake_schema.sky.ecliptic import ecliptic
from lake_schema.store import request_links
from lake_schema.store.object_storage.s3 import Folder
from truesky.request.area import ECLIPTIC_MIN, GALACTIC_MIN, Area, side_normals

_UNKNOWN = "in_area: the lake does not record the area of the request: run a job of the request again"
_SEVERAL = "in_area: requests of this lake have different areas: write REQUEST.in_area(ra, dec)"


def macros(root: Folder, table_names: Iterable[str]) -> Iterator[str]:
    """Yield the SQL commands that define in_area(ra, dec) for a session, and REQUEST.in_area(ra, dec).

    Parameters
    ----------
    root : Folder
        Folder of the lake.
    table_names : iterable of str
        Names of the tables of the session. Names of the form REQUEST.TABLE contain the name of a request.

    Yields
    ------
    str
        Commands. Without a request in the name, the function selects the area of all requests if they have the same
        one. Otherwise a query that calls it fails with the reason.
    """
    requests = sorted({name.partition(".")[0] for name in table_names if "." in name})
    conditions = {name: _condition_of_request(root, name) for name in requests}
    for name, expression in conditions.items():
        yield f'CREATE SCHEMA IF NOT EXISTS "{name}"'
        yield f'CREATE MACRO "{name}".in_area(ra, dec) AS ({expression})'
    different = set(conditions.values())
    common = different.pop() if len(different) == 1 else _failure(_SEVERAL if different else _UNKNOWN)
    yield f"CREATE MACRO in_area(ra, dec) AS ({common})"


def _condition_of_request(root: Folder, name: str) -> str:
    try:
        values = request_links.read_area(root, name)
        return _failure(_UNKNOWN) if values is None else condition(_area(values))
    except (Damaged, TypeError, ValueError, KeyError, OverflowError) as error:
        return _failure(f"in_area: the area of request {name} cannot be read: {error}")


def _failure(message: str) -> str:
    return "error('" + message.replace("'", "''") + "')::BOOLEAN"


def _area(values: dict[str, Any]) -> Area:
    tuples = {name: tuple(tuple(map(_number, place)) for place in values[name]) for name in ("vertices", "patches")}
    box = None if values["box"] is None else tuple(map(_number, values["box"]))
    centre = {name: _number(values[name]) for name in ("ra", "dec", "radius")}
    return Area(**tuples, **centre, box=box, wide=bool(values["wide"]))  # type: ignore[arg-type]


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        # In SQL, it would be the name of a column.
        raise ValueError(f"{number} is not a finite number")
    return number


def condition(area: Area) -> str:
    """Return an SQL expression of ra and dec (deg) that is true for positions in an area, including its edge."""
    if area.wide:
        sines = (float(np.sin(np.radians(low))) for low in (GALACTIC_MIN, ECLIPTIC_MIN))
        latitudes = zip((sky.galactic, ecliptic), sines, strict=True)
        return " AND ".join(f"abs({_product(_pole(system))}) >= {sine!r}" for system, sine in latitudes)
    if area.patches:
        return " OR ".join(_in_circle(*patch) for patch in area.patches)
    if area.box is not None:
        west, east, south, north = area.box
        offset = f"(ra - {west!r})"
        in_ra = f"{offset} - 360 * floor({offset} / 360) <= {(east - west) % 360.0!r}"
        return f"{in_ra} AND dec BETWEEN {south!r} AND {north!r}"
    if area.vertices:
        return " AND ".join(f"{_product(normal)} >= 0" for normal in side_normals(area.vertices))
    return _in_circle(area.ra, area.dec, area.radius)


def _in_circle(ra: float, dec: float, radius: float) -> str:
    return f"separation(ra, dec, {ra!r}, {dec!r}) <= {radius!r}"


def _pole(system: Any) -> Float:
    """Return the unit vector of the north pole of a system of coordinates, from the latitudes of three directions."""
    latitudes = system(np.array([0.0, 90.0, 0.0]), np.array([0.0, 0.0, 90.0]))[1]
    return np.asarray(np.sin(np.radians(latitudes)))


def _product(vector: Float) -> str:
    """Return the SQL of the scalar product of a vector with the direction of a position."""
    x, y, z = (float(value) for value in vector)
    return f"(cos(radians(dec)) * ({x!r} * cos(radians(ra)) + {y!r} * sin(radians(ra))) + {z!r} * sin(radians(dec)))"
