"""Read raw files of a detector as a reduction pipeline does: by their headers alone.

References
----------
FITS standard 4.0; section keywords as NOAO and LSST use them (DATASEC, BIASSEC, CCDSEC)
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.wcs import WCS, FITSFixedWarning

from lake_schema.arrays import Array, Bool, Float, Float32
from lake_schema.errors import BadInput
from lake_schema.fits import images

_SECTION = re.compile(r"\[(\d+):(\d+),(\d+):(\d+)\]")
# Keywords of a celestial WCS, with SIP or TPV distortions.
_WCS_KEYWORD = re.compile(
    r"(CTYPE|CRVAL|CRPIX|CUNIT|CDELT)[12]|(CD|PC)[12]_[12]|PV\d_\d+|[AB]P?_(ORDER|\d_\d)|LONPOLE|LATPOLE|RADESYS"
)
# Suffix of the name of the chi^2 plane of a ramp.
_QUALITY = ".CHI2"
_FLAGS = "QUALFLAG"
# Keyword of a header with an uncertain pointing (FITS paper I); the .head file next to it then has the true WCS.
_UNCERTAIN_POINTING = "CSYER1"
# Fraction of the overscan columns that is not used, since they contain charge released by traps.
_SKIPPED = 0.5
# Differences of neighbours in the overscan that are outliers, in units of their scatter.
_CLIP = 5.0


@dataclass(frozen=True, slots=True)
class Amplifier:
    """Readout of one amplifier.

    Attributes
    ----------
    name : str
        Name of the amplifier.
    pixels : (slice, slice)
        Rows and columns of the detector.
    gain : float
        Gain, e-/ADU.
    level : float
        Level without light, ADU.
    noise : float
        rms of the overscan, e-; NaN if there is no overscan.
    header_read_noise : float
        rms read noise in the header, e-.
    samples : int
        Number of pixels of the overscan.
    saturation_level : float
        Level of the lowest saturated pixel, e-.
    """

    name: str
    pixels: tuple[slice, slice]
    gain: float
    level: float
    noise: float
    header_read_noise: float
    samples: int
    saturation_level: float


@dataclass(frozen=True, slots=True)
class NonlinearityCurve:
    """Nonlinearity of an amplifier.

    Attributes
    ----------
    high : float
        Relative loss at the converter's range: n is read as n / (1 + high) there.
    low : float
        Fraction of the first electrons that is missing.
    knee : float
        Scale of the loss of the first electrons, e-.
    range : float
        Range of the converter, ADU.

    Notes
    -----
    A signal of n electrons is read as s - low * knee * (1 - exp(-s / knee)) with s = n / (1 + high * n / range).
    """

    high: float = 0.0
    low: float = 0.0
    knee: float = 2000.0
    range: float = 65535.0

    def linearize(self, read: Float, max_signal: float) -> Float:
        """Return the collected electrons of electrons that were read; `max_signal` is the converter's range in e-."""
        signal = np.asarray(read, float)
        for _ in range(3):
            signal = read - self.low * self.knee * np.expm1(-np.maximum(signal, 0.0) / self.knee)
        return np.where(signal > 0.0, signal / np.maximum(1.0 - self.high * signal / max_signal, 0.1), signal)


@dataclass(frozen=True, slots=True)
class Instrument:
    """Properties of a camera from the mission database that are not faults of a frame.

    Attributes
    ----------
    curve : NonlinearityCurve
        Nonlinearity of the amplifiers.
    vignetting : float
        Fraction of the light that is lost at the corner of the focal plane.
    pixel_response_rms : float
        rms of the relative response of pixels.
    """

    curve: NonlinearityCurve = NonlinearityCurve()
    vignetting: float = 0.0
    pixel_response_rms: float = 0.0


