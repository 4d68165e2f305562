"""The errors of tables for what was not measured in advance."""

import dataclasses

import numpy as np
import pytest

from truesky.fluxes import integration, passbands
from truesky.fluxes.tables import errors_measured, flux_tables, settings
from truesky.numerics import cache, code_fingerprints
from truesky.request.accuracy import DRAFT, REFERENCE, SURVEY


@pytest.fixture
def mine():
    """A filter of intermediate width."""
    return filter_of(1000)


def filter_of(width):
    wavelength = np.arange(5000.0, 5000.0 + width)
    return passbands.Passband("mine", wavelength, np.hanning(width + 2)[1:-1], "air")


def test_what_was_measured_is_looked_up(library):
    bands = [passbands.load(name) for name in ("euclid_vis", "lsst_u")]
    for accuracy in (DRAFT, SURVEY, REFERENCE):
        wanted = settings.choose(["euclid_vis", "lsst_u"], accuracy)
        assert errors_measured.choose(bands, accuracy, library) == wanted


@pytest.mark.parametrize("accuracy", [DRAFT, SURVEY])
def test_a_filter_of_others_is_measured(library, mine, accuracy):
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


def test_spectra_of_others_are_measured_although_the_band_is_known(library, monkeypatch):
    monkeypatch.setattr(errors_measured, "measure", lambda *_: settings.Choice(None, 1.0, 1.0))
    band = passbands.load("euclid_h")
    assert errors_measured.choose([band], SURVEY, library)[0].setting is not None
    # No table is fine enough for them.
    assert errors_measured.choose([band], SURVEY, dataclasses.replace(library, own=True)) == (settings.INTEGRATED,)


def test_errors_are_measured_on_every_template_and_law(library):
    mix = errors_measured.draw_galaxies(2000, len(library), np.random.default_rng(3)).mix
    assert set(mix.sed.ravel()) == set(range(len(library)))
    assert set(mix.law.ravel()) == set(range(5))
    assert mix.ebv.shape == mix.frac.shape == (2, 2000)
    assert mix.frac.sum(0) == pytest.approx(1.0)
    # Of a uniform distribution's ends, 2000 come this near.
    for found, first, last in ((mix.frac, 0.0, 1.0), (mix.ebv, 0.0, 0.6), (mix.z_obs, -0.03, 3.03)):
        assert (found.min() - first, last - found.max()) == pytest.approx((0.0, 0.0), abs=0.01 * (last - first))


def test_numbers_of_the_files_beside_the_code_are_in_the_keys(library, mine, monkeypatch, request):
    """Depths of hydrogen's lines, and the galaxies' own, are in the key of the errors."""
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
