"""Fluxes that agree with the spectra of their galaxies, and fluxes that do not."""

import numpy as np
import pytest

from lake_schema.tables.galaxies import GALAXIES
from tests.truesky.validation.lake.catalogues import mocks
from tests.truesky.validation.lake.catalogues.test_faults import Version
from tests.universe import rows_of
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import band_fluxes
from truesky.fluxes.libraries import templates
from truesky.validation.lake.catalogues import colours
from truesky.validation.model import observed
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS

BANDS = ("euclid_vis", "lsst_g", "lsst_r", "lsst_i")
N = 600


@pytest.fixture(scope="module")
def tables():
    """Columns of magnified galaxies behind dust, and their fluxes by integration over spectra, in another order."""
    rng = np.random.default_rng(3)
    library = templates.galaxy_library()
    like = rows_of(GALAXIES, N)
    columns = {name: like[name].to_numpy() for name in like.column_names}
    index, ra, dec = mocks.scattered(rng, 2 * N)
    columns |= {"_healpix_29": index[:N], "ra": ra[:N], "dec": dec[:N]}
    columns |= {name: np.zeros(N, np.float32) for name in columns if name.startswith("flux_")}
    z, m_r = rng.uniform(0.1, 1.4, N), np.full(N, -21.0)
    columns |= {
        "kind": np.zeros(N, np.int8), "z_true": z, "z_obs": z, "abs_mag_r01": m_r, "mag_r01": np.full(N, 22.0),
        "sed_1": rng.integers(0, 30, N), "frac_1": np.full(N, 0.6), "frac_2": np.full(N, 0.4),
        "ext_law_1": np.full(N, 2), "ext_law_2": np.full(N, 2), "ebv_1": np.full(N, 0.1), "ebv_2": np.full(N, 0.1),
        "a_v": np.full(N, 0.1), "kappa": rng.normal(0.02, 0.02, N), "gamma1": rng.normal(0, 0.02, N),
        "gamma2": rng.normal(0, 0.02, N), "color_gr_01": np.full(N, 0.5),
    }  # fmt: skip
    columns["sed_2"] = np.minimum(columns["sed_1"] + 1, 30)
    columns["mag_r01"] = observed.apparent_magnitudes(columns, "sdss_r01", FIDUCIAL)
    found = band_fluxes.fluxes_with_settings(
        GALAXIES.build(columns), band_fluxes._load_passbands(BANDS), [None] * len(BANDS), library
    )
    order = rng.permutation(N)
    return columns, {name: found[name].to_numpy()[order] for name in ("id", *(f"f_nu_{band}" for band in BANDS))}


@pytest.fixture(autouse=True)
def all_of_them(monkeypatch):
    monkeypatch.setattr(colours, "_MAX_MAG", 40.0)


def verdicts(galaxies, fluxes):
    result = colours.measure(Version("galaxies", galaxies, mocks.CELLS), Version("galaxy_fluxes", fluxes))
    return {row.quantity: row.verdict for row in result.rows}, result


def test_fluxes_of_their_own_spectra_pass(tables):
    found, result = verdicts(*tables)
    assert {name: found[name] for name in found if name.startswith("flux_")} == {f"flux_{b}": PASS for b in BANDS}
    assert [abs(row.value) < 0.012 for row in result.rows[: len(BANDS)]] == [True] * len(BANDS)
    assert result.series["colour_colour"].sum() > 0.8 * N


@pytest.mark.parametrize("band", BANDS)
def test_a_band_whose_flux_is_shifted(tables, band):
    galaxies, fluxes = tables
    found, _ = verdicts(galaxies, fluxes | {f"f_nu_{band}": fluxes[f"f_nu_{band}"] * 10 ** (-0.4 * 0.1)})
    assert {name for name, verdict in found.items() if verdict == FAIL} == {f"flux_{band}"}


def test_a_band_without_light(tables):
    galaxies, fluxes = tables
    found, _ = verdicts(galaxies, fluxes | {"f_nu_lsst_i": np.zeros(N)})
    assert {name for name, verdict in found.items() if verdict == FAIL} == {"flux_lsst_i"}


def test_colours_quoted_from_memory_are_undecided(tables):
    galaxies, fluxes = tables
    red = galaxies | {"color_gr_01": np.full(N, 1.0), "z_true": np.full(N, 0.2)}
    found, result = verdicts(red, fluxes)
    assert (found["c_perp_z0.2"], found["c_perp_z0.3"]) == ("undecided", NOT_APPLICABLE)
    assert "quoted from memory" in next(row.note for row in result.rows if row.quantity == "c_perp_z0.2")


def test_missing_colours_are_not_applicable(tables):
    galaxies, fluxes = tables
    for many in (0, 1):
        few = {name: values[:many] for name, values in galaxies.items()}
        assert set(verdicts(few, fluxes)[0].values()) == {NOT_APPLICABLE}
    assert set(verdicts(galaxies, {"id": fluxes["id"]})[0].values()) == {NOT_APPLICABLE}
    other = {name: values[:5] for name, values in fluxes.items()}
    assert "lacks galaxies" in verdicts(galaxies, other)[1].rows[0].note
    assert set(verdicts({"id": galaxies["id"]}, fluxes)[0].values()) == {NOT_APPLICABLE}
