"""The class `Scene`: everything about one detector's exposure that detector effects depend on.

Examples are the exposure time, the sky background, bright sources, and the parameters of the camera.
"""

from __future__ import annotations

import math
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
from truesky.render.camera.windows import Window
from truesky.request.accuracy import SURVEY, Accuracy

Frame = Float

# A detector effect is applied if the largest change of a pixel that it causes exceeds this fraction of the pixel's
# noise (rms), or the larger fraction that the request allows as an error (`Scene.noticeable_fraction`).
NOTICEABLE = 0.1
# The part of a detector effect that repeats in every image or every pixel does not average out. It is compared with the
# noise of the mean of this number of values, such as 32 x 32 pixels of sky or one pixel in 1024 images. The limit is
# higher with an accuracy coarser than `survey` (`Scene.noticeable_mean_electrons`).
STACK_SIZE = 1024

# Boltzmann's constant, eV / K (CODATA 2018).
_BOLTZMANN = 8.617333e-5


def dark_current_scaling(temperature: float, reference: float, band_gap: float) -> float:
    """Return the ratio of the dark current at one temperature to that at a reference temperature.

    Parameters
    ----------
    temperature, reference : float
        Temperature of the detector and reference temperature in kelvin, 50 to 400.
    band_gap : float
        Band gap of the detector material in eV.

    Returns
    -------
    float
        Dark current at `temperature` divided by dark current at `reference`.

    Raises
    ------
    OutOfRange
        If a temperature is outside 50 to 400 K. The band gap is not checked.

    Notes
    -----
    The dark current is proportional to T^1.5 exp(-E_g / (2 k T)) [1]_, with the temperature T and the band gap E_g.

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
    """Bright stars and other bright sources on or near a detector, as points that cause ghosts and stray light.

    Attributes
    ----------
    column, row : float64 array, shape (n,)
        Pixel positions, 0-based. They may be outside the detector.
    electrons : float64 array, shape (n,)
        Electrons expected from each source during the exposure.
    """

    column: Frame = field(default_factory=lambda: np.zeros(0))
    row: Frame = field(default_factory=lambda: np.zeros(0))
    electrons: Frame = field(default_factory=lambda: np.zeros(0))

    def concatenate(self, other: Lights) -> Lights:
        """Return a new object with the sources of `self`, followed by the sources of `other`."""
        return Lights(
            np.append(self.column, other.column),
            np.append(self.row, other.row),
            np.append(self.electrons, other.electrons),
        )


@dataclass(frozen=True, slots=True)
class NeighbourCharge:
    """Charge on neighbouring detectors that are read out at the same time, which causes crosstalk between detectors.

    Attributes
    ----------
    pixel : int64 array, shape (n,)
        Flat indices of pixels of this detector, in the order [amplifier, row, column] in which it is read. Values are
        unique.
    electrons : float64 array, shape (n,)
        Charge of the other detectors that is read at the same time as each of these pixels.
    """

    pixel: Int
    electrons: Frame


@dataclass(frozen=True, slots=True)
class Scene:
    """Settings of the exposure of one detector, from which detector effects take their parameters.

    Attributes
    ----------
    mission : MissionConfiguration
        Mission database (parameters of the telescopes and cameras), with the values that the request of the user
        overrides.
    section : str
        Prefix of the detector's parameters in the mission database, such as "vis" or "ext.lsstcam".
    exposure_time_s : float
        Exposure time in seconds.
    sky_rate : float
        Sky background in electrons per second per pixel, in the middle of the detector.
    peak_electrons : float
        Electrons expected in the brightest pixel, without sky: the brightest pixel of the sources, plus the largest
        charge by each effect that fills pixels without sources, such as a lamp, satellite trails or injected charge.
    detector : Detector, optional
        Detector with its position in the focal plane. None for a detector in the centre of the focal plane.
    lights : Lights
        Bright sources that cause ghosts and stray light.
    lamp : int
        Number of the calibration lamp (LED) that is switched on in a flat field, from 1.
    accuracy : Accuracy
        Largest errors of fluxes, shapes, positions and background that the request accepts.
    forced : mapping of str to bool
        Effects that the request switches on (True) or off (False), by name. All others are applied if they are
        noticeable.
    band : Passband, optional
        Passband of the exposure. None for the first built-in passband of the camera.
    track_electrons : float
        Highest charge in electrons that a cosmic ray leaves in one pixel; 0 without cosmic rays.
    ramp : str
        Readout mode of an infrared detector that is read several times during the exposure (up the ramp), "photometric"
        or "spectroscopic". Empty if the detector is read once.
    persistence_charge : float array, shape (ny, nx), optional
        Electrons that were trapped in each pixel in earlier exposures and are released in this one. None without any.
    chromatic_light : float32 array, shape (2, ny, nx), optional
        Light of the sources in electrons, with each photon weighted by one of two functions of wavelength, f1 and f2,
        minus their means over the band. Pixel p has the quantum efficiency 1 + s_p f1 + c_p f2 relative to the mean
        (module `chromatic_response`). None if no source has a noticeable colour.
    chromatic_electrons : float
        Largest change of a pixel in electrons rms that arises because the efficiency of pixels depends on the colours
        of sources.
    sky_change : float array, shape (gy, gx), optional
        Difference between the sky background seen through a grism and a uniform background, in electrons per pixel, on
        an even grid over the detector. None without a grism or without light of the sky.
    neighbour_charge : NeighbourCharge, optional
        Charge on neighbouring detectors that are read at the same time. None if it is negligible.
    seeing : float
        FWHM of stars in arcsec, without aberrations and pixels: air, telescope and camera. Only used for ground
        cameras.
    zero_point : float
        AB magnitude of a source that gives 1 electron per second. Only used for ground cameras.
    window : Window, optional
        Part of the detector that is drawn; None for the whole detector.
    amplifier : int
        Number of the amplifier, from 0, that reads the window. All pixels of a window are read by one amplifier.
    sky_slopes : (float, float)
        Relative change of the sky background per pixel along rows (with the column) and along columns (with the row).
    mjd : float
        Date of the exposure (MJD), on which ageing and the drift of the bias depend; 0 if it does not matter.
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
    window: Window | None = None
    amplifier: int = 0
    sky_slopes: tuple[float, float] = (0.0, 0.0)
    mjd: float = 0.0

    def value(self, key: str, unit: str) -> float:
        """Return a parameter of the detector in the given unit.

        `key` is the name without the prefix of the camera, such as "full_well". A parameter without dimension has the
        unit "". BadInput is raised if the mission database has no such parameter or the unit does not fit.
        """
        return self.mission.value(f"{self.section}.{key}", unit, DetectorPlace(self._detector_name))

    def amplifier_values(self, key: str, unit: str) -> float | Float:
        """Return the value of a parameter for each amplifier of the detector.

        Parameters
        ----------
        key : str
            Name of the parameter without the prefix of the camera, such as "gain".
        unit : str
            Unit of the result.

        Returns
        -------
        float, or float64 array, shape (q,)
            Values of the q amplifiers, in the order of the planes of a frame that is split into amplifiers. One number
            if all amplifiers have the same value, or if a window is drawn.
        """
        if self.detector is not None:
            layout = amplifiers.layout(self.detector, self.mission)
            values = np.atleast_1d(amplifiers.values(key, unit, self.detector, self.mission, layout))
        else:
            values = np.array(self.mission.amplifier_values(f"{self.section}.{key}", unit, ""))
        if self.window is not None and len(values) > 1:
            return float(values[self.amplifier])
        return values if len(values) > 1 else float(values[0])

    @property
    def layout(self) -> Layout | None:
        """Pixels that each amplifier of a ground camera's detector reads.

        None if the detector is read in quadrants or as one frame, if a window is drawn, or if the scene has no
        detector.
        """
        if self.detector is None or self.window is not None:
            return None
        return amplifiers.layout(self.detector, self.mission)

    @property
    def column_segments(self) -> tuple[tuple[int, int, bool], ...]:
        """Parts of every column whose charge is shifted to the same serial register.

        Each part is (first row, last row + 1, True if the serial register is above the part and False if it is below).
        """
        if self.layout is not None:
            return self.layout.column_segments
        lower, upper = self.unread_rows
        return (0, lower, False), (upper, self.ny, True)

    @property
    def _detector_name(self) -> str:
        return self.detector.name if self.detector is not None else ""

    @property
    def nx(self) -> int:
        """Number of pixel columns of the drawn image."""
        if self.window is not None:
            return self.window.nx
        return self.detector.nx if self.detector is not None else int(self.value("fpa.nx", "pix"))

    @property
    def ny(self) -> int:
        """Number of pixel rows of the drawn image, including rows between the halves that are not read."""
        if self.window is not None:
            return self.window.ny
        return self.detector.ny if self.detector is not None else int(self.value("fpa.ny", "pix"))

    @property
    def pixels_in_plane(self) -> tuple[slice, slice]:
        """Rows and columns of the detector's pixels in the plane of a quadrant or amplifier, in readout order.

        The other rows and columns are prescan and overscan.
        """
        if self.layout is not None:
            return self.layout.pixels_in_plane
        prescan = int(self.value("fpa.prescan", "pix"))
        return slice(0, self.half_rows), slice(prescan, prescan + self.nx // 2)

    @property
    def injection_rows(self) -> int:
        """Number of charge-injection rows between the detector's halves, which are not read.

        0 if the scene has no detector, or if a window is drawn.
        """
        return self.detector.injection_rows if self.detector is not None and self.window is None else 0

    @property
    def half_rows(self) -> int:
        """Number of rows that are read through each of the two serial registers, below and above the detector."""
        return (self.ny - self.injection_rows) // 2

    @property
    def unread_rows(self) -> tuple[int, int]:
        """Rows between the two halves, which are not read: (first of these rows, first row of the upper half)."""
        return self.half_rows, self.half_rows + self.injection_rows

    @property
    def sky_electrons(self) -> float:
        """Sky background expected in the whole exposure, in electrons per pixel."""
        return self.sky_rate * self.exposure_time_s

    @property
    def brightest_electrons(self) -> float:
        """Electrons in the brightest pixel: sky plus the brightest source or cosmic ray, whichever has more electrons.

        Nonlinearity and charge transfer depend on the total charge, whatever its origin.
        """
        return max(self.peak_electrons, self.track_electrons) + self.sky_electrons

    @property
    def dark_current_scaling(self) -> float:
        """Dark current at the detector's temperature, divided by the value in the mission database.

        The database gives the value at a reference temperature. The ratio is 1 for cameras for which it has no
        temperature.
        """
        # The mission database has a temperature only for VIS. The dark currents of NISP and of ground cameras are for
        # the operating temperature.
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
        """Dark current expected in the whole exposure, in electrons per pixel."""
        return self.dark_rate * self.exposure_time_s

    @property
    def pixel_noise(self) -> float:
        """Noise of a pixel without sources in electrons rms: shot noise of sky and dark current, and read noise."""
        # Behind a grism the sky background varies over the detector: add its mean difference from a uniform background.
        dispersed = 0.0 if self.sky_change is None else float(self.sky_change.mean())
        return float(np.sqrt(max(self.sky_electrons + dispersed, 0.0) + self.dark_electrons + self.reading_noise**2))

    @property
    def full_well(self) -> float:
        """Full well in electrons of the amplifier in whose pixels it is highest."""
        return float(np.max(self.amplifier_values("full_well", "electron")))

    @property
    def noticeable_fraction(self) -> float:
        """Smallest change of a pixel that is taken into account, as a fraction of `pixel_noise`.

        It is `NOTICEABLE`, or the error of the background that the request allows if this is larger.
        """
        return max(NOTICEABLE, self.accuracy.background)

    @property
    def noticeable_electrons(self) -> float:
        """Smallest change of a pixel that is taken into account, in electrons."""
        return self.noticeable_fraction * self.pixel_noise

    @property
    def noticeable_mean_electrons(self) -> float:
        """Smallest change in electrons per pixel that is taken into account if it does not average out.

        At the accuracy `survey` and finer ones, it is `NOTICEABLE` times the noise of the mean of `STACK_SIZE` pixels.
        It increases in proportion to the error of the background that the request allows.
        """
        of_survey = NOTICEABLE * self.pixel_noise / math.sqrt(STACK_SIZE)
        return of_survey * max(self.accuracy.background / SURVEY.background, 1.0)

    @property
    def reading_noise(self) -> float:
        """Read noise of a pixel in electrons rms, for the amplifier with the lowest noise.

        For an infrared detector that is read up the ramp, it is the noise of the signal that is estimated from all
        reads.

        Notes
        -----
        For a ramp (repeated reads) this is the noise of the difference between the last and the first group of averaged
        reads. It is 4 % below the noise of the estimator with which the signal in the image is measured.
        """
        # Use the amplifier with the lowest noise: in its pixels an effect is noticed first.
        read_noise = float(np.min(self.amplifier_values("read_noise", "electron")))
        if not self.ramp:
            return read_noise
        reads = self.value(f"macc.{self.ramp}.reads", "")
        return float(np.hypot(read_noise * np.sqrt(2.0 / reads), self.value(f"drift_{self.ramp}", "electron")))
