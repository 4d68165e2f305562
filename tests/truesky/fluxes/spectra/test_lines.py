"""Test positions, widths and fluxes of emission lines."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.tables.galaxies import GALAXIES
from truesky.fluxes.spectra import lines

LINES = lines.line_list()
HALPHA = [line.name for line in LINES].index("halpha")


def one(line: int, flux: float = 1.0) -> np.ndarray:
    fluxes = np.zeros((1, len(LINES)))
    fluxes[0, line] = flux
    return fluxes


def bins(found: lines.Profiles) -> np.ndarray:
    return found.first[:, None] + np.arange(found.f_lambda.shape[1])


@given(st.integers(0, len(LINES) - 1), st.floats(0.0, 2.6), st.floats(50.0, 400.0), st.sampled_from(["air", "vacuum"]))
def test_the_integral_is_the_flux_and_the_width_is_sigma(line, z, sigma, medium):
    # The printed exponent, with an additional 1 / (1 + z), would give sqrt(1 + z) times the flux.
    found = lines.profiles(one(line, 3e-16), np.array([z]), np.array([sigma]), medium)
    (f_lambda,), (lam,) = found.f_lambda, bins(found)
    assert f_lambda.sum() == pytest.approx(3e-16, rel=1e-12, abs=0.0)
    centre = np.sum(f_lambda * lam) / f_lambda.sum()
    wanted = float(lines.observed_wavelength(LINES[line].vacuum, z, medium))
    assert centre == pytest.approx(wanted, abs=3e-3)
    # Bins of 1 A add 1/12 A2 to the variance, nearly so for a line of one bin.
    variance = np.sum(f_lambda * (lam - centre) ** 2) / f_lambda.sum()
    assert variance == pytest.approx((sigma / 299792.458 * wanted) ** 2 + 1.0 / 12.0, rel=5e-3)


def test_the_centre_is_redshifted():
    # The printed profile is centred on the rest wavelength.
    found = lines.profiles(one(HALPHA), np.array([1.0]), np.array([100.0]), "vacuum")
    assert bins(found)[0, np.argmax(found.f_lambda[0])] == pytest.approx(2.0 * 6564.614, abs=0.5)


def test_narrow_lines_are_binned_not_sampled():
    oii = [line.name for line in LINES].index("oii")
    for z in np.linspace(0.0, 3e-4, 7):
        found = lines.profiles(one(oii), np.array([z]), np.array([50.0]), "vacuum")
        assert found.f_lambda.sum() == pytest.approx(1.0, rel=1e-6)


def test_air_wavelengths_agree_with_the_table():
    # Table of Serrano et al. 2024, from NIST.
    with (Path(lines.__file__).with_suffix(".csv")).open(newline="") as file:
        rows = list(csv.DictReader(file))
    vacuum, air = (np.array([float(row[name]) for row in rows]) for name in ("vacuum", "air"))
    np.testing.assert_allclose(lines.air_wavelength(vacuum), air, atol=0.005)


def test_air_refracts_at_the_observed_wavelength():
    observed = float(lines.observed_wavelength(3727.09, 2.0, "air"))
    assert observed == float(lines.air_wavelength(3.0 * 3727.09))
    assert abs(observed - 3.0 * float(lines.air_wavelength(3727.09))) > 0.02
    with pytest.raises(BadInput, match="water"):
        lines.observed_wavelength(3727.09, 2.0, "water")


@pytest.mark.parametrize(
    ("mag", "z", "wanted"),
    [(-20.4, 0.0, 219.0), (-18.0, 0.0, 126.0), (-22.0, 2.0, 79.0), (-10.0, 0.0, 50.0), (-29.0, 0.0, 400.0)],
)
def test_velocity_dispersions(mag, z, wanted):
    assert float(lines.velocity_dispersion(mag, z)) == pytest.approx(wanted, abs=0.5)


@given(st.floats(-1e6, 1e6), st.floats(-0.02, 15.0))
def test_velocity_dispersions_stay_within_bounds(mag, z):
    assert 50.0 <= float(lines.velocity_dispersion(mag, z)) <= 400.0


@given(st.floats(0.0, 9.9), st.floats(-30.0, 5.0), st.floats(-30.0, 5.0))
def test_brighter_galaxies_have_no_narrower_lines(z, one_mag, other_mag):
    bright, faint = lines.velocity_dispersion([min(one_mag, other_mag), max(one_mag, other_mag)], [z, z])
    assert bright >= faint


def test_doublets():
    ratios = {line.name: line.ratio for line in LINES}
    assert ratios["oii_2"] == ratios["sii_2"] == 1.0
    # Storey & Zeippen 2000; [S III] by the transition probabilities.
    expected = {"oiii_2": 1 / 2.98, "nii_2": 1 / 3.05, "siii_2": 1 / 2.47}
    assert {name: ratios[name] for name in expected} == pytest.approx(expected)
    assert len(lines.columns()) == 15
    # A column contains only the primary line. If it were the total, as the text may suggest, a doublet would sum to 1.
    totals = {column: sum(line.ratio for line in LINES if line.column == column) for column in lines.columns()}
    assert totals == pytest.approx(
        {
            **dict.fromkeys(totals, 1.0),
            "flux_oii": 2,
            "flux_oiii": 1 + 1 / 2.98,
            "flux_nii": 1 + 1 / 3.05,
            "flux_sii": 2,
            "flux_siii": 1 + 1 / 2.47,
        }
    )
    # The paper's table of lines has [S II], its catalogue does not.
    assert set(totals) <= set(GALAXIES.names)
    primaries = {line.column: line.vacuum for line in LINES[::-1]}
    assert primaries["flux_oii"] == 3727.09
    assert primaries["flux_oiii"] == 5008.239


def test_lines_that_share_a_bin_add_up():
    place = {line.name: k for k, line in enumerate(LINES)}
    fluxes = np.zeros((3, len(LINES)))
    fluxes[0, [place["halpha"], place["nii"], place["nii_2"]]] = 1.0, 2.0, 4.0
    fluxes[2, [place["halpha"], place["sii"]]] = np.nan, 8.0
    found = lines.profiles(fluxes, np.array([0.1, 0.1, 0.3]), np.array([400.0, 400.0, 100.0]), "vacuum")
    assert found.row.tolist() == [0, 0, 0, 2]
    spectra = lines.add(np.zeros((3, 4000)), 6000, found)
    np.testing.assert_allclose(spectra.sum(1), [7.0, 0.0, 8.0], rtol=1e-6)


def test_lines_at_the_edge_of_the_grid_are_cut_not_moved():
    found = lines.profiles(one(HALPHA), np.array([0.0]), np.array([100.0]), "vacuum")
    right = lines.add(np.zeros((1, 100)), 6565, found)
    left = lines.add(np.zeros((1, 100)), 6465, found)
    assert right.sum() + left.sum() == pytest.approx(1.0, rel=1e-6)
    assert 0.3 < left.sum() < 0.7
    assert lines.add(np.zeros((1, 100)), 8000, found).sum() == 0.0


def test_lines_outside_the_range_are_omitted():
    fluxes = np.ones((1, len(LINES)))
    found = lines.profiles(fluxes, np.array([0.5]), np.array([100.0]), "vacuum", 9000.0, 12000.0)
    # H alpha 9847, the two [N II], the two [S II].
    assert len(found.row) == 5
    assert lines.profiles(fluxes, np.array([0.5]), np.array([100.0]), "vacuum", 1e5).f_lambda.size == 0


def test_a_grism_sees_a_line_at_every_redshift():
    """For any z < 3 some line is in 0.95 to 2.0 um, so slitless spectra of emitters are never empty."""
    z = np.arange(0.0, 3.0, 0.01)[:, None]
    seen = np.array([line.vacuum for line in LINES]) * (1.0 + z)
    assert ((seen > 9500.0) & (seen < 20_000.0)).any(1).all()
