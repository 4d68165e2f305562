"""Plan a nominal exposure: one science exposure of a band, with a detector centred on a given place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lake_schema.errors import BadInput, bad_input
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import EUCLID_BANDS, ExposureRow
from truesky.render.camera import detectors
from truesky.render.camera.detectors import Detector
from truesky.render.camera.pointing import boresight_for
from truesky.render.planning.exposure_chunks import Layout
from truesky.request import instruments
from truesky.request.from_toml import from_table
from truesky.request.toml_values import refuse_name

# Name of the request from which a nominal exposure is planned.
_NAME = "nominal"


def find_instrument(band: str, camera: str | None, mission: MissionConfiguration) -> tuple[str, str]:
    """Return the channel and the camera of a band.

    Parameters
    ----------
    band : str
        Name of the passband.
    camera : str or None
        Name of the camera; None for the first camera that has the band.
    mission : MissionConfiguration
        Mission parameters, which list the cameras and their bands.

    Returns
    -------
    (str, str)
        Names of the channel and of the camera.

    Raises
    ------
    BadInput
        If no camera has the band, or if the camera is unknown or does not have it.
    """
    bands_of = {
        (channel, name): instruments.band_names(channel, name, mission)
        for channel in (*EUCLID_BANDS, instruments.GROUND_CHANNEL)
        for name in instruments.camera_names(channel, mission)
    }
    cameras = list(dict.fromkeys(name for _, name in bands_of))
    if camera is not None and camera not in cameras:
        raise BadInput(f"camera: {refuse_name(camera, cameras)}")
    for (channel, name), bands in bands_of.items():
        if band in bands and camera in (None, name):
            return channel, name
    camera_bands = [each for (_, name), bands in bands_of.items() if camera in (None, name) for each in bands]
    raise BadInput(f"band: {refuse_name(band, list(dict.fromkeys(camera_bands)))}")


def central_detector(camera: str, mission: MissionConfiguration) -> Detector:
    """Return the detector of a camera whose centre is closest to the optical axis, as if it were not mirrored.

    Images without a planned exposure therefore have east to the left, and not to the right as in raw frames of DECam.
    """
    all_detectors = detectors.detectors(camera, mission)
    central = min(all_detectors, key=lambda d: (round(float(np.hypot(d.x, d.y)), 6), d.name))
    return replace(central, is_mirrored=False)


def nominal_exposure(
    instrument: tuple[str, str], band: str, place: tuple[float, float], seed: int, mission: MissionConfiguration,
    mjd: float | None = None,
) -> ExposureRow:  # fmt: skip
    """Plan a science exposure with the nominal exposure time of a band.

    Parameters
    ----------
    instrument : (str, str)
        Names of the channel and of the camera.
    band : str
        Name of the passband.
    place : (float, float)
        Right ascension and declination of the centre of the central detector, deg.
    seed : int
        Seed from which the seeing of ground cameras is drawn.
    mission : MissionConfiguration
        Mission parameters.
    mjd : float, optional
        Start of the exposure (MJD, UTC). By default the date of `ground_surveys.first_date`.

    Returns
    -------
    ExposureRow
        The exposure, with its sky level and seeing.

    Raises
    ------
    BadInput
        If the place cannot be observed at the date.
    """
    (channel, camera), (ra, dec) = instrument, place
    pointing: dict[str, Any] = {
        "channel": channel, "camera": camera, "band": band, "ra": ra, "dec": dec,
        "centre_on": central_detector(camera, mission).name,
    }  # fmt: skip
    if mjd is not None:
        pointing["mjd"] = mjd
    try:
        row = _plan_one(pointing, seed, mission)
    except BadInput as error:
        raise bad_input(message.replace("pointing[0].mjd", "date") for message in error.messages) from None
    return ExposureRow.from_row(row)


def _plan_one(pointing: Mapping[str, Any], seed: int, mission: MissionConfiguration) -> Mapping[str, Any]:
    """Return the row of the table `exposures` for one pointing of a request."""
    area = {"cone": {"ra": pointing["ra"], "dec": pointing["dec"], "radius": 0.1}}
    request = from_table({"name": _NAME, "seed": seed, "area": area, "pointing": [pointing]})
    layout = Layout.from_request(request, mission)
    (row,) = layout.exposures(layout.chunks[0], {}, seed).to_pylist()
    return dict(row)


def move_exposure(exposure: ExposureRow, detector: Detector, place: tuple[float, float]) -> ExposureRow:
    """Return an exposure with the same sky and seeing and another pointing.

    Parameters
    ----------
    exposure : ExposureRow
        The exposure.
    detector : Detector
        Detector of its camera.
    place : (float, float)
        Right ascension and declination of the centre of the detector in the new exposure, deg.

    Returns
    -------
    ExposureRow
        The new exposure, in which the columns of the detector point north at this place. The y axis of the focal plane
        points south if the detector is mounted upside down.
    """
    ra, dec, angle = boresight_for(detector, *place, -detector.row_angle)
    return replace(exposure, ra=ra, dec=dec, position_angle=angle)
