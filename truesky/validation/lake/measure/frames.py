"""Read raw FITS files of a detector as a reduction pipeline does: only with the information in their headers.

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

# Pattern of a FITS section, a rectangle of pixels such as [1:2048,1:4096]: first and last column, first and last row.
_SECTION = re.compile(r"\[(\d+):(\d+),(\d+):(\d+)\]")
# Pattern of the FITS keywords of a celestial WCS, including SIP and TPV distortions.
_WCS_KEYWORD = re.compile(
    r"(CTYPE|CRVAL|CRPIX|CUNIT|CDELT)[12]|(CD|PC)[12]_[12]|PV\d_\d+|[AB]P?_(ORDER|\d_\d)|LONPOLE|LATPOLE|RADESYS"
)
# Pattern of the keywords of SIP coefficients, such as A_2_0.
_SIP_TERM = re.compile(r"[AB]P?_\d_\d")
# End of the name of the extension that has chi^2 of the fits to infrared ramps.
_QUALITY = ".CHI2"
# Keyword in the header of the extension with the quality of ramp fits, if it has flags instead of chi^2.
_FLAGS = "QUALFLAG"
# Keyword of a header with an uncertain pointing (systematic error, FITS paper I). The true WCS is then in the .head
# file in the same folder.
_UNCERTAIN_POINTING = "CSYER1"
# Fraction of the overscan columns that is not used, half of it at each side: columns next to the image contain charge
# released by traps.
_SKIPPED = 0.5
# Beginning of a card EFFECTn of a frame in which the request switches read noise off, also in prescan and overscan.
_WITHOUT_READ_NOISE = "read_noise: off (forced)"
# Differences between neighbours in the overscan are outliers beyond this number of standard deviations.
_CLIP = 5.0


@dataclass(frozen=True, slots=True)
class Amplifier:
    """An amplifier of a detector, with its properties from the header and from its overscan.

    Attributes
    ----------
    name : str
        Name of the amplifier or of its FITS extension.
    pixels : (slice, slice)
        Rows and columns of the detector that the amplifier reads.
    gain : float
        Gain in the header, e-/ADU.
    level : float
        Level without light: mean of the overscan, or BIAS of the header without overscan, ADU.
    noise : float
        rms noise of the overscan, e-; NaN if there is no overscan.
    header_read_noise : float
        rms read noise of the pixels in the header, e-; 0 if light hides it.
    samples : int
        Number of pixels of the overscan that were used, 0 without overscan.
    saturation_level : float
        Pixels at or above this level are saturated, e- above the level without light.
    overscan_read_noise : float
        rms read noise of the overscan in the header, e-; 0 if the request switches it off.
    """

    name: str
    pixels: tuple[slice, slice]
    gain: float
    level: float
    noise: float
    header_read_noise: float
    samples: int
    saturation_level: float
    overscan_read_noise: float


@dataclass(frozen=True, slots=True)
class NonlinearityCurve:
    """Nonlinearity of an amplifier: a loss at high signals, and a loss of the first electrons at low signals.

    Attributes
    ----------
    high : float
        Relative loss at high signals: n at the upper limit of the analogue-to-digital converter is read as
        n / (1 + high).
    low : float
        Fraction of the first electrons that is lost.
    knee : float
        Signal up to which electrons are lost at low signals (scale of an exponential), e-.
    range : float
        Largest value of the analogue-to-digital converter, ADU.

    Notes
    -----
    A signal of n electrons is read as s - low * knee * (1 - exp(-s / knee)) with s = n / (1 + high * n / range), where
    the range is converted to electrons.
    """

    high: float = 0.0
    low: float = 0.0
    knee: float = 2000.0
    range: float = 65535.0

    def linearize(self, read: Float, max_signal: float) -> Float:
        """Correct measured electrons `read` for nonlinearity, and return the electrons that the pixels collected.

        `max_signal` is the range of the analogue-to-digital converter in e-. Negative signals are not changed.
        """
        signal = np.asarray(read, float)
        for _ in range(3):
            signal = read - self.low * self.knee * np.expm1(-np.maximum(signal, 0.0) / self.knee)
        return np.where(signal > 0.0, signal / np.maximum(1.0 - self.high * signal / max_signal, 0.1), signal)


@dataclass(frozen=True, slots=True)
class Instrument:
    """Known properties of a camera, from the mission database, for which checks correct the measurements.

    Attributes
    ----------
    curve : NonlinearityCurve
        Nonlinearity of the amplifiers.
    vignetting : float
        Fraction of the light that is lost at the corner of the focal plane, 0 to 1.
    pixel_response_rms : float
        Standard deviation of the relative response of pixels.
    """

    curve: NonlinearityCurve = NonlinearityCurve()
    vignetting: float = 0.0
    pixel_response_rms: float = 0.0


@dataclass(frozen=True, slots=True)
class Frame:
    """A raw frame: the pixels of one detector in one exposure, converted to electrons.

    Attributes
    ----------
    electrons : float32 array, shape (ny, nx)
        Electrons above the level without light of each amplifier; 0 in pixels that no amplifier reads.
    amplifiers : tuple of Amplifier
        Amplifiers of the detector.
    quality : uint8 array, shape (ny, nx), optional
        chi^2 of the fit to an infrared ramp, or 1 for a bad fit if the header has QUALFLAG; None for other detectors.
    header : mapping of str to object
        Primary header by keyword.
    wcs : WCS
        World coordinate system of the detector's pixels without overscan.
    instrument : Instrument
        Nonlinearity, vignetting and pixel response of the camera.
    """

    electrons: Float32
    amplifiers: tuple[Amplifier, ...]
    quality: Array | None
    header: Mapping[str, Any]
    wcs: WCS
    instrument: Instrument = Instrument()

    def illumination(self, x: Float, y: Float) -> Float:
        """Return the fraction of the light that reaches pixel positions (x, y), counted from 0, after vignetting.

        The fraction is 1 - vignetting r^2, with the distance r from the optical axis in units of the distance of the
        corner of the focal plane (keyword DETSIZE).
        """
        if self.instrument.vignetting == 0.0:
            return np.ones(len(x))
        wide, high = (axis.stop - axis.start for axis in section(self.header["DETSIZE"]))
        across, up = x + 1.0 - self.wcs.wcs.crpix[0], y + 1.0 - self.wcs.wcs.crpix[1]
        return np.asarray(1.0 - self.instrument.vignetting * (across**2 + up**2) / (0.25 * (wide**2 + high**2)))

    def linearize(self, read: Float) -> Float:
        """Correct measured electrons (any shape) for the camera's nonlinearity with the mean gain of the amplifiers."""
        max_signal = self.instrument.curve.range * float(np.mean([amplifier.gain for amplifier in self.amplifiers]))
        return self.instrument.curve.linearize(read, max_signal)

    @property
    def seconds(self) -> float:
        """Return the exposure time (EXPTIME) in seconds."""
        return float(self.header["EXPTIME"])

    @property
    def scale(self) -> float:
        """Return the pixel scale (PIXSCALE) in arcsec per pixel."""
        return float(self.header["PIXSCALE"])

    @property
    def saturation_level(self) -> float:
        """Return the lowest saturation level of the amplifiers, e-."""
        return min(amplifier.saturation_level for amplifier in self.amplifiers)

    def saturated_pixels(self) -> Bool:
        """Return a mask, bool[ny, nx], of pixels at or above the saturation level of their amplifier."""
        out = np.zeros(self.electrons.shape, bool)
        for amplifier in self.amplifiers:
            out[amplifier.pixels] = self.electrons[amplifier.pixels] >= amplifier.saturation_level
        return out


