"""Light curves from the columns of variable stars: any dates, any order, accurate phases, constant stars."""

import time

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema.tables import stars as declarations
from truesky.fluxes import passbands
from truesky.variability import eclipses, light_curves, pulsation, variable_stars
from truesky.variability.eclipses import Pairs

BAND = passbands.load("lsst_g")


def columns(n=70, seed=2):
    """Return columns of n stars of all types, one after the other, with constant ones between them."""
    rng = np.random.default_rng(seed)
    kind = np.arange(n) % 8
    return {
        "variability": kind,
        "period": rng.uniform(0.2, 1.0, n) * np.where(kind == 3, 10.0, np.where(np.isin(kind, (4, 5)), 200.0, 1.0)),
        "epoch": 60_000.0 + rng.random(n),
        "amplitude": rng.uniform(0.2, 1.0, n),
        "eclipse_radius_ratio": np.where(kind == 6, rng.uniform(0.3, 1.5, n), 0.0),
        "eclipse_impact": np.where(kind == 6, rng.uniform(0.0, 0.9, n), 0.0),
        "eclipse_duration": np.where(kind == 6, 0.02, 0.0),
        "tidal_amplitude": np.where(kind >= 6, 0.03, 0.0),
    }


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(50_000.0, 80_000.0), min_size=1, max_size=20), st.randoms(use_true_random=False))
def test_values_do_not_depend_on_other_dates_and_stars(dates, random):
    stars = columns()
    whole = variable_stars.flux_factors(stars, BAND, dates)
    assert whole.shape == (70, len(dates))
    k, i = random.randrange(len(dates)), random.randrange(70)
    assert np.array_equal(variable_stars.flux_factors(stars, BAND, dates[k]), whole[:, k])
    one = {name: values[[i]] for name, values in stars.items()}
    assert np.array_equal(variable_stars.flux_factors(one, BAND, dates), whole[[i]])
    assert np.all(whole >= 0.0)
    assert np.all(whole[stars["variability"] == 0] == 1.0)


def test_blocks_do_not_change_values(monkeypatch):
    stars, dates = columns(), np.linspace(60_000.0, 60_010.0, 50)
    whole = variable_stars.flux_factors(stars, BAND, dates)
    monkeypatch.setattr(variable_stars, "_BLOCK", 100)
    assert np.array_equal(variable_stars.flux_factors(stars, BAND, dates), whole)


def test_phases_are_accurate_after_50_000_periods():
    """A period of 0.2 d at MJD 70000; whole numbers of periods after the epoch the flux is at its maximum again."""
    stars = {name: values[:1] for name, values in columns().items()} | {
        "variability": np.array([1]), "period": np.array([0.2]), "epoch": np.array([60_000.125]),
    }  # fmt: skip
    near = variable_stars.flux_factors(stars, BAND, 60_000.125 + 0.2 * np.linspace(0.0, 1.0, 30))
    far = variable_stars.flux_factors(stars, BAND, 60_000.125 + 0.2 * (50_000.0 + np.linspace(0.0, 1.0, 30)))
    assert far == pytest.approx(near, rel=1e-6)
    assert near.argmax() in (0, 29)


def test_mean_flux_of_pulsating_stars_and_flux_outside_of_eclipses():
    stars = columns()
    for k in range(1, 8):
        one = {name: values[[k]] for name, values in stars.items()}
        dates = one["epoch"] + one["period"] * np.arange(2000.0) / 2000.0
        flux = variable_stars.flux_factors(one, BAND, dates)[0]
        if k < 6:
            assert flux.mean() == pytest.approx(1.0, abs=2e-4)
        else:
            outside = np.abs(np.arange(2000.0) / 2000.0 - 0.5) < 0.5 - one["eclipse_duration"] / one["period"]
            assert flux[outside].max() == pytest.approx(1.03, abs=1e-3)
            assert flux.argmin() in (0, 1000, 1999)


