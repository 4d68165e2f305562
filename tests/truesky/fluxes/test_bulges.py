"""Test the colours of bulges and discs: bulges are redder by the requested amount, within the range of templates."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.fluxes import band_fluxes, bulges, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table
from truesky.fluxes.spectra import continuum

LIBRARY = templates.galaxy_library()
VIS, H = (passbands.load(name) for name in ("euclid_vis", "euclid_h"))
OWN = bulges.colour_sequence(LIBRARY)


def rows(share=0.3, colour=0.2, z=0.5, sed=14.0, kind=0):
    """Return rows between neighbouring templates; arguments are numbers or arrays."""
    share, colour, z, sed, kind = np.broadcast_arrays(*np.atleast_1d(share, colour, z, sed, kind))
    first = np.minimum(sed.astype(int), len(LIBRARY) - 2)
    return pa.table(
        {
            "kind": kind.astype(np.int8),
            "bulge_fraction": share.astype(float),
            "bulge_color": colour.astype(float),
            "z_obs": z.astype(float),
            "sed_1": first.astype(np.int16),
            "sed_2": (first + 1).astype(np.int16),
            "frac_1": 1.0 - (sed - first),
            "frac_2": sed - first,
        }
    )


def share_of(table, band):
    return bulges.with_fractions_in_band(table, band, LIBRARY)["bulge_fraction"].to_numpy()


def odds(share):
    return share / (1.0 - share)


def test_the_colour_is_that_of_the_column():
    """Compare bulge over disc in 0.1g and in 0.1r at rest; the fraction refers to r."""
    table = rows(share=[0.05, 0.3, 0.9], sed=[6.0, 14.4, 28.0], z=0.0)
    blue, red = (share_of(table, passbands.load(f"sdss_{band}01")) for band in "gr")
    np.testing.assert_allclose(red, [0.05, 0.3, 0.9], atol=1e-5)
    np.testing.assert_allclose(-2.5 * np.log10(odds(blue) / odds(red)), 0.2, atol=0.004)


def test_the_reddest_galaxies_have_one_colour():
    reddest = int(OWN.template[-1])
    np.testing.assert_allclose(share_of(rows(sed=float(reddest)), H), 0.3, rtol=1e-12)
    near = share_of(rows(sed=reddest + 0.01), H)
    np.testing.assert_allclose(near, 0.3, atol=1e-3)


@pytest.mark.parametrize("known", [{"colour": np.nan}, {"colour": 0.0}, {"kind": 2}, {"share": 1.0}, {"share": 0.0}])
def test_rows_without_a_colour_are_unchanged(known):
    table = rows(**known)
    assert bulges.with_fractions_in_band(table, VIS, LIBRARY) is table
    assert (
        bulges.with_fractions_in_band(table.drop_columns(["bulge_color"]), VIS, LIBRARY).num_columns
        == table.num_columns - 1
    )
    missing = table.set_column(2, "bulge_color", pa.nulls(1, pa.float32()))
    assert bulges.with_fractions_in_band(missing, VIS, LIBRARY) is missing


@pytest.mark.parametrize("band", ["lsst_u", "euclid_vis", "euclid_y", "euclid_h"])
@pytest.mark.parametrize("ebv", [0.0, 0.4])
def test_against_whole_spectra(galaxies, band, ebv):
    """Compare with spectra of two templates whose colours differ by the requested amount, with equal light in 0.1r."""
    passband, z, dust = passbands.load(band), np.array([0.01, 0.2, 0.7, 1.4, 2.2, 4.0]), continuum.dust_curves(LIBRARY)
    known = {f"{name}_{k}": value for k in (1, 2) for name, value in (("ebv", ebv), ("ext_law", 2))}
    light, first, count = [], int(passband.wavelength[0]), len(passband.wavelength)
    for sed in (18, 12):
        mix = galaxies_from_table(galaxies(z.size, **known, sed_1=sed, sed_2=sed, z_obs=z, a_v=0.0), LIBRARY).mix
        amplitude = continuum.amplitudes(mix, passbands.load(continuum.REFERENCE_BAND), LIBRARY, dust)
        spectra = continuum.observed_shape(mix, amplitude / amplitude.sum(), LIBRARY, dust, first, count)
        light.append(spectra.astype(float) @ passbands.weights(passband) * amplitude.sum())
    redness = OWN.colour[OWN.rank[12]] - OWN.colour[OWN.rank[18]]
    found = odds(share_of(rows(colour=redness, z=z, sed=18.0), passband)) / odds(0.3)
    # Dust changes the distribution of light within the band.
    np.testing.assert_allclose(found, light[1] / light[0], rtol=0.005 if ebv == 0.0 else 0.05)


@given(st.floats(0.0, 1.0), st.floats(-0.5, 0.5), st.floats(-0.02, 6.0), st.floats(0.0, 30.0))
def test_a_share_is_one_and_continuous(share, colour, z, sed):
    here, nearer, redder = (
        share_of(rows(share, colour, np.clip(z + dz, -0.02, 6.0), np.clip(sed + ds, 0.0, 30.0)), VIS)[0]
        for dz, ds in ((0.0, 0.0), (2e-4, 0.0), (0.0, 2e-4))
    )
    assert 0.0 <= here <= 1.0
    assert nearer == pytest.approx(here, abs=2e-3)
    assert redder == pytest.approx(here, abs=2e-3)


def test_a_redder_bulge_has_more_of_the_infrared_and_less_of_the_blue():
    table = rows(sed=np.linspace(2.0, 30.0, 57), z=0.3)
    blue, vis, infrared = (share_of(table, band) for band in (passbands.load("lsst_u"), VIS, H))
    assert (blue < vis).all()
    assert (vis < infrared).all()


def test_bins_are_narrow_bands():
    grid = LIBRARY.wavelength
    flux = np.array([LIBRARY.flux[:, abs(grid - at) <= 300].mean(1) for at in (3500, 6000, 15000)], float).T
    found = bulges.fractions_in_bins(rows(sed=[5.0, 20.5], z=1.0), flux, LIBRARY)
    for column, at in enumerate((3500, 6000, 15000)):
        seen = np.arange(at - 300, at + 301, dtype=float)
        band = passbands.Passband("narrow", seen, 1.0 / seen, "vacuum")
        np.testing.assert_allclose(share_of(rows(sed=[5.0, 20.5], z=0.0), band), found[:, column], atol=5e-4)


def test_fluxes_do_not_depend_on_bulges(galaxies):
    table = galaxies(20)
    other = table.append_column("bulge_color", pa.array(np.full(20, 0.4, np.float32)))
    first, second = (band_fluxes.galaxy_fluxes(one, ["euclid_vis"], LIBRARY) for one in (table, other))
    assert first.equals(second)


def test_a_library_of_one_spectrum_has_one_colour():
    alone = replace(LIBRARY, flux=LIBRARY.flux[:1], names=LIBRARY.names[:1])
    table = rows()
    assert bulges.with_fractions_in_band(table, VIS, alone) is table
