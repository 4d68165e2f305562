"""Define a channel: the properties of an instrument mode (such as VIS or NISP-S) for planning and rendering."""

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
    """Functions that describe the slitless spectra of a channel (instrument mode).

    In the signatures below, "exposure" is a row of the table `exposures`, and "mission" the mission database.

    Attributes
    ----------
    traces : callable
        (exposure, detector, mission, seed of the request) -> trace of each spectral order on the detector.
    throughput : callable
        (exposure, spectral order, wavelengths [n] in Angstrom, detector, mission) -> light [n] in this order, relative
        to the light that the passband detects.
    vignetting : callable
        (exposure, detector, columns [n] and rows [n] of undispersed images in 0-based pixels, mission) -> fraction [n]
        of the light of each source that the grism transmits, 0 to 1.
    psf : callable
        (detector, wavelengths [n] in Angstrom, mission, number of positions on the detector at which the PSF is
        computed) -> PSF.
    reach : callable
        (beginning of the camera's parameter names, mission) -> largest distance in arcsec from a detector of a source
        whose first order falls on it.
    selection_band : str
        Band in which the mission may set a flux limit for the sources that are drawn.
    """

    traces: Callable[[ExposureRow, Detector, MissionConfiguration, int], tuple[Trace, ...]]
    throughput: Callable[[ExposureRow, int, Float, Detector, MissionConfiguration], Float]
    vignetting: Callable[[ExposureRow, Detector, Float, Float, MissionConfiguration], Float]
    psf: Callable[[Detector, Float, MissionConfiguration, int], Psf]
    reach: Callable[[str, MissionConfiguration], float]
    selection_band: str


@dataclass(frozen=True, slots=True)
class Channel:
    """Instrument mode (channel), such as VIS, NISP-S or the ground cameras: how it is planned and rendered.

    In the signatures below, "exposure" is a row of the table `exposures`, and "mission" the mission database.

    Attributes
    ----------
    effects : mapping of str to tuple of Effect
        Effects of telescope, detector and electronics for each image type, in the order in which light and charge pass
        through them. Image types that are missing cannot be rendered.
    psf : callable
        (exposure, detector, passband, mission, number of positions on the detector at which it is computed) -> PSF.
    readout : ReadoutMode
        Readout of the detectors, which defines the arrays in the image files.
    bands : callable
        (name of a camera, mission) -> names of its passbands; () if the camera does not belong to the channel.
    sky : callable
        (detector, name of a band, mission, passband or None for the passband of truesky) -> diffuse sky.
    cost : Cost
        Measured costs to render an image of a detector.
    on_ground : bool
        True for ground telescopes, which have no limits on the angle from the Sun.
    sky_types : tuple of str
        Image types in which light of astronomical sources reaches the detectors.
    transfer_effect : Effect or None
        Effect that changes the transfer function (Fourier transform of the PSF) with which sources are drawn, such as
        a sensitivity that varies inside each pixel; None if there is no such effect.
    diffraction_edges : callable or None
        (detector, passband, mission) -> edges of the pupil whose diffraction spikes are drawn far from bright stars;
        None if spikes are not drawn.
    draws_moving_bodies : bool
        True if bodies of the Solar System are drawn.
    non_source_effects : tuple of Effect
        Effects that fill pixels without astronomical sources, such as lamps, satellite trails and injected charge.
    track_effects : tuple of Effect
        Effects that leave tracks of charge, such as cosmic rays; they also act in the dark.
    has_scattered_light : bool
        True if bright sources scatter light to distant pixels (ghosts and stray light).
    ramp_name : str
        Name of the up-the-ramp readout in the mission database, "photometric" or "spectroscopic"; "" if detectors are
        read once.
    persistence_effect : Effect or None
        Effect that adds the persistence of earlier exposures; None if there is no persistence.
    chromatic_effect : Effect or None
        Effect that depends on the colours of sources, because the response of a pixel varies with wavelength. It needs
        `Scene.chromatic_light`, the light of the sources weighted by functions of wavelength. None if no effect does.
    dispersion : Dispersion or None
        Slitless spectra of the sources; None for direct images.
    alternative_readouts : mapping of str to ReadoutMode
        Other formats of the image files that a request may choose, by name.

    Raises
    ------
    BadInput
        If the cost of an effect (CPU seconds per million pixels), with which the time of images is forecast, is not
        positive.
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
        """Return the channel with another format of the image files, such as "amplifiers" or "electrons".

        A format records the pixels at one stage of the detector simulation; effects after this stage are left out. The
        channel is unchanged if it has no format of that name.
        """
        if readout_name not in self.alternative_readouts:
            return self
        mode = self.alternative_readouts[readout_name]
        effects = {
            kind: tuple(takewhile(lambda e: e.name != mode.stop_before, kind_effects))
            for kind, kind_effects in self.effects.items()
        }
        return replace(self, readout=mode, effects=effects)

    def sees_sky(self, image_type: str) -> bool:
        """Return True if light of astronomical sources reaches the detectors in an image type such as "science".

        The result is False for an unknown image type.
        """
        return image_type in self.sky_types

    def margin(self, section: str, mission: MissionConfiguration) -> float:
        """Return the distance beyond a detector, in arcsec, up to which all sources are read from the catalogue.

        For a grism it includes the length of spectra. `section` is the beginning of the camera's parameter names.
        """
        spread = 0.0 if self.dispersion is None else self.dispersion.reach(section, mission)
        return mission.value("survey.selection_margin", "arcsec") + spread

    def sees_bodies(self, image_type: str) -> bool:
        """Return True if the channel draws Solar System bodies and an image type (such as "science") shows the sky."""
        return self.draws_moving_bodies and self.sees_sky(image_type)
