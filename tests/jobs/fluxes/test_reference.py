"""K-corrections: the table against direct integration, published values, and an exact identity."""

import numpy as np
import pytest

from jobs.fluxes import continuum, cosmology, extinction, passbands, reference
from jobs.fluxes.continuum import mix_of
from lake_schema.errors import BadInput, OutOfRange

Z = np.array([0.1, 0.5, 1.0, 2.0])


@pytest.fixture(scope="module")
def table(library):
    return reference.correction(library, passbands.load("sdss_r01"))


@pytest.fixture(scope="module")
def vis(library):
    return reference.correction(library, passbands.load("euclid_vis"))


def plain(library, z, template, **columns):
    """One template, without dust."""
    n = len(z)
    values = {"z_obs": z, "sed_1": template, "sed_2": template, "frac_1": 1.0, "frac_2": 0.0}
    values |= {f"{name}_{k}": 0.0 for name in ("ext_law", "ebv") for k in (1, 2)}
    return mix_of({name: np.broadcast_to(value, n) for name, value in (values | columns).items()}, library)


# Computed once from the same recipe with the weak lines left in the four observed spectra; bridging them
# moves the blue templates, which have [O III] in 0.1r, by up to 0.02.
@pytest.mark.parametrize(
    ("template", "k", "m_ie"),
    [
        (0, [0.16, 1.60, 3.28, 5.06], [-0.43, 0.07, 1.15, 3.62]),
        (13, [0.005, 0.54, 1.17, 1.12], [-0.27, -0.17, 0.29, 0.91]),
        (25, [-0.14, -0.42, -0.75, -1.31], [-0.15, -0.46, -0.73, -1.25]),
    ],
)
def test_k_corrections_of_the_templates(library, table, vis, template, k, m_ie):
    mix = plain(library, Z, template)
    modulus = cosmology.distance_modulus(Z)
    np.testing.assert_allclose(reference.reference_magnitude(-20.0, Z, mix, table) + 20.0 - modulus, k, atol=0.02)
    np.testing.assert_allclose(reference.apparent_magnitude(-20.0, Z, mix, vis) + 20.0 - modulus, m_ie, atol=0.011)


def test_a_galaxy_at_a_tenth_seen_in_sdss_r_is_its_rest_frame_seen_in_the_reference_band(library):
    """m_r = M_r + DM - 2.5 log10(1.1), whatever the spectrum: the sign of every term."""
    z = np.full(31, 0.1)
    mix = plain(library, z, np.arange(31), ext_law_1=2, ebv_1=0.3)
    r = reference.correction(library, passbands.load("sdss_r"))
    wanted = -21.0 + cosmology.distance_modulus(z) - 2.5 * np.log10(1.1)
    np.testing.assert_allclose(reference.apparent_magnitude(-21.0, z, mix, r), wanted, atol=2e-4)


def test_nothing_happens_at_redshift_zero(library, table):
    rng = np.random.default_rng(5)
    n = 200
    mix = plain(
        library,
        np.zeros(n),
        rng.integers(0, 31, n),
        sed_2=rng.integers(0, 31, n),
        frac_1=0.4,
        frac_2=0.6,
        ext_law_1=rng.integers(0, 5, n),
        ebv_1=rng.uniform(0.0, 3.0, n),
    )
    z_true = np.full(n, 0.01)
    got = reference.reference_magnitude(-20.0, z_true, mix, table)
    np.testing.assert_allclose(got, -20.0 + cosmology.distance_modulus(z_true), atol=1e-4)


@pytest.mark.parametrize(("band", "worst"), [("sdss_r01", 2e-4), ("euclid_vis", 5e-4)])
def test_the_table_is_the_integral(library, table, vis, band, worst):
    rng = np.random.default_rng(6)
    n = 300
    frac = rng.uniform(0.0, 1.0, n)
    columns = {f"sed_{k}": rng.integers(0, 31, n) for k in (1, 2)}
    columns |= {f"ext_law_{k}": rng.integers(0, 5, n) for k in (1, 2)}
    columns |= {f"ebv_{k}": rng.uniform(0.0, 0.6, n) for k in (1, 2)}
    z = rng.uniform(0.001, 2.4, n)
    mix = mix_of(columns | {"z_obs": z, "frac_1": frac, "frac_2": 1.0 - frac}, library)
    curve, r01, dust = passbands.load(band), passbands.load("sdss_r01"), continuum.dust_of(library)
    amplitude = continuum.amplitudes(mix, r01, library, dust)
    weights, first = passbands.weights(curve), int(curve.wavelength[0])
    shape = continuum.observed_shape(mix, amplitude / amplitude.sum(0), library, dust, first, len(weights))
    direct = -2.5 * np.log10((shape.astype(float) @ weights) * amplitude.sum(0))
    chosen = {"sdss_r01": table, "euclid_vis": vis}[band]
    error = reference.apparent_magnitude(0.0, z, mix, chosen) - cosmology.distance_modulus(z) - direct
    assert np.abs(error).max() < worst
    assert error.std() < 1e-4


def test_any_h_cancels_but_the_distance_is_the_true_one(library, table):
    mix = plain(library, np.array([0.5]), 10)
    near, far = (float(reference.reference_magnitude(-20.0, [z], mix, table)[0]) for z in (0.5, 0.51))
    assert far - near == pytest.approx(float(cosmology.distance_modulus(0.51) - cosmology.distance_modulus(0.5)))


def test_rest_colours(library):
    colors = reference.rest_color_table(library)
    assert colors.color.shape == (31, extinction.LAW_COUNT, len(colors.ebv))
    # Monotone in the template, so that it can be inverted; redder with dust, by about its k(g) - k(r).
    assert (np.diff(colors.color, axis=0) < 0.0).all()
    assert (np.diff(colors.color[:, 1:], axis=2) > 0.0).all()
    np.testing.assert_array_equal(np.ptp(colors.color[:, 0], axis=1), 0.0)
    at = extinction.laws([4274.0, 5616.0])
    reddening = (colors.color[13, :, -1] - colors.color[13, :, 0]) / colors.ebv[-1]
    np.testing.assert_allclose(reddening, at[:, 0] - at[:, 1], atol=0.1)


def test_the_wrong_table_and_redshifts_outside_are_refused(library, table, vis):
    mix = plain(library, np.array([1.0]), 3)
    with pytest.raises(BadInput, match="euclid_vis"):
        reference.reference_magnitude(-20.0, [1.0], mix, vis)
    with pytest.raises(OutOfRange, match="z_obs"):
        reference.apparent_magnitude(-20.0, [6.2], plain(library, np.array([6.2]), 3), table)
    ends = plain(library, np.array([-0.02, 6.0]), 3)
    assert np.isfinite(reference.apparent_magnitude(-20.0, [0.01, 6.0], ends, table)).all()
