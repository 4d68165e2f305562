"""Measure how well the emulator repeats detections and measurements on images that were not used for training.

    python -m scripts.emulator_accuracy MODEL LAKE [LAKE ..] [--band BAND] [--detectors DETECTOR ..]

The images of the lakes are measured as by `truesky train`, and their true sources are observed with the model. The
tables have one row per 0.5 mag of the true magnitude.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from lake_schema.store import layout, read
from truesky.emulator import examples, lookup, model, train
from truesky.emulator.examples import Examples, Outcomes
from truesky.emulator.frame_examples import Settings
from truesky.randomness.per_source import PerSourceGenerator
from truesky.reduction.catalogue import Limits

# Magnitudes of the bins, and magnitude to which counts and redshifts are compared.
EDGES = np.arange(20.0, 26.01, 0.5)
LIMIT = 24.5
# Number of observations of each source, whose mean has a smaller error than one.
REPEATS = 20


def draw_outcomes(fitted, features, repeats=REPEATS):
    """Return the outcomes of sources with these features, each `repeats` times, in the order of the repetitions."""
    draws = []
    for i in range(repeats):
        generator = PerSourceGenerator(np.arange(len(features.brightness)), i, "emulator_accuracy")
        draws.append(lookup.draw(fitted.lookup, features, tuple(generator.random() for _ in range(4))))
    outcomes = fitted.examples.outcomes.select(np.concatenate(draws))
    can_be_seen = np.tile(features.brightness <= fitted.faintest, repeats)
    return Outcomes(outcomes.detected & can_be_seen, outcomes.blended, *(
        getattr(outcomes, name) for name in Outcomes.__slots__[2:]
    ))  # fmt: skip


def spread(values):
    """Return 1.48 times the median absolute deviation, the standard deviation of a Gaussian without outliers."""
    return 1.48 * float(np.median(np.abs(values - np.median(values)))) if len(values) > 10 else np.nan


def compare(magnitude, frames, emulated):
    """Return a row per bin: magnitude, number, completeness, bias and scatter of MAG_AUTO, median and scatter of size.

    `magnitude` are true magnitudes of n sources, `frames` their outcomes on images, and `emulated` those of the model,
    several for each source. Each pair of columns is (images, emulator).
    """
    repeats = len(emulated.detected) // len(magnitude)
    all_magnitudes, rows = np.tile(magnitude, repeats), []
    for low, high in pairwise(EDGES):
        row = [low, int(((magnitude >= low) & (magnitude < high)).sum())]
        pairs = ((magnitude, frames), (all_magnitudes, emulated))
        inside = [(m >= low) & (m < high) for m, _ in pairs]
        row += [o.detected[i].mean() if i.any() else np.nan for i, (_, o) in zip(inside, pairs, strict=True)]
        detections = [i & o.detected for i, (_, o) in zip(inside, pairs, strict=True)]
        for name, functions in (("mag_auto", (np.median, spread)), ("radius", (np.median, spread))):
            for function in functions:
                values = [getattr(o, name)[f] for f, (_, o) in zip(detections, pairs, strict=True)]
                row += [function(v) if len(v) else np.nan for v in values]
        rows.append(row)
    return np.array(rows)


def counts_and_redshifts(magnitude, redshift, outcomes):
    """Return the number of galaxies that are measured brighter than the limit, and their mean redshift."""
    repeats = len(outcomes.detected) // len(magnitude)
    chosen = outcomes.detected & (np.tile(magnitude, repeats) + outcomes.mag_auto < LIMIT)
    chosen &= np.isfinite(np.tile(redshift, repeats))
    return chosen.sum() / repeats, float(np.tile(redshift, repeats)[chosen].mean())


def print_table(rows):
    print("| I_E | sources | completeness | bias of MAG_AUTO | its scatter | size / true | its scatter |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        pairs = [f"{a:.3f} / {b:.3f}" for a, b in row[2:].reshape(-1, 2)]
        print(f"| {row[0]:.1f} | {row[1]:.0f} | {' | '.join(pairs)} |")


def settings_of(fitted):
    """Return the settings of detection and measurement with which a model was trained."""
    given = fitted.facts["settings"]
    return Settings(Limits(given["threshold"], given["pixels"]), given["aperture_fwhm"])


def read_frames(path, band, settings, detectors=()):
    """Return the examples of all frames of a lake, with true magnitudes and redshifts (NaN for stars)."""
    root = layout.resolve_lake(path)
    options = argparse.Namespace(name=None, masters=None)
    frames, parts, magnitudes, redshifts = train.frames_of_band(root, band, detectors, (), None), [], [], []
    products, truth = (read.version(root, name) for name in ("products", "rendered_truth"))
    galaxies = read.version(root, "galaxies", products.manifest["facts"]["inputs"]["galaxies"]).rows(["id", "z_true"])
    z_of = dict(zip(galaxies["id"].to_pylist(), galaxies["z_true"].to_pylist(), strict=True))
    for frame, sample in train.measured_frames(root, frames, settings, options):
        sources = train.true_sources(truth, frame, np.zeros(0, np.int64), np.zeros(0))
        parts.append(sample.examples)
        magnitudes.append(sources.magnitude[sample.rows])
        redshifts.append([z_of.get(int(number), np.nan) for number in sources.ids[sample.rows]])
        print(f"{frame.stem}: depth {sample.conditions['depth']:.2f}, sky {sample.conditions['sky']:.3f} e-/s")
    return examples.join(parts), np.concatenate(magnitudes), np.concatenate(redshifts)


def report(fitted: model.Model, frames: Examples, magnitude, redshift):
    """Print the comparison of images with the emulator, and return the rows of the table."""
    emulated = draw_outcomes(fitted, frames.features)
    rows = compare(magnitude, frames.outcomes, emulated)
    print_table(rows)
    for name, outcomes in (("images", frames.outcomes), ("emulator", emulated)):
        number, z = counts_and_redshifts(magnitude, redshift, outcomes)
        print(f"{name}: {number:.1f} galaxies measured brighter than {LIMIT}, mean redshift {z:.4f}")
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("lakes", nargs="+")
    parser.add_argument("--band")
    parser.add_argument("--detectors", nargs="+", default=())
    options = parser.parse_args()
    fitted = model.read_model(options.model)
    band, settings = options.band or fitted.band, settings_of(fitted)
    for path in options.lakes:
        report(fitted, *read_frames(path, band, settings, options.detectors))


if __name__ == "__main__":
    main()
