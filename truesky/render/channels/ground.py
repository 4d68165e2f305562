"""Define the channel of ground cameras: its effects in the order in which light passes through them, and its costs."""

from __future__ import annotations

from collections.abc import Mapping

from truesky.render.camera import bands
from truesky.render.channels import readout
from truesky.render.channels.channel import Channel
from truesky.render.channels.cost import Cost
from truesky.render.effects.charge import (
    bleeding,
    brighter_fatter,
    cosmic_rays,
    dark_current,
    pixel_borders,
    pixel_response,
    poisson,
)
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import (
    background,
    calibration_lamp,
    fringes,
    ground_ghosts,
    illumination,
    pixel_area,
    satellite_trails,
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
)
from truesky.render.psf import seeing
from truesky.render.sky import diffuse_light

SKY = (
    ground_ghosts.EFFECT,
    satellite_trails.EFFECT,
    background.EFFECT,
    pixel_area.EFFECT,
    fringes.EFFECT,
    illumination.EFFECT,
    pixel_response.EFFECT,
    pixel_borders.RINGS,
    pixel_borders.EDGES,
    poisson.EFFECT,
    brighter_fatter.EFFECT,
    dark_current.EFFECT,
    dark_current.HOT,
    cosmic_rays.EFFECT,
    bleeding.EFFECT,
    quadrants.AMPLIFIERS,
    charge_transfer.PARALLEL_LOSS,
    charge_transfer.SERIAL_LOSS,
    nonlinearity.EFFECT,
    crosstalk.EFFECT,
    detector_crosstalk.EFFECT,
    bias_structure.EFFECT,
    read_noise.EFFECT,
    adc.EFFECT,
)


def _effects_from(first: Effect) -> tuple[Effect, ...]:
    """Return the effects of an image of the sky (`SKY`, in physical order) from the effect `first` on, inclusive."""
    return SKY[SKY.index(first) :]


# Effects of a dome flat. It is taken by day, without sky and stars. The light of the lamp passes through the telescope
# like starlight.
FLAT = (calibration_lamp.EFFECT, illumination.EFFECT, *_effects_from(pixel_response.EFFECT))

EFFECTS: Mapping[str, tuple[Effect, ...]] = {
    "science": SKY,
    "deep": SKY,
    "flat": FLAT,
    "dark": _effects_from(dark_current.EFFECT),
    "bias": _effects_from(quadrants.AMPLIFIERS),
}


# Costs of an image (CPU seconds, memory), measured on an Intel Xeon 2.5 GHz for one detector of each camera except HSC,
# with all effects and 1.1e4 to 1.4e5 sources (benchmarks/ext.py), where sky_s was 1.9. In runs of the demo with two
# workers on an AMD EPYC, an LSST detector took 1.5 times the seconds of this model, so that sky_s was increased. Most
# of it (CPU seconds for the sky and its sources, apart from the time per source) is spent on reading catalogues, on
# colours of galaxies and on PSFs.
COST = Cost(
    frame_s=0.2,
    sky_s=2.6,
    galaxy_s=2.5e-5,
    star_s=4.5e-5,
    base_gb=0.8,
    bytes_per_pixel=33.0,
    sky_bytes_per_pixel=34.0,
    file_bytes_per_pixel=2.0,
)

CHANNEL = Channel(
    effects=EFFECTS,
    psf=seeing.exposure_psf,
    readout=readout.AMPLIFIERS,
    bands=bands.ground_bands,
    sky=diffuse_light.ground_sky,
    cost=COST,
    on_ground=True,
    non_source_effects=(calibration_lamp.EFFECT, satellite_trails.EFFECT),
    track_effects=(cosmic_rays.EFFECT,),
    diffraction_edges=seeing.typical_edges,
    has_scattered_light=True,
    alternative_readouts={"amplifiers": readout.BY_AMPLIFIER, "electrons": readout.ELECTRONS},
)