def open_frame(path: Path, instrument: Instrument | None = None) -> Frame:
    """Read a raw FITS file of one detector and convert its pixels to electrons.

    `instrument` has the known nonlinearity, vignetting and pixel response of the camera; None means a linear detector
    without vignetting.

    Raises
    ------
    BadInput
        If the header lacks a keyword that a pipeline requires, or has an invalid section.
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
    # Copy the keyword QUALFLAG, which marks flags instead of chi^2, from the header of the extension.
    first |= {_FLAGS: quality_header[_FLAGS]} if _FLAGS in quality_header else {}
    return Frame(electrons, tuple(amplifiers), quality_plane, first, _wcs(_header(signal[0]), path, first))


def _header(unit: images.Image) -> dict[str, Any]:
    return {key: value for key, value, _ in unit.cards} | ({"EXTNAME": unit.name} if unit.name else {})


_AmplifierData = tuple[tuple[slice, slice], Array, Array | None, Mapping[str, Any], str]


def _parts(header: dict[str, Any], array: Array) -> list[_AmplifierData]:
    """Divide an image array into its amplifiers according to the sections in the header.

    For each amplifier the result has its rows and columns on the detector, its pixels, its overscan (or None), the
    header and the name.
    """
    if "NAMPS" in header:
        return [_numbered_amplifier(header, array, n) for n in range(1, int(header["NAMPS"]) + 1)]
    ny, nx = array.shape
    data = section(header["DATASEC"]) if "DATASEC" in header else (slice(0, ny), slice(0, nx))
    size = [axis.stop - axis.start for axis in data]
    ccd = section(header["CCDSEC"]) if "CCDSEC" in header else (slice(0, size[0]), slice(0, size[1]))
    bias = array[section(header["BIASSEC"])] if "BIASSEC" in header else None
    column_step, row_step = _steps(header["CCDSEC"]) if "CCDSEC" in header else (1, 1)
    return [(ccd, array[data][::row_step, ::column_step], bias, header, str(header.get("EXTNAME", "")))]


def _numbered_amplifier(header: dict[str, Any], array: Array, n: int) -> _AmplifierData:
    """Return amplifier number `n` (from 1) of an array that contains several; keywords end with this number."""
    cards = {**header, "GAIN": header[f"GAIN{n}"]}
    if f"RDN{n}" in header:
        cards["RDNOISE"] = header[f"RDN{n}"]
        cards["RDNDRAWN"] = header[f"RDN{n}"] if header.get("RDNDRAWN", 1.0) > 0.0 else 0.0
    bias = array[section(header[f"BSEC{n}"])]
    place = section(header[f"CSEC{n}"])
    return place, array[section(header[f"DSEC{n}"])], bias if bias.size else None, cards, str(header[f"AMP{n}"])


def _amplifier(name: str, ccd: tuple[slice, slice], bias: Array | None, cards: Mapping[str, Any]) -> Amplifier:
    gain, read_noise = float(cards["GAIN"]), float(cards["RDNDRAWN"])
    level, noise, samples = float(cards.get("BIAS", 0.0)), np.nan, 0
    if bias is not None:
        # Use the middle half of the overscan columns: at the edge next to the image, traps release charge.
        cut = int(0.5 * _SKIPPED * bias.shape[1])
        overscan = bias[:, cut : bias.shape[1] - cut].astype(float)
        level = float(overscan.mean())
        # Take differences between adjacent columns, then between adjacent rows: offsets of rows and columns cancel.
        step = np.diff(np.diff(overscan, axis=1), axis=0)
        # Leave out outliers, which are due to cosmic rays.
        step = step[np.abs(step) < _CLIP * 1.4826 * max(float(np.median(np.abs(step))), 1.0)]
        noise = float(np.std(step) / 2.0) * gain if step.size else np.nan
        samples = overscan.size
    saturation_level = (float(cards["SATURATE"]) - (level if cards.get("BUNIT", "adu") != "electron" else 0.0)) * gain
    return Amplifier(
        name, ccd, gain, level, noise, read_noise, samples, saturation_level, _overscan_read_noise(cards)
    )  # fmt: skip


def _overscan_read_noise(cards: Mapping[str, Any]) -> float:
    """Return the read noise (e-) that the overscan of an amplifier has according to its header.

    It is that of the detector, also if light hides it in the pixels, unless the request switches read noise off.
    """
    effects = (str(value) for key, value in cards.items() if key.startswith("EFFECT"))
    if any(effect.startswith(_WITHOUT_READ_NOISE) for effect in effects):
        return 0.0
    return float(cards.get("RDNOISE", cards["RDNDRAWN"]))


def section(text: str) -> tuple[slice, slice]:
    """Convert a FITS section "[x1:x2,y1:y2]", which counts from 1 and includes both ends, to slices (rows, columns).

    Raises
    ------
    BadInput
        If the text does not have this form.
    """
    match = _SECTION.fullmatch(text.strip())
    if match is None:
        raise BadInput(f"section must be of the form [x1:x2,y1:y2], got {text!r}")
    (x1, x2), (y1, y2) = (sorted(map(int, ends)) for ends in (match.groups()[:2], match.groups()[2:]))
    return slice(y1 - 1, y2), slice(x1 - 1, x2)


def _steps(text: str) -> tuple[int, int]:
    """Return 1 or -1 for columns and rows of a FITS section "[x1:x2,y1:y2]": -1 if the numbers decrease."""
    x1, x2, y1, y2 = map(int, re.findall(r"\d+", text))
    return 1 if x1 <= x2 else -1, 1 if y1 <= y2 else -1


def _wcs(header: dict[str, Any], path: Path, first: Mapping[str, Any]) -> WCS:
    """Return the WCS of the detector's pixels without prescan.

    If the header marks its pointing as uncertain and a .head file exists in the same folder, the true WCS in this file
    is used.
    """
    cards = header if "CTYPE1" in header else first
    head_file = path.with_suffix(".head")
    if (_UNCERTAIN_POINTING in header or _UNCERTAIN_POINTING in first) and head_file.is_file():
        cards = {key: value for key, value, _ in images.read_head_file(head_file)}
    wcs_cards = {key: value for key, value in cards.items() if _WCS_KEYWORD.fullmatch(key)}
    all_cards = {**first, **header}
    names = ("DSEC1", "CSEC1") if "DSEC1" in all_cards else ("DATASEC", "CCDSEC")
    # Without DATASEC, prescan and overscan lie between the pixels, and the WCS is that of the pixels without them.
    if "DATASEC" in all_cards and all(name in all_cards for name in names):
        _move_reference(wcs_cards, *(all_cards[name] for name in names))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        return WCS(wcs_cards)


def _move_reference(wcs_cards: dict[str, Any], data: str, ccd: str) -> None:
    """Convert the WCS cards of an array, in place, to the pixels of the detector.

    `data` is the FITS section of the array that lies at the section `ccd` of the detector. The numbers of `ccd` may
    decrease; columns or rows of the array are then in the opposite order.
    """
    steps = _steps(ccd)
    starts = [[axis.start for axis in section(text)[::-1]] for text in (data, ccd)]
    sizes = [axis.stop - axis.start for axis in section(ccd)[::-1]]
    for number, (step, data_start, ccd_start, size) in enumerate(zip(steps, *starts, sizes, strict=True), start=1):
        inside = wcs_cards[f"CRPIX{number}"] - data_start
        wcs_cards[f"CRPIX{number}"] = ccd_start + (inside if step > 0 else size + 1 - inside)
        for row in (1, 2):
            for key in (f"CD{row}_{number}", f"PC{row}_{number}"):
                if key in wcs_cards:
                    wcs_cards[key] *= step
    # The distortion is a polynomial of pixels from the reference pixel (SIP). TPV counts in degrees on the sky.
    for key in [key for key in wcs_cards if _SIP_TERM.fullmatch(key)]:
        name, p, q = key.split("_")
        wcs_cards[key] *= steps[name.startswith("B")] * steps[0] ** int(p) * steps[1] ** int(q)


def sky_to_pixel(wcs: WCS, ra: Float, dec: Float) -> tuple[Float, Float]:
    """Convert sky positions to pixel coordinates, including distortion.

    Parameters
    ----------
    wcs : WCS
        World coordinate system of the pixels.
    ra, dec : float array, shape (n,)
        Positions, deg.

    Returns
    -------
    x, y : float array, shape (n,)
        Columns and rows from 0. Far outside the image, where the inversion of the distortion does not converge, they
        are not accurate, and no error is raised.
    """
    if not len(ra):
        return np.zeros(0), np.zeros(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        x, y = wcs.all_world2pix(np.asarray(ra, float), np.asarray(dec, float), 0, quiet=True, tolerance=1e-6)
    return np.asarray(x), np.asarray(y)
