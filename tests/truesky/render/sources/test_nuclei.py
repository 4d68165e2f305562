"""Active nuclei are stars with their own flux and spectrum."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids, units
from truesky.fluxes import passbands
from truesky.render.sources import nuclei, point_light
from truesky.render.sources.nuclei import Nuclei


def points(n, min_f_nu=0.0, seed=2):
    """Return n nuclei of all templates and redshifts, also of z = 0, with large variations."""
    rng = np.random.default_rng(seed)
    values = {
        "light_curve_key": np.arange(1, n + 1) << 40, "z_obs": np.append(0.0, rng.uniform(-0.002, 6.0, n - 1)),
        "m_1450": rng.uniform(-24.0, -16.0, n), "log_black_hole_mass": rng.uniform(6.0, 9.5, n), "type": np.ones(n),
        "id": ids.transient_id(1000, np.arange(n, dtype=np.uint64)), "mag_1450": rng.uniform(22.0, 31.0, n),
        "template": np.arange(n)[::-1] % 9, "kappa": rng.uniform(0.0, 0.2, n), "gamma1": rng.uniform(-0.1, 0.1, n),
        "gamma2": np.zeros(n), "a_v": np.where(np.arange(n) % 2, 0.2, 0.0), "ra": np.zeros(n), "dec": np.zeros(n),
        "magnification": rng.uniform(1.0, 9.0, n), "delay": np.zeros(n), point_light.MIN_F_NU: np.full(n, min_f_nu),
    }  # fmt: skip
    return pa.table(values)


NONE = points(1).slice(0, 0)


@pytest.mark.parametrize("name", ["lsst_u", "euclid_vis", "euclid_h", "twomass_ks"])
def test_faint_nuclei_are_left_out(name):
    """Upper limits of fluxes, by which most are left out, hide none that is bright enough."""
    band, n = passbands.load(name), 200
    every = nuclei.light_at(Nuclei(points(n), NONE), band, 60000.0)
    assert len(every.ids) > 150
    limit = float(np.quantile(every.f_nu, 0.6))
    bright = nuclei.light_at(Nuclei(points(n, limit), NONE), band, 60000.0)
    chosen = every.f_nu >= limit
    np.testing.assert_array_equal(bright.ids, every.ids[chosen])
    np.testing.assert_array_equal(bright.f_nu, every.f_nu[chosen])
    np.testing.assert_array_equal(
        bright.spectra.compute(np.arange(3)), every.spectra.compute(np.flatnonzero(chosen)[:3])
    )


def test_the_reddest_light_is_below_the_upper_limit():
    """A band at the end of the range of wavelengths, at z = 0, has the largest flux relative to 1450 A."""
    red = passbands.Passband("red", np.arange(23800.0, 24001.0), np.ones(201), "vacuum")
    rows = points(9)
    for name, value in (("z_obs", 0.0), ("kappa", 0.0), ("gamma1", 0.0), ("a_v", 0.0)):
        rows = rows.set_column(rows.schema.get_field_index(name), name, pa.array(np.full(9, value)))
    excess = nuclei.mean_fluxes(rows, red) / rows["magnification"].to_numpy()
    excess /= units.f_nu_of_mag(rows["mag_1450"].to_numpy())
    assert 5.0 < 2.5 * np.log10(excess.max()) < nuclei._LARGEST_EXCESS


def test_no_nuclei():
    light = nuclei.light_at(Nuclei(NONE, NONE), passbands.load("lsst_r"), 60000.0)
    assert len(light.ids) == light.spectra.count == 0
