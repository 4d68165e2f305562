"""Test normalisation, colours and origins of the built-in libraries."""

import numpy as np
import pytest

from lake_schema import units
from truesky.fluxes import passbands
from truesky.fluxes.libraries import brown_dwarfs, stellar, templates
from truesky.fluxes.libraries import vega as libraries_vega
from truesky.fluxes.libraries.vega import spectrum_file
from truesky.numerics import cache


def magnitudes(name, wavelength, flux):
    band = passbands.load(name)
    return units.mag_of_f_nu(units.ujy_of_cgs(1e-20 * passbands.ab_flux(band, wavelength, flux)))


def color(blue, red, wavelength, flux):
    return magnitudes(blue, wavelength, flux) - magnitudes(red, wavelength, flux)


def test_galaxies_cover_all_that_is_observed(library):
    # 600 A at z = 2.3 is 182 A in the rest frame.
    assert library.wavelength[0] <= 182.0
    assert library.wavelength[-1] >= 24000.0
    np.testing.assert_array_equal(np.diff(library.wavelength), 1.0)
    assert library.flux.shape == (31, len(library.wavelength)) == (len(library), len(library.wavelength))
    assert np.isfinite(library.flux).all()
    assert (library.flux >= 0.0).all()
    assert (library.flux[:, library.wavelength >= 182.0] > 0.0).all()


def test_a_template_is_named_after_what_it_is_mixed_of(library):
    named = tuple(f"{k:02d} " + "-".join(templates.template_anchors(k)) for k in range(len(library)))
    assert library.names == named


def test_every_spectrum_is_normalised(library, stars_library):
    for each in (library, stars_library):
        inside = (each.wavelength >= 5450.0) & (each.wavelength <= 5550.0)
        np.testing.assert_allclose(each.flux[:, inside].mean(1), 1.0, rtol=1e-5)


def test_colours_run_from_early_to_late(library):
    gr = color("sdss_g01", "sdss_r01", library.wavelength, library.flux)
    assert (np.diff(gr) < 0.0).all()
    np.testing.assert_allclose(gr[[0, 8, 13, 19, 25, 30]], [1.02, 0.60, 0.49, 0.27, -0.02, -0.22], atol=0.01)
    ur = color("sdss_u", "sdss_r", library.wavelength, library.flux)
    np.testing.assert_allclose(ur[[0, 8, 13, 25, 30]], [2.55, 1.58, 1.30, 0.06, -0.38], atol=0.02)


def test_anchors_are_in_the_sequence(library):
    # 13 is Scd and 19 is Im, as published, away from their masked lines.
    for k, name in ((13, "Scd"), (19, "Im")):
        at, flux = np.loadtxt(spectrum_file(f"CWW_{name}_ext.sed").read_text().splitlines()).T
        clean = (at > 200.0) & (np.abs(at[:, None] - templates.emission_wavelengths()) > 100.0).all(1)
        seen = library.flux[k][(at[clean] - library.wavelength[0]).astype(int)]
        np.testing.assert_allclose(seen / flux[clean], np.median(seen / flux[clean]), rtol=0.05)


def test_no_lines_are_left_in_the_continua(library):
    assert {6564.614, 5008.239} <= set(np.round(templates.emission_wavelengths(), 3))
    for centre in templates.emission_wavelengths():
        low = int(centre - 30.0 - library.wavelength[0])
        # Only templates from observed spectra; later templates contain the smooth burst.
        window = library.flux[:20, low : low + 61].astype(float)
        straight = np.linspace(window[:, 0], window[:, -1], 61, axis=1)
        assert np.abs(window / straight - 1.0).max() < 1e-5


def test_red_tail_and_lyman_edge(library):
    at = library.wavelength
    tail = library.flux[0, at == 24000.0] / library.flux[0, at == 23000.0]
    assert tail[0] == pytest.approx((24.0 / 23.0) ** -3.2, rel=1e-5)
    assert library.flux[30, at == 911.0] < 0.05 * library.flux[30, at == 913.0]


def test_library_is_computed_once(library, monkeypatch):
    """The library is computed once for all processes, and loaded once per process."""
    assert templates.galaxy_library() is library
    monkeypatch.setattr(templates, "galaxy_spectra", lambda *_: pytest.fail("made again"))
    again = templates.galaxy_library.__wrapped__()
    np.testing.assert_array_equal(again.flux, library.flux)
    assert not again.flux.flags.writeable


def test_a_new_recipe_is_a_new_key(monkeypatch, tmp_path):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path))
    templates.galaxy_library.__wrapped__()
    monkeypatch.setattr(templates, "emission_wavelengths", lambda: np.array([5000.0]))
    templates.galaxy_library.__wrapped__()
    assert len(list(cache.cache_dir().glob("galaxy_library-*"))) == 2


def test_planck_follows_plancks_law():
    from astropy import units as u
    from astropy.modeling.models import BlackBody

    lam = np.geomspace(600.0, 24000.0, 50)
    for temperature in (2380.0, 5770.0, 33300.0):
        oracle = BlackBody(temperature * u.K)
        wanted = oracle(lam * u.AA).value / lam**2 / (oracle(5500.0 * u.AA).value / 5500.0**2)
        np.testing.assert_allclose(stellar.planck(lam, temperature), wanted, rtol=1e-6)


