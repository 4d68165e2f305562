"""What an effect is, what it may know of an exposure, and the loop that applies a channel's effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.accuracy import SURVEY, Accuracy
from jobs.fluxes.passbands import Passband
from jobs.render.focal_plane import Detector
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import MissionConfiguration

Frame = npt.NDArray[np.float64]

# An effect is needed where its largest contribution exceeds this part of a pixel's noise; and what comes back in every
# frame, or in every pixel, where it exceeds this part of the noise that is left in the mean of so many: 32 x 32 pixels
# of the sky, or of one in a stack of 1024 frames.
NOTICEABLE, STACK = 0.1, 1024


# Boltzmann's constant, eV / K (CODATA 2018).
_BOLTZMANN = 8.617333e-5


def warmth(temperature: float, reference: float, band_gap: float) -> float:
    """Dark current over that at the reference temperature, K; band gap in eV.

    Ref : Janesick 2001, Scientific Charge-Coupled Devices: T^1.5 exp(-Eg / 2 k T)
    """
    for value in (temperature, reference):
        if not 50.0 <= value <= 400.0:
            raise OutOfRange("detector temperature", value, 50.0, 400.0)
    exponent = band_gap / (2.0 * _BOLTZMANN) * (1.0 / temperature - 1.0 / reference)
    return float((temperature / reference) ** 1.5 * np.exp(-exponent))


@dataclass(frozen=True, slots=True)
class Lights:
    """Bright sources on a detector and around it, as points.

    column, row : float64[n] 0-based pixel position, also outside the frame
    electrons   : float64[n] expected in the exposure
    """

    column: Frame = field(default_factory=lambda: np.zeros(0))
    row: Frame = field(default_factory=lambda: np.zeros(0))
    electrons: Frame = field(default_factory=lambda: np.zeros(0))

    def and_those(self, more: Lights) -> Lights:
        """These, then those."""
        return Lights(
            np.append(self.column, more.column),
            np.append(self.row, more.row),
            np.append(self.electrons, more.electrons),
        )


@dataclass(frozen=True, slots=True)
class Scene:
    """What effects may know of an exposure of one detector.

    section        : prefix of the detector's parameters, "vis" or "ext.lsstcam"
    sky_rate       : electrons per second in a pixel
    peak_electrons : brightest pixel of the expected image: of the sources, with a lamp's light or injected charge
    track_electrons : brightest likely pixel of cosmic rays' tracks, where there are some
    detector       : where it lies in the focal plane; None: at its centre
    lights         : what shines around corners: ghosts, straylight
    lamp           : the LED of a flat, from 1
    forced         : effect name -> on or off, instead of what the scene needs
    band           : the exposure's passband, None = the embedded one
    """

    mission: MissionConfiguration
    section: str
    exposure_time_s: float
    sky_rate: float
    peak_electrons: float
    detector: Detector | None = None
    lights: Lights = field(default_factory=Lights)
    lamp: int = 1
    accuracy: Accuracy = SURVEY
    forced: Mapping[str, bool] = field(default_factory=dict)
    band: Passband | None = None
    track_electrons: float = 0.0

    def value(self, key: str, unit: str) -> float:
        """A parameter of the detector."""
        return self.mission.value(f"{self.section}.{key}", unit)

    @property
    def nx(self) -> int:
        """Columns of its detector; without one, of the mission's."""
        return self.detector.nx if self.detector is not None else int(self.value("fpa.nx", "pix"))

    @property
    def ny(self) -> int:
        """Rows, likewise."""
        return self.detector.ny if self.detector is not None else int(self.value("fpa.ny", "pix"))

    @property
    def middle(self) -> int:
        """Rows between the halves, that are not read."""
        return self.detector.middle if self.detector is not None else 0

    @property
    def half_rows(self) -> int:
        """Rows that are read through one register, of two."""
        return (self.ny - self.middle) // 2

    @property
    def unread(self) -> tuple[int, int]:
        """The first row between the halves, and the first of the upper half."""
        return self.half_rows, self.half_rows + self.middle

    @property
    def sky_electrons(self) -> float:
        return self.sky_rate * self.exposure_time_s

    @property
    def brightest_electrons(self) -> float:
        """Of a pixel, whatever has brought them: what is read is squeezed and left behind alike."""
        return max(self.peak_electrons, self.track_electrons) + self.sky_electrons

    @property
    def warmth(self) -> float:
        """Thermal electrons over those at the temperature that they are given at."""
        # Ground cameras are given at the temperature they are run at.
        if f"{self.section}.detector_temperature" not in self.mission:
            return 1.0
        temperatures = self.value("detector_temperature", "K"), self.value("dark_reference_temperature", "K")
        return warmth(*temperatures, self.value("dark_band_gap", "eV"))

    @property
    def dark_rate(self) -> float:
        """Dark current at the detector's temperature, e-/s in a pixel."""
        return self.value("dark_current", "electron / (s pix)") * self.warmth

    @property
    def dark_electrons(self) -> float:
        return self.dark_rate * self.exposure_time_s

    @property
    def pixel_noise(self) -> float:
        """Electrons rms of a pixel without a source: sky, dark current, reading."""
        read_noise = self.value("read_noise", "electron")
        return float(np.sqrt(self.sky_electrons + self.dark_electrons + read_noise**2))


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect.

    apply        : (frame, *parameters, rng) -> frame; never writes its argument
    parameters   : scene -> the numbers that `apply` wants
    contribution : scene -> its largest change of a pixel, electrons; rms, of what is random
    repeated     : scene -> the part of it that a mean over frames or pixels keeps, electrons; None = all of it
    optional     : False where the frame is no product without it
    fixed        : a pattern of the detector itself: its random numbers are the same in every exposure
    numbers      : the effect whose random numbers it takes, "" = its own
    cost         : seconds a million pixels take on one core (measured by benchmarks/effects)
    """

    name: str
    apply: Callable[..., Frame]
    parameters: Callable[[Scene], tuple[Any, ...]]
    contribution: Callable[[Scene], float]
    optional: bool = True
    fixed: bool = False
    numbers: str = ""
    cost: float = 0.0
    repeated: Callable[[Scene], float] | None = None

    def margin(self, scene: Scene) -> float:
        """Contribution over what would be noticed, in a pixel or in a mean: above 1 the effect is needed."""
        repeated = float((self.repeated or self.contribution)(scene))
        change = max(float(self.contribution(scene)), math.sqrt(STACK) * repeated)
        noise = NOTICEABLE * scene.pixel_noise
        # Without any noise everything is noticed.
        return change / noise if noise > 0.0 else math.inf if change > 0.0 else 0.0

    def needed_if(self, scene: Scene) -> bool:
        """Whether the scene needs it, or no frame can do without it, whatever a request forces."""
        return not self.optional or self.margin(scene) > 1.0

    def applied(self, scene: Scene) -> bool:
        """Whether it is applied to the scene: as its request forces it, else as the scene needs it."""
        return scene.forced.get(self.name, self.needed_if(scene))


def nothing(scene: Scene) -> float:
    """Of a contribution what a mean keeps, where it is noise."""
    return 0.0


def by_pixel(kernel: Callable[..., None], frame: Frame, *numbers: Any) -> Frame:
    """A new frame of the same shape, in which a compiled kernel(before [n], after [n], *numbers) has set each pixel."""
    out = np.empty(frame.shape)
    kernel(np.ascontiguousarray(frame, dtype=float).reshape(-1), out.reshape(-1), *numbers)
    return out


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether an effect was applied, why, and by which margin."""

    name: str
    applied: bool
    forced: bool
    margin: float


