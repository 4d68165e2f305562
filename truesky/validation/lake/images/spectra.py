"""Check slitless spectra of NISP: flux of first orders, positions of their traces, and positions of emission lines.

Notes
-----
For point sources with an isolated first order, light is summed across the trace, and the background on both sides is
subtracted. An emission line is the light above the median of the spectrum around it; its position is the centroid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow.compute as pc

from lake_schema.arrays import Float, Int
from truesky.validation.lake.measure.frame_context import DISPERSED, FrameCheck, FrameContext
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.verdicts import AT_LEAST

SOURCE = "rendered_spectra of the lake; the extracted flux of stars: Serrano et al. 2024, app. C"
# Relative tolerance of the median ratio of measured and expected flux in the first spectral order.
_FLUX = 0.05
# Tolerance of the median offset of measured from expected traces, pixels across the trace.
_TRACE = 0.1
# Tolerance of the median offset of measured from expected positions of emission lines, pixels along the trace.
_LINE = 0.3
# Light is summed up to this distance from the trace, pixels.
_HALF = 6
# The background is measured from this distance on both sides of the trace, pixels.
_FROM = 9
# The background is measured up to this distance on both sides of the trace, pixels.
_TO = 15
# Only spectra with a larger estimated signal-to-noise ratio than this are measured.
_MIN_SNR = 60.0
# Only emission lines with a larger expected signal-to-noise ratio than this are searched in the spectra.
_MIN_LINE_SNR = 8.0
# Spectra of which a larger fraction of the trace overlaps with other spectra are not measured.
_MAX_OVERLAP = 0.1
# A median of fewer spectra or emission lines than this number is not computed.
_MIN_NUMBER = 5
# Largest number of spectra that are measured; the brightest are selected.
_MAX_SPECTRA = 150
# A line is detected only within this distance from its expected position, pixels.
_LINE_REACH = 3
# The continuum of a line is measured up to this distance from its expected position, pixels.
_LEVEL_REACH = 12
# A line counts as detected only if its light above the continuum exceeds this number of standard deviations of the
# noise.
_MIN_SIGNIFICANCE = 3.0
# Fraction of the expected lines that may be missed.
_MAX_MISSED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ExtractedSpectrum:
    """Spectrum that was extracted along its trace, with one value per pixel along the trace.

    Attributes
    ----------
    t : float array, shape (n,)
        Position along the trace, from 0 at its first wavelength to 1 at its last.
    light : float array, shape (n,)
        Light of the source above the background, summed across the trace, e-.
    offset : float
        Measured minus expected position of the trace, pixels across the trace; NaN if the total light is not positive.
    """

    t: Float
    light: Float
    offset: float


def check(context: FrameContext) -> list[Row]:
    """Check the spectra of first order in a dispersed frame of NISP.

    The rows (measurements with expected value and verdict) are the fraction of expected lines that are detected, and
    the medians of flux ratios, trace offsets and line offsets. With fewer than five values, the row of a median is
    "not_applicable", and the row of the detected fraction is left out.
    """
    # Select the first orders explicitly: the table may contain other orders, which have no value in `overlapped`.
    condition = (pc.field("order") == 1) & (pc.field("overlapped") < _MAX_OVERLAP)
    first = context.spectra.filter(condition).to_pylist()
    points = set(context.sources.id[context.sources.point].tolist())
    isolated = [row for row in first if row["id"] in points and row["drawn"] > 0.9 * row["expected"]]
    isolated = sorted(isolated, key=lambda row: -row["expected"])[:_MAX_SPECTRA]
    ratios, offsets = [], []
    for row in isolated:
        spectrum = extract_spectrum(context.frame.electrons, row)
        snr = row["drawn"] / np.sqrt(row["drawn"] + (2 * _HALF + 1) * 512 * context.noise**2)
        if spectrum is not None and snr > _MIN_SNR:
            ratios.append(float(spectrum.light.sum()) / row["drawn"])
            offsets.append(spectrum.offset)
    line_offsets = np.array([line for row in first for line in _line_offsets(context, row)])
    lines = line_offsets[np.isfinite(line_offsets)].tolist()
    out = []
    if len(line_offsets) >= _MIN_NUMBER:
        # Check the detected fraction as well: with very wrong wavelengths no line is found, so no shift is measured.
        part = len(lines) / len(line_offsets)
        adjusted_share = (len(lines) + 2.0) / (len(line_offsets) + 4.0)
        out.append(
            Row(
                "spectra",
                "lines",
                context.place,
                part,
                float(np.sqrt(adjusted_share * (1.0 - adjusted_share) / (len(line_offsets) + 4.0))),
                1.0,
                _MAX_MISSED,
                "",
                SOURCE,
                AT_LEAST,
                f"{len(line_offsets)} lines expected at S/N > {_MIN_LINE_SNR:g}",
            )
        )
    for name, values, expected, tolerance, unit in (
        ("flux", ratios, 1.0, _FLUX, ""),
        ("trace", offsets, 0.0, _TRACE, "pix"),
        ("wavelength", lines, 0.0, _LINE, "pix"),
    ):
        if len(values) < _MIN_NUMBER:
            why = f"{name}: {len(values)} isolated and bright spectra or lines; {_MIN_NUMBER} are required"
            out.append(not_applicable("spectra", context.place, why, SOURCE, name))
            continue
        found_values = np.array(values)
        middle = float(np.median(found_values))
        error = 1.2533 * 1.4826 * float(np.median(np.abs(found_values - middle))) / np.sqrt(len(values))
        out.append(Row("spectra", name, context.place, middle, error, expected, tolerance, unit, SOURCE,
                       note=f"{len(values)} values, median"))  # fmt: skip
    context.series["spectra"] = np.array(ratios)
    return out


def extract_spectrum(image: Any, row: Mapping[str, Any]) -> ExtractedSpectrum | None:
    """Extract the spectrum of a source in the first order along its trace.

    Parameters
    ----------
    image : float array, shape (ny, nx)
        Pixels of the frame, e-.
    row : mapping of str to object
        Row of the table `rendered_spectra`, which describes the trace by polynomials.

    Returns
    -------
    ExtractedSpectrum or None
        Spectrum along the trace. None if the trace with its background regions is not entirely on the detector, or is
        shorter than 50 pixels.
    """
    along_x = abs(row["x_last"] - row["x_first"]) >= abs(row["y_last"] - row["y_first"])
    plane = image if along_x else image.T
    names = ("trace_x", "trace_y") if along_x else ("trace_y", "trace_x")
    main, across = (np.array(row[name]) for name in names)
    t = np.linspace(0.0, 1.0, 1025)
    positions = _polynomial(main, t)
    low, high = sorted((positions[0], positions[-1]))
    columns = np.arange(int(np.ceil(low)), int(np.floor(high)) + 1)
    order = np.argsort(positions, kind="stable")
    at = np.interp(columns, positions[order], t[order])
    middle = _polynomial(across, at)
    ny, nx = plane.shape
    trace_rows = np.rint(middle).astype(int)
    if (
        len(columns) < 50
        or columns[0] < 0
        or columns[-1] >= nx
        or trace_rows.min() < _TO
        or trace_rows.max() >= ny - _TO
    ):
        return None
    offsets: Int = np.arange(-_TO, _TO + 1)
    strip = plane[trace_rows[None, :] + offsets[:, None], columns[None, :]].astype(float)
    level = np.median(strip[np.abs(offsets) >= _FROM], axis=0)
    inner = strip[np.abs(offsets) <= _HALF] - level
    # Remove cosmic rays: single pixels that are much brighter than their neighbours along the trace.
    inner = _remove_outliers(inner)
    weight = inner.sum(axis=1)
    centre = (weight * np.arange(-_HALF, _HALF + 1)).sum() / weight.sum() if weight.sum() > 0.0 else np.nan
    return ExtractedSpectrum(at, inner.sum(axis=0), float(centre + np.mean(trace_rows - middle)))


def _remove_outliers(inner: Float) -> Float:
    """Replace pixels far above the median of their neighbours in the same row by this median.

    `inner` has the light across the trace (rows) and along the trace (columns).
    """
    typical = np.median(np.stack([np.roll(inner, step, axis=1) for step in (-3, -2, -1, 1, 2, 3)]), axis=0)
    spread = 1.4826 * np.median(np.abs(inner - typical))
    is_outlier = inner > typical + 8.0 * spread + 1.0 * np.abs(typical)
    # Replace only if one or two pixels of a column are outliers: an emission line is bright in more rows.
    return np.where(is_outlier & (is_outlier.sum(axis=0) <= 2), typical, inner)


def _polynomial(coefficients: Float, t: Float) -> Float:
    out = np.zeros_like(t)
    for coefficient in coefficients[::-1]:
        out = out * t + coefficient
    return out


def _line_offsets(context: FrameContext, row: Mapping[str, Any]) -> list[float]:
    """Return measured minus expected positions of the bright emission lines of a spectrum, pixels along the trace.

    A line that is not detected gives NaN. Lines near other lines or near the end of the trace are left out. The list is
    empty if the spectrum has no bright line or cannot be extracted.
    """
    bright = [
        wavelength
        for wavelength, snr in zip(row["line_wavelength"] or (), row["line_snr"] or (), strict=True)
        if snr > _MIN_LINE_SNR
    ]
    if not bright or (spectrum := extract_spectrum(context.frame.electrons, row)) is None:
        return []
    step = (row["wavelength_last"] - row["wavelength_first"]) * np.abs(np.diff(spectrum.t)).mean()
    wavelength = row["wavelength_first"] + (row["wavelength_last"] - row["wavelength_first"]) * spectrum.t
    out = []
    for line in bright:
        pixel = (wavelength - line) / step
        in_window = np.abs(pixel) < _LEVEL_REACH
        other_lines = [other for other in row["line_wavelength"] if other != line]
        if (
            any(abs(other - line) < 2 * _LINE_REACH * step for other in other_lines)
            or in_window.sum() < 2 * _LEVEL_REACH - 1
        ):
            continue
        continuum = spectrum.light[in_window & (np.abs(pixel) > _LINE_REACH)]
        level = np.median(continuum)
        noise = 1.4826 * np.median(np.abs(continuum - level))
        # Move the window to the measured centroid and repeat, because light of the continuum biases the centroid
        # towards the centre of the window.
        centre, significance = 0.0, 0.0
        for _ in range(10):
            window = np.exp(-0.5 * ((pixel - centre) / 1.2) ** 2)
            above = np.where(in_window, spectrum.light - level, 0.0) * window
            significance = above.sum() / max(noise * float(np.sqrt((window[in_window] ** 2).sum())), 1e-9)
            if significance <= 0.0:
                break
            centre += float(np.clip(2.0 * (above * (pixel - centre)).sum() / above.sum(), -1.0, 1.0))
        out.append(centre if abs(centre) < _LINE_REACH and significance > _MIN_SIGNIFICANCE else np.nan)
    return out


def _why_not_applicable(context: FrameContext) -> str:
    if context.channel != DISPERSED:
        return "no spectra"
    return (
        ""
        if context.spectra is not None and len(context.spectra)
        else "table rendered_spectra has no first order on this frame"
    )


SPECTRA = FrameCheck("spectra", SOURCE, _why_not_applicable, check)
