"""Labels: by them a forecast finds entries of the cache whose keys it does not know."""

import shutil

import numpy as np
import pytest

from lake_schema.mission import configuration
from truesky.cosmology import FIDUCIAL
from truesky.numerics import cache, cache_labels


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))


def test_a_label_finds_the_entry_that_was_made_or_used_with_it():
    label = cache_labels.label_dust_map(1)
    assert not cache.has_label(label)
    cache.cached_arrays("some", "a", lambda: {"a": np.zeros(1)})
    assert not cache.has_label(label)
    cache.cached_arrays("some", "a", lambda: {"a": np.ones(1)}, label)
    assert cache.has_label(label)
    assert not cache.has_label(cache_labels.label_dust_map(2))


def test_a_label_without_its_entry_finds_nothing():
    label = cache_labels.label_halo_tables(FIDUCIAL.fingerprint())
    cache.cached_arrays("some", "a", lambda: {"a": np.zeros(1)}, label)
    (entry,) = cache.cache_dir().glob("some-*")
    shutil.rmtree(entry)
    assert not cache.has_label(label)
    cache.cached_arrays("some", "b", lambda: {"a": np.zeros(1)}, label)
    assert cache.has_label(label)


def test_a_cache_that_cannot_be_written_has_no_labels(monkeypatch):
    cache.cached_arrays("some", "a", lambda: {"a": np.zeros(1)})
    (cache.cache_dir() / "labels").write_text("in the way")
    label = cache_labels.label_halo_bias(FIDUCIAL.fingerprint())
    assert cache.cached_arrays("some", "a", lambda: {"a": np.zeros(1)}, label)["a"].size == 1


def test_labels_differ():
    labels = [
        cache_labels.label_box("box", FIDUCIAL.fingerprint(), 1, 192),
        cache_labels.label_box("box", FIDUCIAL.fingerprint(), 1, 256),
        cache_labels.label_box("box", FIDUCIAL.fingerprint(), 2, 192),
        cache_labels.label_box("box", "0123456789abcdef", 1, 192),
        cache_labels.label_box("tides", "0123456789abcdef", 1, 192),
        cache_labels.label_halo_bias("0123456789abcdef"),
        cache_labels.label_halo_tables(FIDUCIAL.fingerprint()),
        cache_labels.label_halo_tables("0123456789abcdef"),
        cache_labels.label_lensing("0123456789abcdef", 1, 192, 256, True),
        cache_labels.label_box("tides", FIDUCIAL.fingerprint(), 1, 192),
        cache_labels.label_halo_bias(FIDUCIAL.fingerprint()),
        cache_labels.label_lensing(FIDUCIAL.fingerprint(), 1, 192, 256, True),
        cache_labels.label_lensing(FIDUCIAL.fingerprint(), 1, 192, 256, False),
        cache_labels.label_lensing(FIDUCIAL.fingerprint(), 1, 192, 512, True),
        cache_labels.label_galaxy_table("euclid_vis", 0.02, 3, 2),
        cache_labels.label_galaxy_table("euclid_vis", 0.02, 4, 3),
        cache_labels.label_star_table("euclid_vis"),
        cache_labels.label_band_ratios("euclid_vis"),
        cache_labels.label_spectra(),
        cache_labels.label_profiles(),
    ]
    assert len({*labels}) == len(labels)


def test_the_label_of_a_psf_changes_with_the_optics_only():
    def label(**changes):
        overrides = {key.replace("_", ".", 1): value for key, value in changes.items()}
        mission = configuration.resolve(overrides=overrides)
        return cache_labels.label_psf("vis", "3-4", "euclid_vis", 9, mission.parameters)

    assert label() == label(**{"vis_cti.age": (1.0, "")})
    assert label() != label(**{"vis_psf.wavefront_scale": (0.5, "")})
