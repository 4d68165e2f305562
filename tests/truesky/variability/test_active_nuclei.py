"""Tests of light curves of active nuclei."""

import numpy as np
import pyarrow as pa
import pytest

from truesky.fluxes import high_redshift, passbands
from truesky.randomness import per_source
from truesky.variability import active_nuclei

BLUE, RED = (passbands.load(name) for name in ("lsst_g", "lsst_i"))
_N = 20_000


def quasars(n, z=1.0, m_1450=-24.0, log_mass=8.7, nucleus_type=1):
    """Return n quasars that differ in their identifier only."""
    ids = (2 << 60) + np.arange(n)
    columns = {"z_obs": z, "m_1450": m_1450, "log_black_hole_mass": log_mass, "mag_1450": 20.0}
    columns |= {"kappa": 0.05, "gamma1": 0.01, "gamma2": -0.02, "a_v": 0.1}
    return {
        "id": ids,
        "light_curve_key": per_source.keys(ids, 1, "test").view(np.int64),
        "type": np.full(n, nucleus_type),
        "template": np.arange(n) % 9,
        **{name: np.full(n, value) for name, value in columns.items()},
    }


def test_the_parameters_are_those_of_the_paper():
    """MacLeod et al. 2010: at 4000 A, M_i = -23 and 1e9 Msun, SF_inf is 10^-0.51 mag and tau 10^2.4 days."""
    m_1450, mass = np.array([-23.0, -23.0, -28.0, -23.0]) + 1.486, np.array([9.0, 9.0, 9.0, 8.0])
    sf, tau = active_nuclei.parameters(m_1450, mass, np.array([4000.0, 2000.0, 4000.0, 4000.0]))
    assert np.log10(sf) == pytest.approx([-0.51, -0.51 + 0.479 * np.log10(2.0), -0.51 - 0.655, -0.69])
    assert np.log10(tau) == pytest.approx([2.4, 2.4 - 0.17 * np.log10(2.0), 2.4 - 0.15, 2.19])


def test_faint_nuclei_have_a_limited_scatter():
    sf, _ = active_nuclei.parameters(np.array([-14.0]), np.array([9.0]), np.array([4000.0]))
    assert sf[0] == 0.7


@pytest.mark.parametrize("z", [0.5, 2.5])
def test_structure_function_of_magnitudes(z):
    """Within 5 % of SF_inf sqrt(1 - exp(-dt / tau)) from 10 to 1000 days of the observer.

    Sample: 20,000 quasars, one pair of dates for each lag. Significance: the root of the mean square has a relative
    standard deviation of 0.5 %; 5 % are 10 of them. A time scale without the factor 1 + z would be 20 % off.
    """
    rows, lags = quasars(_N, z), np.array([10.0, 30.0, 100.0, 300.0, 1000.0])
    magnitudes = -2.5 * np.log10(active_nuclei.flux_factors(rows, BLUE, 60000.3 + np.append(0.0, lags)))
    measured = np.sqrt(((magnitudes[:, 1:] - magnitudes[:, :1]) ** 2).mean(0))
    wavelength = np.array([active_nuclei.mean_wavelength(BLUE) / (1.0 + z)])
    sf, tau = active_nuclei.parameters(np.array([-24.0]), np.array([8.7]), wavelength)
    assert measured == pytest.approx(sf * np.sqrt(1.0 - np.exp(-lags / tau / (1.0 + z))), rel=0.05)


def test_the_mean_flux_is_that_of_the_catalogue():
    """Sample: 20,000 quasars at two dates far apart. Significance: 4.5 standard deviations of the mean (7e-6)."""
    factors = active_nuclei.flux_factors(quasars(_N), BLUE, np.array([50000.0, 70000.0]))
    limit = 4.5 * factors.std() / np.sqrt(_N)
    assert limit < 0.01
    assert np.abs(factors.mean(0) - 1.0).max() < limit


