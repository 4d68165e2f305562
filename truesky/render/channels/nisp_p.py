"""Define channel NISP-P of Euclid (images in filters): its effects in the order in which they act, and its costs.

Pixels have expected (fractional) electrons until noise is drawn for the groups of reads of an up-the-ramp exposure.
Effects of pixels, of their neighbours and of the readout then change the charge of the groups. Finally the signal and
its quality are estimated from the groups, as the spacecraft does.
"""

from __future__ import annotations

from collections.abc import Mapping

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera import bands
from truesky.render.camera.detectors import Detector
from truesky.render.channels import readout
from truesky.render.channels.channel import Channel
from truesky.render.channels.cost import Cost
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.effects.charge import (
    dark_map,
    ipc,
    persistence,
    pixel_response,
    ramp,
    ramp_cosmic_rays,
    ramp_nonlinearity,
)
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import (
    background,
    calibration_lamp,
    chromatic_response,
    ghosts,
    pixel_area,
    straylight,
)
from truesky.render.effects.readout import adc, macc, output_gain, ramp_noise
from truesky.render.psf import euclid
from truesky.render.psf.model import Psf
from truesky.render.sky import diffuse_light

_LIGHT = (
    ghosts.EFFECT,
    ghosts.FILTER,
    straylight.EFFECT,
    background.EFFECT,
    pixel_area.EFFECT,
)
# Effects that add charge without light (dark current, persistence) to NISP detectors, in both images and spectra.
CURRENT = (
    dark_map.EFFECT,
    persistence.EFFECT,
)
# Effects of NISP detectors that act from the collection of charge, in groups of reads of an up-the-ramp exposure, to
# the conversion of the estimated signal to ADU. They are the same in images and in spectra.
RAMP = (
    ramp_cosmic_rays.EFFECT,
    ramp_nonlinearity.EFFECT,
    ramp.EFFECT,
    ipc.EFFECT,
    ramp_noise.RESET,
    ramp_noise.EFFECT,
    ramp_noise.DRIFT,
    output_gain.EFFECT,
    macc.EFFECT,
    ramp_nonlinearity.SIGNAL,
    adc.SIGNAL,
)

SKY = (*_LIGHT, chromatic_response.EFFECT, pixel_response.EFFECT, *CURRENT, *RAMP)
# Effects of a flat, which is assumed to be taken during a slew, without sky and stars.
FLAT = (calibration_lamp.EFFECT, chromatic_response.LAMP, pixel_response.EFFECT, *CURRENT, *RAMP)
DARK = (*CURRENT, *RAMP)

EFFECTS: Mapping[str, tuple[Effect, ...]] = {
    "science": SKY,
    "deep": SKY,
    "self_calibration": SKY,
    "standard_star": SKY,
    "flat": FLAT,
    "dark": DARK,
    "persistence": DARK,
}


def _psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    return euclid.nisp_psf(detector, band, mission, positions)


# Costs of an image (CPU seconds, memory) on the reference machine. The times were measured in runs of the requests
# nisp_spectra and slitless with two workers (see nisp_s.py): 3.4 s at draft accuracy without earlier images, and at
# survey accuracy 5.4 to 5.9 s after one NISP-S image, 10.4 to 11.8 s after four of them and nine to eleven NISP-P
# images, which were then drawn again for each image. A single process that has drawn before needs 1.5 s for 1.2e4
# sources and 1.2 GB. redraw_s is the cost to draw the charge map of an image, once for all later images, and release_s
# the cost of the charge that one earlier image releases. An AMD EPYC with other load took 0.92 to 1.07 s and 0.038 s
# (2.2 to 2.6 s for the map of a NISP-S image), when it took 17.0 to 20.2 s for an image with a forecast of 12.9 s.
# group_s and lamp_frame_s follow from 11 frames without light and 12 flats of DET14, DET22 and DET33, rendered in one
# process of an AMD EPYC with other load, for which `forecasting.speed` measured a factor of 0.83. Darks took 1.4 to
# 2.2 s with 4 groups, 2.6 s with 8, and 4.2 and 4.9 s with 15. Flats of 76 frames took 6.2 to 8.2 s, or 2.0 to 2.3 s if
# the lamp is faint.
COST = Cost(
    frame_s=0.05,
    sky_s=2.6,
    galaxy_s=1.6e-4,
    star_s=1.6e-4,
    base_gb=0.5,
    bytes_per_pixel=120.0,
    sky_bytes_per_pixel=160.0,
    file_bytes_per_pixel=3.0,
    redraw_s=0.7,
    release_s=0.03,
    group_s=0.07,
    lamp_frame_s=0.02,
)

CHANNEL = Channel(
    effects=EFFECTS,
    psf=_psf,
    readout=readout.RAMP,
    bands=bands.single_camera_bands("nisp", "euclid_y", "euclid_j", "euclid_h"),
    sky=diffuse_light.thermal_sky,
    cost=COST,
    sky_types=(*SKY_TYPES, "standard_star"),
    diffraction_edges=euclid.nisp_edges,
    draws_moving_bodies=True,
    non_source_effects=(calibration_lamp.EFFECT,),
    has_scattered_light=True,
    ramp_name="photometric",
    persistence_effect=persistence.EFFECT,
    chromatic_effect=chromatic_response.EFFECT,
)
