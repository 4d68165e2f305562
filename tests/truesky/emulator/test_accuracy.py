"""Test the comparison of the emulator with images in scripts/emulator_accuracy.py, on made-up catalogues."""

import numpy as np
import pytest

from lake_schema import sky
from scripts import emulator_accuracy as accuracy
from tests.truesky.emulator import samples
from truesky.emulator import lookup, model
from truesky.emulator.examples import Examples
from truesky.emulator.features import Features

PATCHES = accuracy.PATCHES**2


def places(axes, frame):
    """Return unit vectors and patches of places on an image of 7 arcmin."""
    ra, dec = 150.0 + frame + (axes[0] - 0.5) * 7.0 / 60.0, (axes[1] - 0.5) * 7.0 / 60.0
    return sky.unit_vectors(ra, dec), accuracy._patches(axes) + frame * PATCHES


def sample(axes, catalogue):
    """Return sources on several images; `axes`, shape (images, 2, n), are their places on the images."""
    rng = np.random.default_rng(8)
    place, patch = zip(*(places(part, i) for i, part in enumerate(axes)), strict=True)
    points = [places(rng.random((2, 2000)), i) for i in range(len(axes))]
    n = axes.shape[0] * axes.shape[2]
    return accuracy.Sample(
        catalogue, np.full(n, 23.0), np.ones(n), np.concatenate(place), np.concatenate(patch),
        *(np.concatenate(values) for values in zip(*points, strict=True)),
    )  # fmt: skip


def clustered(n, images, seed=1):
    """Return places of which nine tenths are about a hundred centres."""
    rng = np.random.default_rng(seed)
    centres = rng.random((images, 2, 100))[:, :, rng.integers(0, 100, n)]
    near = np.clip(centres + rng.normal(0.0, 0.03, centres.shape), 0.0, 1.0)
    return np.where(rng.random((images, 1, n)) < 0.9, near, rng.random((images, 2, n)))


def test_pairs_are_those_of_a_comparison_of_all_positions():
    """The patches beyond the eleventh contain no position."""
    axes = np.random.default_rng(2).random((2, 150))
    axes[1] = 0.7 * axes[1]
    place, patch = places(axes, 0)
    counts, all_pairs = accuracy.pair_counts(place, patch)
    first, second = np.triu_indices(150, 1)
    ra, dec = 150.0 + (axes[0] - 0.5) * 7.0 / 60.0, (axes[1] - 0.5) * 7.0 / 60.0
    separation = sky.separation(ra[first], dec[first], ra[second], dec[second]) * 60.0
    for left_out in (-1, 0, 9, 15):
        kept = (patch[first] != left_out) & (patch[second] != left_out)
        np.testing.assert_array_equal(counts[left_out + 1], np.histogram(separation[kept], accuracy.SEPARATIONS)[0])
        assert all_pairs[left_out + 1] == kept.sum()


def test_the_correlation_of_some_sources_is_that_of_all_if_they_are_chosen_at_random(capsys):
    """The sample is 4,000 clustered sources on 2 images; the significance of each limit is 4 standard errors."""
    axes = clustered(2000, 2)
    catalogue = sample(axes, samples.examples(4000))
    frames = np.random.default_rng(4).random(4000) < 0.5
    emulated = np.random.default_rng(5).random((10, 4000)) < 0.5
    counts, expected = accuracy.correlation_functions(catalogue, frames, emulated)
    assert counts.shape == expected.shape == (2, 1 + 2 * PATCHES, len(accuracy.SEPARATIONS) - 1)
    assert (counts[0, 0] / expected[0, 0] - 1.0)[0] > 0.2
    ratio, error = accuracy.print_correlations(counts, expected)
    assert abs(ratio - 1.0) < 4.0 * error
    assert 0.0 < error < 0.2
    assert "w of emulator / w on images" in capsys.readouterr().out


def test_a_selection_that_depends_on_the_place_changes_the_correlation():
    """An emulator that misses the sources about half of the centres is not in agreement with the images."""
    axes = clustered(2000, 2)
    catalogue = sample(axes, samples.examples(4000))
    is_west = np.concatenate([part[0] < 0.5 for part in axes])
    emulated = np.random.default_rng(6).random((3, 4000)) < np.where(is_west, 1.0, 0.3)
    counts, expected = accuracy.correlation_functions(catalogue, np.ones(4000, bool), emulated)
    difference, error = accuracy.jackknife((counts / expected)[1] - (counts / expected)[0])
    assert difference[0] > 4.0 * error[0]


def test_the_jackknife_gives_the_standard_error_of_a_mean():
    values = np.random.default_rng(5).normal(size=40)
    without = (values.sum() - values) / 39.0
    mean, error = accuracy.jackknife(np.append(values.mean(), without)[:, None])
    assert mean[0] == values.mean()
    assert error[0] == pytest.approx(values.std(ddof=1) / np.sqrt(40.0), rel=1e-9)


def test_report_prints_both_tables_for_limits_of_the_measured_magnitude(tmp_path, capsys):
    fitted = model.read_model(samples.write(tmp_path / "m.parquet"))
    catalogue = samples.examples(2000, seed=3)
    rows = accuracy.report(fitted, sample(clustered(1000, 2), catalogue), limits=(23.5, 24.5))
    assert rows.shape == (len(accuracy.EDGES) - 1, 12)
    printed = capsys.readouterr().out
    assert printed.count("Galaxies measured brighter than") == 2
    assert "| magnitude | sources |" in printed
    assert isinstance(fitted.lookup, lookup.Lookup)


def test_galaxies_fainter_than_the_examples_are_not_detected_as_in_the_table_observed():
    """Galaxies end at 0.1 mag fainter than the depth; the model has stars to 1.4 mag. All examples are detected."""
    outcomes = samples.examples(20_000).outcomes
    outcomes = outcomes.select(np.flatnonzero(outcomes.detected)[:4000])
    made_up = Examples(samples.features(4000, 1, faintest=0.1), outcomes)
    fitted = model.Model({**samples.FACTS, "faintest": 1.4}, made_up, lookup.build(made_up), "")
    features = Features(np.array([-0.5, 0.3, 0.3, 1.5]), np.zeros(4), np.full(4, -2.0), np.array([0, 0, 1, 1], bool))
    detected = accuracy.draw_outcomes(fitted, features, 5).detected.reshape(5, 4).any(axis=0)
    np.testing.assert_array_equal(detected, [True, False, True, False])


@pytest.mark.parametrize(("facts", "expected"), [({}, 5.0), ({"calibration": {"masters": False, "cosmic_rays": 0}}, 0)])
def test_images_are_calibrated_as_for_the_training(tmp_path, facts, expected):
    fitted = model.read_model(samples.write(tmp_path / "m.parquet", **facts))
    assert accuracy.settings_of(fitted).cosmic_rays == expected
    assert accuracy.settings_of(fitted).facts() == samples.FACTS["settings"]
