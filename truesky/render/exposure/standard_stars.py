"""Stars and nebulae that calibrate: what exposures of these types are of, at five places of every detector at once.

The star of a check of stray light is one alone, beside the field.

with_standards   catalogue rows, and the standard's among them

Ref : Euclid Collaboration: Serrano et al. 2024 (the stars, how bright they are, five places)
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

# Parameter of the mission that says how bright they are, and the band of that magnitude, "" = the exposure's.
_BRIGHTNESS = {
    "standard_star": ("survey.calibration.standard_magnitude", "euclid_y"),
    "planetary_nebula": ("survey.calibration.standard_magnitude", "euclid_y"),
    "bleeding": ("survey.bleeding.magnitude", ""),
    "white_dwarf": ("survey.white_dwarf.magnitude", ""),
    "stray_light": ("survey.stray_light.magnitude", ""),
}
_OUTSIDE = "stray_light"
# Assumed: in parts of the detector's sides; of a detector whose middle rows are not read, none in the middle.
_PLACES = ((0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75))
_PLACES_OF_HALVES = ((0.25, 0.25), (0.75, 0.25), (0.4, 0.4), (0.25, 0.75), (0.75, 0.75))
# Of an identifier: stars, of which catalogues have no members; and the order whose cells number 22 bits in one of it.
_STAR, _MEMBER, _FINE = 5, 1, GENERATION_ORDER + 11


def with_standards(rows: Rows, aim: Aim, mission: MissionConfiguration) -> Rows:
    """Rows that a detector may see; in an exposure of a calibration star with five of it, or with the one beside it.

    rows : of the catalogues;  aim : the exposure and detector;  mission : the mission database
    Errors : BadInput for a target that is no standard star
    """
    if aim.exposure.image_type not in _BRIGHTNESS:
        return rows
    target = aim.exposure.target
    if target not in standards.NAMES:
        raise BadInput(
            f"exposure {aim.exposure.exposure_id}: target {target!r} is none of {', '.join(standards.NAMES)}"
        )
    ra, dec = star_positions(aim, mission)
    cell = sky.cell_at(ra, dec, GENERATION_ORDER)
    number = sky.cell_at(ra, dec, _FINE) - (cell << 2 * (_FINE - GENERATION_ORDER))
    ids = source_id(_STAR, cell, number, _MEMBER)
    library = templates.stellar_library()
    # A user's own library has the same standards.
    sed = library.names.index(target)
    magnitude, magnitude_band = brightness(aim.exposure, mission)
    band_flux, reference_flux = (
        float(passbands.ab_flux(band, library.wavelength, library.flux[sed].astype(float)))
        for band in (aim.band, aim.band if magnitude_band == aim.exposure.band else passbands.load(magnitude_band))
    )
    f_nu = 10.0 ** (0.4 * (units.AB_UJY - magnitude)) * band_flux / reference_flux
    # Of the spectrum the shape alone is taken: its H matters not.
    star = {"id": ids, "ra": ra, "dec": dec, "sed": sed, "mag_h": magnitude, "a_v": 0.0}
    return replace(
        rows,
        stars=_append_rows(rows.stars, star),
        star_fluxes=_append_rows(rows.star_fluxes, {"id": ids, f"f_nu_{aim.exposure.band}": f_nu}),
    )


def brightness(exposure: ExposureRow, mission: MissionConfiguration) -> tuple[float, str]:
    """AB magnitude of what an exposure of one of these types is of, and the band that it is in."""
    key, band = _BRIGHTNESS[exposure.image_type]
    return mission.value(key, "mag"), band or exposure.band


def star_positions(aim: Aim, mission: MissionConfiguration) -> tuple[Float, Float]:
    """Where they are: ra [n], dec [n], deg; mission : the mission database."""
    exposure, nx, ny = aim.exposure, aim.detector.nx, aim.detector.ny
    if exposure.image_type == _OUTSIDE:
        # On the tangent plane, which stretches the angle.
        offset_arcsec = np.tan(mission.value("survey.stray_light.distance", "rad")) / pointing.ARCSEC
        return pointing.sky_of_plane([0.0], [offset_arcsec], exposure.ra, exposure.dec, exposure.position_angle)
    x, y = np.array(_PLACES_OF_HALVES if aim.detector.injection_rows else _PLACES).T
    return astrometry.sky_of_pixel(aim.wcs, x * (nx - 1), y * (ny - 1))


def _append_rows(table: pa.Table, values: Mapping[str, Any]) -> pa.Table:
    """A table with one more row a place; its columns without a value are null there."""
    n = len(values["id"])
    columns = [
        pa.array(np.broadcast_to(values[field.name], n)).cast(field.type) if field.name in values
        else pa.nulls(n, field.type)
        for field in table.schema
    ]  # fmt: skip
    return pa.concat_tables([table, pa.table(columns, schema=table.schema)])
