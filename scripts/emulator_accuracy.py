"""Measure how well the emulator repeats detections and measurements on images that were not used for training.

    python -m scripts.emulator_accuracy MODEL LAKE [LAKE ..] [--band BAND] [--detectors DETECTOR ..]
                                        [--limits MAGNITUDE ..] [--unmasked]

The images of the lakes are measured as by `truesky train`, and their true sources are observed with the model. The
first table has one row per 0.5 mag of the true magnitude, and the others one row per bin of separation: the angular
correlation function w(theta) of the galaxies that are detected. All lakes are compared together.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np

from lake_schema import sky
from lake_schema.store import layout, read
from lake_schema.tables.survey.depth import BRIGHT_STAR, GHOST, SATURATED, SPIKE
from truesky.emulator import examples, lookup, model, train
from truesky.emulator.examples import Examples, Outcomes
from truesky.emulator.frame_examples import Settings
from truesky.randomness.per_source import PerSourceGenerator
from truesky.reduction.catalogue import Limits
from truesky.render.camera import astrometry
from truesky.survey_maps.depth_lookup import read_depth_map
from truesky.validation import pairs

# Magnitudes of the bins, and magnitude to which counts and redshifts are compared.
EDGES = np.arange(20.0, 26.01, 0.5)
LIMIT = 24.5
# Number of observations of each source, whose mean has a smaller error than one.
REPEATS = 20
# Edges of the bins of separation (arcmin), and the largest separation whose w is large enough for a ratio. A detector
# is not much larger, and its mean density is measured on it, which makes w negative at large separations.
SEPARATIONS = np.geomspace(0.1, 10.0, 9)
LARGEST = 1.0
# Number of random positions per frame, and of jackknife patches per side.
RANDOMS, PATCHES = 10_000, 4
# Bits of the table `depth` that mark light of bright stars.
_STARS = BRIGHT_STAR | SPIKE | GHOST | SATURATED


@dataclass(frozen=True)
class Sample:
    """True sources on images, how they were measured there, and random positions on the images.

    Redshifts of stars are NaN. Positions are true ones, as unit vectors. Patches have numbers from 0, PATCHES^2 for
    each image.
    """

    examples: Examples
    magnitude: np.ndarray
    redshift: np.ndarray
    place: np.ndarray
    patch: np.ndarray
    random_place: np.ndarray
    random_patch: np.ndarray


def draw_outcomes(fitted, features, repeats=REPEATS):
    """Return the outcomes of sources with these features, each `repeats` times, in the order of the repetitions."""
    draws = []
    for i in range(repeats):
        generator = PerSourceGenerator(np.arange(len(features.brightness)), i, "emulator_accuracy")
        draws.append(lookup.draw(fitted.lookup, features, tuple(generator.random() for _ in range(4))))
    outcomes = fitted.examples.outcomes.select(np.concatenate(draws))
    can_be_seen = np.tile(fitted.has_examples(features), repeats)
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
    """Print the rows of `compare`, with statistical errors of the numbers on images."""
    print("| magnitude | sources | completeness | bias of MAG_AUTO | its scatter | size / true | its scatter |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        number, (fraction, scatter) = row[1], row[[2, 6]]
        detections = np.maximum(number * fraction, 1.0)
        # Errors of a fraction, a median, and a scatter from the median absolute deviation, for Gaussian errors.
        errors = [np.sqrt(max(fraction * (1.0 - fraction), 1.0 / max(number, 1.0)) / max(number, 1.0))]
        errors += [1.25 * scatter / np.sqrt(detections), 1.17 * scatter / np.sqrt(detections)]
        values = [f"{a:.3f} / {b:.3f}" for a, b in row[2:].reshape(-1, 2)]
        values[:3] = [f"{value} ± {error:.3f}" for value, error in zip(values, errors, strict=False)]
        print(f"| {row[0]:.1f} | {number:.0f} | {' | '.join(values)} |")


def pair_counts(place, patch):
    """Count the pairs of positions in one image.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Positions as unit vectors.
    patch : int array, shape (n,)
        Patch of each position, from 0.

    Returns
    -------
    counts : float array, shape (1 + patches, bins)
        Number of pairs by separation: all, and those without a position in each patch.
    all_pairs : float array, shape (1 + patches,)
        Number of pairs at any separation.
    """
    sums = pairs.count_pairs(place, np.zeros(len(patch), np.int64), patch, np.radians(SEPARATIONS / 60.0))
    counts = np.tile(sums.total[0], (1 + PATCHES**2, 1))
    # Patches without positions at the end have no sums.
    counts[1 : 1 + len(sums.jackknife)] = sums.jackknife[:, 0]
    number = len(patch) - np.append(0, np.bincount(patch, minlength=PATCHES**2)).astype(float)
    return counts, 0.5 * number * (number - 1.0)


def correlation_functions(sample, frames, emulated):
    """Count pairs of the selected sources on images and with the emulator.

    Parameters
    ----------
    sample : Sample
        The sources.
    frames : bool array, shape (n,)
        True for sources that are selected on the images.
    emulated : bool array, shape (repeats, n)
        The same for several observations with the emulator, whose pairs are added up.

    Returns
    -------
    counts, expected : float array, shape (2, 1 + m, bins)
        Number of pairs, and number of pairs of as many positions that are not correlated, so that w(theta) is
        counts / expected - 1. The first axis is (images, emulator), and the second one has all pairs, and those without
        each of the m patches of all images.
    """
    counts, expected = [], []
    for frame in np.unique(sample.patch // PATCHES**2):
        points = np.flatnonzero(sample.random_patch // PATCHES**2 == frame)
        random_counts, random_pairs = pair_counts(sample.random_place[points], sample.random_patch[points] % PATCHES**2)
        is_here = sample.patch // PATCHES**2 == frame
        sums = []
        for selections in (frames[None], emulated):
            chosen = [np.flatnonzero(selection & is_here) for selection in selections]
            image_counts = [pair_counts(sample.place[rows], sample.patch[rows] % PATCHES**2) for rows in chosen]
            sums.append([sum(part[i] for part in image_counts) for i in (0, 1)])
        counts.append(np.stack([part[0] for part in sums], axis=1))
        all_pairs = np.stack([part[1] for part in sums], axis=1)
        expected.append((random_counts / random_pairs[:, None])[:, None, :] * all_pairs[:, :, None])
    return _all_images(np.stack(counts)), _all_images(np.stack(expected))


def _all_images(values):
    """Add up the images, once with all patches and once without each patch, shape (2, 1 + m, bins)."""
    total = values[:, 0].sum(axis=0)
    without = (total + values[:, 1:] - values[:, :1]).reshape(-1, *total.shape)
    return np.moveaxis(np.concatenate([total[None], without]), 1, 0)


def jackknife(values):
    """Return the value of all, and its error from the values without each patch, along the first axis."""
    rest = values[1:]
    return values[0], np.sqrt((len(rest) - 1) / len(rest) * ((rest - rest.mean(axis=0)) ** 2).sum(axis=0))


def print_correlations(counts, expected):
    """Print a row per bin of separation, and the ratio of both functions w; return the ratio and its error.

    The ratio is that of the sums of w over the bins up to LARGEST.
    """
    functions = counts / expected - 1.0
    print("| theta, arcmin | pairs on images | w on images | w of emulator | w of emulator - w on images |")
    print("|---|---|---|---|---|")
    images, emulator, difference = (
        jackknife(values) for values in (functions[0], functions[1], functions[1] - functions[0])
    )
    for i, (low, high) in enumerate(pairwise(SEPARATIONS)):
        values = [f"{value[i]:.4f} ± {error[i]:.4f}" for value, error in (images, emulator, difference)]
        print(f"| {low:.2f} - {high:.2f} | {counts[0, 0, i]:.0f} | {' | '.join(values)} |")
    sums = functions[:, :, SEPARATIONS[1:] <= LARGEST + 1e-6].sum(axis=2)
    ratio, error = jackknife(sums[1] / sums[0])
    print(f"w of emulator / w on images to {LARGEST:g} arcmin: {ratio:.3f} ± {error:.3f}")
    return ratio, error


def compare_correlations(sample, emulated, limit):
    """Print w(theta) of the galaxies that are measured brighter than a limit, on images and with the emulator."""
    is_galaxy, repeats = np.isfinite(sample.redshift), len(emulated.detected) // len(sample.magnitude)
    outcomes = sample.examples.outcomes
    chosen = is_galaxy & outcomes.detected & (sample.magnitude + outcomes.mag_auto < limit)
    drawn = emulated.detected & (np.tile(sample.magnitude, repeats) + emulated.mag_auto < limit)
    return print_correlations(*correlation_functions(sample, chosen, is_galaxy & drawn.reshape(repeats, -1)))


def settings_of(fitted):
    """Return the settings of calibration, detection and measurement with which a model was trained."""
    given = fitted.facts["settings"]
    # Older models have no facts about the calibration.
    cosmic_rays = fitted.facts.get("calibration", {}).get("cosmic_rays", Settings().cosmic_rays)
    return Settings(Limits(given["threshold"], given["pixels"]), given["aperture_fwhm"], cosmic_rays)


def read_frames(paths, band, settings, detectors=(), leave_out_masked=False):
    """Return the sources of all frames of some lakes, and print the conditions of each frame.

    Parameters
    ----------
    paths : sequence of str
        Folders of lakes.
    band : str
        Name of the passband.
    settings : Settings
        Settings of detection and measurement.
    detectors : sequence of str
        Names of detectors, or none for all.
    leave_out_masked : bool
        True to leave out places that light of bright stars affects, according to the table `depth`.

    Returns
    -------
    Sample
        The sources.
    """
    parts = []
    for path in paths:
        root = layout.resolve_lake(path)
        options = argparse.Namespace(name=None, masters=None)
        frames = train.frames_of_band(root, band, detectors, (), None)
        depth = read_depth_map(read.version(root, "depth"), band, ["mask"]) if leave_out_masked else None
        redshifts = _redshifts(root)
        for frame, measurement in train.measured_frames(root, frames, settings, options):
            parts.append(_sample(root, (frame, measurement), redshifts, depth, len(parts)))
            conditions, redshift = measurement.conditions, parts[-1].redshift
            print(
                f"{path} {frame.stem}: depth {conditions['depth']:.2f}, sky {conditions['sky']:.3f} e-/s, "
                f"{len(redshift)} sources, of which {np.isnan(redshift).sum()} are stars",
                flush=True,
            )
    arrays = (np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Sample)[1:])
    return Sample(examples.join([part.examples for part in parts]), *arrays)


def _redshifts(root):
    """Return the redshifts of the galaxies of a lake by their identifiers."""
    products = read.version(root, "products")
    rows = read.version(root, "galaxies", products.manifest["facts"]["inputs"]["galaxies"]).rows(["id", "z_true"])
    return dict(zip(rows["id"].to_pylist(), rows["z_true"].to_pylist(), strict=True))


def _sample(root, measured, redshifts, depth, number):
    """Return the sources of one frame, the image with this number; `measured` are the frame and its examples."""
    frame, measurement = measured
    sources = train.true_sources(read.version(root, "rendered_truth"), frame, np.zeros(0, np.int64), np.zeros(0))
    axes = np.stack([sources.x[measurement.rows], sources.y[measurement.rows]])
    low, size = axes.min(axis=1, keepdims=True), np.ptp(axes, axis=1, keepdims=True)
    values, selections = [], []
    for points in (axes, low + size * np.random.default_rng(number).random((2, RANDOMS))):
        ra, dec = astrometry.sky_of_pixel(astrometry.from_cards(frame.cards), *points)
        is_used = (
            np.ones(len(ra), bool) if depth is None else depth.columns["mask"][depth.rows_at(ra, dec)] & _STARS == 0
        )
        patch = _patches((points - low) / size) + number * PATCHES**2
        values += [sky.unit_vectors(ra, dec)[is_used], patch[is_used]]
        selections.append(is_used)
    rows = measurement.rows[selections[0]]
    redshift = np.array([redshifts.get(int(identifier), np.nan) for identifier in sources.ids[rows]])
    return Sample(measurement.examples.select(selections[0]), sources.magnitude[rows], redshift, *values)


def _patches(places):
    """Return the number of the jackknife patch of places in an image, from (0, 0) to (1, 1)."""
    column, row = np.minimum((places * PATCHES).astype(np.int64), PATCHES - 1)
    return row * PATCHES + column


def report(fitted: model.Model, sample: Sample, limits=(LIMIT,)):
    """Print the comparison of images with the emulator, and return the rows of the first table."""
    frames, magnitude = sample.examples.outcomes, sample.magnitude
    emulated = draw_outcomes(fitted, sample.examples.features)
    rows = compare(magnitude, frames, emulated)
    print_table(rows)
    for name, outcomes in (("images", frames), ("emulator", emulated)):
        number, z = counts_and_redshifts(magnitude, sample.redshift, outcomes)
        print(f"{name}: {number:.1f} galaxies measured brighter than {LIMIT}, mean redshift {z:.4f}")
    for limit in limits:
        print(f"\nGalaxies measured brighter than {limit:g}")
        compare_correlations(sample, emulated, limit)
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("lakes", nargs="+")
    parser.add_argument("--band")
    parser.add_argument("--detectors", nargs="+", default=())
    parser.add_argument(
        "--limits", nargs="+", type=float, default=(LIMIT, 30.0),
        help="measured magnitudes to which w(theta) is compared",
    )  # fmt: skip
    parser.add_argument("--unmasked", action="store_true", help="leave out places near bright stars (table depth)")
    options = parser.parse_args()
    fitted = model.read_model(options.model)
    band, settings = options.band or fitted.band, settings_of(fitted)
    sample = read_frames(options.lakes, band, settings, options.detectors, options.unmasked)
    report(fitted, sample, options.limits)


if __name__ == "__main__":
    main()
