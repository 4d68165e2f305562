"""Define channel NISP-S of Euclid: slitless spectra through a grism, then the effects of the NISP detectors.

Detectors are read up a longer ramp than in images (NISP-P). Ghosts and stray light of bright sources are not simulated,
since their form through a grism is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import SELECTION_BANDS, ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera import bands, grism_wheel, traces
from truesky.render.camera.detectors import Detector, detectors
from truesky.render.camera.traces import Trace
from truesky.render.channels import image_types, nisp_p, readout
from truesky.render.channels.channel import Channel, Dispersion
from truesky.render.channels.cost import Cost
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.effects.charge import persistence, pixel_response
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import background, calibration_lamp, chromatic_response, dispersed_sky, pixel_area
from truesky.render.psf import double_gaussian, euclid
from truesky.render.psf.model import Psf
from truesky.render.sky import diffuse_light

SKY = (
    background.EFFECT,
    dispersed_sky.EFFECT,
    pixel_area.EFFECT,
    chromatic_response.EFFECT,
    pixel_response.EFFECT,
    *nisp_p.CURRENT,
    *nisp_p.RAMP,
)
# Effects of a flat, which is taken with the grism in the beam. The lamp fills the field of view, so that spectral
# orders overlap and every pixel receives light of the whole spectrum.
FLAT = (calibration_lamp.EFFECT, chromatic_response.LAMP, pixel_response.EFFECT, *nisp_p.CURRENT, *nisp_p.RAMP)
DARK = (*nisp_p.CURRENT, *nisp_p.RAMP)

EFFECTS: Mapping[str, tuple[Effect, ...]] = {
    "science": SKY,
    "deep": SKY,
    "standard_star": SKY,
    "planetary_nebula": SKY,
    "flat": FLAT,
    "dark": DARK,
    "persistence": DARK,
}


def _grism_and_tilt(exposure: ExposureRow, section: str, mission: MissionConfiguration) -> tuple[str, float]:
    """Return the name of the grism of an exposure, and the angle in degrees by which the wheel must tilt it.

    The tilt follows from the requested angle of spectra in the focal plane. Raises BadInput if the exposure has no
    grism or no angle, or if the tilt exceeds `grism_wheel.MAX_TILT`.
    """
    where = f"exposure {exposure.exposure_id}"
    if exposure.grism is None or exposure.grism_angle is None:
        raise BadInput(f"{where}: a spectrum requires a grism and its angle")
    requested_tilt = grism_wheel.tilt(exposure.grism, exposure.grism_angle, section, mission)
    if abs(requested_tilt) > grism_wheel.MAX_TILT:
        angle = f"grism_angle = {exposure.grism_angle:g} deg"
        raise BadInput(
            f"{where}: {angle} turns {exposure.grism} by {requested_tilt:g} deg, more than {grism_wheel.MAX_TILT:g}"
        )
    return exposure.grism, requested_tilt


def _traces(exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, seed: int) -> tuple[Trace, ...]:
    grism, requested_tilt = _grism_and_tilt(exposure, detector.section, mission)
    # The error of the grism wheel is drawn from the identity of the exposure without the number of its repetition, so
    # that repetitions have the same error.
    identity = image_types.identity(replace(exposure, realisation=None))
    return traces.traces(
        grism, grism_wheel.tilt_with_error(requested_tilt, identity, detector.section, mission, seed), detector, mission
    )


def _throughput(
    exposure: ExposureRow, order: int, wavelength: Float, detector: Detector, mission: MissionConfiguration
) -> Float:
    grism, _ = _grism_and_tilt(exposure, detector.section, mission)
    return traces.throughput(grism, order, wavelength, detector, mission)


def _vignetting_throughput(
    exposure: ExposureRow, detector: Detector, column: Float, row: Float, mission: MissionConfiguration
) -> Float:
    _, requested_tilt = _grism_and_tilt(exposure, detector.section, mission)
    u = (column - (detector.nx - 1) / 2) * detector.pixel_scale
    v = (row - (detector.ny - 1) / 2) * detector.pixel_scale
    x, y = detector.to_focal_plane(u, v)
    return grism_wheel.vignetting_throughput(
        x, y, float(exposure.grism_angle or 0.0), requested_tilt, detector.section, mission
    )


def _reach(section: str, mission: MissionConfiguration) -> float:
    """Return the largest distance from a detector, in arcsec, of a source whose first-order spectrum may fall on it.

    It is the maximum over all grisms of the camera, without tilt. `section` is the prefix of the camera's parameters in
    the mission database, such as "nisp".
    """
    first = detectors(section, mission)[0]
    distances = [
        abs(edge - inside)
        for grism in sorted({row["grism"] for row in mission.rows(f"{section}.traces")})
        for trace in traces.traces(grism, 0.0, first, mission)
        if trace.order == 1
        for edge, inside in zip(
            traces.source_rectangle(trace, first.nx, first.ny, (trace.first, trace.last)),
            (0.0, first.nx - 1.0, 0.0, first.ny - 1.0),
            strict=True,
        )
    ]
    return max(distances) * first.pixel_scale


def _psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    """Return the PSF at the mean wavelength of a band, weighted by its response; `exposure` is not used.

    `positions` is the number of positions on the detector at which the PSF is computed.
    """
    middle = np.array([np.average(band.wavelength, weights=band.response)])
    return _psf_at(detector, middle, mission, positions)


def _psf_at(detector: Detector, waves: Float, mission: MissionConfiguration, positions: int) -> Psf:
    """Return the PSF at wavelengths `waves` (Angstrom).

    The mission parameter `spectra.psf` selects diffraction at the pupil (0), or the double Gaussian of Serrano et al.
    2024 (1). For diffraction, `positions` is the number of positions on the detector at which the PSF is computed.
    """
    if mission.value(f"{detector.section}.spectra.psf", "") < 0.5:
        return euclid.nisp_psf_at(detector, waves, mission, positions)
    return double_gaussian.psf_at(detector, waves, mission)


# Costs of an image (CPU seconds, memory) on the reference machine. The times were measured in runs of the requests
# nisp_spectra (survey accuracy, galaxies to H = 24) and slitless (draft accuracy, to I_E = 25.5) with two workers on an
# AMD EPYC, whose factor is 0.67 (forecasting/speed.py), and 1.25 more with two workers. Images of the sky took 38 and
# 25 s. Both contained 1.6e4 spectra: three times the 5.6e3 sources on the detector with H < 24, because the spectra of
# sources up to 10 arcmin around it fall on it. The spectra of fainter sources are not noticeable. With eight truth maps
# (images of the true signals), Spark tasks use 1.6 to 2.3 GB; darks and flats with four maps use 1.4 to 1.8 GB.
# nisp_p.py explains redraw_s and release_s, the costs of the persistence of an earlier image, and group_s. lamp_frame_s
# follows from four flats of 394 frames, 23.2 to 23.7 s.
COST = Cost(
    frame_s=0.05,
    sky_s=0.5,
    galaxy_s=7.6e-3,
    star_s=7.6e-3,
    base_gb=0.6,
    bytes_per_pixel=190.0,
    sky_bytes_per_pixel=240.0,
    file_bytes_per_pixel=3.0,
    redraw_s=1.6,
    release_s=0.03,
    group_s=0.07,
    lamp_frame_s=0.014,
    most_sources=5600.0,
)

CHANNEL = Channel(
    effects=EFFECTS,
    psf=_psf,
    readout=readout.RAMP_AND_CHI2,
    bands=bands.single_camera_bands("nisp", "nisp_red", "nisp_blue"),
    sky=diffuse_light.thermal_sky,
    cost=COST,
    sky_types=(*SKY_TYPES, "standard_star", "planetary_nebula"),
    draws_moving_bodies=True,
    non_source_effects=(calibration_lamp.EFFECT,),
    ramp_name="spectroscopic",
    chromatic_effect=chromatic_response.EFFECT,
    persistence_effect=persistence.EFFECT,
    dispersion=Dispersion(_traces, _throughput, _vignetting_throughput, _psf_at, _reach, SELECTION_BANDS["NISP-S"]),
)
