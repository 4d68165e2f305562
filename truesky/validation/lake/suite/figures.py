"""Pictures of the report, as base64 of PNG.

drawn   (caption, picture) of whatever there is something of
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.stats
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from truesky.validation.lake.measure.seen import Result
from truesky.validation.lake.suite import catalogue_figures
from truesky.validation.lake.suite.running import Found

_WIDTH = 10.0


def drawn(found: Found) -> Iterator[tuple[str, str]]:
    """Of what was found."""
    channels = dict.fromkeys(str(result.place.channel) for result in found.results)
    for channel in channels:
        own = [result for result in found.results if result.place.channel == channel]
        for wants, text, draw in _FIGURES:
            some = [result for result in own if wants in result.series]
            if some:
                figure = Figure(figsize=(_WIDTH, 4.0), layout="constrained")
                draw(figure, some)
                figure.suptitle(channel)
                yield f"{channel}: {text}", _encoded(figure)
    series = {name: values for result in found.catalogues for name, values in result.series.items()}
    for text, figure in catalogue_figures.drawn(found.rows, series):
        yield text, _encoded(figure)


def _encoded(figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=95, metadata={"Software": None})
    return base64.b64encode(stream.getvalue()).decode("ascii")


def _together(results: list[Result], name: str) -> Any:
    return np.concatenate([np.asarray(result.series[name], float) for result in results])


def _astrometry(figure: Figure, results: list[Result]) -> None:
    """Residuals as vectors over the detector, and their scatter."""
    u, v, x, y = (_together(results, name) for name in ("u", "v", "off_x", "off_y"))
    left, right = figure.subplots(1, 2)
    # Hit by a cosmic ray, or beside something that nobody knows: no residuals of the system.
    usual = np.hypot(x - np.median(x), y - np.median(y)) < 6.0 * np.median(np.hypot(x, y))
    u, v, x, y = u[usual], v[usual], x[usual], y[usual]
    some = np.linspace(0, len(u) - 1, min(len(u), 500)).astype(int)
    left.quiver(u[some], v[some], x[some], y[some], angles="xy", width=2e-3, color="#1f4e79")
    left.set(xlabel="column / half a side", ylabel="row / half a side", title="residuals over the detector")
    limit = float(np.abs(np.append(x, y)).max()) or 1.0
    right.plot(x, y, ".", ms=2, alpha=0.5, color="#1f4e79")
    right.axhline(0, lw=0.5, color="k")
    right.axvline(0, lw=0.5, color="k")
    right.set(xlim=(-limit, limit), ylim=(-limit, limit), xlabel="columns, mas", ylabel="rows, mas")
    right.set_title(f"median {np.median(x):+.2f}, {np.median(y):+.2f} mas")
    right.set_aspect("equal")


def _photometry(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    for band in dict.fromkeys(str(result.place.band) for result in results):
        own = [result for result in results if result.place.band == band]
        axis.plot(_together(own, "mag"), _together(own, "dm"), ".", ms=2, alpha=0.6, label=band)
    axis.axhspan(-0.02, 0.02, color="k", alpha=0.08)
    axis.set(xlabel="AB of the catalogue", ylabel="measured - catalogue", ylim=(-0.15, 0.15))
    axis.legend(markerscale=4)


def _noise(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    told, found = _together(results, "noise").T
    axis.loglog(told, found, ".", color="#1f4e79")
    for ticks in (axis.xaxis, axis.yaxis):
        # 14 for 1.4 x 10^1.
        ticks.set_major_formatter(LogFormatter())
        ticks.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    ends = np.array([told.min() * 0.95, told.max() * 1.05])
    axis.plot(ends, ends, "k-", lw=0.7)
    axis.set(xlabel="foreseen by the header, e- rms", ylabel="blank sky, e- rms")


def _background(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    column, row, level = _together(results, "background").T
    points = axis.scatter(column, row, c=level, s=6, cmap="viridis")
    figure.colorbar(points, label="blank sky / foreseen")
    axis.set(xlabel="column", ylabel="row")
    axis.set_aspect("equal")


def _completeness(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    for band in dict.fromkeys(str(result.place.band) for result in results):
        found = np.concatenate([result.series["completeness"] for result in results if result.place.band == band])
        middle = np.unique(found[:, 0])
        count = np.array([found[found[:, 0] == at, 2].sum() for at in middle])
        part = np.array([(found[found[:, 0] == at, 1] * found[found[:, 0] == at, 2]).sum() for at in middle])
        known = count >= 8
        axis.plot(middle[known], part[known] / count[known], "o-", ms=3, label=band)
    axis.axhline(0.5, lw=0.5, color="k")
    axis.set(xlabel="AB", ylabel="found by sep", ylim=(0.0, 1.05))
    axis.legend()


def _quality(figure: Figure, results: list[Result]) -> None:
    axis = figure.subplots()
    mean = np.mean([result.series["chi2"] for result in results], axis=0)
    axis.step(np.arange(len(mean)), mean, where="mid", label="ramps", color="#1f4e79")
    x = np.linspace(0.5, 60.0, 300)
    freedom = results[0].series["freedom"]
    axis.plot(x, scipy.stats.chi2.pdf(x, freedom), "k-", lw=0.8, label=f"{freedom} degrees of freedom")
    axis.set(xlabel="chi^2", ylabel="part of the pixels", xlim=(0, 60))
    axis.legend()


def _whiskers(figure: Figure, results: list[Result]) -> None:
    """Ellipticities as whiskers along the long axis, over the detector."""
    u, v, e1, e2 = (_together([r for r in results if "u" in r.series], name) for name in ("u", "v", "e1", "e2"))
    angle, size = 0.5 * np.arctan2(e2, e1), np.hypot(e1, e2)
    usual = size < 6.0 * np.median(size) + 1e-6
    axis = figure.subplots()
    drawn = axis.quiver(u[usual], v[usual], (size * np.cos(angle))[usual], (size * np.sin(angle))[usual], pivot="mid",
                        headwidth=0, headlength=0, headaxislength=0, width=2e-3, color="#1f4e79")  # fmt: skip
    axis.quiverkey(drawn, 0.9, 1.03, 0.05, "e = 0.05")
    axis.set(xlabel="column / half a side", ylabel="row / half a side")
    axis.set_aspect("equal")


_Draw = Callable[[Figure, list[Result]], None]
_FIGURES: tuple[tuple[str, str, _Draw], ...] = (
    ("off_x", "positions of stars against the catalogue by the WCS of the frame", _astrometry),
    ("dm", "magnitudes of stars against the catalogue", _photometry),
    ("e1", "ellipticities of stars in a window of their half-light diameter", _whiskers),
    ("completeness", "sources that are found, by magnitude", _completeness),
    ("chi2", "how well ramps fit", _quality),
    ("noise", "noise of blank sky, an amplifier a point", _noise),
    ("background", "level of blank sky, tile by tile", _background),
)
