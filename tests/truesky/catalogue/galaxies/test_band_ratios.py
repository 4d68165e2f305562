"""Ratios of fluxes in other bands to the reference band: published K-corrections, and integration."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.galaxies import band_ratios
from truesky.fluxes import passbands
from truesky.fluxes.libraries import rest_grid, templates
from truesky.fluxes.spectra import extinction

MAG = -2.5 / np.log(10.0)


@pytest.fixture(scope="module")
def vis(library):
    return band_ratios.load(library, "euclid_vis", 2.3, 0.5)


@pytest.fixture(scope="module")
def reference(library):
    return band_ratios.load(library, "sdss_r01", 2.3, 0.5)


def clean(table, template, z):
    at = (np.array([value], dtype) for value, dtype in ((z, float), (template, int), (0, int), (0.0, float)))
    return MAG * float(band_ratios.ln_ratio(table, *at)[0])


# K-corrections and m_IE - M_r - DM at z = 0.1, 0.5, 1, 2, computed once with an independent program from the four
# observed spectra including their lines.
K_CORRECTIONS = {
    "sdss_r01": {0: (0.16, 1.60, 3.29, 5.06), 13: (0.005, 0.54, 1.17, 1.12), 25: (-0.14, -0.42, -0.75, -1.31)},
    "euclid_vis": {0: (-0.43, 0.07, 1.15, 3.63), 13: (-0.27, -0.17, 0.29, 0.91), 25: (-0.15, -0.46, -0.73, -1.25)},
}


@pytest.fixture(scope="module")
def with_lines():
    """Return the library whose observed spectra keep their weak lines."""
    wavelength = rest_grid.rest_grid()
    flux = templates.galaxy_spectra(wavelength, bridge_width=-1.0)[[0, 13, 25]].astype(np.float32)
    return templates.Library(wavelength, flux, ("0", "13", "25"))


@pytest.mark.parametrize("band", K_CORRECTIONS)
def test_k_corrections(with_lines, band):
    table = band_ratios.build(with_lines, band, 2.3, 0.5)
    for k, published in enumerate(K_CORRECTIONS[band].values()):
        assert [clean(table, k, z) for z in (0.1, 0.5, 1.0, 2.0)] == pytest.approx(published, abs=0.007)


@pytest.mark.parametrize("band", K_CORRECTIONS)
def test_k_corrections_without_lines(library, band):
    """Library without lines: removing [O III], which is in 0.1r, makes blue templates 0.02 mag fainter there."""
    table = band_ratios.load(library, band, 2.3, 0.5)
    for template, published in K_CORRECTIONS[band].items():
        k = [clean(table, template, z) for z in (0.1, 0.5, 1.0, 2.0)]
        assert k == pytest.approx(published, abs=0.02 if template == 25 else 0.01)


@pytest.mark.parametrize("template", [0, 13, 30])
def test_a_galaxy_at_z_01_in_sdss_r_is_seen_in_its_reference_band(library, template):
    """0.1r is SDSS r blue-shifted to z = 0.1: m_r = M_r + DM - 2.5 log10(1.1), whatever the spectrum.

    Ref: Blanton et al. 2003
    """
    flux = library.flux[template].astype(float)
    seen = band_ratios.band_weights(library, "sdss_r", 0.1) @ flux
    rest = band_ratios.band_weights(library, "sdss_r01", 0.0) @ flux
    assert -2.5 * np.log10(seen / rest) == pytest.approx(-2.5 * np.log10(1.1), abs=1e-3)


@pytest.mark.parametrize(
    ("band", "dustiest"), [("euclid_vis", 0.5), ("sdss_r01", 0.5), ("lsst_u", 0.5), ("euclid_vis", 3.0)]
)
def test_table_against_integration_of_the_dusty_redshifted_spectrum(library, band, dustiest, rng):
    """In the ultraviolet, and behind as much dust as a training table may have, too."""
    table = band_ratios.load(library, band, 2.3, dustiest)
    n = 60
    z, ebv = rng.uniform(0.0, 2.3, n), rng.uniform(0.0, dustiest, n)
    template, law = rng.integers(0, 31, n), rng.integers(0, 5, n)
    k = extinction.laws(library.wavelength)
    curve, rest = passbands.load(band), passbands.load("sdss_r01")
    expected = []
    for i in range(n):
        dusty = library.flux[template[i]] * 10.0 ** (-0.4 * k[law[i]] * ebv[i])
        seen = passbands.ab_flux(curve, library.wavelength * (1.0 + z[i]), dusty / (1.0 + z[i]))
        expected.append(-2.5 * np.log10(seen / passbands.ab_flux(rest, library.wavelength, dusty)))
    assert MAG * band_ratios.ln_ratio(table, z, template, law, ebv) == pytest.approx(expected, abs=5e-4)


@given(st.floats(0.0, 2.3), st.integers(1, 30), st.floats(0.0, 1.0), st.integers(0, 4), st.floats(0.0, 0.5))
def test_no_spectrum_is_brighter_than_the_brightest(vis, z, template, share, law, ebv):
    nodes, brightest = band_ratios.brightest_offset(vis)
    one = np.ones(1)
    early, late = template * one.astype(int) - 1, template * one.astype(int)
    sed = band_ratios.Sed(late, one - share, early, share * one, law * one.astype(int), ebv * one)
    assert band_ratios.offset(vis, z * one, sed)[0] > np.interp(z, nodes, brightest) - 1e-3


@given(st.floats(0.0, 0.5))
def test_weights_of_the_nodes_reproduce_a_quartic(ebv):
    nodes = np.array([0.0, 0.07, 0.25, 0.43, 0.5])
    weights = band_ratios.ebv_weights(nodes, np.array([ebv]))[0]
    assert weights @ np.polyval([3.0, -1.0, 2.0, 1.0, 0.5], nodes) == pytest.approx(
        np.polyval([3.0, -1.0, 2.0, 1.0, 0.5], ebv), abs=1e-12
    )


@pytest.mark.parametrize("band", ["euclid_vis", "lsst_g"])
def test_the_compiled_reading_is_that_of_arrays(library, band, rng):
    """Five nodes of E(B-V) and more, redshifts at nodes, at 0 and behind the last."""
    table, n = band_ratios.load(library, band, 3.0, 0.5), 2000
    z, template, law = 3.2 * rng.random(n), rng.integers(0, 31, n), rng.integers(0, 5, n)
    z[:2], ebv = (0.0, np.expm1(0.005 * 7)), 0.5 * rng.random(n)
    ebv[5:9] = table.ebv[:4]
    step = np.log1p(z) / 0.005
    row = np.minimum(step.astype(int), table.values.shape[0] - 2)
    part, curve = (step - row)[:, None], np.maximum(law, 1) - 1
    nodes = (1.0 - part) * table.values[row, curve, template] + part * table.values[row + 1, curve, template]
    expected = np.sum(nodes * band_ratios.ebv_weights(table.ebv, np.where(law > 0, ebv, 0.0)), axis=1)
    assert band_ratios.ln_ratio(table, z, template, law, ebv) == pytest.approx(expected, abs=1e-9)
    # Whole columns of a table, and one of them alone.
    found = band_ratios.ln_ratio(table, z.astype(np.float32), template.astype(np.int16), law.astype(np.int8), ebv)
    alone = band_ratios.ln_ratio(table, z[3:4].astype(np.float32), template[3:4], law[3:4], ebv[3:4])
    assert found[3] == alone[0]


def test_law_0_has_no_dust_whatever_its_excess(vis):
    z, template = np.array([0.7]), np.array([20])
    dustless = band_ratios.ln_ratio(vis, z, template, np.array([0]), np.array([0.4]))
    assert dustless == band_ratios.ln_ratio(vis, z, template, np.array([2]), np.array([0.0]))
    assert dustless != band_ratios.ln_ratio(vis, z, template, np.array([2]), np.array([0.4]))


def test_the_cache_returns_what_was_built(library):
    built = band_ratios.build(library, "sdss_g01", 0.0, 0.5)
    loaded = band_ratios.load(library, "sdss_g01", 0.0, 0.5)
    assert np.array_equal(built.values, loaded.values)
    assert np.array_equal(built.ebv, loaded.ebv)


@pytest.fixture(scope="module")
def rest_gr(library):
    return band_ratios.load(library, "sdss_g01", 0.0, 0.5)


def test_templates_grow_bluer_along_the_library_for_every_dust(rest_gr):
    assert np.diff(rest_gr.values[0], axis=1).min() > 0.01


def test_spectra_have_the_wanted_colours(rest_gr, rng):
    n = 5000
    wanted, law, ebv = rng.uniform(-0.2, 1.01, n), rng.integers(0, 5, n), rng.uniform(0.0, 0.5, n)
    spectra = band_ratios.sed_of_colour(rest_gr, wanted, law, ebv)
    realised = band_ratios.colours(rest_gr, spectra)
    inside = (spectra.frac_1 > 0) & (spectra.frac_1 < 1)
    assert inside.mean() > 0.5
    assert realised[inside] == pytest.approx(wanted[inside], abs=1e-6)
    # Where dust leaves none, the end of the library: the bluest for colours too blue.
    too_blue = realised > wanted + 1e-5
    assert np.all((spectra.template_1 == 30)[too_blue] & (spectra.frac_1 == 1)[too_blue])
    too_red = realised < wanted - 1e-5
    assert np.all((spectra.template_2 == 0)[too_red] & (spectra.frac_2 == 1)[too_red])


@given(st.floats(-0.5, 1.5), st.integers(0, 4), st.floats(0.0, 0.5))
def test_every_spectrum_is_two_neighbours_with_shares(rest_gr, colour, law, ebv):
    spectrum = band_ratios.sed_of_colour(rest_gr, np.array([colour]), np.array([law]), np.array([ebv]))
    assert 1 <= spectrum.template_1[0] <= 30
    assert spectrum.template_2[0] == spectrum.template_1[0] - 1
    assert 0.0 <= spectrum.frac_1[0] <= 1.0
    assert spectrum.frac_1[0] + spectrum.frac_2[0] == pytest.approx(1.0)
