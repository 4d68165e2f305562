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
    return Transients(rows(*arguments), supernova_templates.templates())


def appended(sky, mjd):
    """Return stars and fluxes with the supernovae at a date, and the spectra of the supernovae."""
    light = transients.light_at(sky, BAND, mjd)
    return *point_light.append_points(STARS, FLUXES, light, BAND.name), light.spectra


def test_those_that_shine_are_appended():
    sky = supernovae()
    stars, fluxes, own = appended(sky, 60000.0)
    assert stars.schema == STARS.schema
    assert stars.slice(0, 2).equals(STARS)
    assert fluxes.slice(0, 2).equals(FLUXES)
    assert stars["id"].to_pylist()[2:] == fluxes["id"].to_pylist()[2:] == sky.rows["id"].to_pylist()[:2]
    expected = supernova_light.fluxes(transients.supernovae(sky.rows), BAND, np.array([[60000.0]]), sky.templates)
    np.testing.assert_array_equal(fluxes["f_nu_lsst_r"].to_numpy()[2:], expected[:2, 0].astype(np.float32))
    np.testing.assert_allclose(passbands.ab_flux(BAND, BAND.wavelength, own) * 1e29, expected[:2, 0])


def test_at_other_dates_the_stars_are_alone():
    stars, fluxes, own = appended(supernovae(), 50000.0)
    assert stars.equals(STARS)
    assert fluxes.equals(FLUXES)
    assert own.shape == (0, len(BAND.wavelength))


def test_own_spectra_replace_templates():
    """The function of spectra returns templates of stars and the spectra of supernovae, each for one photon."""
    stars, _, own = appended(supernovae(), 60000.0)
    sun = np.ones(len(BAND.wavelength))
    galaxies = pa.table({"id": pa.array([], pa.int64())})
    numbers = np.array([-1, 0, 1, 2, 3])
    found = spectra.spectrum_function(numbers, galaxies, stars, BAND, sun, own_spectra=own)(np.arange(5))
    without = spectra.spectrum_function(numbers[:3], galaxies, STARS, BAND, sun)(np.arange(3))
    np.testing.assert_array_equal(found[:3], without)
    weights = BAND.response * BAND.wavelength
    np.testing.assert_allclose(found[3:] @ weights, 1.0, rtol=1e-5)
    np.testing.assert_allclose(found[3:] / found[3:].max(1)[:, None], own / own.max(1)[:, None], rtol=1e-5)


def test_photons_of_a_supernova_are_those_of_its_spectrum():
    _, _, own = appended(supernovae(), 60030.0)
    shares = colours.spectrum_fractions(BAND, own[0])
    assert shares.sum() == pytest.approx(1.0)
    photons = own[0] * BAND.response * BAND.wavelength
    middle = np.sum(photons * BAND.wavelength) / np.sum(photons)
    red = colours.spectrum_fractions(BAND, own[0] * BAND.wavelength**8)
    assert np.sum(red * np.arange(8)) > np.sum(shares * np.arange(8))
    assert BAND.wavelength[0] < middle < BAND.wavelength[-1]


def test_supernovae_are_left_out_by_identifier():
    sky = supernovae()
    rest = transients.without(sky, pa.array([sky.rows["id"][1].as_py()], pa.int64()))
    assert rest.rows["id"].to_pylist() == [sky.rows["id"][0].as_py(), sky.rows["id"][2].as_py()]
