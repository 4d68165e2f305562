"""Plot the measurements of the simulated universe with observations and theory for comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Float
from truesky.catalogue.halos import luminosity_function
from truesky.cosmology import FIDUCIAL
from truesky.validation.model import census

# Observed numbers of galaxies per arcmin^2 brighter than a magnitude i (key): GAMA and zCOSMOS (Driver et al. 2016),
# VVDS (Le Fevre et al. 2005), LSST Science Book (2009).
_OBSERVED = {20: 0.57, 21: 1.45, 22: 3.7, 23: 9.0, 24: 21.0, 25: 44.5, 26: 94.0}


def draw(
    folder: Path,
    sample: census.Census,
    curves: Mapping[str, Any],
    power: Float,
    bands: Sequence[int],
    figures: Mapping[str, float],
) -> None:
    """Write universe.png with six plots: counts, redshifts, luminosities, halos, w(theta) and C_l of the convergence.

    Parameters
    ----------
    folder : Path
        Folder of the file; it is made if it does not exist.
    sample : Census
        Simulated galaxies.
    curves : mapping of str to tuple
        Arrays (theta in deg, measured w, error, predicted w) by kind of tracer and scale, such as "halos_wide".
    power : float array, shape (planes, bands)
        C_l of the convergence divided by linear theory, for two source redshifts; nothing is plotted if it is empty.
    bands : sequence of int
        Edges of the bands in l.
    figures : mapping of str to float
        Measured values by name.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = pyplot.subplots(2, 3, figsize=(16, 9), layout="constrained")
    for ax, plot in zip(axes.ravel(), (_plot_counts, _plot_redshifts, _plot_luminosities, _plot_halos), strict=False):
        plot(ax, sample, figures)
    _plot_clustering(axes[1, 1], curves)
    _plot_convergence(axes[1, 2], power, bands)
    with user_files.replace_atomically(folder / "universe.png") as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    pyplot.close(figure)


def _plot_counts(ax: Any, sample: census.Census, figures: Mapping[str, float]) -> None:
    ax.plot(list(_OBSERVED), [figures[f"i_{limit}"] for limit in _OBSERVED], "-", label="drawn")
    ax.plot(list(_OBSERVED), list(_OBSERVED.values()), "ko", label="observed")
    ax.set(yscale="log", xlabel="i / AB mag", ylabel="brighter / arcmin$^2$")
    ax.legend()


def _plot_redshifts(ax: Any, sample: census.Census, figures: Mapping[str, float]) -> None:
    bins = np.arange(0.0, 6.05, 0.05)
    for limit in (26.0, 24.5, 23.0):
        z = sample.rows["z_true"][sample.mags["euclid_vis"] < limit]
        ax.hist(
            z, bins, weights=np.full(z.size, 20.0 / sample.area / 3600.0), histtype="step", label=f"$I_E$ < {limit}"
        )
    ax.set(xlabel="redshift", ylabel="galaxies / arcmin$^2$ / unit redshift")
    ax.legend()


def _plot_luminosities(ax: Any, sample: census.Census, figures: Mapping[str, float]) -> None:
    law, edges = luminosity_function.schechter(), np.arange(-24.5, -15.9, 0.5)
    for at, half, reddest in census.SHELLS[:3]:
        z, m = sample.rows["z_true"], sample.rows["abs_mag_r01"]
        volume = float(FIDUCIAL.comoving_volume(at - half, at + half)) * np.radians(1.0) ** 2 * sample.area
        middle = 0.5 * (edges[1:] + edges[:-1])
        density = np.histogram(m[np.abs(z - at) < half], edges)[0] / volume / 0.5
        limit = sample.limit - float(FIDUCIAL.distance_modulus(at + half)) - reddest
        (line,) = ax.plot(middle, luminosity_function.density(law, middle, at), label=f"z = {at}")
        is_complete = edges[1:] <= limit
        for mask, style in ((is_complete, "o"), (~is_complete, "x")):
            ax.plot(middle[mask], density[mask], style, color=line.get_color())
    ax.set(yscale="log", ylim=(1e-7, 0.2), xlabel="$M_r$", ylabel="(Mpc/h)$^{-3}$ mag$^{-1}$ (x: not all seen)")
    ax.legend()


def _plot_halos(ax: Any, sample: census.Census, figures: Mapping[str, float]) -> None:
    for min_log_mass in census.HALO_MASSES:
        names = [f"halos_{min_log_mass:g}_z{at}" for at, _ in census.HALO_SHELLS]
        z = [at for at, _ in census.HALO_SHELLS]
        ax.errorbar(
            z, [figures[name] for name in names], [figures[f"{name}_error"] for name in names], fmt="o-",
            label=f"log M > {min_log_mass:g}",
        )  # fmt: skip
    ax.axhspan(0.95, 1.05, color="0.9")
    ax.set(ylim=(0.7, 1.3), xlabel="redshift", ylabel="halos / mass function")
    ax.legend()


def _plot_clustering(ax: Any, curves: Mapping[str, Any]) -> None:
    for name, (theta, w, error, expected) in curves.items():
        kind, _, scale = name.partition("_")
        colour = {"halos": "tab:blue", "galaxies": "tab:red"}[kind]
        label = {"label": kind} if scale == "wide" else {}
        ax.errorbar(theta, w, error, fmt="o", color=colour, **label)
        ax.plot(theta, expected, color=colour)
    ax.axvspan(0.3, 1.5, color="0.9", zorder=-1)
    ax.set(xscale="log", yscale="log", xlabel=r"$\theta$ / deg", ylabel=r"$w(\theta)$, lines: linear theory")
    ax.legend()


def _plot_convergence(ax: Any, power: Float, bands: Sequence[int]) -> None:
    middle = np.sqrt(np.array(bands[1:]) * np.array(bands[:-1]))
    if not power.size:
        return
    for row, z in zip(power, (1.0, 2.4), strict=True):
        ax.plot(middle, row, "o-", label=f"sources at z = {z}")
    ax.axhspan(0.9, 1.1, color="0.9")
    ax.set(xscale="log", ylim=(0.7, 1.3), xlabel="multipole", ylabel=r"$C_\ell^\kappa$ / linear theory")
    ax.legend()
