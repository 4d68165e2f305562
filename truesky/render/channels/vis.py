"""Define channel VIS of Euclid: its effects in the order in which light and charge pass through them, and its costs.

Pixels have expected (fractional) electrons until photon noise is drawn, then whole electrons. The detector is then read
in four quadrants, and the last effects are due to the electronics.
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
    bleeding,
    brighter_fatter,
    charge_injection,
    cosmic_rays,
    dark_current,
    pixel_response,
    poisson,
)
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import (
    background,
    calibration_lamp,
    ghosts,
    illumination,
    intra_pixel,
    pixel_area,
    straylight,
)
from truesky.render.effects.readout import (
    adc,
    bias_structure,
    charge_transfer,
    crosstalk,
    detector_crosstalk,
    nonlinearity,
    quadrants,
    read_noise,
    readout_cosmic_rays,
    readout_trail,
    trap_pumping,
)
from truesky.render.psf import euclid
from truesky.render.psf.model import Psf
from truesky.render.sky import diffuse_light

# Effect that changes the transfer function (Fourier transform of the PSF and the pixel) with which sources are drawn:
# pixels are more sensitive at their centre.
TRANSFER_EFFECT = intra_pixel.EFFECT

_LIGHT = (
    ghosts.EFFECT,
    straylight.EFFECT,
    background.EFFECT,
    pixel_area.EFFECT,
    illumination.EFFECT,
)
_COUNTED = (
    pixel_response.EFFECT,
    poisson.EFFECT,
    brighter_fatter.EFFECT,
)
_CHARGE = (
    dark_current.EFFECT,
    dark_current.HOT,
    cosmic_rays.EFFECT,
    bleeding.EFFECT,
)
_READOUT = (
    quadrants.EFFECT,
    charge_transfer.PARALLEL,
    readout_cosmic_rays.READOUT,
    charge_transfer.SERIAL,
    nonlinearity.EFFECT,
    crosstalk.EFFECT,
    detector_crosstalk.EFFECT,
    bias_structure.EFFECT,
    bias_structure.DRIFT,
    bias_structure.ROW_NOISE,
    read_noise.EFFECT,
    adc.EFFECT,
)

SKY = (*_LIGHT, illumination.SHUTTER, *_COUNTED, *_CHARGE, *_READOUT)
# Effects of a flat. It is taken with an open shutter and contains sky and stars, and the trails of both during readout.
# The lamp is switched off before the readout, and its brightness does not depend on the exposure time.
FLAT = (
    *_LIGHT,
    readout_trail.EFFECT,
    calibration_lamp.EFFECT,
    *_COUNTED,
    *_CHARGE,
    *_READOUT,
)
DARK = (*_CHARGE, *_READOUT)
_INJECTED = (charge_injection.EFFECT, charge_injection.NOISE)
INJECTION = (*_INJECTED, bleeding.EFFECT, *_READOUT)
# Effects of trap pumping, which takes minutes with a closed shutter: dark current and cosmic rays accumulate.
PUMPING = (*_INJECTED, trap_pumping.EFFECT, *_CHARGE, *_READOUT)
# Image types of calibration exposures on the sky, which have the same detector effects as science images.
_CHECKS = ("defocus", "bleeding", "stray_light", "white_dwarf")

EFFECTS: Mapping[str, tuple[Effect, ...]] = {
    "science": SKY,
    "deep": SKY,
    "self_calibration": SKY,
    "flat": FLAT,
    "dark": DARK,
    "charge_injection": INJECTION,
    "trap_pumping": PUMPING,
    **dict.fromkeys(_CHECKS, SKY),
    "bias": _READOUT,
}


def _psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    return euclid.vis_psf(detector, band, mission, positions)


# Costs of an image (CPU seconds, memory), measured on an Intel Xeon 2.5 GHz with 2 shared cores: for detectors with
# 3e2, 5.5e3 and 2.7e4 predicted sources, and for bias, dark and flat frames.
COST = Cost(
    frame_s=0.05,
    sky_s=1.5,
    galaxy_s=5.0e-4,
    star_s=8.5e-4,
    base_gb=0.5,
    bytes_per_pixel=48.0,
    sky_bytes_per_pixel=57.0,
    file_bytes_per_pixel=2.1,
)

CHANNEL = Channel(
    effects=EFFECTS,
    psf=_psf,
    readout=readout.QUADRANTS,
    bands=bands.single_camera_bands("vis", "euclid_vis"),
    sky=diffuse_light.starlit_sky,
    cost=COST,
    # Flats belong to the types that see the sky, because they are taken with an open shutter.
    sky_types=(*SKY_TYPES, *_CHECKS, "flat"),
    transfer_effect=TRANSFER_EFFECT,
    diffraction_edges=euclid.vis_edges,
    draws_moving_bodies=True,
    non_source_effects=(calibration_lamp.EFFECT, *_INJECTED, trap_pumping.EFFECT),
    track_effects=(cosmic_rays.EFFECT, readout_cosmic_rays.READOUT),
    has_scattered_light=True,
)
