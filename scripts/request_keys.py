"""Find the keys of a request (TOML file of a user), and the limits of its numbers, by reading sample requests."""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any
from unittest.mock import patch

from truesky.request import from_toml, sky_notation, toml_values

# Functions that read one value of a request, and the type of the value for the documentation.
_VALUE_KINDS: dict[Callable[..., object], str] = {
    toml_values.number: "number",
    toml_values.optional_number: "number",
    toml_values.checked_number: "number",
    toml_values.integer: "whole number",
    toml_values.checked_integer: "whole number",
    toml_values.integer_choice: "whole number",
    toml_values.string: "text",
    toml_values.strings: "list of texts",
    toml_values.boolean: "true or false",
    sky_notation.ra_of: "number (deg) or text (hours)",
    sky_notation.optional_ra: "number (deg) or text (hours)",
    sky_notation.dec_of: "number or text (deg)",
    sky_notation.optional_dec: "number or text (deg)",
    sky_notation.mjd: "number (MJD, UTC) or date",
    sky_notation.optional_mjd: "number (MJD, UTC) or date",
}
_PLACE = {"ra": 53.1, "dec": -27.8}
_PLANE = {"channels": ["NISP-P"], "exposures": 2}
# Valid requests that together have all keys with numbers. Some keys exclude each other, such as the forms of an area.
SAMPLES: tuple[dict[str, Any], ...] = (
    {
        "name": "x",
        "seed": 1,
        "noise_seed": 1,
        "accuracy": {"flux": 1e-3, "shape": 1e-3, "position": 1e-3, "background": 0.1},
        "area": {"cone": {**_PLACE, "radius": 1.0}},
        "universe": {
            "galaxy_limit": 24.0, "star_limit": 24.0, "z_max": 5.0, "box_cells": 192, "lensing_nside": 64,
            "high_redshift_boost": 1.0, "quasar_boost": 1.0, "lensing": {"g1": 0.0, "g2": 0.0}, "alignment": 1.0,
            "rotation": 0.0, "transients": {"start": 61000.0, "end": 61100.0, "boost": 1.0}, "variables": True,
            "cosmology": {
                "omega_m": 0.3, "omega_b": 0.05, "h": 0.7, "sigma_8": 0.8, "n_s": 0.96, "w0": -0.9, "wa": 0.1,
                "m_nu": 0.0,
            },
        },
        "stars": {"brown_dwarf_boost": 1.0, "plane_limit": 20.0, "bright_limit": 10.0, "rows_a_file": 1000},
        "strong_lenses": {"boost": 1.0},
        "structure": {
            "arms": {"contrast": 0.8, "knots": 0.1, "number": 100, "least_radius": 1.0},
            "stamps": {"file": "stamps.fits", "nearest": True, "least_radius": 1.0},
        },
        "pointing": [
            {"channel": "NISP-S", **_PLACE, "position_angle": 0.0, "mjd": 61000.0, "exposure_time_s": 100.0,
             "realisations": 1, "grism_angle": 0.0},
        ],
        "observation": [
            {"channels": ["VIS"], **_PLACE, "position_angle": 0.0, "visits": 2, "dither": [[0.0, 1.0], [2.0, 3.0]],
             "mjd": 61000.0, "realisations": 1},
            {"channels": ["NISP-P"], "area": {"cone": {**_PLACE, "radius": 1.0}}, "fields": 1, "macc": [4, 16, 4]},
            {**_PLANE, "image_type": "persistence", "lamps": [1], "intensities": [1.0], "delays_s": [60.0]},
            {"channels": ["NISP-P"], "exposures": 2, "image_type": "dark", "exposure_time_s": 100.0},
            {"channels": ["VIS"], "exposures": 2, "image_type": "trap_pumping", "phase_times_s": [0.1]},
            {"channels": ["VIS"], "exposures": 2, "image_type": "defocus", "defocus_nm": [500.0]},
            {"channels": ["VIS"], "exposures": 2, "image_type": "stray_light", "magnitude": 0.0, "distance_deg": 1.0},
        ],
    },
    {
        "name": "x",
        "seed": 1,
        "area": {"box": {"ra": [10.0, 20.0], "dec": [-10.0, 10.0]}},
        "sources": {"only": "grid", "spacing": 4.0, "stars": "stars.csv"},
    },
    {"name": "x", "seed": 1, "area": {"polygon": [[10.0, 0.0], [20.0, 0.0], [15.0, 8.0]]}},
    {"name": "x", "seed": 1, "area": {"patches": [[10.0, 0.0, 1.0]]}},
    {"name": "x", "seed": 1, "area": {"tile": 100}},
)  # fmt: skip


