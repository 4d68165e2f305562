"""Spectra without a slit: the light of first orders, where their traces lie, and where their lines do.

Of points whose first order nobody overlaps, light is summed across the trace, above the level on both sides of it. Of
any source whose lines are bright enough, a line is the light above its spectrum's own median, and its place is told by
its centroid.
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
# Of the light over what is expected, pixels of the trace, part of a pixel of a line's wavelength.
_FLUX, _TRACE, _LINE = 0.05, 0.1, 0.3
# Half the height that is summed, and where the level is taken, pixels on either side.
_HALF, _FROM, _TO = 6, 9, 15
# S/N of a spectrum and of a line that are used, and how much of a trace may be overlapped.
_MIN_SNR, _MIN_LINE_SNR, _MAX_OVERLAP, _MIN_NUMBER, _MAX_SPECTRA = 60.0, 8.0, 0.1, 5, 150
# Pixels about a line that its light and its level are told by.
_LINE_REACH, _LEVEL_REACH = 3, 12
# Standard deviations from which a line is there, and the part of those foreseen that may be missed.
_MIN_SIGNIFICANCE, _MAX_MISSED = 3.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ExtractedSpectrum:
    """Along a trace, a value a pixel: t of the trace, e- of the source, and its centroid across minus the trace."""

    t: Float
    light: Float
    offset: float


def check(context: FrameContext) -> list[Row]:
    """Of a frame's first orders."""
    # Of other orders, where they are among the rows, the overlap is null.
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
        # Where wavelengths are far off, nothing is left at the foreseen places that a shift could be told by.
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
                f"{len(line_offsets)} lines foreseen at S/N > {_MIN_LINE_SNR:g}",
            )
        )
    for name, values, expected, tolerance, unit in (
        ("flux", ratios, 1.0, _FLUX, ""),
        ("trace", offsets, 0.0, _TRACE, "pix"),
        ("wavelength", lines, 0.0, _LINE, "pix"),
    ):
        if len(values) < _MIN_NUMBER:
            why = f"{name}: {len(values)} spectra or lines alone and bright enough; {_MIN_NUMBER} are wanted"
            out.append(not_applicable("spectra", context.place, why, SOURCE, name))
            continue
        found_values = np.array(values)
        middle = float(np.median(found_values))
        error = 1.2533 * 1.4826 * float(np.median(np.abs(found_values - middle))) / np.sqrt(len(values))
        out.append(Row("spectra", name, context.place, middle, error, expected, tolerance, unit, SOURCE,
                       note=f"{len(values)} of them, median"))  # fmt: skip
    context.series["spectra"] = np.array(ratios)
    return out


def extract_spectrum(image: Any, row: Mapping[str, Any]) -> ExtractedSpectrum | None:
    """The light along a first order; None where it is not wholly on the detector, or lies along rows and columns both.

    image : float[ny, nx] e-;  row : of `rendered_spectra`
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
    # One row after the other: light is where the trace is, and what is far from it is of a cosmic ray.
    inner = _remove_outliers(inner)
    weight = inner.sum(axis=1)
    centre = (weight * np.arange(-_HALF, _HALF + 1)).sum() / weight.sum() if weight.sum() > 0.0 else np.nan
    return ExtractedSpectrum(at, inner.sum(axis=0), float(centre + np.mean(trace_rows - middle)))


def _remove_outliers(inner: Float) -> Float:
    """[rows, columns] without single pixels far above their neighbours along the row."""
    typical = np.median(np.stack([np.roll(inner, step, axis=1) for step in (-3, -2, -1, 1, 2, 3)]), axis=0)
    spread = 1.4826 * np.median(np.abs(inner - typical))
    is_outlier = inner > typical + 8.0 * spread + 1.0 * np.abs(typical)
    # A line is bright in several rows.
    return np.where(is_outlier & (is_outlier.sum(axis=0) <= 2), typical, inner)


def _polynomial(coefficients: Float, t: Float) -> Float:
    out = np.zeros_like(t)
    for coefficient in coefficients[::-1]:
        out = out * t + coefficient
    return out


def _line_offsets(context: FrameContext, row: Mapping[str, Any]) -> list[float]:
    """Of a spectrum's bright lines: measured place minus the foreseen, pixels along the trace; NaN where none is."""
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
        # About the place that was found, until it stays: light of the continuum pulls to the middle of the window.
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
        else "the lake's rendered_spectra have no first order on it"
    )


SPECTRA = FrameCheck("spectra", SOURCE, _why_not_applicable, check)
