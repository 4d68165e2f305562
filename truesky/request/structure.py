"""Galaxies that are no smooth profiles: the section `structure`.

Arms, Stamps, Structure   what is asked for
parse             the section
facts             what shapes an image, for its key
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from truesky.request.toml_values import Toml, as_table, boolean, integer, number, string

# Fewer knots would be no disc, and each is drawn.
_KNOT_LIMITS = (20, 5000)


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
class Stamps:
    """A library of galaxies, drawn in place of profiles (truesky/render/sources/galaxy_stamps.py).

    nearest : galaxies that name no stamp have one, too, drawn among those nearest in shape
    least_radius : arcsec, half-light radius of the smallest of them
    """

    file: Path
    nearest: bool = False
    least_radius: float = 0.5


@dataclass(frozen=True, slots=True)
class Structure:
    """What galaxies have beside their profiles; arms : None = discs are smooth;  stamps : None = there are none."""

    arms: Arms | None = None
    stamps: Stamps | None = None


def parse(table: Toml, folder: Path) -> Structure:
    """The section `structure`; files are found from `folder`.  BadInput names the key."""
    return Structure(_arms(table.get("arms", False)), _stamps(table["stamps"], folder) if "stamps" in table else None)


def _stamps(value: object, folder: Path) -> Stamps:
    path = "structure.stamps"
    stamps_table = as_table(value, path, set(Stamps.__slots__))
    nearest = boolean(stamps_table, f"{path}.nearest", False)
    if "least_radius" in stamps_table and not nearest:
        raise BadInput(f"{path}.least_radius wants nearest = true: a stamp that is named is drawn at any size")
    return Stamps(
        user_files.expand_path(string(stamps_table, f"{path}.file"), folder),
        nearest,
        number(stamps_table, f"{path}.least_radius", 0.05, 60.0, 0.5),
    )


def _arms(value: object) -> Arms | None:
    path, default = "structure.arms", Arms()
    if isinstance(value, bool):
        return default if value else None
    arms_table = as_table(value, path, set(Arms.__slots__))
    arms = Arms(
        number(arms_table, f"{path}.contrast", 0.0, 2.0, default.contrast),
        number(arms_table, f"{path}.knots", 0.0, 0.5, default.knots),
        integer(arms_table, f"{path}.number", *_KNOT_LIMITS) if "number" in arms_table else default.number,
        number(arms_table, f"{path}.least_radius", 0.3, 60.0, default.least_radius),
    )
    if not arms.contrast and not arms.knots:
        raise BadInput(f"{path}: neither contrast nor knots: false leaves discs smooth")
    return arms


def facts(structure: Structure) -> dict[str, Any]:
    """Of a request that asks for some structure; nothing where galaxies are smooth.  A file's name is no part of it."""
    structure_facts: dict[str, Any] = {}
    if structure.arms is not None:
        structure_facts["arms"] = asdict(structure.arms)
    if structure.stamps is not None:
        structure_facts["stamps"] = {name: getattr(structure.stamps, name) for name in ("nearest", "least_radius")}
    return {"structure": structure_facts} if structure_facts else {}