@dataclass(frozen=True)
class Key:
    """A key of a request that has a single value, or an element of a list.

    Attributes
    ----------
    path : str
        Path of the key with the index of each list, such as "observation[0].macc[1] (reads)".
    kind : str
        Type of the value, such as "whole number".
    lo, hi : float or None
        Smallest and largest number, None if there are no limits. The limits of mission parameters are infinite here.
    unit : str
        Unit of the limits.
    legal : tuple of object
        Values that are allowed, () for any within the limits.
    default : str
        Default value, "" for none.
    """

    path: str
    kind: str
    lo: float | None = None
    hi: float | None = None
    unit: str = ""
    legal: tuple[object, ...] = ()
    default: str = ""

    @property
    def name(self) -> str:
        """Path of the key without the indices of lists."""
        return re.sub(r"\[\d+\]", "", self.path)

    @property
    def is_number(self) -> bool:
        """True if the value is a number, which has limits or is one of a few numbers."""
        return self.lo is not None or self.kind == "whole number"


def read_keys(sample: dict[str, Any]) -> list[Key]:
    """Return the keys that the parser of requests looks for in a sample, in the order in which it reads them.

    Keys that other functions read, such as tables, are not included. BadInput is raised for an invalid request.
    """
    keys: dict[str, Key] = {}

    def note(key: Key) -> None:
        # The functions call each other. The outermost one knows the default, and the innermost one the limits.
        if (outer := keys.get(key.path)) is None:
            keys[key.path] = key
        elif outer.lo is None:
            keys[key.path] = replace(outer, lo=key.lo, hi=key.hi, unit=key.unit)

    with ExitStack() as patched:
        for reader in _VALUE_KINDS:
            recording = _record_calls(reader, note)
            for module, name in _names_of(reader):
                patched.enter_context(patch.object(module, name, recording))
        from_toml.from_table(sample)
    return list(keys.values())


def _names_of(reader: Callable[..., object]) -> Iterator[tuple[ModuleType, str]]:
    """Yield the modules of the package `truesky.request` that contain a function, and its name there."""
    for module_name, module in list(sys.modules.items()):
        if module_name.startswith("truesky.request."):
            yield from ((module, name) for name, value in list(vars(module).items()) if value is reader)


def _record_calls(reader: Callable[..., object], note: Callable[[Key], None]) -> Callable[..., object]:
    """Return a function that does what `reader` does, and first calls `note` with the key that is read."""
    arguments = inspect.signature(reader)

    def record_and_read(*positional: object, **keywords: object) -> object:
        bound = arguments.bind(*positional, **keywords).arguments
        default = bound.get("default")
        note(
            Key(
                str(bound["path"]),
                _VALUE_KINDS[reader],
                bound.get("lo"),
                bound.get("hi"),
                bound.get("unit", ""),
                tuple(bound.get("legal") or ()),
                "" if default is None else json.dumps(default),
            )
        )
        return reader(*positional, **keywords)

    return record_and_read


def all_keys() -> dict[str, Key]:
    """Return the keys of all samples by their name, that is the path without the indices of lists."""
    keys: dict[str, Key] = {}
    for sample in SAMPLES:
        for key in read_keys(sample):
            keys.setdefault(key.name, key)
    return keys
