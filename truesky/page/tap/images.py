"""The images of a lake as files: where they are, and how ObsCore describes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.page.opened import Lake, Requested
from truesky.page.pictures import pictures
from truesky.page.tap.tables import image_row

# A passband's response at its ends, of its largest.
_FAINTEST = 0.01


def obscore(lake: Lake, address: str) -> list[dict[str, Any]]:
    """Rows of ivoa.obscore.

    address : of the service from which the files can be had
    """
    owns = {own.request: own for own in lake.observed}
    known = pictures(lake)
    numbers: dict[str | None, set[int]] = {name: set() for name in owns}
    for one in known:
        numbers[one.own.request].add(one.row["exposure_id"])
    exposures = {
        (name, row["exposure_id"]): row
        for name, own in owns.items()
        for row in own.rows("exposures", None, numbers[name])
    }
    bands = {name: _bands(own) for name, own in owns.items()}
    found = []
    for number, one in enumerate(known):
        entry = one.version.manifest.by_path[one.row["path"]]
        corners = np.array([float(text) for text in one.row["s_region"].split()[2:]]).reshape(-1, 2)
        header = {key: value for key, value, _ in one.cards}
        about = {
            "url": f"{address}/file/{lake.key}/{number}", "kbyte": entry["bytes"] // 1024, "version": one.version.key,
            "fov": _diameter(one.row["ra"], one.row["dec"], corners),
            "wavelengths": bands[one.own.request].get(one.row["band"]),
            "exposure": "/".join(str(part) for part in one.place[:2] if part is not None),
            "nx": header.get("NAXIS1"), "ny": header.get("NAXIS2"),
        }  # fmt: skip
        found.append(image_row(number, one.row, exposures.get(one.place[:2], {}), about))
    return found


def _diameter(ra: float, dec: float, corners: Float) -> float:
    return 2.0 * float(np.max(sky.separation(corners[:, 0], corners[:, 1], ra, dec)))


def _bands(own: Requested) -> dict[str, tuple[float, float]]:
    """Passband -> shortest and longest wavelength, angstrom."""
    found = {}
    for row in own.rows("passbands", ["name", "first_wavelength", "wavelength_step", "response"]):
        response = np.array(row["response"])
        seen = np.flatnonzero((response > 0.0) & (response >= _FAINTEST * response.max(initial=0.0)))
        if not seen.size:
            continue
        ends = row["first_wavelength"] + row["wavelength_step"] * seen[[0, -1]]
        found[str(row["name"])] = float(ends[0]), float(ends[1])
    return found


def file(lake: Lake, number: int) -> Path:
    """A FITS file, compared with its sha256.  Errors: BadInput where the lake has none of that number"""
    known = pictures(lake)
    if not 0 <= number < len(known):
        raise BadInput(f"the lake has no image {number}; it has {len(known)}")
    version: read.Version = known[number].version
    return version.file(known[number].row["path"])