def decide(effects: Sequence[Effect], scene: Scene) -> tuple[Decision, ...]:
    """What a scene needs, and what is forced on or off in it (effects of other channels do nothing)."""
    for effect in effects:
        if not effect.optional and not effect.applied(scene):
            raise BadInput(f"effect {effect.name} cannot be switched off")
    return tuple(
        Decision(effect.name, effect.applied(scene), effect.name in scene.forced, effect.margin(scene))
        for effect in effects
    )


def apply_all(
    frame: Frame,
    effects: Sequence[Effect],
    scene: Scene,
    stream: Callable[[Effect], np.random.Generator],
    watch: Callable[[str, Frame, Frame], None] | None = None,
) -> tuple[Frame, tuple[Decision, ...]]:
    """Apply a channel's effects in their order.

    stream : effect -> its own generator, so that switching one effect off leaves the draws of the others as they were
    watch  : sees the name of an effect that is applied, and the frame before and after it
    """
    decisions = decide(effects, scene)
    for effect, decision in zip(effects, decisions, strict=True):
        if decision.applied:
            before, frame = frame, effect.apply(frame, *effect.parameters(scene), rng=stream(effect))
            if watch is not None:
                watch(effect.name, before, frame)
            # Frames are large: the next effect needs one.
            del before
    return frame, decisions
