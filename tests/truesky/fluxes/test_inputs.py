"""Test the lake tables of inputs: origins of the rows, and user files."""

import hashlib

import numpy as np
import pyarrow.compute as pc
import pytest

from lake_schema.errors import BadInput
from lake_schema.store.validate import check_rows
from lake_schema.tables.galaxies import EMISSION_LINES
from lake_schema.tables.passbands import PASSBANDS
from lake_schema.tables.templates import EXTINCTION_LAWS, TEMPLATES
from tests.truesky.fluxes.libraries.test_from_files import BAND, FLUX, RESPONSE, WAVELENGTH, ascii_file, votable
from truesky.fluxes import inputs, passbands, sources
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.vega import spectrum_file, vega_magnitudes
from truesky.fluxes.spectra import continuum, lines
from truesky.request.files import Curves, UserCurves


@pytest.fixture(scope="module")
def embedded():
    return inputs.read(UserCurves())


def own(tmp_path, **changes):
    """Return two galaxies, a filter and a law, all synthetic."""
    slope = (WAVELENGTH / 5500.0) ** -1.0
    files = tuple(ascii_file(tmp_path / f"{name}.sed", value=flux) for name, flux in (("early", FLUX), ("late", slope)))
    mine = ascii_file(tmp_path / "mine.dat", BAND, RESPONSE)
    law = ascii_file(tmp_path / "law.dat", value=4.05 * 5500.0 / WAVELENGTH)
    wanted = {
        "passbands": (("mine", Curves((mine,), "passband_ascii", "air")),),
        "templates": Curves(files, "cosmos"),
        "extinction": ((3, Curves((law,), "extinction")),),
    }
    return UserCurves(**(wanted | changes))


def test_embedded_templates_say_where_they_are_from(embedded):
    rows = inputs.template_rows(embedded)
    check_rows(rows, TEMPLATES)
    assert rows.num_rows == 31 + 9 + 15 + 768
    vega = next(row for row in rows.select(["name", "source", "sha256"]).to_pylist() if row["name"] == "Vega")
    assert vega["source"].startswith("vega.txt")
    assert vega["sha256"] == hashlib.sha256(spectrum_file("vega.txt").read_bytes()).hexdigest()
    galaxies = rows.filter(np.array([name == "galaxy" for name in rows["library"].to_pylist()]))
    assert [galaxies["source"][k].as_py().partition(":")[0] for k in (0, 13, 30)] == [
        "CWW_E_ext.sed, CWW_Sbc_ext.sed", "CWW_Sbc_ext.sed, CWW_Scd_ext.sed", "CWW_Im_ext.sed, templates.py",
    ]  # fmt: skip
    np.testing.assert_array_equal(np.array(galaxies["flux"][7].as_py(), np.float32), embedded.library.flux[7])


def test_embedded_passbands_and_laws_say_where_they_are_from(embedded):
    rows = inputs.passband_rows(embedded)
    check_rows(rows, PASSBANDS)
    assert rows["name"].to_pylist() == list(passbands.names())
    by_name = {row["name"]: row for row in rows.to_pylist()}
    assert by_name["euclid_vis"]["source"].startswith("Euclid-VIS.ecsv")
    assert by_name["jedis_g"]["source"].startswith("passbands.csv: logistic:")
    assert len({row["sha256"] for row in by_name.values()}) > 30
    laws = inputs.law_rows(embedded)
    check_rows(laws, EXTINCTION_LAWS)
    np.testing.assert_array_equal(np.stack(laws["k"].to_numpy()), continuum.dust_curves(embedded.library))


def test_vegas_level_is_that_of_the_published_spectrum_and_responses(embedded):
    """Compute AB magnitudes of Vega from two tables of a lake; all bands give the same level of the spectrum."""
    spectra = inputs.template_rows(embedded)
    vega = spectra.filter(pc.equal(spectra["name"], "Vega")).to_pylist()[0]
    at = vega["first_wavelength"] + vega["wavelength_step"] * np.arange(len(vega["flux"]))

    def level(row):
        wavelength = row["first_wavelength"] + row["wavelength_step"] * np.arange(len(row["response"]))
        response = np.array(row["response"])
        photons = np.sum(np.interp(wavelength, at, vega["flux"]) * response * wavelength)
        return 10.0 ** (-0.4 * (row["ab_minus_vega"] + 48.6)) * 2.99792458e18 * np.sum(response / wavelength) / photons

    rows = [row for row in inputs.passband_rows(embedded).to_pylist() if row["ab_minus_vega"] is not None]
    assert len(rows) > 40
    # CALSPEC: 3.44e-9 erg s-1 cm-2 A-1 at 5556 A.
    levels = np.array([level(row) for row in rows])
    np.testing.assert_allclose(levels, levels.mean(), rtol=5e-4)
    assert levels.mean() == pytest.approx(3.5e-9, rel=0.03)
    (own,) = (row["ab_minus_vega"] for row in rows if row["name"] == "twomass_h")
    assert own == pytest.approx(1.3753, abs=1e-4)
    beyond = passbands.Passband("beyond", np.array([2e4, 3e4]), np.ones(2), "vacuum")
    assert vega_magnitudes([beyond]) == [None]


