"""Add the target of a calibration exposure to its catalogue rows: copies of a star or nebula on each detector.

There are five copies at fixed positions on every detector. The star of a stray-light check is a single one outside the
field.

References
----------
Euclid Collaboration: Serrano et al. 2024 (stars, their magnitudes, and the five positions).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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
from truesky.render.sources.point_light import append_rows

# For each image type with a calibration target: the name of the parameter in the mission database with the AB magnitude
# of the target, and the band of this magnitude ("" for the band of the exposure).
_BRIGHTNESS = {
    "standard_star": ("survey.calibration.standard_magnitude", "euclid_y"),
    "planetary_nebula": ("survey.calibration.standard_magnitude", "euclid_y"),
    "bleeding": ("survey.bleeding.magnitude", ""),
    "white_dwarf": ("survey.white_dwarf.magnitude", ""),
    "stray_light": ("survey.stray_light.magnitude", ""),
}
# Image type whose target is a single star outside the field of view: a check of stray light.
_OUTSIDE = "stray_light"
# Assumed positions of the five copies of a calibration star on a detector, as fractions (x, y) of its width and height.
_PLACES = ((0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75))
# Positions of the five copies of a calibration star on a detector whose middle rows are not read, as fractions (x, y)
# of its width and height: no star is in the middle.
_PLACES_OF_HALVES = ((0.25, 0.25), (0.75, 0.25), (0.4, 0.4), (0.25, 0.75), (0.75, 0.75))
# Number that stands for stars in the identifiers of sources (`lake_schema.ids.source_id`, argument `kind`).
_STAR = 5
# Last part (member number) of the identifiers of calibration stars; it is 0 in identifiers of catalogue stars.
_MEMBER = 1
# HEALPix order of the fine cells by which calibration stars are numbered. A generation cell (HEALPix cell in which the
# catalogue is generated) has 2^22 of them.
_FINE = GENERATION_ORDER + 11


def with_standards(rows: Rows, aim: Aim, mission: MissionConfiguration) -> Rows:
    """Add the target of a calibration exposure to the stars in its catalogue rows.

    Parameters
    ----------
    rows : Rows
        Catalogue rows.
    aim : Aim
        Exposure and detector.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras), with the magnitudes of the targets.

    Returns
    -------
    Rows
        Rows with five copies of the target on the detector, or with one star outside the field for a stray-light check.
        Rows of exposures that are no such calibrations are unchanged.

    Raises
    ------
    BadInput
        If the target of the exposure is not one of `standards.NAMES`.
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
    # Every stellar library, also one from a user, contains the standard stars, so that the target has the same row here
    # as in the library that is used for drawing.
    sed = library.names.index(target)
    magnitude, magnitude_band = brightness(aim.exposure, mission)
    band_flux, reference_flux = (
        float(passbands.ab_flux(band, library.wavelength, library.flux[sed].astype(float)))
        for band in (aim.band, aim.band if magnitude_band == aim.exposure.band else passbands.load(magnitude_band))
    )
    f_nu = 10.0 ** (0.4 * (units.AB_UJY - magnitude)) * band_flux / reference_flux
    # A row of the table `stars` needs `mag_h`. Its value does not matter, because only the shape of the spectrum is
    # used, and the flux is given separately.
    star = {"id": ids, "ra": ra, "dec": dec, "sed": sed, "mag_h": magnitude, "a_v": 0.0}
    return replace(
        rows,
        stars=append_rows(rows.stars, star),
        star_fluxes=append_rows(rows.star_fluxes, {"id": ids, f"f_nu_{aim.exposure.band}": f_nu}),
    )


def brightness(exposure: ExposureRow, mission: MissionConfiguration) -> tuple[float, str]:
    """Return the AB magnitude of the target of a calibration exposure, and the band of this magnitude.

    KeyError is raised if the image type has no such target.
    """
    key, band = _BRIGHTNESS[exposure.image_type]
    return mission.value(key, "mag"), band or exposure.band


def star_positions(aim: Aim, mission: MissionConfiguration) -> tuple[Float, Float]:
    """Return right ascension and declination, degrees [n], of the copies of a calibration target for one detector.

    n is 5, or 1 for the star outside the field of a stray-light check.
    """
    exposure, nx, ny = aim.exposure, aim.detector.nx, aim.detector.ny
    if exposure.image_type == _OUTSIDE:
        # On the tangent plane, the distance of a star from the pointing is the tangent of the angle.
        offset_arcsec = np.tan(mission.value("survey.stray_light.distance", "rad")) / pointing.ARCSEC
        return pointing.sky_of_plane([0.0], [offset_arcsec], exposure.ra, exposure.dec, exposure.position_angle)
    x, y = np.array(_PLACES_OF_HALVES if aim.detector.injection_rows else _PLACES).T
    return astrometry.sky_of_pixel(aim.wcs, x * (nx - 1), y * (ny - 1))