@dataclass(frozen=True, slots=True)
class Frame:
    """A detector of an exposure.

    Attributes
    ----------
    electrons : float32 array, shape (ny, nx)
        Electrons above the level of each amplifier.
    amplifiers : tuple of Amplifier
        Amplifiers of the detector.
    quality : uint8 array, shape (ny, nx), optional
        chi^2 of a ramp.
    header : mapping of str to object
        Header of the whole file.
    wcs : WCS
        World coordinates of the detector's pixels; the first pixel is (0, 0).
    instrument : Instrument
        Camera of the frame.
    """

    electrons: Float32
    amplifiers: tuple[Amplifier, ...]
    quality: Array | None
    header: Mapping[str, Any]
    wcs: WCS
    instrument: Instrument = Instrument()

    def illumination(self, x: Float, y: Float) -> Float:
        """Return the fraction of light after vignetting at pixel positions.

        The fraction is 1 - vignetting r^2 with r = 1 at the corner of DETSIZE.
        """
        if self.instrument.vignetting == 0.0:
            return np.ones(len(x))
        wide, high = (axis.stop - axis.start for axis in section(self.header["DETSIZE"]))
        across, up = x + 1.0 - self.wcs.wcs.crpix[0], y + 1.0 - self.wcs.wcs.crpix[1]
        return np.asarray(1.0 - self.instrument.vignetting * (across**2 + up**2) / (0.25 * (wide**2 + high**2)))

    def linearize(self, read: Float) -> Float:
        """Return the collected electrons of electrons that were read."""
        max_signal = self.instrument.curve.range * float(np.mean([amplifier.gain for amplifier in self.amplifiers]))
        return self.instrument.curve.linearize(read, max_signal)

    @property
    def seconds(self) -> float:
        """Exposure time, s."""
        return float(self.header["EXPTIME"])

    @property
    def scale(self) -> float:
        """Pixel scale, arcsec per pixel."""
        return float(self.header["PIXSCALE"])

    @property
    def saturation_level(self) -> float:
        """Level of the lowest saturated pixel of all amplifiers, e-."""
        return min(amplifier.saturation_level for amplifier in self.amplifiers)

    def saturated_pixels(self) -> Bool:
        """Return a mask of the saturated pixels."""
        out = np.zeros(self.electrons.shape, bool)
        for amplifier in self.amplifiers:
            out[amplifier.pixels] = self.electrons[amplifier.pixels] >= amplifier.saturation_level
        return out


def open_frame(path: Path, instrument: Instrument | None = None) -> Frame:
    """Open a science file of an instrument from the mission database; None for a linear detector without vignetting.

    Raises
    ------
    BadInput
        If the header lacks a keyword that a pipeline requires.
    """
    units = images.read_images(path)
    try:
        return replace(_frame(units, path), instrument=instrument or Instrument())
    except KeyError as error:
        raise BadInput(f"{path}: header lacks the keyword {error.args[0]}") from None


def _frame(units: Sequence[images.Image], path: Path) -> Frame:
    first = _header(units[0])
    planes = [unit for unit in units if unit.data is not None and unit.data.ndim == 2]
    signal = [unit for unit in planes if not unit.name.endswith(_QUALITY)]
    parts = [part for unit in signal for part in _parts({**first, **_header(unit)}, np.asarray(unit.data))]
    shape = tuple(max(part[0][axis].stop for part in parts) for axis in (0, 1))
    electrons, amplifiers = np.zeros(shape, np.float32), []
    for ccd, data, bias, cards, name in parts:
        amplifier = _amplifier(name, ccd, bias, cards)
        electrons[ccd] = (data - np.float32(amplifier.level)) * np.float32(amplifier.gain)
        amplifiers.append(amplifier)
    quality = next((unit for unit in planes if unit.name.endswith(_QUALITY)), None)
    quality_header = {} if quality is None else _header(quality)
    quality_plane = None if quality is None else np.asarray(quality.data)[section(quality_header["DATASEC"])]
    # The keyword that marks a plane of flags is in the header of the plane.
    first |= {_FLAGS: quality_header[_FLAGS]} if _FLAGS in quality_header else {}
    return Frame(electrons, tuple(amplifiers), quality_plane, first, _wcs(_header(signal[0]), path, first))


def _header(unit: images.Image) -> dict[str, Any]:
    return {key: value for key, value, _ in unit.cards} | ({"EXTNAME": unit.name} if unit.name else {})


_AmplifierData = tuple[tuple[slice, slice], Array, Array | None, Mapping[str, Any], str]


def _parts(header: dict[str, Any], array: Array) -> list[_AmplifierData]:
    """Amplifiers of an array: their pixels on the detector, data, overscan columns (or None), cards and name."""
    if "NAMPS" in header:
        return [_numbered_amplifier(header, array, n) for n in range(1, int(header["NAMPS"]) + 1)]
    ny, nx = array.shape
    data = section(header["DATASEC"]) if "DATASEC" in header else (slice(0, ny), slice(0, nx))
    size = [axis.stop - axis.start for axis in data]
    ccd = section(header["CCDSEC"]) if "CCDSEC" in header else (slice(0, size[0]), slice(0, size[1]))
    bias = array[section(header["BIASSEC"])] if "BIASSEC" in header else None
    return [(ccd, array[data], bias, header, str(header.get("EXTNAME", "")))]


