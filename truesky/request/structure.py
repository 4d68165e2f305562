"""Read the section `structure` of a request (a user's TOML file): spiral arms, knots and images of galaxies."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput, Mistakes
from truesky.request.toml_values import Toml, as_table, boolean, integer, number, quote_value, string

# Smallest and largest number of knots per disc. Fewer knots do not fill a disc. More take too long, since each knot is
# drawn.
_KNOT_LIMITS = (20, 5000)


@dataclass(frozen=True, slots=True)
class Arms:
    """Spiral arms and knots (bright compact regions) of large discs.

    Attributes
    ----------
    contrast : float
        Brightness at the ridge of an arm divided by the mean at this radius, minus 1, for the average disc; 0 for no
        arms.
    knots : float
        Fraction of the disc's light in knots, 0 to 0.5.
    number : int
        Number of knots per disc.
    least_radius : float
        Half-light radius in arcsec of the smallest disc with arms.
    """

    contrast: float = 0.8
    knots: float = 0.12
    number: int = 250
    least_radius: float = 1.0


@dataclass(frozen=True, slots=True)
class Stamps:
    """A user's library of galaxy images (stamps), which are drawn instead of smooth profiles.

    Attributes
    ----------
    file : Path
        File of the library (truesky/render/sources/galaxy_stamps.py describes it).
    nearest : bool
        True if galaxies for which the catalogue has no stamp number get a random one among the stamps with the most
        similar shape.
    least_radius : float
        Half-light radius in arcsec of the smallest galaxy that gets a random stamp.
    """

    file: Path
    nearest: bool = False
    least_radius: float = 0.5


@dataclass(frozen=True, slots=True)
class Structure:
    """Structure of galaxies in addition to smooth profiles: spiral arms and knots, and images from a library.

    `arms` is None for smooth discs, and `stamps` is None if no library of images is used.
    """

    arms: Arms | None = None
    stamps: Stamps | None = None


def parse(table: Toml, folder: Path) -> Structure:
    """Read the section `structure` of a request; file names are relative to `folder`, the folder of the request.

    Raises
    ------
    BadInput
        If the section is not valid. The message names the key.
    """
    with Mistakes() as mistakes:
        arms = mistakes.read(_arms, table.get("arms", False))
        stamps = mistakes.read(_stamps, table["stamps"], folder) if "stamps" in table else None
    return Structure(arms, stamps)


def _stamps(value: object, folder: Path) -> Stamps:
    path = "structure.stamps"
    stamps_table = as_table(value, path, Stamps.__slots__)
    with Mistakes() as mistakes:
        read = mistakes.read
        nearest = read(boolean, stamps_table, f"{path}.nearest", False)
        if "least_radius" in stamps_table and nearest is False:
            problem = f"{path}.least_radius requires nearest = true: stamps selected by number are drawn at any size"
            mistakes.add(BadInput(problem))
        file = read(string, stamps_table, f"{path}.file")
        radius = read(number, stamps_table, f"{path}.least_radius", 0.05, 60.0, 0.5, "arcsec")
    return Stamps(user_files.expand_path(file, folder), nearest, radius)


def _arms(value: object) -> Arms | None:
    path, default = "structure.arms", Arms()
    if isinstance(value, bool):
        return default if value else None
    if not isinstance(value, dict):
        form = "true or a table such as { contrast = 0.5 }"
        raise BadInput(f"{path} must be {form}, got {quote_value(value)}")
    arms_table = as_table(value, path, Arms.__slots__)
    with Mistakes() as mistakes:
        read = mistakes.read
        arms = Arms(
            read(number, arms_table, f"{path}.contrast", 0.0, 2.0, default.contrast),
            read(number, arms_table, f"{path}.knots", 0.0, 0.5, default.knots),
            read(integer, arms_table, f"{path}.number", *_KNOT_LIMITS, default.number),
            read(number, arms_table, f"{path}.least_radius", 0.3, 60.0, default.least_radius, "arcsec"),
        )
    if not arms.contrast and not arms.knots:
        raise BadInput(f"{path}: contrast or knots must be above 0; use arms = false for smooth discs")
    return arms


def facts(structure: Structure) -> dict[str, Any]:
    """Return the settings that change the images of galaxies, as JSON values for the hash of an image.

    File names are left out. The result is {} if all galaxies are smooth.
    """
    structure_facts: dict[str, Any] = {}
    if structure.arms is not None:
        structure_facts["arms"] = asdict(structure.arms)
    if structure.stamps is not None:
        structure_facts["stamps"] = {name: getattr(structure.stamps, name) for name in ("nearest", "least_radius")}
    return {"structure": structure_facts} if structure_facts else {}