def test_stars_are_the_dwarf_sequence(stars_library):
    types = stars_library.types
    assert stars_library.names[0] == "O9V"
    assert stars_library.names[: len(types.names)] == types.names
    assert types.names[-1] == "M9V"
    assert (np.diff(types.teff) < 0.0).all()
    for values in (
        types.log_g,
        types.mass,
        types.abs_mag_v,
        types.abs_mag_j,
        types.abs_mag_h,
        types.abs_mag_ks,
    ):
        assert np.isfinite(values).all()
    g2 = stars_library.names.index("G2V")
    # Pecaut & Mamajek 2013: the Sun's type.
    assert types.teff[g2] == 5770.0
    assert types.mass[g2] == 1.0
    assert types.log_g[g2] == pytest.approx(4.44, abs=0.02)
    assert types.color_bv[g2] == 0.650
    assert types.abs_mag_h[g2] == pytest.approx(3.309)
    assert types.abs_mag_v[g2] - types.abs_mag_ks[g2] == pytest.approx(1.564, abs=0.001)


def test_stars_have_the_tables_colours(stars_library):
    names = (
        "bessell_u",
        "bessell_b",
        "bessell_v",
        "bessell_r",
        "bessell_i",
        "twomass_j",
        "twomass_h",
        "twomass_ks",
    )
    vega = np.array([magnitudes(name, *libraries_vega.vega()) for name in names])
    mags = np.stack([magnitudes(name, stars_library.wavelength, stars_library.flux[:76]) for name in names], 1) - vega
    error = mags - mags[:, 2:3] - stars_library.types.colors
    assert np.nanmax(np.abs(error)) < 1e-6
    assert np.isfinite(error).sum() > 590


def test_the_suns_colours(stars_library):
    # Willmer 2018, AB: g - r 0.46, r - i 0.12, i - z 0.03 in SDSS; nothing in the library was fitted to them.
    sun = stars_library.flux[stars_library.names.index("G2V")]
    for blue, red, wanted in (
        ("sdss_g", "sdss_r", 0.46),
        ("sdss_r", "sdss_i", 0.12),
        ("sdss_i", "sdss_z", 0.03),
    ):
        assert float(color(blue, red, stars_library.wavelength, sun)) == pytest.approx(wanted, abs=0.03)
    # CALSPEC's Sun in the bands of Euclid.
    for blue, red, wanted in (
        ("euclid_vis", "euclid_y", 0.05),
        ("euclid_y", "euclid_j", -0.06),
        ("euclid_j", "euclid_h", -0.21),
    ):
        assert float(color(blue, red, stars_library.wavelength, sun)) == pytest.approx(wanted, abs=0.09)


@pytest.mark.parametrize(("name", "wanted"), [("twomass_j", 0.90), ("twomass_h", 1.37), ("twomass_ks", 1.85)])
def test_vega_is_not_ab(name, wanted):
    assert float(magnitudes(name, *libraries_vega.vega())) - 50.0 == pytest.approx(wanted, abs=0.03)


def test_vega_reaches_over_ks():
    wavelength, flux = libraries_vega.vega()
    assert wavelength[-1] >= 24000.0
    assert (np.diff(wavelength) > 0.0).all()
    # Bohlin & Gilliland 2004: 3.44e-9 erg s-1 cm-2 A-1 at 5556 A.
    assert np.interp(5556.0, wavelength, flux) == pytest.approx(3.44e-9, rel=0.01)


def test_brown_dwarfs_have_their_colours(stars_library):
    types = brown_dwarfs.subtypes()
    assert types.names == tuple(f"L{k}" for k in range(10)) + tuple(f"T{k}" for k in range(9))
    names = np.array(stars_library.names)
    found = np.array([name.partition("-")[0] in types.names for name in names])
    assert np.flatnonzero(found).tolist() == list(range(76, 441))
    flux, which = stars_library.flux[found], [types.names.index(name.partition("-")[0]) for name in names[found]]
    mean = np.array([name.endswith("-00") for name in names[found]])
    for blue, red, zero, column in (("sdss_i", "sdss_z", 0.0, "i-z"), ("twomass_j", "twomass_h", 0.47, "J-H")):
        published = np.array([v for n, v in zip(*_published(column), strict=True) if "." not in n])[which]
        got = color(blue, red, stars_library.wavelength, flux) + zero
        np.testing.assert_allclose(got[mean], published[mean], atol=0.02)
        if column == "J-H":
            scatter = (got - published)[~mean]
            assert scatter.std() == pytest.approx(0.07, rel=0.15)
            assert scatter.mean() == pytest.approx(0.0, abs=0.02)


def _published(column):
    names, columns = stellar.table("L0V", "T8V")
    return names, columns[column]


def test_standards(stars_library):
    names = stars_library.names
    assert names[441:444] == ("Vega", "white dwarf DA", "planetary nebula")
    vega, dwarf, nebula = stars_library.flux[441:444].astype(float)
    wavelength = stars_library.wavelength
    for band, zero in (("twomass_j", 0.90), ("twomass_h", 1.37)):
        # V is almost AB.
        assert float(color(band, "bessell_v", wavelength, vega)) == pytest.approx(zero, abs=0.06)
    # Hotter than any star of the sequence but the first, with Balmer lines.
    assert float(color("sdss_u", "sdss_r", wavelength, dwarf)) < -0.7
    assert dwarf[6563 - 600] < 0.7 * dwarf[6500 - 600]
    # [O III] 5008 : 4960 : H beta = 10 : 3.35 : 1 over the continuum.
    level = nebula[6200 - 600]
    sums = [np.sum(nebula[at - 610 : at - 590] - level) for at in (5008, 4960, 4863)]
    np.testing.assert_allclose(sums / sums[2], [10.0, 3.35, 1.0], rtol=1e-3)
