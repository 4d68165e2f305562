"""Properties of an instrument mode that planning and rendering use."""

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
    """Slitless dispersion of the light of sources by a channel.

    Attributes
    ----------
    traces : callable
        (exposure, detector, mission, seed of the request) -> trace of each order.
    throughput : callable
        (exposure, order, wavelengths [n] in Angstrom, detector, mission) -> light of an order [n], relative to the
        light that the passband detects.
    vignetting : callable
        (exposure, detector, columns [n] and rows [n] of undispersed images, mission) -> transmitted fraction [n].
    psf : callable
        (detector, wavelengths [n] in Angstrom, mission, number of positions on the detector) -> PSF.
    reach : callable
        (section, mission) -> largest distance from a detector of a source whose first order falls on it, arcsec.
    selection_band : str
        Band of the flux limit for sources, if the mission sets one.
    """

    traces: Callable[[ExposureRow, Detector, MissionConfiguration, int], tuple[Trace, ...]]
    throughput: Callable[[ExposureRow, int, Float, Detector, MissionConfiguration], Float]
    vignetting: Callable[[ExposureRow, Detector, Float, Float, MissionConfiguration], Float]
    psf: Callable[[Detector, Float, MissionConfiguration, int], Psf]
    reach: Callable[[str, MissionConfiguration], float]
    selection_band: str


@dataclass(frozen=True, slots=True)
class Channel:
    """Everything that distinguishes a channel while a detector is planned and rendered.

    Attributes
    ----------
    effects : mapping
        Effects of each image type, in the order of physics.
    psf : callable
        (exposure, detector, band, mission, number of positions on the detector) -> PSF.
    readout : ReadoutMode
        Readout of its detectors, and the arrays in its files.
    bands : callable
        (camera, mission) -> names of the camera's passbands; () if the channel does not use the camera.
    sky : callable
        (detector, name of a band, mission, its passband or None for the embedded one) -> diffuse sky of the band.
    cost : Cost
        Measured costs per detector.
    on_ground : bool
        True if the telescope may point in any direction; a spacecraft must keep its orientation to the Sun.
    sky_types : tuple of str
        Image types in which light of astronomical sources reaches the detectors.
    transfer_effect : Effect or None
        Effect that is a part of the pixel's transfer function and is applied while sources are drawn.
    diffraction_edges : callable or None
        (detector, band, mission) -> edges of the pupil whose diffraction is drawn far from stars; None if it is not
        drawn.
    draws_moving_bodies : bool
        True if bodies of the Solar System are drawn.
    non_source_effects : tuple of Effect
        Effects that fill pixels without light of the sky, such as lamps and injected charge.
    track_effects : tuple of Effect
        Effects that leave tracks of charge, also in the dark.
    has_scattered_light : bool
        True if bright sources scatter light to distant pixels: ghosts and stray light.
    ramp_name : str
        Ramp of the mission with which its detectors are read (`Scene.ramp`); "" if they are read once.
    persistence_effect : Effect or None
        Effect that adds the persistence of earlier exposures; None if there is no persistence.
    chromatic_effect : Effect or None
        Effect that depends on the colours of sources (`Scene.chromatic_light`); None if no effect does.
    dispersion : Dispersion or None
        Dispersion of the light of sources; None for direct images.
    alternative_readouts : mapping
        Other formats of the files that a request may choose, by name.
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
                    problem = f"effect {effect.name} has the cost {effect.cost:g}, but it must be positive"
                    raise BadInput(f"{problem}: measure it by python -m benchmarks.effects")

    def with_readout(self, readout_name: str) -> Channel:
        """Return the channel with a requested file format; unchanged if the channel has no alternative of that name."""
        if readout_name not in self.alternative_readouts:
            return self
        mode = self.alternative_readouts[readout_name]
        effects = {
            kind: tuple(takewhile(lambda e: e.name != mode.stop_before, kind_effects))
            for kind, kind_effects in self.effects.items()
        }
        return replace(self, readout=mode, effects=effects)

    def sees_sky(self, image_type: str) -> bool:
        """Return True if light of astronomical sources reaches the detectors in this image type."""
        return image_type in self.sky_types

    def margin(self, section: str, mission: MissionConfiguration) -> float:
        """Distance beyond a detector up to which all sources are read, arcsec; `section` is the camera's prefix."""
        spread = 0.0 if self.dispersion is None else self.dispersion.reach(section, mission)
        return mission.value("survey.selection_margin", "arcsec") + spread

    def sees_bodies(self, image_type: str) -> bool:
        """Return True if bodies of the Solar System are drawn in this image type."""
        return self.draws_moving_bodies and self.sees_sky(image_type)