def test_user_files_replace_built_in_ones(tmp_path, embedded):
    mine = inputs.read(own(tmp_path))
    assert set(mine.sha256()) == {
        "fluxes.passbands.mine", "fluxes.templates.0", "fluxes.templates.1", "fluxes.extinction.3",
    }  # fmt: skip
    assert mine.sha256()["fluxes.extinction.3"] == hashlib.sha256((tmp_path / "law.dat").read_bytes()).hexdigest()
    assert mine.library.names == ("early", "late")
    changed = (continuum.dust_curves(mine.library) != continuum.dust_curves(embedded.library)).any(1)
    assert changed.tolist() == [False, False, False, True, False]
    assert inputs.template_rows(mine)["source"][1].as_py() == "late.sed, read as cosmos"
    assert inputs.law_rows(mine)["source"].to_pylist()[3] == "law.dat, read as extinction"
    rows = inputs.passband_rows(mine).to_pylist()
    assert rows[-1]["name"] == "mine"
    assert rows[-1]["sha256"] == mine.sha256()["fluxes.passbands.mine"]


def test_a_user_law_applies_to_built_in_galaxies(tmp_path, embedded):
    mine = inputs.read(own(tmp_path, templates=None, passbands=()))
    np.testing.assert_array_equal(mine.library.flux, embedded.library.flux)
    k = continuum.dust_curves(mine.library)[3]
    assert k[mine.library.wavelength == 5500.0] == pytest.approx(4.05, rel=1e-4)
    # Beyond the wavelengths of the file, the law is constant.
    assert k[0] == k[mine.library.wavelength == 899.0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"passbands": (("euclid_vis", 0),)}, r"fluxes\.passbands\.euclid_vis: truesky has a passband euclid_vis"),
        ({"passbands": (("x", ("absent.dat", "passband_ascii", "air")),)}, r"fluxes\.passbands\.x\.file: .*absent"),
        ({"passbands": (("x", ("mine.dat", "nonsense", "air")),)}, r"fluxes\.passbands\.x\.file: format 'nonsense' is"),
        ({"passbands": (("x", ("mine.dat", "passband_svo", "air")),)}, r"fluxes\.passbands\.x\.file: .*cannot be read"),
        ({"templates": (("mine.dat",), "cosmos")}, r"fluxes\.templates: .*mine\.dat: covers 5000 \.\. 7000 A"),
        ({"extinction": ((2, ("steep.dat", "extinction")),)}, r"fluxes\.extinction\.2: .*row 1 is more than k = 100"),
    ],
)
def test_bad_files_are_refused_with_their_key(tmp_path, changes, message):
    own(tmp_path)
    ascii_file(tmp_path / "steep.dat", value=1e4 * FLUX)

    def made(value):
        files, *rest = value if value else (("mine.dat",), "passband_ascii", "air")
        return Curves(tuple(tmp_path / file for file in ([files] if isinstance(files, str) else files)), *rest)

    given = {
        name: made(value) if name == "templates" else tuple((key, made(curves)) for key, curves in value)
        for name, value in changes.items()
    }
    for reader in (inputs.read, inputs.check_files):
        with pytest.raises(BadInput, match=message):
            reader(UserCurves(**given))


def test_a_check_of_files_does_not_compute_spectra_of_stars(tmp_path, monkeypatch):
    monkeypatch.setattr(templates, "stellar_library", None)
    assert list(inputs.check_files(own(tmp_path))) == ["mine"]


def test_a_votable_without_its_own_unit_is_in_angstrom(tmp_path):
    path = votable(tmp_path / "filter.xml")
    mine = inputs.read(UserCurves(passbands=(("svo", Curves((path,), "passband_svo", "vacuum")),)))
    assert passbands.pivot_wavelength(mine.passbands["svo"]) == pytest.approx(5985.0, abs=20.0)


def test_lines_are_published_with_wavelength_ratio_and_width(embedded, galaxies, library):
    """The lake contains flux, wavelength and width of each line in the spectra."""
    published = inputs.line_rows(embedded)
    check_rows(published, EMISSION_LINES)
    rows = published.to_pylist()
    assert len(rows) == 20
    assert {row["flux_column"] for row in rows} == set(lines.columns())
    assert all(len(row["sha256"]) == 64 and row["source"] for row in rows)
    table = galaxies(1, seed=3, abs_mag_r01=-20.5, z_obs=0.8)
    (seen,) = sources.galaxies_from_table(table, library).lines
    assert seen == pytest.approx(
        [row["ratio"] * table[row["flux_column"]][0].as_py() for row in rows], rel=1e-6, abs=0.0
    )
    row = rows[0]
    log_sigma = (row["width_slope"] + row["width_slope_z"] * 0.8) * (-20.5 - row["width_magnitude"])
    sigma = np.clip(10.0 ** (log_sigma + row["width_z"] * 0.8), row["width_least"], row["width_most"])
    assert sigma == pytest.approx(float(lines.velocity_dispersion(-20.5, 0.8)), rel=1e-12)
    for row in rows:
        assert float(lines.air_wavelength(row["vacuum_wavelength"])) == pytest.approx(row["air_wavelength"], abs=0.006)
