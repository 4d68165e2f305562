"""Replace functions of other databases, which DuckDB does not have, by SQL that it runs."""

from __future__ import annotations

from collections.abc import Sequence

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
# Example of a condition for a circle.
CIRCLE = "separation(ra, dec, RA, DEC) < RADIUS (deg)"


def replace_function(name: str, arguments: Sequence[str]) -> str:
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
        return circle_condition(arguments)
    if name in _CONES:
        # A radius after a position only may be in any unit.
        return circle_condition(("ra", "dec", *arguments[:2], "RADIUS") if len(arguments) == 3 else arguments)
    if name in _AROUND:
        position = ("ra", "dec", *arguments[:2])
        is_complete = len(arguments) == 3
        condition = circle_condition((*position, _divide(arguments[2], 60)) if is_complete else ())
        return f"FROM galaxies WHERE {condition}"
    if name in _PERCENTILES and len(arguments) >= 2:
        column, percent = arguments[:2]
        # Some databases have fractions in place of percent.
        is_fraction = (number := _number(percent)) is not None and number <= 1.0
        return f"quantile_cont({column}, {percent if is_fraction else _divide(percent, 100)})"
    return "quantile_cont(z_obs, 0.5)" if name in _PERCENTILES else ""


def circle_condition(arguments: Sequence[str]) -> str:
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