def test_amplitudes_in_g_and_in_h():
    """RR Lyrae stars: 1.2 of V in g, a third of V in H."""
    one = {name: values[[1]] for name, values in columns().items()} | {"amplitude": np.array([1.0])}
    dates = one["epoch"] + one["period"] * np.arange(500.0) / 500.0
    found = {}
    for name in ("lsst_g", "euclid_h"):
        flux = variable_stars.flux_factors(one, passbands.load(name), dates)
        found[name] = np.ptp(2.5 * np.log10(flux))
    assert found["lsst_g"] == pytest.approx(1.2, abs=0.06)
    assert found["euclid_h"] == pytest.approx(0.33, abs=0.03)


def test_both_stars_of_a_binary():
    """Equal suns 5 radii apart: each is eclipsed once per orbit, half a period after the other."""
    n = 5000
    pairs = Pairs(np.ones((2, n)), np.full((2, n), 4.438), np.ones(n, bool), np.full(n, 5.0 * eclipses.SUN_RADIUS_AU))
    index, _, found = variable_stars.binary_columns(np.arange(n), pairs, 7)
    chosen = int(np.flatnonzero((found["eclipse_duration"] > 0.0).all(0) & (found["eclipse_impact"].max(0) < 0.3))[0])
    star = {name: values[:, chosen] for name, values in found.items()}
    assert np.array_equal(star["variability"], [6, 6])
    assert abs(np.diff(star["epoch"])[0]) == pytest.approx(0.5 * star["period"][0])
    dates = star["epoch"][0] + star["period"][0] * np.arange(1000.0) / 1000.0
    flux = variable_stars.flux_factors(star, BAND, dates)
    assert flux[0].argmin() == 0
    assert flux[1].argmin() == 500
    few, _, again = variable_stars.binary_columns(np.arange(n)[index[:5]], pairs.select(index[:5]), 7)
    assert few.size == 5
    assert np.array_equal(again["epoch"], found["epoch"][:, :5])


def test_columns_of_a_star_do_not_depend_on_the_other_stars(halo):
    stars, _ = halo
    ids = np.arange(stars.teff.size, dtype=np.int64)
    index, found = variable_stars.pulsation_columns(ids, stars, 5)
    half = ids[::2]
    part, fewer = variable_stars.pulsation_columns(half, stars.select(half), 5)
    both = np.isin(index, half)
    assert np.array_equal(half[part], index[both])
    for name, values in fewer.items():
        assert np.array_equal(values, found[name][both])
    assert np.all((found["epoch"] >= 60_000.0) & (found["epoch"] - 60_000.0 <= found["period"]))


def test_columns_are_read_from_the_table():
    names = {column.name for column in declarations.VARIABILITY_COLUMNS}
    plain = pa.table({"id": np.arange(3)})
    read = variable_stars.read_columns(plain)
    assert np.array_equal(variable_stars.flux_factors(read, BAND, [60_000.0, 60_001.0]), np.ones((3, 2)))
    values = columns(8)
    mask = values["variability"] == 0
    rows = pa.table({name: pa.array(column, mask=mask) for name, column in values.items()})
    read = variable_stars.read_columns(rows)
    assert set(read) == names
    expected = variable_stars.flux_factors(values, BAND, 60_000.3)
    assert np.array_equal(variable_stars.flux_factors(read, BAND, 60_000.3), expected)


@pytest.mark.parametrize("code", [1, 5, 6])
def test_a_million_points_take_less_than_a_second(code):
    rng = np.random.default_rng(1)
    stars = {name: np.repeat(values[code : code + 1], 1000) for name, values in columns().items()}
    stars["epoch"] = 60_000.0 + rng.random(1000)
    dates = rng.uniform(60_000.0, 70_000.0, 1000)
    variable_stars.flux_factors(stars, BAND, dates[:1])
    start = time.process_time()
    variable_stars.flux_factors(stars, BAND, dates)
    assert time.process_time() - start < 1.0


def test_every_type_has_a_light_curve():
    codes = [code for code, _ in declarations.VARIABILITY]
    assert codes == [*range(1, 6), variable_stars.ECLIPSING, variable_stars.TIDAL]
    assert pulsation.SEMIREGULAR == 5
    assert light_curves.HARMONICS == 6