def test_bands_vary_together_and_less_in_the_red():
    """Sample: 20,000 quasars. Significance: the correlation of magnitudes is above 0.99; its scatter is 1e-4."""
    rows = quasars(_N)
    g, i = (np.log(active_nuclei.flux_factors(rows, band, 60000.0)) for band in (BLUE, RED))
    assert np.corrcoef(g, i)[0, 1] > 0.99
    # The scatter falls with the wavelength to the power -0.479.
    ratio = (active_nuclei.mean_wavelength(BLUE) / active_nuclei.mean_wavelength(RED)) ** 0.479
    assert i.std() / g.std() == pytest.approx(ratio, rel=0.02)


def test_type_2_does_not_vary_and_has_no_continuum():
    rows = quasars(3, nucleus_type=2)
    assert (active_nuclei.flux_factors(rows, BLUE, 60000.0) == 1.0).all()
    assert (active_nuclei.fluxes(rows, BLUE, np.array([60000.0, 60010.0])) == 0.0).all()


def test_shapes_and_dates_of_each_nucleus():
    rows, dates = quasars(4), np.array([60000.0, 60010.0, 60500.0])
    factors = active_nuclei.flux_factors(rows, BLUE, dates)
    assert factors.shape == (4, 3)
    np.testing.assert_array_equal(active_nuclei.flux_factors(rows, BLUE, dates[1]), factors[:, 1])
    own = active_nuclei.flux_factors(rows, BLUE, np.broadcast_to(dates, (4, 3)) + np.arange(4)[:, None])
    np.testing.assert_array_equal(own[0], factors[0])
    assert not np.array_equal(own[1], factors[1])


def test_mean_fluxes_are_those_of_quasars():
    """The slow reference is the flux of rows of table galaxies, band by band."""
    rows = {**quasars(6), "type": np.array([1, 1, 2, 1, 2, 1])}
    zeros = np.zeros(6)
    table = pa.table(
        {
            **{name: rows[name] for name in ("id", "z_obs", "kappa", "gamma1", "gamma2", "a_v")},
            "kind": np.full(6, 2), "mag_r01": rows["mag_1450"], "sed_1": rows["template"],
            "frac_2": zeros, "ebv_1": zeros,
        }
    )  # fmt: skip
    expected = high_redshift.fluxes(table, (BLUE, RED)) * (rows["type"] == 1)[:, None]
    mean = active_nuclei.mean_fluxes(rows, (BLUE, RED))
    np.testing.assert_allclose(mean, expected, rtol=1e-4)
    at_dates = active_nuclei.fluxes(rows, RED, np.array([60000.0, 61000.0]))
    factors = active_nuclei.flux_factors(rows, RED, np.array([60000.0, 61000.0]))
    np.testing.assert_array_equal(at_dates, factors * mean[:, 1:])


@pytest.mark.parametrize("name", ["lsst_u", "euclid_vis", "lsst_y", "euclid_h", "sdss_g"])
def test_fluxes_with_few_wavelengths_agree_with_all(name):
    """Lyman alpha and the absorption below it cross each band; the step of 4 A was chosen with other redshifts."""
    n, band = 150, passbands.load(name)
    rows = {**quasars(n), "z_obs": np.random.default_rng(8).uniform(0.0, 7.0, n), "a_v": np.linspace(0.0, 2.0, n)}
    zeros, names = np.zeros(n), ("id", "z_obs", "kappa", "gamma1", "gamma2", "a_v")
    table = pa.table(
        {
            **{column: rows[column] for column in names},
            "kind": np.full(n, 2), "mag_r01": rows["mag_1450"], "sed_1": rows["template"],
            "frac_2": zeros, "ebv_1": zeros,
        }
    )  # fmt: skip
    found = active_nuclei.mean_fluxes(rows, (band,))
    np.testing.assert_allclose(found, high_redshift.fluxes(table, (band,)), rtol=1e-4, atol=0.0)
    alone = {column: values[70:71] for column, values in rows.items()}
    np.testing.assert_array_equal(active_nuclei.mean_fluxes(alone, (band,)), found[70:71])
