"""Plot the measurements of a lake's images and catalogues for the HTML report, as base64-encoded PNG images."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.stats
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.suite import catalogue_figures
from truesky.validation.lake.suite.running import LakeResults

# Width of every plot in the report, inches.
_WIDTH = 10.0


def draw_all(lake_results: LakeResults) -> Iterator[tuple[str, str]]:
    """Yield the caption and the PNG image (base64) of every plot for which there are data.

    Plots of image checks come first, separately for each channel (VIS, NISP-P, NISP-S, EXT), then plots of catalogues.
    """
    channels = dict.fromkeys(str(result.place.channel) for result in lake_results.frame_results)
    for channel in channels:
        channel_results = [result for result in lake_results.frame_results if result.place.channel == channel]
        for series_name, text, draw in _FIGURES:
            plotted = [result for result in channel_results if series_name in result.series]
            if plotted:
                figure = Figure(figsize=(_WIDTH, 4.0), layout="constrained")
                draw(figure, plotted)
                figure.suptitle(channel)
                yield f"{channel}: {text}", _encode_png(figure)
    series = {name: values for result in lake_results.catalogue_results for name, values in result.series.items()}
    for text, figure in catalogue_figures.draw_all(lake_results.rows, series):
        yield text, _encode_png(figure)


def _encode_png(figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=95, metadata={"Software": None})
    return base64.b64encode(stream.getvalue()).decode("ascii")


def _concatenate_series(results: list[Result], name: str) -> Any:
    return np.concatenate([np.asarray(result.series[name], float) for result in results])


def _plot_astrometry(figure: Figure, results: list[Result]) -> None:
    """Plot the position residuals of stars (mas) as vectors over the detector, and as points in x and y."""
    u, v, x, y = (_concatenate_series(results, name) for name in ("u", "v", "off_x", "off_y"))
    left_axes, right_axes = figure.subplots(1, 2)
    # Do not plot outliers, which are due to cosmic rays and unknown neighbours.
    is_typical = np.hypot(x - np.median(x), y - np.median(y)) < 6.0 * np.median(np.hypot(x, y))
    u, v, x, y = u[is_typical], v[is_typical], x[is_typical], y[is_typical]
    sampled = np.linspace(0, len(u) - 1, min(len(u), 500)).astype(int)
    left_axes.quiver(u[sampled], v[sampled], x[sampled], y[sampled], angles="xy", width=2e-3, color="#1f4e79")
    left_axes.set(xlabel="column / half a side", ylabel="row / half a side", title="residuals over the detector")
    limit = float(np.abs(np.append(x, y)).max()) or 1.0
    right_axes.plot(x, y, ".", ms=2, alpha=0.5, color="#1f4e79")
    right_axes.axhline(0, lw=0.5, color="k")
    right_axes.axvline(0, lw=0.5, color="k")
    right_axes.set(xlim=(-limit, limit), ylim=(-limit, limit), xlabel="columns, mas", ylabel="rows, mas")
    right_axes.set_title(f"median {np.median(x):+.2f}, {np.median(y):+.2f} mas")
    right_axes.set_aspect("equal")


def _plot_photometry(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    for band in dict.fromkeys(str(result.place.band) for result in results):
        band_results = [result for result in results if result.place.band == band]
        axis.plot(
            _concatenate_series(band_results, "mag"),
            _concatenate_series(band_results, "dm"),
            ".",
            ms=2,
            alpha=0.6,
            label=band,
        )
    axis.axhspan(-0.02, 0.02, color="k", alpha=0.08)
    axis.set(xlabel="AB of the catalogue", ylabel="measured - catalogue", ylim=(-0.15, 0.15))
    axis.legend(markerscale=4)


def _plot_noise(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    predicted, measured = _concatenate_series(results, "noise").T
    axis.loglog(predicted, measured, ".", color="#1f4e79")
    for ticks in (axis.xaxis, axis.yaxis):
        # Label ticks as 14 instead of 1.4 x 10^1.
        ticks.set_major_formatter(LogFormatter())
        ticks.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    ends = np.array([predicted.min() * 0.95, predicted.max() * 1.05])
    axis.plot(ends, ends, "k-", lw=0.7)
    axis.set(xlabel="expected from the header, e- rms", ylabel="blank sky, e- rms")


def _plot_background(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    column, row, level = _concatenate_series(results, "background").T
    points = axis.scatter(column, row, c=level, s=6, cmap="viridis")
    figure.colorbar(points, label="blank sky / expected")
    axis.set(xlabel="column", ylabel="row")
    axis.set_aspect("equal")


def _plot_completeness(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    for band in dict.fromkeys(str(result.place.band) for result in results):
        bins = np.concatenate([result.series["completeness"] for result in results if result.place.band == band])
        middle = np.unique(bins[:, 0])
        count = np.array([bins[bins[:, 0] == at, 2].sum() for at in middle])
        part = np.array([(bins[bins[:, 0] == at, 1] * bins[bins[:, 0] == at, 2]).sum() for at in middle])
        well_sampled = count >= 8
        axis.plot(middle[well_sampled], part[well_sampled] / count[well_sampled], "o-", ms=3, label=band)
    axis.axhline(0.5, lw=0.5, color="k")
    axis.set(xlabel="AB", ylabel="found by sep", ylim=(0.0, 1.05))
    axis.legend()


def _plot_quality(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    mean = np.mean([result.series["chi2"] for result in results], axis=0)
    axis.step(np.arange(len(mean)), mean, where="mid", label="ramps", color="#1f4e79")
    x = np.linspace(0.5, 60.0, 300)
    freedom = results[0].series["freedom"]
    axis.plot(x, scipy.stats.chi2.pdf(x, freedom), "k-", lw=0.8, label=f"{freedom} degrees of freedom")
    axis.set(xlabel="chi^2", ylabel="fraction of the pixels", xlim=(0, 60))
    axis.legend()


def _plot_whiskers(figure: Figure, results: list[Result]) -> None:
    """Plot the ellipticities of stars over the detector as lines along their long axis, without outliers."""
    u, v, e1, e2 = (
        _concatenate_series([r for r in results if "u" in r.series], name) for name in ("u", "v", "e1", "e2")
    )
    angle, size = 0.5 * np.arctan2(e2, e1), np.hypot(e1, e2)
    is_typical = size < 6.0 * np.median(size) + 1e-6
    axis = figure.subplots()
    arrows = axis.quiver(
        u[is_typical],
        v[is_typical],
        (size * np.cos(angle))[is_typical],
        (size * np.sin(angle))[is_typical],
        pivot="mid",
        headwidth=0,
        headlength=0,
        headaxislength=0,
        width=2e-3,
        color="#1f4e79",
    )
    axis.quiverkey(arrows, 0.9, 1.03, 0.05, "e = 0.05")
    axis.set(xlabel="column / half a side", ylabel="row / half a side")
    axis.set_aspect("equal")


_Draw = Callable[[Figure, list[Result]], None]
_FIGURES: tuple[tuple[str, str, _Draw], ...] = (
    ("off_x", "positions of stars against the catalogue and the WCS of the frame", _plot_astrometry),
    ("dm", "magnitudes of stars against the catalogue", _plot_photometry),
    ("e1", "ellipticities of stars in a window of their half-light diameter", _plot_whiskers),
    ("completeness", "sources that are found, by magnitude", _plot_completeness),
    ("chi2", "chi^2 of the ramp fits", _plot_quality),
    ("noise", "noise of blank sky, one point per amplifier", _plot_noise),
    ("background", "level of blank sky per tile", _plot_background),
)
