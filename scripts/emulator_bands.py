"""Measure how well the emulator repeats the correlation of two bands, on images that show the same sources.

    python -m scripts.emulator_bands MODEL MODEL LAKE [LAKE ..]

Each row of the table is a bin of the brightness in the second band, magnitude minus depth: number of sources, fraction
that both bands detect and that is blended in both, and Spearman's correlation of the errors of MAG_AUTO, and of sizes.
Each pair of columns is (images, emulator). The models should not be trained on these images.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from lake_schema.store import layout, read
from scripts.emulator_accuracy import settings_of
from truesky.emulator import examples, observation, train
from truesky.emulator.examples import Examples
from truesky.emulator.model import read_model

EDGES = (-9.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.5)
# Number of observations of each source, whose mean has a smaller error than one.
REPEATS = 10


def samples_of_band(root, fitted):
    """Return the identifiers and the examples of the sources in the images of a band."""
    truth, options = read.version(root, "rendered_truth"), argparse.Namespace(name=None, masters=None)
    frames, ids, parts = train.frames_of_band(root, fitted.band, (), (), None), [], []
    for frame, sample in train.measured_frames(root, frames, settings_of(fitted), options):
        sources = train.true_sources(truth, frame, np.zeros(0, np.int64), np.zeros(0))
        ids.append(sources.ids[sample.rows])
        parts.append(sample.examples)
    return np.concatenate(ids), examples.join(parts)


def common_sources(first, second):
    """Return the examples of sources that both bands show, in the same order; each band is (identifiers, examples)."""
    _, rows_1, rows_2 = np.intersect1d(first[0], second[0], return_indices=True)
    return first[1].select(rows_1), second[1].select(rows_2)


def emulate(models, pair, repeats=REPEATS):
    """Return emulated examples of the same sources in both bands, `repeats` times."""
    parts = []
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        common = tuple(rng.standard_normal((2, len(pair[0]))))
        parts.append([
            Examples(band.features, observation.draw_outcomes(fitted, band.features, rng, common))
            for fitted, band in zip(models, pair, strict=True)
        ])  # fmt: skip
    return tuple(examples.join(list(column)) for column in zip(*parts, strict=True))


def rank_correlation(first, second):
    """Return Spearman's correlation of two lists of numbers, NaN for less than 10."""
    if len(first) < 10:
        return np.nan
    ranks = [np.argsort(np.argsort(values)).astype(float) for values in (first, second)]
    return float(np.corrcoef(*ranks)[0, 1])


def statistics(first, second):
    """Return a row per bin: number, fraction detected in both and blended in both, two correlations, their error."""
    rows, brightness = [], second.features.brightness
    for low, high in pairwise(EDGES):
        inside = (brightness >= low) & (brightness < high)
        a, b = first.select(inside).outcomes, second.select(inside).outcomes
        both = a.detected & b.detected
        correlations = [rank_correlation(getattr(a, name)[both], getattr(b, name)[both]) for name in
                        ("mag_auto", "radius")]  # fmt: skip
        error = (1.0 - correlations[0] ** 2) / np.sqrt(max(both.sum(), 1))
        rows.append((inside.sum(), both.mean(), (a.blended & b.blended).mean(), *correlations, error))
    return np.array(rows)


def print_table(images, emulated):
    print("| brightness | sources | detected in both | blended in both | correlation of magnitudes | and of sizes |")
    print("|---|---|---|---|---|---|")
    for low, a, b in zip(EDGES, images, emulated, strict=False):
        cells = [f"{x:.3f} / {y:.3f}" for x, y in zip(a[1:5], b[1:5], strict=True)]
        cells[2] = f"{a[3]:.2f} ± {a[5]:.2f} / {b[3]:.2f}"
        print(f"| {low:g} | {a[0]:.0f} | {' | '.join(cells)} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs=2, type=Path, metavar="model")
    parser.add_argument("lakes", nargs="+")
    options = parser.parse_args()
    models, pairs = [read_model(path) for path in options.models], []
    for lake in options.lakes:
        root = layout.resolve_lake(lake)
        pairs.append(common_sources(*(samples_of_band(root, fitted) for fitted in models)))
    pair = tuple(examples.join(list(column)) for column in zip(*pairs, strict=True))
    print_table(statistics(*pair), statistics(*emulate(models, pair)))


if __name__ == "__main__":
    main()