def _numbered_amplifier(header: dict[str, Any], array: Array, n: int) -> _AmplifierData:
    """Amplifier `n` of an array that contains several."""
    cards = {**header, "GAIN": header[f"GAIN{n}"]}
    if f"RDN{n}" in header and header.get("RDNDRAWN", 1.0) > 0.0:
        cards["RDNDRAWN"] = header[f"RDN{n}"]
    bias = array[section(header[f"BSEC{n}"])]
    place = section(header[f"CSEC{n}"])
    return place, array[section(header[f"DSEC{n}"])], bias if bias.size else None, cards, str(header[f"AMP{n}"])


def _amplifier(name: str, ccd: tuple[slice, slice], bias: Array | None, cards: Mapping[str, Any]) -> Amplifier:
    gain, read_noise = float(cards["GAIN"]), float(cards["RDNDRAWN"])
    level, noise, samples = float(cards.get("BIAS", 0.0)), np.nan, 0
    if bias is not None:
        # The middle half of the overscan is farthest from the pixels, whichever side they are on.
        cut = int(0.5 * _SKIPPED * bias.shape[1])
        overscan = bias[:, cut : bias.shape[1] - cut].astype(float)
        level = float(overscan.mean())
        # Differences in both directions remove offsets of rows and columns.
        step = np.diff(np.diff(overscan, axis=1), axis=0)
        # Outliers from cosmic rays are left out.
        step = step[np.abs(step) < _CLIP * 1.4826 * max(float(np.median(np.abs(step))), 1.0)]
        noise = float(np.std(step) / 2.0) * gain if step.size else np.nan
        samples = overscan.size
    saturation_level = (float(cards["SATURATE"]) - (level if cards.get("BUNIT", "adu") != "electron" else 0.0)) * gain
    return Amplifier(name, ccd, gain, level, noise, read_noise, samples, saturation_level)


def section(text: str) -> tuple[slice, slice]:
    """Return the slices (rows, columns) of a section [x1:x2,y1:y2], which counts from 1 and includes both ends.

    Raises
    ------
    BadInput
        If the text does not have this form.
    """
    match = _SECTION.fullmatch(text.strip())
    if match is None:
        raise BadInput(f"section must be of the form [x1:x2,y1:y2], got {text!r}")
    x1, x2, y1, y2 = map(int, match.groups())
    return slice(y1 - 1, y2), slice(x1 - 1, x2)


def _wcs(header: dict[str, Any], path: Path, first: Mapping[str, Any]) -> WCS:
    """WCS of the detector's pixels without leading overscan; the true WCS if the header is uncertain."""
    cards = header if "CTYPE1" in header else first
    head_file = path.with_suffix(".head")
    if (_UNCERTAIN_POINTING in header or _UNCERTAIN_POINTING in first) and head_file.is_file():
        lines = head_file.read_text("ascii").split("END\n")[0]
        cards = {key: value for key, value, _ in images.cards_from_text(lines)}
    wcs_cards = {key: value for key, value in cards.items() if _WCS_KEYWORD.fullmatch(key)}
    all_cards = {**first, **header}
    names = ("DSEC1", "CSEC1") if "DSEC1" in all_cards else ("DATASEC", "CCDSEC")
    if all(name in all_cards for name in names):
        (dy, dx), (cy, cx) = (section(all_cards[name]) for name in names)
        wcs_cards["CRPIX1"] -= dx.start - cx.start
        wcs_cards["CRPIX2"] -= dy.start - cy.start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        return WCS(wcs_cards)


def sky_to_pixel(wcs: WCS, ra: Float, dec: Float) -> tuple[Float, Float]:
    """Return pixel columns and rows, from 0, of sky positions.

    Parameters
    ----------
    wcs : WCS
        World coordinates of the pixels.
    ra, dec : float array, shape (n,)
        Positions, deg.

    Returns
    -------
    x, y : float array, shape (n,)
        Columns and rows; values are not accurate if the inversion does not converge.
    """
    if not len(ra):
        return np.zeros(0), np.zeros(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        x, y = wcs.all_world2pix(np.asarray(ra, float), np.asarray(dec, float), 0, quiet=True, tolerance=1e-6)
    return np.asarray(x), np.asarray(y)
