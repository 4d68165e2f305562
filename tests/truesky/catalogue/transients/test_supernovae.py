"""Supernovae of a cell: numbers, dates, and catalogues that nest."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import ids, sky
from tests.truesky.catalogue.transients.hosts import CELL, galaxies
from truesky.catalogue.transients import rates, supernovae
from truesky.catalogue.transients.supernovae import FAMILIES, Window
from truesky.cosmology import FIDUCIAL
from truesky.variability import supernova_light, supernova_templates
from truesky.variability.supernova_templates import KINDS, TYPE_IA

TEMPLATES = supernova_templates.templates()
WINDOW = Window(61000.0, 64652.5, FAMILIES, 1.0, TEMPLATES)
SEED = 6


def drawn(window=WINDOW, hosts=None, seed=SEED):
    return supernovae.draw(CELL, galaxies() if hosts is None else hosts, seed, window, FIDUCIAL)


@pytest.fixture(scope="module")
def many():
    """Return 20 times the natural number of supernovae."""
    return drawn(replace(WINDOW, boost=20.0))


def test_ranges_of_the_columns(many):
    index = sky.cell_at(many["ra"].to_numpy(), many["dec"].to_numpy(), 29)
    np.testing.assert_array_equal(many["_healpix_29"].to_numpy(), index)
    assert (sky.parent(index, 29, 8) == CELL).all()
    assert (np.diff(index) >= 0).all()
    assert ids.is_transient(many["id"].to_numpy()).all()
    assert len(np.unique(many["id"].to_numpy())) == len(many)
    assert set(many["host_id"].to_pylist()) <= set(galaxies()["id"].to_pylist())
    assert set(many["type"].to_pylist()) == set(KINDS.values())


def test_all_shine_in_the_window(many):
    names = ("z_obs", "peak_mjd", "mag_b", "stretch", "ebv", "magnification", "a_v")
    light = supernova_light.Supernovae(
        many["type"].to_numpy(), *(many[name].to_numpy().astype(float) for name in names)
    )
    first, last = supernova_light.first_and_last_day(light, TEMPLATES)
    assert (first <= WINDOW.end + 1e-3).all()
    assert (last >= WINDOW.start - 1e-3).all()
    assert many["peak_mjd"].to_numpy().min() < WINDOW.start
    assert many["peak_mjd"].to_numpy().max() > WINDOW.end


def test_numbers_follow_the_rates():
    """Sample: supernovae that peak in 10 years in 2,000 galaxies, 20 times the natural rate; significance 4 sigma."""
    hosts, boost = galaxies(), 20.0
    z = hosts["z_true"].to_numpy()
    expected = rates.expected_rates(hosts["log_stellar_mass"].to_numpy(), hosts["log_sfr"].to_numpy(), z)
    rows = drawn(replace(WINDOW, boost=boost), hosts)
    peak = rows["peak_mjd"].to_numpy()
    inside = (peak >= WINDOW.start) & (peak < WINDOW.end)
    is_ia = rows["type"].to_numpy() == TYPE_IA
    for rate, chosen in zip(expected, (is_ia, ~is_ia), strict=True):
        mean = float(np.sum(rate * boost * 10.0 / (1.0 + z)))
        assert abs(np.sum(inside & chosen) - mean) < 4.0 * mean**0.5
    np.testing.assert_array_equal(rows["density_boost"].to_numpy(), np.float32(boost))


@pytest.mark.parametrize("smaller", [
    replace(WINDOW, start=61500.0, end=61600.0, boost=20.0), replace(WINDOW, kinds=("ia",), boost=20.0),
    replace(WINDOW, start=60999.0, end=63000.0, boost=20.0),
])  # fmt: skip
def test_a_smaller_window_has_some_of_the_same_supernovae(many, smaller):
    """The first parts of windows that begin earlier contain supernovae that the other lacks."""
    rows = drawn(smaller)
    both = np.isin(rows["id"].to_numpy(), many["id"].to_numpy())
    assert len(rows) > 50
    assert both.all() or smaller.start < WINDOW.start
    chosen = np.isin(many["id"].to_numpy(), rows["id"].to_numpy())
    assert many.filter(chosen).equals(rows.filter(both))


def test_fewer_galaxies_have_the_same_supernovae(many):
    """A shallower catalogue lacks the supernovae of its missing galaxies, and changes no other."""
    hosts = galaxies()
    keep = np.arange(len(hosts)) % 3 > 0
    rows = drawn(replace(WINDOW, boost=20.0), hosts.filter(keep))
    in_kept = np.isin(many["host_id"].to_numpy(), hosts["id"].to_numpy()[keep])
    assert rows.equals(many.filter(in_kept))


def test_galaxies_without_stars_have_no_supernovae():
    number = 50
    bare = galaxies(number, log_stellar_mass=np.full(number, np.nan))
    assert len(drawn(replace(WINDOW, boost=1000.0), bare)) == 0
    assert len(drawn(WINDOW, galaxies(0))) == 0


def test_seeds_differ(many):
    other = drawn(replace(WINDOW, boost=20.0), seed=SEED + 1)
    assert not np.isin(other["id"].to_numpy(), many["id"].to_numpy()).any()


@given(st.floats(0.0, 1.0, exclude_min=True, exclude_max=True), st.floats(0.0, 500.0))
def test_poisson_counts_are_quantiles(uniform, mean):
    """scipy is the reference; at a step of the distribution function, rounding decides."""
    found = supernovae.poisson_counts(np.array([uniform]), np.array([mean]))[0]
    below, above = scipy.stats.poisson.cdf([found - 1, found], mean)
    assert below <= uniform + 1e-9
    assert above >= uniform - 1e-9


def test_poisson_counts_end_at_the_edges():
    counts = supernovae.poisson_counts(np.array([0.0, 1.0, 1.0, 0.5]), np.array([5.0, 0.0, 5.0, 0.0]))
    np.testing.assert_array_equal(counts[[0, 1, 3]], 0)
    assert 20 < counts[2] < 60


def test_large_means_have_poisson_scatter():
    """Sample: 20,000 quantiles of a mean of 5,000; the scatter has an error of 0.5 %, and 3 % are allowed."""
    uniform = (np.arange(20_000) + 0.5) / 20_000
    counts = supernovae.poisson_counts(uniform, np.full(uniform.size, 5000.0))
    assert np.mean(counts) == pytest.approx(5000.0, abs=1.0)
    assert np.std(counts) == pytest.approx(5000.0**0.5, rel=0.03)


def test_magnitudes_of_type_ia_supernovae(many):
    """Sample: some hundred supernovae. Observed: mean -19.2 (AB, h = 0.67), scatter 0.3 to 0.4 mag with colour."""
    light = many.filter(many["type"].to_numpy() == TYPE_IA)
    assert len(light) > 300
    absolute = light["abs_mag_b"].to_numpy()
    assert np.mean(absolute) == pytest.approx(-19.2, abs=0.15)
    assert 0.25 < np.std(absolute) < 0.5
    distance = FIDUCIAL.distance_modulus(light["z_true"].to_numpy().astype(float)) - 5.0 * np.log10(FIDUCIAL.h)
    np.testing.assert_allclose(light["mag_b"].to_numpy(), absolute + distance, atol=1e-4)
