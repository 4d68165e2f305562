"""What an effect may know of an exposure of one detector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.detector_overrides import DetectorPlace
from truesky.fluxes.passbands import Passband
from truesky.render.camera import amplifiers
from truesky.render.camera.amplifiers import Layout
from truesky.render.camera.detectors import Detector
from truesky.request.accuracy import SURVEY, Accuracy

Frame = Float

# An effect is needed where its largest contribution exceeds this part of a pixel's noise; and what comes back in every
# frame, or in every pixel, where it exceeds this part of the noise that is left in the mean of so many: 32 x 32 pixels
# of the sky, or of one in a stack of 1024 frames.
NOTICEABLE, STACK_SIZE = 0.1, 1024


# Boltzmann's constant, eV / K (CODATA 2018).
_BOLTZMANN = 8.617333e-5


def dark_current_scaling(temperature: float, reference: float, band_gap: float) -> float:
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

    def concatenate(self, other: Lights) -> Lights:
        """These, then those."""
        return Lights(
            np.append(self.column, other.column),
            np.append(self.row, other.row),
            np.append(self.electrons, other.electrons),
        )


@dataclass(frozen=True, slots=True)
class NeighbourCharge:
    """What other detectors hold while one is read.

    pixel     : int64[n] of the parts of the detector in readout order, counted on; each once
    electrons : float64[n]
    """

    pixel: Int
    electrons: Frame


@dataclass(frozen=True, slots=True)
class Scene:
    """What effects may know of an exposure of one detector.

    section        : prefix of the detector's parameters, "vis" or "ext.lsstcam"
    sky_rate       : electrons per second in a pixel
    peak_electrons : brightest pixel of the expected image: of the sources, with a lamp's light or injected charge
    track_electrons : brightest likely pixel of cosmic rays' tracks, where there are some
    detector       : where it lies in the focal plane; None: at its centre
    lights         : sources of scattered light: ghosts, straylight
    lamp           : the LED of a flat, from 1
    forced         : effect name -> on or off, instead of what the scene needs
    band           : the exposure's passband, None = the embedded one
    ramp           : which of the mission's ramps the detector is read up, "photometric" or "spectroscopic"; "" = it is
                     read once
    remembered     : [ny, nx] e- that earlier exposures leave in this one; None = nothing
    tints          : float32[2, ny, nx] of `chromatic_response`: sources of which pixels see the colour; None = of none
    spread_sky     : [gy, gx] e- that a grism changes of the sky, at places evenly over the detector; None = nothing
    tint_electrons : the most that this changes in a pixel, e- rms
    seeing         : FWHM, arcsec, of a ground camera's exposure;  zero_point : AB magnitude of 1 e-/s
    elsewhere      : charge of the detectors that are read with this one; None = none that is noticed
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
    ramp: str = ""
    persistence_charge: Frame | None = None
    chromatic_light: Float32 | None = None
    chromatic_electrons: float = 0.0
    sky_change: Frame | None = None
    neighbour_charge: NeighbourCharge | None = None
    seeing: float = 0.0
    zero_point: float = 0.0

    def value(self, key: str, unit: str) -> float:
        """A parameter of the detector."""
        return self.mission.value(f"{self.section}.{key}", unit, DetectorPlace(self._detector_name))

    def amplifier_values(self, key: str, unit: str) -> float | Float:
        """A parameter of its amplifiers: float64[q] in the order in which they are read; one number where all agree."""
        if self.detector is not None and self.layout is not None:
            return amplifiers.values(key, unit, self.detector, self.mission, self.layout)
        values = self.mission.amplifier_values(f"{self.section}.{key}", unit, self._detector_name)
        return np.array(values) if len(values) > 1 else values[0]

    @property
    def layout(self) -> Layout | None:
        """Its amplifiers, of a ground camera's detector; None: it is read in quadrants, or as one frame."""
        return None if self.detector is None else amplifiers.layout(self.detector, self.mission)

    @property
    def column_segments(self) -> tuple[tuple[int, int, bool], ...]:
        """Pieces of its columns: first row, the one past the last, whether their charge leaves upwards."""
        if self.layout is not None:
            return self.layout.column_segments
        lower, upper = self.unread_rows
        return (0, lower, False), (upper, self.ny, True)

    @property
    def _detector_name(self) -> str:
        return self.detector.name if self.detector is not None else ""

    @property
    def nx(self) -> int:
        """Columns of its detector; without one, of the mission's."""
        return self.detector.nx if self.detector is not None else int(self.value("fpa.nx", "pix"))

    @property
    def ny(self) -> int:
        """Rows, likewise."""
        return self.detector.ny if self.detector is not None else int(self.value("fpa.ny", "pix"))

    @property
    def injection_rows(self) -> int:
        """Rows between the halves, that are not read."""
        return self.detector.injection_rows if self.detector is not None else 0

    @property
    def half_rows(self) -> int:
        """Rows that are read through one register, of two."""
        return (self.ny - self.injection_rows) // 2

    @property
    def unread_rows(self) -> tuple[int, int]:
        """The first row between the halves, and the first of the upper half."""
        return self.half_rows, self.half_rows + self.injection_rows

    @property
    def sky_electrons(self) -> float:
        return self.sky_rate * self.exposure_time_s

    @property
    def brightest_electrons(self) -> float:
        """Of a pixel, whatever has brought them: what is read is squeezed and left behind alike."""
        return max(self.peak_electrons, self.track_electrons) + self.sky_electrons

    @property
    def dark_current_scaling(self) -> float:
        """Thermal electrons over those at the temperature that they are given at."""
        # Ground cameras are given at the temperature they are run at.
        if f"{self.section}.detector_temperature" not in self.mission:
            return 1.0
        temperatures = self.value("detector_temperature", "K"), self.value("dark_reference_temperature", "K")
        return dark_current_scaling(*temperatures, self.value("dark_band_gap", "eV"))

    @property
    def dark_rate(self) -> float:
        """Dark current at the detector's temperature, e-/s in a pixel."""
        return self.value("dark_current", "electron / (s pix)") * self.dark_current_scaling

    @property
    def dark_electrons(self) -> float:
        return self.dark_rate * self.exposure_time_s

    @property
    def pixel_noise(self) -> float:
        """Electrons rms of a pixel without a source: sky, dark current, reading."""
        # In the mean over the detector.
        dispersed = 0.0 if self.sky_change is None else float(self.sky_change.mean())
        return float(np.sqrt(max(self.sky_electrons + dispersed, 0.0) + self.dark_electrons + self.reading_noise**2))

    @property
    def reading_noise(self) -> float:
        """Electrons rms that reading adds to a pixel; of a ramp, to its signal.

        Error : of a ramp, that of the difference of its last group and its first: 4 % below the estimator's
        """
        # Of the quietest amplifier: what is noticed there matters.
        read_noise = float(np.min(self.amplifier_values("read_noise", "electron")))
        if not self.ramp:
            return read_noise
        reads = self.value(f"macc.{self.ramp}.reads", "")
        return float(np.hypot(read_noise * np.sqrt(2.0 / reads), self.value(f"drift_{self.ramp}", "electron")))
