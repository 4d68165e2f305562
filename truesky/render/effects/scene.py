"""Properties of one detector's exposure that detector effects depend on."""

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

# An effect is applied if its largest contribution to a pixel exceeds NOTICEABLE times the pixel's noise. A contribution
# that repeats in every frame or every pixel does not average out: it is compared with the noise of the mean of
# STACK_SIZE values, such as 32 x 32 pixels of sky or one pixel in 1024 frames.
NOTICEABLE, STACK_SIZE = 0.1, 1024

# Boltzmann's constant, eV / K (CODATA 2018).
_BOLTZMANN = 8.617333e-5


def dark_current_scaling(temperature: float, reference: float, band_gap: float) -> float:
    """Dark current relative to the reference temperature.

    Parameters
    ----------
    temperature, reference : float
        Temperature of the detector and reference temperature in kelvin, 50 to 400.
    band_gap : float
        Band gap in eV.

    Returns
    -------
    float
        Ratio of the dark currents.

    Raises
    ------
    OutOfRange
        If a temperature is outside its limits.

    Notes
    -----
    The dark current is proportional to T^1.5 exp(-E_g / (2 k T)) [1]_.

    References
    ----------
    .. [1] Janesick 2001, Scientific Charge-Coupled Devices.
    """
    for value in (temperature, reference):
        if not 50.0 <= value <= 400.0:
            raise OutOfRange("detector temperature", value, 50.0, 400.0)
    exponent = band_gap / (2.0 * _BOLTZMANN) * (1.0 / temperature - 1.0 / reference)
    return float((temperature / reference) ** 1.5 * np.exp(-exponent))


@dataclass(frozen=True, slots=True)
class Lights:
    """Bright sources on and around a detector, as points.

    Attributes
    ----------
    column, row : float64 array, shape (n,)
        Pixel position, 0-based, also outside the frame.
    electrons : float64 array, shape (n,)
        Expected electrons in the exposure.
    """

    column: Frame = field(default_factory=lambda: np.zeros(0))
    row: Frame = field(default_factory=lambda: np.zeros(0))
    electrons: Frame = field(default_factory=lambda: np.zeros(0))

    def concatenate(self, other: Lights) -> Lights:
        """Return the sources of `self` followed by those in `other`."""
        return Lights(
            np.append(self.column, other.column),
            np.append(self.row, other.row),
            np.append(self.electrons, other.electrons),
        )


@dataclass(frozen=True, slots=True)
class NeighbourCharge:
    """Charge on other detectors that are read out at the same time, for crosstalk between detectors.

    Attributes
    ----------
    pixel : int64 array, shape (n,)
        Pixel index in readout order, counted through all amplifiers of the detector. Values are unique.
    electrons : float64 array, shape (n,)
        Charge read at the same time as this pixel.
    """

    pixel: Int
    electrons: Frame


