"""Compare fluxes from tables with integration."""

import dataclasses
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.truesky import nightly
from truesky.fluxes import band_fluxes, integration, passbands, sources
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.sources import Galaxies, Stars
from truesky.fluxes.spectra import lines
from truesky.fluxes.spectra.continuum import TemplateMix
from truesky.fluxes.tables import build_tables, errors_measured, flux_tables
from truesky.fluxes.tables.settings import choose
from truesky.request.accuracy import DRAFT, REFERENCE, SURVEY

# The widest, the one with the red leak, one of the infrared: space and ground.
BANDS = ("euclid_vis", "lsst_u", "euclid_h")
CURVES = [passbands.load(name) for name in BANDS]


def chosen(accuracy):
    return [choice.setting for choice in choose(BANDS, accuracy)]


@pytest.fixture(scope="module")
def grid(library):
    return flux_tables.open_grid(CURVES, chosen(SURVEY), library)


def drawn(n, seed=5):
    """Return galaxies distributed uniformly over the range of the tables."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(errors_measured.draw_galaxies(n, 31, rng), magnification=rng.uniform(0.5, 3.0, n))


@nightly.parametrize("accuracy", [DRAFT, SURVEY], (1,))
def test_tables_agree_with_integration_within_the_accuracy(library, accuracy):
    rows = drawn(1500)
    fast = flux_tables.galaxy_fluxes(rows, flux_tables.open_grid(CURVES, chosen(accuracy), library))
    slow = integration.galaxy_fluxes(rows, CURVES, library)
    assert np.abs(fast / slow - 1.0).max() <= accuracy.flux


@settings(max_examples=40, deadline=None)
@given(
    z=st.floats(build_tables.Z_FIRST, build_tables.Z_LAST),
    sed=st.tuples(st.integers(0, 30), st.integers(0, 30)),
    law=st.tuples(st.integers(0, 4), st.integers(0, 4)),
    ebv=st.tuples(st.floats(0.0, build_tables.EBV_LAST), st.floats(0.0, build_tables.EBV_LAST)),
    frac=st.floats(0.0, 1.0),
    a_v=st.floats(0.0, build_tables.A_V_LAST),
    line=st.floats(0.0, 3e-16),
    abs_mag=st.floats(-30.0, 5.0),
)
def test_tables_agree_with_integration_for_any_galaxy(library, grid, z, sed, law, ebv, frac, a_v, line, abs_mag):
    mix = TemplateMix(*(np.array(x)[..., None] for x in (z, sed, law, (frac, 1.0 - frac), ebv)))
    one = np.ones(1)
    rows = Galaxies(mix, abs_mag * one, 20.0 * one, np.full((1, len(lines.line_list())), line), one, a_v * one)
    assert flux_tables.covered_galaxies(rows).all()
    slow = integration.galaxy_fluxes(rows, CURVES, library)
    np.testing.assert_allclose(flux_tables.galaxy_fluxes(rows, grid), slow, rtol=SURVEY.flux)


def test_lines_alone(library, grid):
    # Compare only if the band receives at least 1 % of its maximum, since the flux in the wing of a line is negligible.
    rows = dataclasses.replace(drawn(400), mag_r01=np.full(400, 45.0))
    fast, slow = flux_tables.galaxy_fluxes(rows, grid), integration.galaxy_fluxes(rows, CURVES, library)
    bright = slow > 0.01 * slow.max(0)
    assert bright.sum() > 300
    np.testing.assert_allclose(fast[bright], slow[bright], rtol=5e-3)


def test_a_source_does_not_depend_on_its_neighbours(grid):
    rows = drawn(300)
    wanted = flux_tables.galaxy_fluxes(rows, grid)
    order = np.random.default_rng(8).permutation(300)
    np.testing.assert_array_equal(flux_tables.galaxy_fluxes(rows.select(order), grid), wanted[order])
    np.testing.assert_array_equal(flux_tables.galaxy_fluxes(rows.select(slice(7, 8)), grid), wanted[7:8])


def test_flux_is_linear_in_components_and_lines(grid):
    rows = drawn(100)
    wanted = flux_tables.galaxy_fluxes(rows, grid)
    lensed = dataclasses.replace(rows, magnification=3.0 * rows.magnification)
    np.testing.assert_allclose(flux_tables.galaxy_fluxes(lensed, grid), 3.0 * wanted, rtol=1e-12)
    brighter = dataclasses.replace(rows, mag_r01=rows.mag_r01 - 2.5, lines=10.0 * rows.lines)
    np.testing.assert_allclose(flux_tables.galaxy_fluxes(brighter, grid), 10.0 * wanted, rtol=1e-12)
    dark = dataclasses.replace(rows, lines=np.zeros_like(rows.lines))
    only = dataclasses.replace(rows, mag_r01=np.full(100, 60.0))
    added = flux_tables.galaxy_fluxes(dark, grid) + flux_tables.galaxy_fluxes(only, grid)
    np.testing.assert_allclose(added, wanted, rtol=1e-7)


def test_two_equal_components_are_one(grid):
    rows = drawn(50)
    same = {name: np.repeat(getattr(rows.mix, name)[:1], 2, 0) for name in ("sed", "law", "ebv")}
    twice = dataclasses.replace(rows, mix=dataclasses.replace(rows.mix, **same))
    once_frac = np.stack([np.ones(50), np.zeros(50)])
    once = dataclasses.replace(twice, mix=dataclasses.replace(twice.mix, frac=once_frac))
    np.testing.assert_allclose(
        flux_tables.galaxy_fluxes(twice, grid), flux_tables.galaxy_fluxes(once, grid), rtol=1e-12
    )


def test_without_a_law_there_is_no_dust(grid):
    rows = drawn(50)
    lawless = dataclasses.replace(rows.mix, law=np.zeros((2, 50), np.int64))
    clean = dataclasses.replace(lawless, ebv=np.zeros((2, 50)))
    results = [flux_tables.galaxy_fluxes(dataclasses.replace(rows, mix=mix), grid) for mix in (lawless, clean)]
    np.testing.assert_array_equal(*results)
    beyond = dataclasses.replace(rows, mix=dataclasses.replace(lawless, ebv=np.full((2, 50), 2.0)))
    assert flux_tables.covered_galaxies(beyond).all()


def test_a_component_without_flux_may_have_any_dust(grid):
    rows = drawn(50)
    single = dataclasses.replace(rows.mix, frac=np.stack([np.ones(50), np.zeros(50)]))
    ebv = np.stack([rows.mix.ebv[0], np.full(50, 3.0)])
    both = [dataclasses.replace(rows, mix=mix) for mix in (single, dataclasses.replace(single, ebv=ebv))]
    assert flux_tables.covered_galaxies(both[1]).all()
    np.testing.assert_array_equal(*(flux_tables.galaxy_fluxes(each, grid) for each in both))


@pytest.mark.parametrize(
    ("column", "value"), [("ebv_1", 0.61), ("ebv_2", 2.5), ("a_v", 1.56), ("a_v", 30.0), ("z_obs", 3.1)]
)
def test_galaxies_outside_the_tables_are_integrated(galaxies, library, column, value):
    values = galaxies()[column].to_numpy().copy()
    values[[3, 11]] = value
    table = galaxies(**{column: values, "ext_law_1": 2, "ext_law_2": 1})
    rows = sources.galaxies_from_table(table, library)
    assert list(np.flatnonzero(~flux_tables.covered_galaxies(rows))) == [3, 11]
    survey, reference = (band_fluxes.galaxy_fluxes(table, BANDS, library, a) for a in (SURVEY, REFERENCE))
    assert list(np.flatnonzero(survey["integrated"])) == [3, 11]
    assert all(reference["integrated"].to_pylist())
    for band in BANDS:
        fast, slow = (np.asarray(t[f"f_nu_{band}"]) for t in (survey, reference))
        np.testing.assert_array_equal(fast[[3, 11]], slow[[3, 11]])
        np.testing.assert_allclose(fast, slow, rtol=SURVEY.flux)


def test_star_tables_agree_with_integration(stars_library):
    rng = np.random.default_rng(4)
    n = 2000
    frac = rng.dirichlet(np.ones(3), n).T
    frac[1:, : n // 2] = 0.0
    rows = Stars(
        rng.integers(0, len(stars_library), (3, n)),
        frac,
        rng.uniform(5.0, 26.0, n),
        rng.uniform(0.0, build_tables.STAR_A_V_LAST, n),
    )
    curves = [*CURVES, passbands.load("gaia_g")]
    fast, slow = (
        flux_tables.star_fluxes(rows, curves, stars_library),
        integration.star_fluxes(rows, curves, stars_library),
    )
    np.testing.assert_allclose(fast, slow, rtol=5e-6)


def test_stars_behind_too_much_dust_are_integrated(stars, stars_library):
    table = stars(6, a_v=np.array([0.0, 5.0, 5.1, 30.0, 2.0, 0.1]))
    survey, reference = (band_fluxes.star_fluxes(table, BANDS, stars_library, a) for a in (SURVEY, REFERENCE))
    assert list(np.flatnonzero(survey["integrated"])) == [2, 3]
    for band in BANDS:
        fast, slow = (np.asarray(t[f"f_nu_{band}"]) for t in (survey, reference))
        np.testing.assert_array_equal(fast[[2, 3]], slow[[2, 3]])
        np.testing.assert_allclose(fast, slow, rtol=5e-6)


def test_tables_are_made_once_and_mapped(library, grid, monkeypatch):
    monkeypatch.setattr(build_tables, "_compute_galaxy_table", None)
    monkeypatch.setattr(build_tables, "_compute_line_table", None)
    again = flux_tables.open_grid(CURVES, chosen(SURVEY), library)
    assert all(not table.flags.writeable and not table.flags.owndata for table in again.tables)


def test_another_library_has_other_tables(library, tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path))
    setting = build_tables.Setting(0.2, 2, 2)
    few = Library(library.wavelength, np.asarray(library.flux[:2]), library.names[:2])
    other = dataclasses.replace(few, flux=1.5 * few.flux * np.linspace(1.0, 2.0, few.flux.shape[1], dtype=np.float32))
    tables = [
        build_tables.galaxy_table(CURVES[0], each, setting, build_tables.library_key(each)) for each in (few, other)
    ]
    assert np.abs(tables[0] - tables[1]).max() > 0.01


def test_the_tables_are_small(grid):
    # 4.5 MB per band.
    assert max(table.nbytes for table in grid.tables) <= 4.5e6


def test_hundreds_of_times_faster(library, grid):
    rows = drawn(20_000)
    flux_tables.galaxy_fluxes(rows.select(slice(0, 10)), grid)
    times = []
    for work in (
        lambda: flux_tables.galaxy_fluxes(rows, grid),
        lambda: integration.galaxy_fluxes(rows.select(slice(0, 200)), CURVES, library),
    ):
        best = np.inf
        for _ in range(2):
            started = time.process_time()
            work()
            best = min(best, time.process_time() - started)
        times.append(best)
    # Measured: about 200 with 22 bands, and with these three.
    assert times[1] / 200 > 30.0 * times[0] / 20_000


def test_the_example_compiles(grid):
    flux_tables.compile_kernels(grid)


def test_a_library_is_hashed_once(monkeypatch):
    library = dataclasses.replace(templates.stellar_library())
    key = build_tables.library_key(library)
    monkeypatch.setattr(build_tables, "dust_curves", None)
    assert build_tables.library_key(library) == key


def test_prepare_fills_the_cache(monkeypatch):
    wanted = (CURVES, chosen(SURVEY), templates.galaxy_library(), templates.stellar_library(), SURVEY)
    band_fluxes.prepare(*wanted)
    monkeypatch.setattr(build_tables, "_compute_galaxy_table", None)
    monkeypatch.setattr(build_tables, "_compute_star_table", None)
    band_fluxes.prepare(*wanted)
    assert templates.GALAXY_LIBRARY_SIZE == 31
