"""Draw how well the emulator repeats detections and magnitudes on images that were not used for training.

    python -m scripts.emulator_picture MODEL OUT.jpg LAKE [LAKE ..] [--band BAND] [--detectors DETECTOR ..]

The left panel shows the detected fraction against the true magnitude, with its standard error, and the right panel
MAG_AUTO minus the true magnitude: medians, and quantiles of 16 and 84 %.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from scripts import emulator_accuracy
from truesky.emulator import model

_IMAGES, _EMULATOR = "#1f3b57", "#d2691e"
_EDGES = np.arange(19.0, 26.51, 0.5)
# Bins with fewer sources are not drawn.
_FEWEST = 20


def bins(magnitude, outcomes):
    """Return the middle, number, detected fraction, and quantiles of the magnitude difference of each bin."""
    rows = []
    for low in _EDGES[:-1]:
        inside = (magnitude >= low) & (magnitude < low + 0.5)
        difference = outcomes.mag_auto[inside & outcomes.detected]
        if inside.sum() >= _FEWEST and len(difference) >= _FEWEST:
            quantiles = np.quantile(difference, [0.16, 0.5, 0.84])
            rows.append((low + 0.25, inside.sum(), outcomes.detected[inside].mean(), *quantiles))
    return np.array(rows).T


def draw(path, magnitude, frames, emulated):
    """Draw the outcomes on images and the outcomes of the emulator, several for each source."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.8), dpi=100, layout="constrained")
    fraction_axes, magnitude_axes = figure.subplots(1, 2)
    repeats = len(emulated.detected) // len(magnitude)
    middle, number, fraction, low, median, high = bins(magnitude, frames)
    error = np.sqrt(np.maximum(fraction * (1.0 - fraction), 1.0 / number) / number)
    fraction_axes.errorbar(middle, fraction, error, fmt="o", color=_IMAGES, label="images")
    bars = np.abs(np.stack([low, high]) - median)
    magnitude_axes.errorbar(middle, median, bars, fmt="o", capsize=3, color=_IMAGES, label="images")
    middle, _, fraction, low, median, high = bins(np.tile(magnitude, repeats), emulated)
    fraction_axes.plot(middle, fraction, color=_EMULATOR, label="emulator")
    magnitude_axes.plot(middle, median, color=_EMULATOR, label="emulator")
    magnitude_axes.fill_between(middle, low, high, color=_EMULATOR, alpha=0.25, linewidth=0.0)
    magnitude_axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    fraction_axes.set_ylabel("detected fraction")
    fraction_axes.set_ylim(0.0, 1.03)
    magnitude_axes.set_ylabel("MAG_AUTO - true magnitude [mag]")
    for axes in (fraction_axes, magnitude_axes):
        axes.set_xlabel("true magnitude [AB mag]")
        axes.set_xlim(_EDGES[0], _EDGES[-1])
        axes.legend(frameon=False)
    figure.savefig(path, pil_kwargs={"quality": 88})


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("lakes", nargs="+")
    parser.add_argument("--band")
    parser.add_argument("--detectors", nargs="+", default=())
    options = parser.parse_args()
    fitted = model.read_model(options.model)
    settings, band = emulator_accuracy.settings_of(fitted), options.band or fitted.band
    sample = emulator_accuracy.read_frames(options.lakes, band, settings, options.detectors)
    emulated = emulator_accuracy.draw_outcomes(fitted, sample.examples.features)
    draw(options.out, sample.magnitude, sample.examples.outcomes, emulated)


if __name__ == "__main__":
    main()
