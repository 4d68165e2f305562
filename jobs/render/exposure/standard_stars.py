"""Standard stars and planetary nebulae: what exposures of these types are of, at five places of every detector at once.

with_standards   catalogue rows, and the standard's among them

Ref : Euclid Collaboration: Serrano et al. 2024 (the stars, how bright they are, five places)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from jobs.fluxes import passbands
from jobs.fluxes.libraries import standards, templates
from jobs.render.camera import astrometry
from jobs.render.channels.aim import Aim
from jobs.render.exposure.records import Rows
from lake_schema import sky, units
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER, source_id
from lake_schema.mission.configuration import MissionConfiguration

IMAGE_TYPES = ("standard_star", "planetary_nebula")
# Assumed: in parts of the detector's sides.
_PLACES = ((0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75))
# Their magnitude is of this band.
_BAND = "euclid_y"
# Of an identifier: stars, of which catalogues have no members; and the order whose cells number 22 bits in one of it.
_STAR, _MEMBER, _FINE = 5, 1, GENERATION_ORDER + 11


def with_standards(rows: Rows, aim: Aim, mission: MissionConfiguration) -> Rows:
    """Rows that a detector may see; in an exposure of a standard star with five of it.

    rows : of the catalogues;  aim : the exposure and detector;  mission : the mission database
    Errors : BadInput for a target that is no standard star
    """
    if aim.exposure.image_type not in IMAGE_TYPES:
        return rows
    target, nx, ny = aim.exposure.target, aim.detector.nx, aim.detector.ny
    if target not in standards.NAMES:
        raise BadInput(
            f"exposure {aim.exposure.exposure_id}: target {target!r} is none of {', '.join(standards.NAMES)}"
        )
    x, y = np.array(_PLACES).T
    ra, dec = astrometry.sky_of_pixel(aim.wcs, x * (nx - 1), y * (ny - 1))
    cell = sky.cell_of(ra, dec, GENERATION_ORDER)
    number = sky.cell_of(ra, dec, _FINE) - (cell << 2 * (_FINE - GENERATION_ORDER))
    ids = source_id(_STAR, cell, number, _MEMBER)
    library = templates.stellar_library()
    # A user's own library has the same standards.
    sed = library.names.index(target)
    magnitude = mission.value("survey.calibration.standard_magnitude", "mag")
    seen, reference = (
        float(passbands.ab_flux(band, library.wavelength, library.flux[sed].astype(float)))
        for band in (aim.band, passbands.load(_BAND))
    )
    f_nu = 10.0 ** (0.4 * (units.AB_UJY - magnitude)) * seen / reference
    # Of the spectrum the shape alone is taken: its H matters not.
    star = {"id": ids, "ra": ra, "dec": dec, "sed": sed, "mag_h": magnitude, "a_v": 0.0}
    return replace(
        rows,
        stars=_appended(rows.stars, star),
        star_fluxes=_appended(rows.star_fluxes, {"id": ids, f"f_nu_{aim.exposure.band}": f_nu}),
    )


def _appended(table: pa.Table, values: Mapping[str, Any]) -> pa.Table:
    """A table with one more row a place; its columns without a value are null there."""
    n = len(_PLACES)
    columns = [
        pa.array(np.broadcast_to(values[field.name], n)).cast(field.type) if field.name in values
        else pa.nulls(n, field.type)
        for field in table.schema
    ]  # fmt: skip
    return pa.concat_tables([table, pa.table(columns, schema=table.schema)])
