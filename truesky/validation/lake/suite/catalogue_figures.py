"""Plot measurements of galaxy catalogues for the report: counts, redshifts, colours, clustering and shear.

The plots also show observations or theory for comparison.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from lake_schema.arrays import Float
from truesky.validation.lake.catalogues import angular_power
from truesky.validation.lake.measure.rows import Row

# Colour of most points and lines.
_INK = "#1f4e79"
# Colours of points and lines if a plot shows several samples of galaxies.
_PALETTE = ("#1f4e79", "#b8541a", "#2e7d4f")
# Names of measured number counts; the number in the name is the i magnitude.
_COUNT = re.compile(r"log_i_([0-9.]+)")
# Sentence about error bars in the captions of plots.
_ERROR_NOTE = "Errors are jackknife errors over patches of the field"


def draw_all(rows: Sequence[Row], series: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Yield a caption and a plot for every result of catalogue checks for which there are data.

    Parameters
    ----------
    rows : sequence of Row
        Rows (measured values with expected values) of all checks; only number counts of galaxies are plotted from them.
    series : mapping of str to array
        Arrays for plots that the checks of catalogues return, by name.

    Yields
    ------
    caption : str
        Caption of the plot.
    figure : Figure
        The plot. Nothing is yielded without data.
    """
    counts = [row for row in rows if row.check == "observed" and _COUNT.fullmatch(row.quantity)]
    counts = [row for row in counts if np.isfinite(row.value)]
    if counts:
        yield (
            f"galaxies: counts against magnitude, compared with {counts[0].source}. {_ERROR_NOTE}.",
            _plot_counts(counts),
        )
    if "redshifts" in series and "colours" in series:
        text = "galaxies: redshifts for I_E < 24.5, and colours against redshift for i < 22.5"
        yield f"{text}. {_ERROR_NOTE}.", _plot_redshifts(series)
    if "colour_colour" in series:
        text = "galaxies: colours of the fluxes for magnitudes below 23 at 5600 A and z < 1.5"
        yield (
            f"{text}; the line is the observed locus of red galaxies at z < 0.4 (Eisenstein et al. 2001).",
            _plot_colours(series),
        )
    limits = [name.removeprefix("w_theory_") for name in series if name.startswith("w_theory_")]
    if limits:
        text = "galaxies: how they cluster on the sky, and non-linear theory with the bias of their halos"
        yield f"{text}. {_ERROR_NOTE}.", _plot_clustering(series, limits)
    powers = [name for name in series if name.startswith(("power_", "convergence_power_"))]
    if powers:
        text = "galaxies: angular power in redshift bins and with the convergence behind them, and theory"
        yield f"{text}. Errors are those of Gaussian fields.", _plot_power(series, powers)
    if "multipoles" in series:
        text = "galaxies: multipoles of the correlation function in redshift space, and linear theory"
        yield f"{text}. {_ERROR_NOTE}.", _plot_multipoles(series["multipoles"])
    if "shear" in series:
        text = "galaxies: shear correlation functions at 0.8 < z < 1.2, and non-linear theory"
        yield f"{text}. {_ERROR_NOTE}; neighbouring points are not independent.", _plot_shear(series)


def _plot_counts(rows: Sequence[Row]) -> Figure:
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    left_axes, right_axes = figure.subplots(1, 2)
    mag = np.array([float(match[1]) for row in rows if (match := _COUNT.fullmatch(row.quantity))])
    value, error, expected, tolerance = (
        np.array([getattr(row, name) for row in rows]) for name in ("value", "error", "expected", "tolerance")
    )
    error = np.nan_to_num(error)
    for axis, zero in ((left_axes, 0.0), (right_axes, expected)):
        axis.fill_between(mag, expected - tolerance - zero, expected + tolerance - zero, color="k", alpha=0.12, lw=0)
        axis.plot(mag, expected - zero, "k-", lw=1, label="observed, with tolerance")
        axis.errorbar(mag, value - zero, error, fmt="o", ms=4, color=_INK, capsize=2, label="this lake")
        axis.set_xlabel("i, AB mag")
    left_axes.set_ylabel("log$_{10}$ of galaxies mag$^{-1}$ deg$^{-2}$")
    right_axes.set_ylabel("simulated - observed, dex")
    left_axes.legend()
    return figure


