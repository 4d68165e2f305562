"""Add calibration stars and nebulae to the catalogue rows of an exposure, at five positions on every detector.

The star of a stray-light check is a single one outside the field.

References
----------
Euclid Collaboration: Serrano et al. 2024 (stars, their magnitudes, and the five positions).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import sky, units
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER, source_id
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes import passbands
from truesky.fluxes.libraries import standards, templates
from truesky.render.camera import astrometry, pointing
from truesky.render.channels.aim import Aim
from truesky.render.exposure.records import Rows

# Mission parameter with the magnitude for each image type, and its band ("" for the band of the exposure).
_BRIGHTNESS = {
    "standard_star": ("survey.calibration.standard_magnitude", "euclid_y"),
    "planetary_nebula": ("survey.calibration.standard_magnitude", "euclid_y"),
    "bleeding": ("survey.bleeding.magnitude", ""),
    "white_dwarf": ("survey.white_dwarf.magnitude", ""),
    "stray_light": ("survey.stray_light.magnitude", ""),
}
_OUTSIDE = "stray_light"
# Positions (assumed) as fractions of the detector's sides. If middle rows are not read, no star is in the middle.
_PLACES = ((0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75))
_PLACES_OF_HALVES = ((0.25, 0.25), (0.75, 0.25), (0.4, 0.4), (0.25, 0.75), (0.75, 0.75))
# Parts of identifiers: the code of stars, a member number that catalogue stars do not have, and the HEALPix order that
# has 2^22 cells per generation cell.
_STAR, _MEMBER, _FINE = 5, 1, GENERATION_ORDER + 11


def with_standards(rows: Rows, aim: Aim, mission: MissionConfiguration) -> Rows:
    """Add five copies of an exposure's calibration star, or the single star outside the field, to its catalogue rows.

    Parameters
    ----------
    rows : Rows
        Catalogue rows.
    aim : Aim
        Exposure and detector.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Rows
        Rows with the stars. Exposures of other types have unchanged rows.

    Raises
    ------
    BadInput
        If the target is not a standard star.
    """
    if aim.exposure.image_type not in _BRIGHTNESS:
        return rows
    target = aim.exposure.target
    if target not in standards.NAMES:
        raise BadInput(
            f"exposure {aim.exposure.exposure_id}: target must be one of {', '.join(standards.NAMES)}, got {target!r}"
        )
    ra, dec = star_positions(aim, mission)
    cell = sky.cell_at(ra, dec, GENERATION_ORDER)
    number = sky.cell_at(ra, dec, _FINE) - (cell << 2 * (_FINE - GENERATION_ORDER))
    ids = source_id(_STAR, cell, number, _MEMBER)
    library = templates.stellar_library()
    # Libraries of users contain the same standards.
    sed = library.names.index(target)
    magnitude, magnitude_band = brightness(aim.exposure, mission)
    band_flux, reference_flux = (
        float(passbands.ab_flux(band, library.wavelength, library.flux[sed].astype(float)))
        for band in (aim.band, aim.band if magnitude_band == aim.exposure.band else passbands.load(magnitude_band))
    )
    f_nu = 10.0 ** (0.4 * (units.AB_UJY - magnitude)) * band_flux / reference_flux
    # The value of `mag_h` is irrelevant, because only the shape of the spectrum is used.
    star = {"id": ids, "ra": ra, "dec": dec, "sed": sed, "mag_h": magnitude, "a_v": 0.0}
    return replace(
        rows,
        stars=_append_rows(rows.stars, star),
        star_fluxes=_append_rows(rows.star_fluxes, {"id": ids, f"f_nu_{aim.exposure.band}": f_nu}),
    )


def brightness(exposure: ExposureRow, mission: MissionConfiguration) -> tuple[float, str]:
    """Return the AB magnitude of the calibration source of an exposure, and the band of this magnitude."""
    key, band = _BRIGHTNESS[exposure.image_type]
    return mission.value(key, "mag"), band or exposure.band


def star_positions(aim: Aim, mission: MissionConfiguration) -> tuple[Float, Float]:
    """Return right ascension and declination of the calibration stars in degrees, each of shape (n,)."""
    exposure, nx, ny = aim.exposure, aim.detector.nx, aim.detector.ny
    if exposure.image_type == _OUTSIDE:
        # Distances on the tangent plane are the tangents of angles.
        offset_arcsec = np.tan(mission.value("survey.stray_light.distance", "rad")) / pointing.ARCSEC
        return pointing.sky_of_plane([0.0], [offset_arcsec], exposure.ra, exposure.dec, exposure.position_angle)
    x, y = np.array(_PLACES_OF_HALVES if aim.detector.injection_rows else _PLACES).T
    return astrometry.sky_of_pixel(aim.wcs, x * (nx - 1), y * (ny - 1))


def _append_rows(table: pa.Table, values: Mapping[str, Any]) -> pa.Table:
    """Return the table with one more row per identifier; columns without a value are null."""
    n = len(values["id"])
    columns = [
        pa.array(np.broadcast_to(values[field.name], n)).cast(field.type) if field.name in values
        else pa.nulls(n, field.type)
        for field in table.schema
    ]  # fmt: skip
    return pa.concat_tables([table, pa.table(columns, schema=table.schema)])
