"""Describe the images of a lake for the table ivoa.obscore (ObsCore) of the TAP service, and find their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.page.lake_session import LakeSession, RequestTables
from truesky.page.pictures import pictures
from truesky.page.tap.tables import obscore_row

# A passband extends over the wavelengths at which its response is at least this fraction of its maximum.
_MIN_RESPONSE = 0.01


def obscore_rows(lake: LakeSession, address: str) -> list[dict[str, Any]]:
    """Return the rows of the table ivoa.obscore: one per image of the lake, in the order of `pictures.pictures`.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    address : str
        URL of the TAP service; the URLs of the image files begin with it.

    Returns
    -------
    list of dict
        Values by column for each image; empty if the lake has no images.
    """
    tables_by_request = {request_tables.request: request_tables for request_tables in lake.observed_requests}
    images = pictures(lake)
    exposure_ids: dict[str | None, set[int]] = {name: set() for name in tables_by_request}
    for image in images:
        exposure_ids[image.request_tables.request].add(image.row["exposure_id"])
    exposures = {
        (name, row["exposure_id"]): row
        for name, request_tables in tables_by_request.items()
        for row in request_tables.rows("exposures", None, exposure_ids[name])
    }
    bands = {name: _wavelength_ranges(request_tables) for name, request_tables in tables_by_request.items()}
    rows = []
    for number, image in enumerate(images):
        manifest_entry = image.version.manifest.by_path[image.row["path"]]
        corners = np.array([float(text) for text in image.row["s_region"].split()[2:]]).reshape(-1, 2)
        header = {key: value for key, value, _ in image.header_cards}
        file_facts = {
            "url": f"{address}/file/{lake.key}/{number}",
            "kbyte": manifest_entry["bytes"] // 1024,
            "version": image.version.key,
            "fov": _diameter(image.row["ra"], image.row["dec"], corners),
            # The width of stars in the image. The column `seeing` is that of the air at the zenith and at 500 nm.
            "resolution": header.get("PSFFWHM") or None,
            "wavelengths": bands[image.request_tables.request].get(image.row["band"]),
            "exposure": "/".join(str(part) for part in image.detector_key[:2] if part is not None),
            "nx": header.get("NAXIS1"),
            "ny": header.get("NAXIS2"),
        }
        rows.append(obscore_row(number, image.row, exposures.get(image.detector_key[:2], {}), file_facts))
    return rows


def _diameter(ra: float, dec: float, corners: Float) -> float:
    return 2.0 * float(np.max(sky.separation(corners[:, 0], corners[:, 1], ra, dec)))


def _wavelength_ranges(request_tables: RequestTables) -> dict[str, tuple[float, float]]:
    """Return the shortest and longest wavelength (angstrom) of each passband of a request, by name.

    The passband extends over the wavelengths at which its response is at least 1 % of its maximum. Passbands without a
    positive response are left out.
    """
    wavelength_ranges = {}
    for row in request_tables.rows("passbands", ["name", "first_wavelength", "wavelength_step", "response"]):
        response = np.array(row["response"])
        transmitting = np.flatnonzero((response > 0.0) & (response >= _MIN_RESPONSE * response.max(initial=0.0)))
        if not transmitting.size:
            continue
        ends = row["first_wavelength"] + row["wavelength_step"] * transmitting[[0, -1]]
        wavelength_ranges[str(row["name"])] = float(ends[0]), float(ends[1])
    return wavelength_ranges


def find_file(lake: LakeSession, number: int) -> Path:
    """Return the path of the file of an image, after its sha256 has been verified.

    `number` is the index of the image in the list of `pictures.pictures`. BadInput is raised if there is no such image.
    """
    images = pictures(lake)
    if not 0 <= number < len(images):
        raise BadInput(f"the lake has no image {number}; it has {len(images)}")
    version: read.Version = images[number].version
    return version.sidecar_path(images[number].row["path"])