def _plot_redshifts(series: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    left_axes, right_axes = figure.subplots(1, 2)
    low, high, number, error = series["redshifts"]
    middle = 0.5 * (low + high)
    left_axes.stairs(number, np.append(low, high[-1]), color=_INK, label="this lake")
    left_axes.errorbar(middle, number, np.nan_to_num(error), fmt="none", ecolor=_INK, capsize=2, lw=1)
    # Plot the redshift distribution that Euclid forecasts assume, with a median of 0.9.
    z = np.linspace(0.0, float(high[-1]), 200)
    shape = z**2 * np.exp(-((z * 1.412 / 0.9) ** 1.5))
    total = float(np.sum(number * (high - low)))
    left_axes.plot(
        z, shape * total / np.trapezoid(shape, z), "k--", lw=1, label="z$^2$ exp(-(z/z$_0$)$^{1.5}$), median 0.9"
    )
    left_axes.set(xlabel="redshift", ylabel="galaxies with I$_E$ < 24.5, arcmin$^{-2}$ per unit z", xlim=(0, high[-1]))
    left_axes.set_ylim(bottom=0.0)
    left_axes.legend()
    at, *levels = series["colours"]
    right_axes.fill_between(at, levels[0], levels[4], color=_INK, alpha=0.15, lw=0, label="5 to 95 %")
    right_axes.fill_between(at, levels[1], levels[3], color=_INK, alpha=0.3, lw=0, label="16 to 84 %")
    right_axes.errorbar(at, levels[2], np.nan_to_num(levels[5]), fmt="o-", ms=3, lw=1, color=_INK, label="median")
    right_axes.set(xlabel="redshift", ylabel="r - i of LSST, mag, of galaxies with i < 22.5")
    right_axes.legend()
    return figure


def _plot_colours(series: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    axis, edges = figure.subplots(), series["colour_edges"]
    number = np.ma.masked_equal(series["colour_colour"].T, 0.0)
    mesh = axis.pcolormesh(edges, edges, number, norm=LogNorm(), cmap="Blues", rasterized=True)
    figure.colorbar(mesh, label="galaxies in 0.033 mag by 0.033 mag")
    gr = np.array([1.0, 1.7])
    axis.plot(gr, gr / 4.0 + 0.18, "-", color=_PALETTE[1], lw=1.5, label="r - i = (g - r) / 4 + 0.18")
    axis.set(xlabel="g - r, AB mag of LSST", ylabel="r - i, AB mag of LSST", xlim=(-0.5, 2.3), ylim=(-0.4, 1.6))
    axis.legend(loc="upper left")
    return figure


def _plot_clustering(series: Mapping[str, Any], limits: Sequence[str]) -> Figure:
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    left_axes, right_axes = figure.subplots(1, 2)
    for limit, color in zip(limits, _PALETTE, strict=False):
        theta, w, error, w_theory = series[f"w_{limit}"]
        curve, expected = series[f"w_theory_{limit}"]
        shift = 1.0 + 0.04 * limits.index(limit)
        _plot_points(left_axes, theta, w, error, color, f"I$_E$ < {limit}")
        left_axes.plot(curve, expected, "-", lw=1, color=color)
        right_axes.errorbar(
            theta * shift, w / w_theory, np.nan_to_num(error / w_theory), fmt="o", ms=4, color=color, capsize=2
        )
    left_axes.set(xscale="log", yscale="log", xlabel="separation, arcmin", ylabel="w")
    _plain_ticks(left_axes)
    left_axes.plot([], [], "-", lw=1, color="0.4", label="theory")
    left_axes.legend()
    _format_ratio_axes(right_axes, "w over theory", 0.5)
    return figure


def _plot_shear(series: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    left_axes, right_axes = figure.subplots(1, 2)
    theta, plus, minus, cross, *errors = series["shear"]
    curve, *expected = series["shear_theory"]
    for name, value, error, prediction, color in zip(
        ("$\\xi_+$", "$\\xi_-$"), (plus, minus), errors, expected, _PALETTE, strict=False
    ):
        _plot_points(left_axes, theta, value, error, color, name)
        left_axes.plot(curve, prediction, "-", lw=1, color=color)
    left_axes.plot([], [], "-", lw=1, color="0.4", label="theory")
    left_axes.set(xscale="log", yscale="log", xlabel="separation, arcmin", ylabel="$\\xi$")
    _plain_ticks(left_axes)
    left_axes.legend()
    right_axes.axhline(0.0, lw=0.8, color="k")
    right_axes.errorbar(theta, cross / plus, np.nan_to_num(errors[2] / plus), fmt="o", ms=4, color=_INK, capsize=2)
    right_axes.axhspan(-0.1, 0.1, color="k", alpha=0.08)
    right_axes.set(xscale="log", xlabel="separation, arcmin", ylabel="cross component / $\\xi_+$", ylim=(-0.3, 0.3))
    _plain_ticks(right_axes)
    return figure


def _plot_power(series: Mapping[str, Any], names: Sequence[str]) -> Figure:
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, start, label in zip(
        axes, ("power_", "convergence_power_"), ("C$_l$ of galaxies", "C$_l$ with convergence"), strict=True
    ):
        axis.axhline(1.0, lw=0.8, color="k")
        for number, (low, high) in enumerate(pairwise(angular_power.Z_EDGES)):
            if (name := f"{start}{low:g}") in names:
                ell, value, error, expected = series[name]
                # Redshift bins have the same bands: move their points apart.
                ell = ell + (2.0 * number - 3.0)
                axis.errorbar(
                    ell, value / expected, error / expected, fmt="o", ms=4, color=f"C{number}", capsize=2,
                    label=f"{low:g} < z < {high:g}",
                )  # fmt: skip
        axis.set(xlabel="l", ylabel=f"{label} / theory")
        axis.legend()
    return figure


def _plot_multipoles(multipoles: Float) -> Figure:
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    axis = figure.subplots()
    separation, mono, quad, mono_error, quad_error, *expected = multipoles
    for name, value, error, theory, color in zip(
        ("$\\xi_0$", "$\\xi_2$"), (mono, quad), (mono_error, quad_error), expected, _PALETTE, strict=False
    ):
        axis.errorbar(separation, separation**2 * value, separation**2 * error, fmt="o", ms=4, color=color, label=name)
        axis.plot(separation, separation**2 * theory, "-", lw=1, color=color)
    axis.axhline(0.0, lw=0.8, color="k")
    axis.set(xlabel="separation s, Mpc/h", ylabel="s$^2$ $\\xi$, (Mpc/h)$^2$")
    axis.legend()
    return figure


def _plot_points(axis: Any, x: Float, y: Float, error: Float, color: str, label: str) -> None:
    """Plot points with error bars on logarithmic axes; negative values are open symbols at their absolute value."""
    for sign, fill in ((1.0, color), (-1.0, "none")):
        has_sign = sign * y > 0.0
        if has_sign.any():
            bar = np.nan_to_num(error[has_sign])
            # Shorten error bars that would reach below 0, which a logarithmic axis cannot show.
            bars = np.stack([np.minimum(bar, 0.9 * np.abs(y[has_sign])), bar])
            axis.errorbar(x[has_sign], sign * y[has_sign], bars, fmt="o", ms=4, color=color, mfc=fill, capsize=2,
                          label=label if sign > 0 else f"-{label}")  # fmt: skip


def _format_ratio_axes(axis: Any, label: str, tolerance: float) -> None:
    axis.axhline(1.0, lw=0.8, color="k")
    axis.axhspan(1.0 - tolerance, 1.0 + tolerance, color="k", alpha=0.08)
    axis.set(xscale="log", xlabel="separation, arcmin", ylabel=label, ylim=(0.0, 2.5))
    _plain_ticks(axis)


def _plain_ticks(axis: Any) -> None:
    """Label the ticks of a logarithmic x axis as 1 and 10 instead of 10^0 and 10^1."""
    axis.xaxis.set_major_formatter("{x:g}")
