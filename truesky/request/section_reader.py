"""Read the sections of a request (a user's TOML file), and collect their mistakes."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from lake_schema.errors import Mistakes
from truesky.cosmology import LIMITS
from truesky.request import instruments
from truesky.request.files import UserSources
from truesky.request.schema import EFFECTS, Stars, Universe
from truesky.request.structure import Structure
from truesky.request.toml_values import LIST_KEYS, TOP_KEYS, Toml, check_keys, meant_key, section

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

# Keys of each section; () for a section that may have any key, or whose keys another module checks.
_SECTIONS: dict[str, tuple[str, ...]] = {
    "area": (),
    "universe": (*Universe.__slots__, "transients"),
    "stars": tuple(key for key in Stars.__slots__ if key != "columns"),
    "ingest": ("galaxies", "halos", "training", "dust"),
    "sources": ("only", *UserSources.__slots__),
    "strong_lenses": ("boost",),
    "structure": Structure.__slots__,
    "mission": ("ladder", "overrides", "cameras"),
    "fluxes": ("bands", "intergalactic", "passbands", "templates", "stars", "extinction"),
    "psf": (),
    "solar_system": ("bodies",),
    "effects": ("on", "off"),
    "explore": (),
    "products": ("truth", "compression", "wcs", "files", "names", "readout"),
}
# Sections and lists of exposures where a key belongs, for error messages about a key in a wrong place.
_PLACES: dict[str, str] = {
    **{key: "[[pointing]] or [[observation]]" for key in ("ra", "dec", "mjd", "band", "detectors", "exposure_time_s")},
    **{key: "[[observation]]" for key in ("channels", "survey", "dither", "visits", "exposures", "image_type")},
    **{key: "[[pointing]]" for key in ("channel", "camera", "centre_on")},
    **dict.fromkeys(EFFECTS, "the lists on and off of [effects]"),
    **{key: "[area]" for key in ("cone", "box", "polygon", "tile", "patches", "wide")},
    **{key: f"[{name}]" for name, keys in _SECTIONS.items() for key in keys if key not in _SECTIONS},
    **dict.fromkeys((*LIMITS, "sigma8", "ns"), "[universe.cosmology]"),
}
# The same for keys in the section itself, whose other meanings are in other sections.
_PLACES_IN: dict[str, dict[str, str]] = {
    "ingest": {
        "columns": "did you mean [ingest.galaxies.columns]?",
        **dict.fromkeys(("files", "format"), "[ingest.galaxies]"),
    },
}


class RequestReader:
    """Read keys of a request, and collect their mistakes and the names of the top-level keys that have mistakes."""

    def __init__(self, table: Toml) -> None:
        self.table = table
        self.invalid: set[str] = set()
        self._mistakes = Mistakes()

    def read(
        self,
        key: str,
        function: Callable[_Parameters, _Result],
        *arguments: _Parameters.args,
        **options: _Parameters.kwargs,
    ) -> _Result | None:
        """Call a function that reads a value, and collect its mistakes.

        Parameters
        ----------
        key : str
            Key of the request outside sections, or name of the section, to which the value belongs.
        function : callable
            Function that reads the value.
        *arguments, **options : object
            Arguments of the function.

        Returns
        -------
        object
            Result of the function, or None if it raises BadInput.
        """
        count = len(self._mistakes)
        value = self._mistakes.read(function, *arguments, **options)
        if len(self._mistakes) > count:
            self.invalid.add(key)
        return value

    def section(self, key: str) -> Toml:
        """Return a section, {} if it is missing or not a table. Its unknown keys are mistakes."""
        values = self.read(key, section, self.table, key, None)
        if values is not None and _SECTIONS[key]:
            places = {
                **_PLACES,
                **_PLACES_IN.get(key, {}),
                **(_places_of_parameters(values) if key == "mission" else {}),
            }
            self.read(key, check_keys, values, key, _SECTIONS[key], places)
        return values or {}

    def check_top_keys(self) -> None:
        """Check that the request has no unknown key outside sections."""
        self.read("", check_keys, self.table, "", (*TOP_KEYS, *LIST_KEYS, *_SECTIONS), _PLACES)

    def messages(self) -> tuple[str, ...]:
        """Return the lines of all mistakes in the order of the file.

        A required key is not reported as missing if an unknown key of the same table was meant to be it.
        """
        lines = self._mistakes.messages
        meant = [f"{path} is missing" for path in map(meant_key, lines) if path]
        lines = tuple(line for line in lines if not line.startswith(tuple(meant)))
        return tuple(sorted(lines, key=lambda message: _position(message, self.table)))


def _places_of_parameters(values: Toml) -> dict[str, str]:
    """Return where the parameters of instruments belong that are in the section `mission` itself, by key."""
    parameters = {
        key: value
        for key, value in values.items()
        if key not in _SECTIONS["mission"] and ("." in key or isinstance(value, dict))
    }
    units = instruments.parameter_units() if parameters else {}
    lines = {
        key: instruments.explain_override(*next(instruments.override_values(key, value)), units)
        for key, value in parameters.items()
    }
    return {
        key: f"[mission.overrides] as {line}{f' ({problem})' if problem else ''}"
        for key, (problem, line) in lines.items()
    }


def _position(message: str, value: Any) -> list[int]:
    """Return the place of a mistake in a request, so that a list of places can be sorted in the order of the file.

    A message begins with the path of a key. The place has the number of each part of the path in its table or list.
    `value` is the whole request.
    """
    place, path = [], message.split(" ", 1)[0].rstrip(":")
    while path:
        index = re.match(r"\[(\d+)\]", path)
        # The name of a parameter, such as "vis.gain", is one key.
        keys = (
            [key for key in value if re.match(re.escape(key) + r"(?![\w-])", path)] if isinstance(value, dict) else []
        )
        if index and isinstance(value, list) and int(index[1]) < len(value):
            place.append(int(index[1]))
            value, path = value[int(index[1])], path[index.end() :].lstrip(".")
        elif keys:
            key = max(keys, key=len)
            place.append(list(value).index(key))
            value, path = value[key], path[len(key) :].lstrip(".")
        else:
            # Missing keys come first at the top of the file, and otherwise after the other keys of their table.
            place.append(len(value) if place and isinstance(value, (dict, list)) else -1)
            break
    return place