@dataclass(frozen=True, slots=True)
class Scene:
    """Exposure of one detector.

    Attributes
    ----------
    mission : MissionConfiguration
        Mission database, with the overrides of the request.
    section : str
        Prefix of the detector's parameters in the mission database, such as "vis" or "ext.lsstcam".
    exposure_time_s : float
        Exposure time in seconds.
    sky_rate : float
        Sky background in electrons per second per pixel.
    peak_electrons : float
        Brightest pixel of the expected image: sources, the light of a lamp or injected charge, without sky.
    detector : Detector, optional
        Position in the focal plane. None for a detector at the centre.
    lights : Lights
        Sources of scattered light (ghosts, stray light).
    lamp : int
        Number of a flat's LED, from 1.
    accuracy : Accuracy
        Errors that the request accepts.
    forced : mapping of str to bool
        Effects to switch on or off, by name. All others are applied if the scene needs them.
    band : Passband, optional
        Passband of the exposure. None for the passband included in the package.
    track_electrons : float
        Brightest pixel that cosmic rays are likely to produce, 0 without cosmic rays.
    ramp : str
        Readout mode of an infrared detector, "photometric" or "spectroscopic". Empty if the detector is read once.
    persistence_charge : float array, shape (ny, nx), optional
        Electrons that earlier exposures release in this one.
    chromatic_light : float32 array, shape (2, ny, nx), optional
        Light of the sources with each photon weighted by f1 and by f2, see `chromatic_response`.
    chromatic_electrons : float
        Largest change of a pixel by the colours of sources, see `chromatic_response`, in electrons rms.
    sky_change : float array, shape (gy, gx), optional
        Change of the sky by a grism in electrons, on an even grid over the detector.
    neighbour_charge : NeighbourCharge, optional
        Charge on detectors that are read with this one. None if it is negligible.
    seeing : float
        FWHM of the seeing in arcsec, for ground cameras.
    zero_point : float
        AB magnitude that gives 1 electron per second, for ground cameras.
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
        """Return a parameter of the detector in the given unit."""
        return self.mission.value(f"{self.section}.{key}", unit, DetectorPlace(self._detector_name))

    def amplifier_values(self, key: str, unit: str) -> float | Float:
        """Values of a parameter for the amplifiers of the detector.

        Parameters
        ----------
        key, unit : str
            Name of the parameter without its section, and unit.

        Returns
        -------
        float, or float64 array, shape (q,)
            Values in readout order, or one number if all amplifiers have the same value.
        """
        if self.detector is not None and self.layout is not None:
            return amplifiers.values(key, unit, self.detector, self.mission, self.layout)
        values = self.mission.amplifier_values(f"{self.section}.{key}", unit, self._detector_name)
        return np.array(values) if len(values) > 1 else values[0]

    @property
    def layout(self) -> Layout | None:
        """Amplifiers of a ground camera's detector. None if the detector is read in quadrants or as one frame."""
        return None if self.detector is None else amplifiers.layout(self.detector, self.mission)

    @property
    def column_segments(self) -> tuple[tuple[int, int, bool], ...]:
        """Segments of every column: first row, last row + 1, and True if the serial register is above the segment."""
        if self.layout is not None:
            return self.layout.column_segments
        lower, upper = self.unread_rows
        return (0, lower, False), (upper, self.ny, True)

    @property
    def _detector_name(self) -> str:
        return self.detector.name if self.detector is not None else ""

    @property
    def nx(self) -> int:
        """Number of columns."""
        return self.detector.nx if self.detector is not None else int(self.value("fpa.nx", "pix"))

    @property
    def ny(self) -> int:
        """Number of rows."""
        return self.detector.ny if self.detector is not None else int(self.value("fpa.ny", "pix"))

    @property
    def injection_rows(self) -> int:
        """Number of rows between the two halves of the detector. They are not read."""
        return self.detector.injection_rows if self.detector is not None else 0

    @property
    def half_rows(self) -> int:
        """Number of rows that are read through each of the two registers."""
        return (self.ny - self.injection_rows) // 2

    @property
    def unread_rows(self) -> tuple[int, int]:
        """Range of the rows between the two halves: first row, and first row of the upper half."""
        return self.half_rows, self.half_rows + self.injection_rows

    @property
    def sky_electrons(self) -> float:
        """Sky background in electrons per pixel."""
        return self.sky_rate * self.exposure_time_s

    @property
    def brightest_electrons(self) -> float:
        """Electrons in the brightest pixel, from sources or cosmic rays, and sky.

        Nonlinearity and charge transfer depend on the total charge, whatever its origin.
        """
        return max(self.peak_electrons, self.track_electrons) + self.sky_electrons

    @property
    def dark_current_scaling(self) -> float:
        """Dark current relative to its value in the mission database."""
        # The values of ground cameras are for their operating temperature.
        if f"{self.section}.detector_temperature" not in self.mission:
            return 1.0
        temperatures = self.value("detector_temperature", "K"), self.value("dark_reference_temperature", "K")
        return dark_current_scaling(*temperatures, self.value("dark_band_gap", "eV"))

    @property
    def dark_rate(self) -> float:
        """Dark current at the detector's temperature in electrons per second per pixel."""
        return self.value("dark_current", "electron / (s pix)") * self.dark_current_scaling

    @property
    def dark_electrons(self) -> float:
        """Dark current in electrons per pixel."""
        return self.dark_rate * self.exposure_time_s

    @property
    def pixel_noise(self) -> float:
        """Noise of a pixel without sources in electrons rms: sky, dark current and read noise."""
        # Mean over the detector.
        dispersed = 0.0 if self.sky_change is None else float(self.sky_change.mean())
        return float(np.sqrt(max(self.sky_electrons + dispersed, 0.0) + self.dark_electrons + self.reading_noise**2))

    @property
    def reading_noise(self) -> float:
        """Read noise of a pixel in electrons rms; for a ramp, of its signal.

        Notes
        -----
        For a ramp this is the noise of the difference between the last and the first group, 4 % below the noise of the
        estimator that is used.
        """
        # The quietest amplifier decides whether an effect is noticeable.
        read_noise = float(np.min(self.amplifier_values("read_noise", "electron")))
        if not self.ramp:
            return read_noise
        reads = self.value(f"macc.{self.ramp}.reads", "")
        return float(np.hypot(read_noise * np.sqrt(2.0 / reads), self.value(f"drift_{self.ramp}", "electron")))
