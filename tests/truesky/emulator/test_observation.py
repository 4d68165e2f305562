"""Test the drawing of observed catalogues for arrays of sources."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import source_id
from lake_schema.tables.survey.observed import observed_sources
from tests.truesky.emulator import samples
from truesky.emulator import model, observation
from truesky.emulator.features import Features
from truesky.emulator.observation import Conditions, Sources


def sources(n=3000, seed=4):
    """Return sources within 0.05 deg, with magnitudes in two bands."""
    rng = np.random.default_rng(seed)
    ids = source_id(np.where(np.arange(n) % 10, 0, 5), 5, np.arange(n))
    radius = np.where(np.arange(n) % 10, rng.uniform(0.1, 0.6, n), 0.0)
    magnitude = {band: 27.0 - rng.exponential(1.5, n) for band in ("euclid_vis", "euclid_j")}
    return Sources(ids, 150.0 + rng.uniform(0.0, 0.05, n), 2.0 + rng.uniform(0.0, 0.05, n), radius, magnitude)


def chosen(all_sources, rows):
    parts = (all_sources.ids, all_sources.ra, all_sources.dec, all_sources.radius)
    return Sources(*(part[rows] for part in parts), {name: m[rows] for name, m in all_sources.magnitude.items()})


def conditions(n, depth=26.2, is_covered=True):
    return Conditions(np.full(n, is_covered), np.full(n, depth), np.full(n, 0.125))


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return [
        model.read_model(samples.write(folder / f"{band}.parquet", band=band, seed=seed))
        for seed, band in enumerate(("euclid_vis", "euclid_j"), 1)
    ]


def observe(some, models, **changes):
    given = {one.band: conditions(len(some.ids), **changes) for one in models}
    return observation.observe(some, given, models, 7)


def test_measurements_of_a_source_depend_neither_on_the_order_nor_on_distant_sources(models):
    everything = sources()
    order = np.random.default_rng(1).permutation(len(everything.ids))
    first, second = (observe(chosen(everything, rows), models) for rows in (np.arange(len(order)), order))
    for name, values in first.items():
        np.testing.assert_array_equal(np.ma.filled(values[order], 0), np.ma.filled(second[name], 0))
    west = np.flatnonzero(everything.ra < 150.03)
    inner = everything.ra[west] < 150.03 - 10.0 / 3600.0
    part = observe(chosen(everything, west), models)
    for name, values in first.items():
        np.testing.assert_array_equal(np.ma.filled(values[west][inner], 0), np.ma.filled(part[name][inner], 0))


def test_detected_sources_have_measurements_and_others_do_not(models):
    columns = observe(sources(), models)
    for band in ("euclid_vis", "euclid_j"):
        detected = np.ma.filled(columns[f"detected_{band}"], False)
        assert 0 < detected.sum() < len(detected)
        for name in ("mag_auto", "magerr_auto", "mag_aper", "flux_radius", "flags"):
            assert (np.ma.getmaskarray(columns[f"{name}_{band}"]) == ~detected).all()
            assert np.isfinite(columns[f"{name}_{band}"].compressed()).all()
    either = columns["detected_euclid_vis"] | columns["detected_euclid_j"]
    assert (columns["detected"] == either).all()


def test_positions_move_by_the_size_of_the_psf_if_a_source_is_detected(models):
    some = sources()
    columns = observe(some, models)
    shift = sky.separation(some.ra, some.dec, columns["ra"], columns["dec"]) * 3600.0
    assert shift[~columns["detected"]].max() < 1e-6
    assert 0.0 < np.median(shift[columns["detected"]]) < 0.2
    assert shift.max() <= 1.0 + 1e-6


def test_without_exposure_values_are_missing_and_beyond_the_examples_nothing_is_detected(models):
    some = sources(500)
    columns = observe(some, models, is_covered=False)
    assert not columns["detected"].any()
    assert np.ma.getmaskarray(columns["detected_euclid_vis"]).all()
    shallow = observe(some, models, depth=float(min(m.min() for m in some.magnitude.values())) - 1.6)
    assert not shallow["detected"].any()
    assert shallow["extrapolated_euclid_vis"].all()
    assert not observe(some, models)["extrapolated_euclid_vis"].any()


def test_magnitudes_are_relative_to_the_depth(models):
    """At another depth, sources as much brighter or fainter have the same outcomes."""
    some = sources(1000)
    deeper = Sources(some.ids, some.ra, some.dec, some.radius, {b: m + 0.5 for b, m in some.magnitude.items()})
    first, second = observe(some, models), observe(deeper, models, depth=26.7)
    agree = np.ma.filled(first["detected_euclid_vis"], 0) == np.ma.filled(second["detected_euclid_vis"], 0)
    assert agree.mean() > 0.99


def test_a_detection_with_hardly_any_flux_has_values_that_the_table_allows(tmp_path):
    """An example may have a flux near 0, and so an error of thousands of magnitudes."""
    examples = samples.examples(4000)
    examples.outcomes.magerr_auto[examples.outcomes.detected] = 2118.0
    examples.outcomes.radius[examples.outcomes.detected] = 1e5
    model.write_model(tmp_path / "m.parquet", examples, samples.FACTS)
    columns = observe(sources(500), [model.read_model(tmp_path / "m.parquet")])
    allowed = observed_sources(["euclid_vis"])
    for name in ("magerr_auto_euclid_vis", "flux_radius_euclid_vis"):
        column = next(column for column in allowed.columns if column.name == name)
        assert columns[name].count() > 0
        assert columns[name].max() <= column.hi


def drawn_in_two_bands(models, brightness, n=20_000):
    """Return the outcomes of galaxies of one brightness in two bands with common numbers."""
    same = Features(np.full(n, brightness), np.full(n, 0.35), np.full(n, -2.0), np.zeros(n, bool))
    common = tuple(np.random.default_rng(1).standard_normal((2, n)))
    return [
        observation.draw_outcomes(one, same, np.random.default_rng(seed), common) for seed, one in enumerate(models, 2)
    ]


@pytest.mark.parametrize(("brightness", "share"), [(-5.0, 0.7), (-3.0, 0.41), (-0.5, 0.12)])
def test_errors_of_bright_galaxies_are_common_to_two_bands(models, brightness, share):
    """The sum of the errors of magnitude and size, in the order of the lists, has nearly the correlation of the shares.

    sample: 20,000 sources in two bands, more than 2000 detected in both; significance: 0.04, twice the error, below
    which a quarter is allowed for the choice between nodes with other lists
    """
    first, second = drawn_in_two_bands(models, brightness)
    both = first.detected & second.detected
    assert both.sum() > 2000
    sums = [
        sum(np.argsort(np.argsort(values[both])) for values in (one.mag_auto, -one.radius)) for one in (first, second)
    ]
    assert 0.75 * share - 0.04 < np.corrcoef(*sums)[0, 1] < share + 0.04


def test_sources_are_blended_in_both_bands_or_in_none_and_otherwise_detected_independently(models):
    """sample: 20,000 sources in two bands; significance: 5 errors of the fractions"""
    first, second = drawn_in_two_bands(models, 0.5)
    blended = first.blended.mean(), second.blended.mean()
    assert (first.blended & second.blended).mean() > 3.0 * blended[0] * blended[1]
    free = ~first.blended & ~second.blended
    fractions = [one.detected[free].mean() for one in (first, second)]
    both = (first.detected & second.detected)[free].mean()
    assert both == pytest.approx(fractions[0] * fractions[1], abs=5.0 * np.sqrt(0.25 / free.sum()))
