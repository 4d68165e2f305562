"""Galaxies that are no smooth profiles: the section `structure`.

Arms, Structure   what is asked for
parse             the section
facts             what shapes an image, for its key
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from jobs.request.toml_values import Toml, integer, number, table_of
from lake_schema.errors import BadInput

# Fewer knots would be no disc, and each is drawn.
_KNOTS = (20, 5000)


@dataclass(frozen=True, slots=True)
class Arms:
    """Spiral arms and knots of large discs.

    contrast : of an arm's ridge over the mean of its circle, less 1, of the average disc; 0 = no arms
    knots    : part of the disc's light that is in knots
    number   : of knots in a disc
    least_radius : arcsec, half-light radius of the smallest disc that has arms
    """

    contrast: float = 0.8
    knots: float = 0.12
    number: int = 250
    least_radius: float = 1.0


@dataclass(frozen=True, slots=True)
class Structure:
    """What galaxies have beside their profiles; arms : None = discs are smooth."""

    arms: Arms | None = None


def parse(table: Toml) -> Structure:
    """The section `structure`; BadInput names the key."""
    path, default, found = "structure.arms", Arms(), table.get("arms", False)
    if isinstance(found, bool):
        return Structure(default if found else None)
    given = table_of(found, path, set(Arms.__slots__))
    arms = Arms(
        number(given, f"{path}.contrast", 0.0, 2.0, default.contrast),
        number(given, f"{path}.knots", 0.0, 0.5, default.knots),
        integer(given, f"{path}.number", *_KNOTS) if "number" in given else default.number,
        number(given, f"{path}.least_radius", 0.3, 60.0, default.least_radius),
    )
    if not arms.contrast and not arms.knots:
        raise BadInput(f"{path}: neither contrast nor knots: false leaves discs smooth")
    return Structure(arms)


def facts(structure: Structure) -> dict[str, Any]:
    """Of a request that asks for some structure; nothing where galaxies are smooth."""
    return {} if structure.arms is None else {"structure": {"arms": asdict(structure.arms)}}
