"""Compare the two-component continuum with a slow calculation of single spectra."""

import numpy as np
import pytest

from lake_schema.errors import BadInput, OutOfRange
from truesky.fluxes import passbands
from truesky.fluxes.spectra import continuum, extinction
from truesky.fluxes.spectra.continuum import mix_from_columns

REFERENCE = passbands.load("sdss_r01")


def random_mix(library, n=40, seed=3, **columns):
    rng = np.random.default_rng(seed)
    values = {"z_obs": rng.uniform(-0.02, 6.0, n), "frac_1": rng.uniform(0.0, 1.0, n)}
    values["frac_2"] = 1.0 - values["frac_1"]
    for k in (1, 2):
        values[f"sed_{k}"] = rng.integers(0, len(library), n)
        values[f"ext_law_{k}"] = rng.integers(0, 5, n)
        values[f"ebv_{k}"] = rng.uniform(0.0, 0.6, n)
    fixed = {name: np.full(n, value) if np.ndim(value) == 0 else value for name, value in columns.items()}
    return mix_from_columns(values | fixed, library)


def slow_shape(mix, i, library, grid):
    """Compute one galaxy in double precision, following the steps of the appendix."""
    rest = np.zeros(len(library.wavelength))
    for k in range(2):
        law = extinction.laws(library.wavelength)[mix.law[k, i]]
        dusty = library.flux[mix.sed[k, i]].astype(float) * 10.0 ** (-0.4 * mix.ebv[k, i] * law)
        rest += mix.frac[k, i] * dusty / float(passbands.ab_flux(REFERENCE, library.wavelength, dusty))
    shifted = 1.0 + mix.z_obs[i]
    return np.interp(grid, library.wavelength * shifted, rest / shifted)


@pytest.mark.parametrize("shared", [True, False])
def test_shapes_agree_with_a_slow_calculation(library, shared):
    mix = random_mix(library)
    if shared:
        mix = continuum.TemplateMix(mix.z_obs, mix.sed, mix.law[[0, 0]], mix.frac, mix.ebv[[0, 0]])
    dust = continuum.dust_curves(library)
    amplitude = continuum.amplitudes(mix, REFERENCE, library, dust)
    first, count = 3000, 9000
    fast = continuum.observed_shape(mix, amplitude / amplitude.sum(0), library, dust, first, count)
    for i in range(len(mix)):
        slow = slow_shape(mix, i, library, first + np.arange(float(count)))
        np.testing.assert_allclose(fast[i] * amplitude[:, i].sum(), slow, rtol=3e-6, atol=1e-7 * slow.max())


def test_the_whole_grid_is_covered_at_both_ends(library):
    ends = 24000.0 / library.wavelength[-1] - 1.0 + 1e-9, 600.0 / library.wavelength[0] - 1.0 - 1e-9
    mix = random_mix(library, n=2, z_obs=np.array(ends), ebv_1=0.0, ebv_2=0.0)
    shape = continuum.observed_shape(mix, np.ones((2, 2)), library, continuum.dust_curves(library), 600, 23401)
    for i in range(2):
        flat = continuum.TemplateMix(mix.z_obs, mix.sed, mix.law, mix.frac, mix.ebv)
        rest = library.flux[flat.sed[:, i]].sum(0, dtype=float)
        shifted = 1.0 + ends[i]
        slow = np.interp(passbands.grid(), library.wavelength * shifted, rest / shifted)
        np.testing.assert_allclose(shape[i], slow, rtol=2e-6, atol=1e-6)


def test_components_have_their_share_of_the_reference_flux_after_dust(library):
    mix = random_mix(library, z_obs=0.0)
    dust = continuum.dust_curves(library)
    amplitude = continuum.amplitudes(mix, REFERENCE, library, dust)
    first = int(REFERENCE.wavelength[0])
    weights = passbands.weights(REFERENCE)
    for k in range(2):
        only = amplitude.copy()
        only[1 - k] = 0.0
        scale = only.sum(0)
        shape = continuum.observed_shape(mix, only / scale, library, dust, first, len(weights))
        np.testing.assert_allclose(shape.astype(float) @ weights * scale, mix.frac[k], rtol=1e-6)


def test_one_law_agrees_with_the_published_form(library):
    # Combined first, then extinguished, as in Serrano et al. 2024.
    mix = random_mix(library, ext_law_1=2, ext_law_2=2, ebv_1=0.3, ebv_2=0.3, z_obs=0.5, sed_1=12, sed_2=11)
    dust = continuum.dust_curves(library)
    amplitude = continuum.amplitudes(mix, REFERENCE, library, dust)
    shape = continuum.observed_shape(mix, amplitude / amplitude.sum(0), library, dust, 5000, 3000)
    weight = amplitude[0] / amplitude.sum(0)
    for i in range(len(mix)):
        combined = weight[i] * library.flux[12].astype(float) + (1.0 - weight[i]) * library.flux[11]
        dusty = combined * 10.0 ** (-0.4 * 0.3 * extinction.laws(library.wavelength)[2])
        slow = np.interp(5000.0 + np.arange(3000.0), library.wavelength * 1.5, dusty / 1.5)
        np.testing.assert_allclose(shape[i], slow, rtol=2e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("z_obs", -0.03),
        ("z_obs", 7.0),
        ("z_obs", np.nan),
        ("sed_1", 31),
        ("sed_2", -1),
        ("frac_1", 1.1),
        ("frac_2", np.nan),
        ("ext_law_2", 5),
        ("ebv_1", -0.1),
        ("ebv_2", 3.5),
    ],
)
def test_impossible_mixes_are_refused_by_name(library, name, value):
    with pytest.raises(OutOfRange, match=name):
        random_mix(library, **{name: value})


def test_missing_columns_and_empty_mixes_are_refused(library):
    with pytest.raises(BadInput, match="sed_1, sed_2"):
        mix_from_columns(
            {"z_obs": [0.1], **{f"{n}_{k}": [0.0] for n in ("frac", "ext_law", "ebv") for k in (1, 2)}},
            library,
        )
    with pytest.raises(BadInput, match="frac_1 and frac_2"):
        random_mix(library, frac_1=0.0, frac_2=0.0)
