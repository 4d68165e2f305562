"""Test the measured errors of tables for external spectra and passbands."""

import dataclasses

import numpy as np
import pytest

from truesky.fluxes import integration, passbands
from truesky.fluxes.tables import errors_measured, flux_tables, settings
from truesky.numerics import cache, code_fingerprints
from truesky.request.accuracy import DRAFT, REFERENCE, SURVEY


@pytest.fixture
def mine():
    """Return a filter of intermediate width."""
    return filter_of(1000)


def filter_of(width):
    wavelength = np.arange(5000.0, 5000.0 + width)
    return passbands.Passband("mine", wavelength, np.hanning(width + 2)[1:-1], "air")


def test_measured_bands_are_looked_up(library):
    bands = [passbands.load(name) for name in ("euclid_vis", "lsst_u")]
    for accuracy in (DRAFT, SURVEY, REFERENCE):
        wanted = settings.choose(["euclid_vis", "lsst_u"], accuracy)
        assert errors_measured.choose(bands, accuracy, library) == wanted


@pytest.mark.parametrize("accuracy", [DRAFT, SURVEY])
def test_a_user_filter_is_measured(library, mine, accuracy):
    (choice,) = errors_measured.choose([mine], accuracy, library)
    rows = errors_measured.draw_galaxies(1000, len(library), np.random.default_rng(77))
    fast = flux_tables.galaxy_fluxes(rows, flux_tables.open_grid([mine], [choice.setting], library))
    error = np.abs(fast / integration.galaxy_fluxes(rows, [mine], library) - 1.0)
    assert error.max() <= accuracy.flux
    assert 0.0 < choice.rms < choice.largest <= accuracy.flux / 1.5
    assert np.sqrt(np.mean(error**2)) == pytest.approx(choice.rms, rel=0.5)


def test_a_filter_too_narrow_for_any_table_is_integrated(library):
    assert errors_measured.choose([filter_of(30)], SURVEY, library) == (settings.INTEGRATED,)


def test_no_table_for_the_reference(library, mine):
    assert errors_measured.choose([mine], REFERENCE, library) == (settings.INTEGRATED,)


def test_external_spectra_are_measured_in_a_built_in_band(library, monkeypatch):
    monkeypatch.setattr(errors_measured, "measure", lambda *_: settings.Choice(None, 1.0, 1.0))
    band = passbands.load("euclid_h")
    assert errors_measured.choose([band], SURVEY, library)[0].setting is not None
    # No table is accurate enough for these filters.
    assert errors_measured.choose([band], SURVEY, dataclasses.replace(library, external=True)) == (settings.INTEGRATED,)


def test_errors_are_measured_on_every_template_and_law(library):
    mix = errors_measured.draw_galaxies(2000, len(library), np.random.default_rng(3)).mix
    assert set(mix.sed.ravel()) == set(range(len(library)))
    assert set(mix.law.ravel()) == set(range(5))
    assert mix.ebv.shape == mix.frac.shape == (2, 2000)
    assert mix.frac.sum(0) == pytest.approx(1.0)
    # The extremes of 2000 uniform random numbers are this near to the ends.
    for found, first, last in ((mix.frac, 0.0, 1.0), (mix.ebv, 0.0, 0.6), (mix.z_obs, -0.03, 3.03)):
        assert (found.min() - first, last - found.max()) == pytest.approx((0.0, 0.0), abs=0.01 * (last - first))


def test_data_files_are_in_the_keys(library, mine, monkeypatch, request):
    """Keys of the errors include the depths of hydrogen's lines and the line data of galaxies."""
    request.addfinalizer(code_fingerprints.code_key.cache_clear)
    keys, changed = [], {}
    content = code_fingerprints._content
    monkeypatch.setattr(cache, "cached_arrays", lambda name, key, make: keys.append(key) or {"errors": np.ones(2)})
    monkeypatch.setattr(code_fingerprints, "_content", lambda file: content(file) + changed.get(file.name, b""))
    for name in ("", "lines.csv", "lyman_series.csv"):
        changed = {name: b"\n"}
        code_fingerprints.code_key.cache_clear()
        errors_measured.measure(mine, settings.CANDIDATES[0], library)
    assert len(set(keys)) == 3
