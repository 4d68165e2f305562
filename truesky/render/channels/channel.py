"""What an instrument's mode is to the renderer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import takewhile

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera.detectors import Detector
from truesky.render.camera.traces import Trace
from truesky.render.channels.cost import Cost
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.channels.readout import ReadoutMode
from truesky.render.effects.effect import Effect
from truesky.render.psf.model import Psf
from truesky.render.psf.spikes import Edges
from truesky.render.sky.diffuse_light import SkyBand


@dataclass(frozen=True, slots=True)
class Dispersion:
    """How a channel spreads the light of sources out, without a slit.

    traces     : (exposure, detector, mission, seed of the request) -> where each order puts it
    throughput : (exposure, order, wavelengths [n] A, detector, mission) -> [n] light of an order, of what the
                 passband detects
    vignetted  : (exposure, detector, columns [n], rows [n] of undispersed images, mission) -> [n] part of the sources'
                 light that is let through
    psf        : (detector, wavelengths [n] A, mission, positions on the detector) -> PSF
    reach      : (section, mission) -> arcsec beyond a detector, as far as all sources are read: those whose first order
                 is on it
    chosen_by  : band in which sources are bright enough, where the mission says how bright they are to be
    """

    traces: Callable[[ExposureRow, Detector, MissionConfiguration, int], tuple[Trace, ...]]
    throughput: Callable[[ExposureRow, int, Float, Detector, MissionConfiguration], Float]
    vignetting: Callable[[ExposureRow, Detector, Float, Float, MissionConfiguration], Float]
    psf: Callable[[Detector, Float, MissionConfiguration, int], Psf]
    reach: Callable[[str, MissionConfiguration], float]
    selection_band: str


@dataclass(frozen=True, slots=True)
class Channel:
    """All that differs from channel to channel while a detector is planned and rendered.

    effects    : image type -> its effects, in the order of physics
    psf        : (exposure, detector, band, mission, positions on the detector) -> PSF
    readout    : how its detectors are read, and which arrays their files have
    bands      : (camera, mission) -> names of the camera's passbands; () where the channel has no such camera
    sky        : (detector, name of a band, mission, its passband, None = the embedded one) -> the diffuse sky of a band
    cost       : of a detector, measured
    on_ground  : whether it looks where it wants: a spacecraft keeps its side to the Sun
    sky_types  : image types in which sources shine on the detectors
    drawn      : effect that is part of the pixel's transfer function: it acts while sources are drawn
    pupil      : (detector, band, mission) -> diffraction far from a star; None: not drawn
    moving     : whether bodies of the Solar System are drawn
    own_light  : effects that fill pixels besides the sky and its sources: lamps, injected charge
    tracks     : effects that leave tracks of charge, in the dark, too
    scattered  : whether bright sources beside a pixel shine into it: ghosts, stray light
    ramp       : which of the mission's ramps its detectors are read up (Scene.ramp); "" = they are read once
    remembers  : effect that brings what earlier exposures left; None: they leave nothing
    coloured   : effect by which pixels see the colours of sources (Scene.tints); None: all see them alike
    readouts   : other ways in which a request may have its detectors' files, by their names
    disperses  : how the light of sources is spread out; None: it is not
    """

    effects: Mapping[str, tuple[Effect, ...]]
    psf: Callable[[ExposureRow, Detector, Passband, MissionConfiguration, int], Psf]
    readout: ReadoutMode
    bands: Callable[[str, MissionConfiguration], tuple[str, ...]]
    sky: Callable[[Detector, str, MissionConfiguration, Passband | None], SkyBand]
    cost: Cost
    on_ground: bool = False
    sky_types: tuple[str, ...] = SKY_TYPES
    transfer_effect: Effect | None = None
    diffraction_edges: Callable[[Detector, Passband, MissionConfiguration], Edges | None] | None = None
    draws_moving_bodies: bool = False
    non_source_effects: tuple[Effect, ...] = ()
    track_effects: tuple[Effect, ...] = ()
    has_scattered_light: bool = False
    ramp_name: str = ""
    persistence_effect: Effect | None = None
    chromatic_effect: Effect | None = None
    dispersion: Dispersion | None = None
    alternative_readouts: Mapping[str, ReadoutMode] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for effects in self.effects.values():
            for effect in effects:
                if not effect.cost > 0.0:
                    problem = f"effect {effect.name} has the cost {effect.cost:g}: a forecast would take it as free"
                    raise BadInput(f"{problem}; python -m benchmarks.effects measures it")

    def with_readout(self, readout_name: str) -> Channel:
        """With the files that a request asks for; as it is where it has no other way of that name."""
        if readout_name not in self.alternative_readouts:
            return self
        mode = self.alternative_readouts[readout_name]
        effects = {
            kind: tuple(takewhile(lambda e: e.name != mode.stop_before, kind_effects))
            for kind, kind_effects in self.effects.items()
        }
        return replace(self, readout=mode, effects=effects)

    def sees_sky(self, image_type: str) -> bool:
        """Whether sources shine on the detectors."""
        return image_type in self.sky_types

    def margin(self, section: str, mission: MissionConfiguration) -> float:
        """How far beyond a detector all sources are read, arcsec; section : of its camera in the mission database."""
        spread = 0.0 if self.dispersion is None else self.dispersion.reach(section, mission)
        return mission.value("survey.selection_margin", "arcsec") + spread

    def sees_bodies(self, image_type: str) -> bool:
        """Whether moving bodies are drawn."""
        return self.draws_moving_bodies and self.sees_sky(image_type)
