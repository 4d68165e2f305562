"""Supernovae are stars with their own flux and spectrum."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids
from lake_schema.tables.variability.transients import TRANSIENTS
from truesky.fluxes import passbands
from truesky.render.sources import colours, point_light, spectra, transients
from truesky.render.sources.transients import Transients
from truesky.variability import supernova_light, supernova_templates

BAND = passbands.load("lsst_r")
CELL = 1000
STARS = pa.table({
    "id": ids.source_id(5, CELL, np.arange(2)), "ra": [10.0, 10.1], "dec": [1.0, 1.1],
    "pm_ra": pa.array([None, 3.0], pa.float32()), "sed": pa.array([20, 30], pa.int16()),
    "mag_h": pa.array([20.0, 21.0], pa.float32()), "a_v": pa.array([0.0, 0.1], pa.float32()),
})  # fmt: skip
FLUXES = pa.table({"id": STARS["id"], "f_nu_lsst_r": pa.array([5.0, 6.0], pa.float32())})


def rows(n=3, peak=60000.0):
    """Return n supernovae of type Ia; the last one is not seen at the date of its peak."""
    words = np.arange(1, n + 1, dtype=np.uint64) * np.uint64(12345)
    columns = {
        "id": ids.transient_id(CELL, words), "ra": 10.0 + np.arange(n),
        "dec": np.arange(n) - 1.0, "type": np.ones(n), "z_obs": np.full(n, 0.3), "stretch": np.ones(n),
        "peak_mjd": peak + np.where(np.arange(n) == n - 1, 1000.0, 0.0), "mag_b": np.full(n, 22.0),
        "ebv": np.linspace(0.0, 0.2, n), "magnification": np.ones(n), "a_v": np.full(n, 0.1),
    }  # fmt: skip
    return pa.table(
        {name: pa.array(columns[name]).cast(TRANSIENTS.column(name).arrow_type) for name in transients.COLUMNS}
    )


def supernovae(*arguments):
    return with_limit(rows(*arguments), 0.0)


def with_limit(table, min_f_nu):
    """Return supernovae that are drawn above this flux (microjansky)."""
    limits = pa.array(np.full(len(table), min_f_nu))
    return Transients(table.append_column(point_light.MIN_F_NU, limits), supernova_templates.templates())


def appended(sky, mjd):
    """Return stars and fluxes with the supernovae at a date, and the spectra of the supernovae."""
    light = transients.light_at(sky, BAND, mjd)
    return *point_light.append_points(STARS, FLUXES, light, BAND.name), light.spectra


def all_of(spectra):
    return spectra.compute(np.arange(spectra.count))


def test_those_that_shine_are_appended():
    sky = supernovae()
    stars, fluxes, own = appended(sky, 60000.0)
    assert stars.schema == STARS.schema
    assert stars.slice(0, 2).equals(STARS)
    assert fluxes.slice(0, 2).equals(FLUXES)
    assert stars["id"].to_pylist()[2:] == fluxes["id"].to_pylist()[2:] == sky.rows["id"].to_pylist()[:2]
    expected = supernova_light.fluxes(transients.supernovae(sky.rows), BAND, np.array([[60000.0]]), sky.templates)
    np.testing.assert_array_equal(fluxes["f_nu_lsst_r"].to_numpy()[2:], expected[:2, 0].astype(np.float32))
    np.testing.assert_allclose(passbands.ab_flux(BAND, BAND.wavelength, all_of(own)) * 1e29, expected[:2, 0])


def test_at_other_dates_the_stars_are_alone():
    stars, fluxes, own = appended(supernovae(), 50000.0)
    assert stars.equals(STARS)
    assert fluxes.equals(FLUXES)
    assert own.count == 0
    assert all_of(own).shape == (0, len(BAND.wavelength))


def test_own_spectra_replace_templates():
    """The function of spectra returns templates of stars and the spectra of supernovae, each for one photon."""
    stars, _, spectra_of_points = appended(supernovae(), 60000.0)
    own = all_of(spectra_of_points)
    sun = np.ones(len(BAND.wavelength))
    galaxies = pa.table({"id": pa.array([], pa.int64())})
    numbers = np.array([-1, 0, 1, 2, 3])
    found = spectra.spectrum_function(numbers, galaxies, stars, BAND, sun, own_spectra=spectra_of_points)(np.arange(5))
    without = spectra.spectrum_function(numbers[:3], galaxies, STARS, BAND, sun)(np.arange(3))
    np.testing.assert_array_equal(found[:3], without)
    weights = BAND.response * BAND.wavelength
    np.testing.assert_allclose(found[3:] @ weights, 1.0, rtol=1e-5)
    np.testing.assert_allclose(found[3:] / found[3:].max(1)[:, None], own / own.max(1)[:, None], rtol=1e-5)


def test_photons_of_a_supernova_are_those_of_its_spectrum():
    own = all_of(appended(supernovae(), 60030.0)[2])
    several = colours.spectrum_fractions(BAND, own)
    shares = colours.spectrum_fractions(BAND, own[:1])[0]
    np.testing.assert_array_equal(several[0], shares)
    assert shares.sum() == pytest.approx(1.0)
    photons = own[0] * BAND.response * BAND.wavelength
    middle = np.sum(photons * BAND.wavelength) / np.sum(photons)
    (red,) = colours.spectrum_fractions(BAND, own[:1] * BAND.wavelength**8)
    assert np.sum(red * np.arange(8)) > np.sum(shares * np.arange(8))
    assert BAND.wavelength[0] < middle < BAND.wavelength[-1]


def test_faint_supernovae_are_left_out():
    table = rows(3)
    f_nu = supernova_light.fluxes(
        transients.supernovae(table), BAND, np.array([[60000.0]]), supernova_templates.templates()
    )[:2, 0]
    # The second one is redder, with the same magnitude in B.
    assert f_nu[1] > f_nu[0] > 0.0
    for limit, expected in ((f_nu[0], [0, 1]), (f_nu[1], [1]), (1.01 * f_nu[1], [])):
        light = transients.light_at(with_limit(table, limit), BAND, 60000.0)
        assert light.ids.tolist() == [table["id"][i].as_py() for i in expected]
        assert light.spectra.count == len(expected)


def test_spectra_of_two_lists_follow_each_other():
    parts = [point_light.OwnSpectra(n, lambda i, k=k: np.stack([i + k, i], axis=1).astype(float))
             for n, k in ((2, 10), (3, 20), (1, 30))]  # fmt: skip
    joined = parts[0].followed_by(parts[1]).followed_by(parts[2])
    assert joined.count == 6
    np.testing.assert_array_equal(joined.compute(np.array([5, 0, 2, 4, 1]))[:, 0], [30, 10, 20, 22, 11])
    assert joined.compute(np.zeros(0, int)).shape == (0, 2)


def test_sources_inside_and_outside_the_circle_have_their_own_limits():
    task = {"ra": 10.0, "dec": 0.0, "radius": 0.5}
    points = pa.table({"ra": [10.0, 10.6, 359.0, 11.5], "dec": [0.4, 0.0, 0.0, 0.0]})
    near = point_light.add_flux_limits(point_light.select_nearby(points, task, 1800.0), task, (0.1, 5.0))
    assert near["ra"].to_pylist() == [10.0, 10.6]
    assert near[point_light.MIN_F_NU].to_pylist() == [0.1, 5.0]


def test_supernovae_are_left_out_by_identifier():
    sky = supernovae()
    rest = transients.without(sky, pa.array([sky.rows["id"][1].as_py()], pa.int64()))
    assert rest.rows["id"].to_pylist() == [sky.rows["id"][0].as_py(), sky.rows["id"][2].as_py()]
