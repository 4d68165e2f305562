"""Read external files. All files are synthetic: they have the published formats and invented numbers."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, Table

from lake_schema import user_files
from lake_schema.errors import BadInput
from truesky.fluxes import band_fluxes, passbands
from truesky.fluxes.libraries import from_files
from truesky.fluxes.tables import build_tables, flux_tables
from truesky.request.accuracy import SURVEY
from truesky.request.files import PASSBAND_FORMATS

WAVELENGTH = np.arange(900.0, 26_000.0, 20.0)
FLUX = 1.0 + 0.5 * np.sin(WAVELENGTH / 800.0)
BAND = np.arange(5000.0, 7001.0, 10.0)
SYNTHETIC = {"ORIGIN": "SYNTHETIC"}
RESPONSE = np.exp(-0.5 * ((BAND - 6000.0) / 300.0) ** 2)

VOTABLE = """<?xml version="1.0"?>
<VOTABLE version="1.1" xmlns="http://www.ivoa.net/xml/VOTable/v1.1">
 <INFO name="SYNTHETIC" value="YES"/>
 <RESOURCE><TABLE utype="photDM:PhotometryFilter.transmissionCurve.spectrum">
  <FIELD name="Wavelength" ucd="em.wl" unit="AA" datatype="float"/>
  <FIELD name="Transmission" ucd="phys.transmission" datatype="float"/>
  <DATA><TABLEDATA>{rows}</TABLEDATA></DATA>
 </TABLE></RESOURCE>
</VOTABLE>
"""


def ascii_file(path, wavelength=WAVELENGTH, value=FLUX):
    rows = "\n".join(f"{a:.6g} {b:.6g}" for a, b in zip(wavelength, value, strict=True))
    path.write_text("# SYNTHETIC\n" + rows + "\n")
    return path


def votable(path, wavelength=BAND, value=RESPONSE):
    rows = "".join(f"<TR><TD>{a}</TD><TD>{b}</TD></TR>" for a, b in zip(wavelength, value, strict=True))
    path.write_text(VOTABLE.format(rows=rows))
    return path


def test_every_format_names_its_source_and_reader():
    assert {"cosmos", "extinction", "irtf"} <= set(from_files.formats())
    for name, form in from_files.formats().items():
        assert form["source"], name
        assert form["reader"] in ("ascii", "csv", "ecsv", "fits", "votable")
        assert {"wavelength", "value", "unit", "largest_gap", "bounds"} <= set(form)


def test_requests_allow_the_formats_of_passbands():
    assert tuple(name for name in from_files.formats() if name.startswith("passband_")) == PASSBAND_FORMATS


@pytest.mark.parametrize("form", ["cosmos", "extinction", "irtf", "spectrum_csv", "spectrum_ecsv", "spectrum_fits"])
def test_every_form_gives_the_same_spectrum(tmp_path, form):
    path = tmp_path / "synthetic"
    wavelength = np.arange(8000.0, 24_001.0, 20.0) if form == "irtf" else WAVELENGTH
    flux = np.interp(wavelength, WAVELENGTH, FLUX)
    if form in ("cosmos", "extinction"):
        ascii_file(path)
    elif form == "irtf":
        np.savetxt(path, np.stack([wavelength / 1e4, flux, 0.01 * flux], 1), header="SYNTHETIC IRTF")
    elif form == "spectrum_csv":
        Table({"wavelength": wavelength, "flux": flux, "note": ["SYNTHETIC"] * len(flux)}).write(
            path, format="ascii.csv"
        )
    elif form == "spectrum_ecsv":
        QTable({"wavelength": wavelength / 10 * u.nm, "flux": flux}, meta=SYNTHETIC).write(path, format="ascii.ecsv")
    else:
        Table({"WAVELENGTH": wavelength, "FLUX": flux}, meta=SYNTHETIC).write(path, format="fits")
    curve = from_files.read(path, form)
    np.testing.assert_allclose(curve.wavelength, wavelength, rtol=1e-5)
    np.testing.assert_allclose(curve.value, flux, rtol=1e-5)


def broken(name):
    """Return the columns of a filter with one mistake."""
    wavelength, value = BAND.copy(), RESPONSE.copy()
    match name:
        case "one row":
            wavelength, value = wavelength[:1], value[:1]
        case "unsorted":
            wavelength[[40, 41]] = wavelength[[41, 40]]
        case "repeated":
            wavelength[41] = wavelength[40]
        case "descending":
            wavelength, value = wavelength[::-1], value[::-1]
        case "negative":
            value[7] = -0.1
        case "zero":
            value[:] = 0.0
        case "nan":
            value[3] = np.nan
        case "infinite":
            value[3] = np.inf
        case "nm":
            wavelength /= 10.0
        case "um":
            wavelength /= 1e4
        case "m":
            wavelength *= 1e10
        case "gap":
            keep = (wavelength < 5200.0) | (wavelength > 6900.0)
            wavelength, value = wavelength[keep], value[keep]
    return wavelength, value


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("one row", "a curve must have at least 2 rows, got 1"),
        ("unsorted", "wavelengths must increase, but row 42 has "),
        ("repeated", "row 42 repeats the wavelength"),
        ("descending", "wavelengths must increase, but row 2 has "),
        ("negative", "row 8 is negative"),
        ("zero", "all values are 0"),
        ("nan", "row 4 is not a number"),
        ("infinite", "row 4 is not a number"),
        ("nm", "is the unit right"),
        ("um", "is the unit right"),
        ("m", "is the unit right"),
        ("gap", r"row 21 \(\d+ A\) follows a gap of \d+ A, but at most \d+ A is allowed there: add rows$"),
    ],
)
@pytest.mark.parametrize("form", ["passband_ascii", "passband_svo"])
def test_wrong_filters_are_refused_with_file_and_row(tmp_path, name, message, form):
    path = tmp_path / "filter.dat"
    (ascii_file if form == "passband_ascii" else votable)(path, *broken(name))
    with pytest.raises(BadInput, match=rf"filter\.dat: .*{message}"):
        from_files.passband(path, "mine", "air", form)


@pytest.mark.parametrize(
    ("centre", "message"),
    [
        (23_000.0, None), (23_961.7, None), (23_962.0, r"0\.1% of its photons"), (23_990.0, r"28\.1% of its photons"),
        (24_500.0, "is outside 600 .. 24000 A"),
    ],
)  # fmt: skip
def test_a_passband_that_detects_light_beyond_the_spectra_is_refused(tmp_path, centre, message):
    """Such a band once lost the light beyond 24000 A without a message."""
    path = ascii_file(tmp_path / "band", centre + 40.0 * np.linspace(-1.0, 1.0, 5), np.array([0.0, 0.5, 1.0, 0.5, 0.0]))
    if message is None:
        band = from_files.passband(path, "mine", "air", "passband_ascii")
        assert passbands.pivot_wavelength(band) == pytest.approx(centre, abs=0.5)
    else:
        with pytest.raises(BadInput, match=message):
            from_files.passband(path, "mine", "air", "passband_ascii")


@pytest.mark.parametrize("scale", [0.1, 1e-4])
def test_a_spectrum_in_another_unit_is_refused(tmp_path, scale):
    with pytest.raises(BadInput, match="is the unit right"):
        from_files.read(ascii_file(tmp_path / "sed", WAVELENGTH * scale), "cosmos")


def test_a_file_that_is_not_a_table_is_refused(tmp_path):
    path = tmp_path / "nothing"
    for form in from_files.formats():
        with pytest.raises(BadInput, match="nothing: no such file"):
            from_files.read(path, form)
    path.write_bytes(b"\x00\xff\xfe garbage\n1 2 3 <")
    for form in from_files.formats():
        with pytest.raises(BadInput, match="nothing"):
            from_files.read(path, form)
    with pytest.raises(BadInput, match="'guess' is not one of cosmos"):
        from_files.read(path, "guess")


@pytest.mark.parametrize("text", ["", "\n \n", "# wavelength response\n"])
def test_an_empty_file_is_refused_without_a_warning(tmp_path, recwarn, text):
    (tmp_path / "empty.dat").write_text(text)
    with pytest.raises(BadInput, match=r"empty\.dat: has no rows$"):
        from_files.read(tmp_path / "empty.dat", "passband_ascii")
    assert not recwarn


def test_a_votable_declares_no_entities(tmp_path):
    path = votable(tmp_path / "bomb.xml")
    path.write_text(path.read_text().replace("<VOTABLE", '<!DOCTYPE x [<!ENTITY a "b">]>\n<VOTABLE', 1))
    with pytest.raises(BadInput, match="DOCTYPE"):
        from_files.read(path, "passband_svo")


def test_large_files_are_not_opened(tmp_path, monkeypatch):
    monkeypatch.setitem(user_files.MAX_BYTES, "curve", 100)
    with pytest.raises(BadInput, match="is larger than 100 bytes"):
        from_files.read(ascii_file(tmp_path / "sed"), "cosmos")


@pytest.mark.parametrize("form", ["passband_ascii", "passband_ecsv", "passband_svo"])
def test_a_users_filter_is_used_like_any_other(tmp_path, galaxies, library, form):
    path = tmp_path / "filter"
    if form == "passband_ascii":
        ascii_file(path, BAND, RESPONSE)
    elif form == "passband_svo":
        votable(path)
    else:
        QTable({"wavelength": BAND / 1e4 * u.um, "throughput": RESPONSE}, meta=SYNTHETIC).write(
            path, format="ascii.ecsv"
        )
    mine = from_files.passband(path, "mine", "vacuum", form)
    assert mine.medium == "vacuum"
    assert passbands.pivot_wavelength(mine) == pytest.approx(5985.0, abs=20.0)
    table = galaxies(5)
    got = band_fluxes.galaxy_fluxes(table, [mine], library)["f_nu_mine"].to_numpy()
    wanted = band_fluxes.band_fluxes(band_fluxes.galaxy_spectra(table, library), [mine])[:, 0]
    np.testing.assert_allclose(got, wanted, rtol=1e-6)


def test_a_filter_outside_the_grid_or_without_medium_is_refused(tmp_path):
    path = ascii_file(tmp_path / "mid", BAND + 30_000.0, RESPONSE)
    with pytest.raises(BadInput, match=r"mid: the passband is outside 600 \.\. 24000 A"):
        from_files.passband(path, "mine", "air")
    with pytest.raises(BadInput, match="medium 'water'"):
        from_files.passband(path, "mine", "water")


def test_a_library_keeps_the_flux_of_its_files(tmp_path):
    # Sampled every 0.5 A, with a line that is narrower than the grid.
    fine = np.arange(900.0, 9500.0, 0.5)
    flux = 1.0 + 50.0 * np.exp(-0.5 * ((fine - 6000.3) / 0.6) ** 2)
    files = [ascii_file(tmp_path / "Ell1", fine, flux), ascii_file(tmp_path / "SB0")]
    library = from_files.library(files)
    assert library.names == ("Ell1", "SB0")
    near = np.abs(library.wavelength - 6000.0) <= 20.0
    assert library.flux[0, near].sum() - 41.0 == pytest.approx(50.0 * 0.6 * np.sqrt(2.0 * np.pi), rel=1e-3)
    red = library.flux[0, np.isin(library.wavelength, (10_000.0, 20_000.0))]
    assert np.log2(red[1] / red[0]) == pytest.approx(-3.2, abs=1e-3)
    assert not library.flux[0, library.wavelength < 899.0].any()
    grid = flux_tables.open_grid([passbands.load("euclid_h")], [build_tables.Setting(0.1, 2, 2)], library)
    assert np.isfinite(grid.tables[0]).all()
    assert SURVEY.flux < 1.0


@pytest.mark.parametrize("last", [1500.0, 2600.0])
def test_bins_of_a_straight_spectrum_hold_its_middles_and_those_beyond_it_go_on(last):
    grid, at = np.arange(1000.0, 2001.0), np.arange(900.0, last + 1.0, 5.0)
    found = from_files.resample(grid, from_files.Curve(at, at / 1000.0))
    inside = grid < at[-1]
    np.testing.assert_allclose(found[inside], grid[inside] / 1000.0, rtol=1e-12)
    wanted = at[-1] / 1000.0 * (grid[~inside] / at[-1]) ** -3.2
    np.testing.assert_allclose(found[~inside][1:], wanted[1:], rtol=1e-5)


def test_a_law_that_is_not_per_colour_excess_is_refused(tmp_path):
    """The steepest law, of the Small Magellanic Cloud, has k = 25 at the Lyman limit."""
    ascii_file(tmp_path / "steep", value=25.0 * WAVELENGTH[0] / WAVELENGTH)
    assert from_files.law(tmp_path / "steep", "extinction", np.array([900.0]))[0] == pytest.approx(25.0)
    ascii_file(tmp_path / "wrong", value=500.0 * WAVELENGTH[0] / WAVELENGTH)
    with pytest.raises(BadInput, match=r"wrong: row 1 is more than k = 100: the values must be A / E\(B-V\)"):
        from_files.law(tmp_path / "wrong", "extinction", np.array([900.0]))


@pytest.mark.parametrize("shape", [(len(WAVELENGTH), 0), (len(WAVELENGTH), 1), (len(WAVELENGTH), 3)])
def test_a_column_of_lists_is_no_curve(tmp_path, shape):
    path = tmp_path / "x.fits"
    Table({"WAVELENGTH": WAVELENGTH, "FLUX": np.ones(shape)}).write(path, format="fits")
    with pytest.raises(BadInput, match=r"x\.fits: "):
        from_files.read(path, "spectrum_fits")


def test_no_word_needs_more_memory_than_its_file(tmp_path):
    """Refuse a type with 10 MB per row, and a word that would have the same width in every row."""
    path = tmp_path / "x.ecsv"
    wavelength = np.linspace(4000.0, 5000.0, 21)
    Table({"wavelength": wavelength, "throughput": np.ones(21)}).write(path, format="ascii.ecsv")
    text = path.read_text()
    path.write_text(text.replace("datatype: float64", "datatype: 9999999D", 1))
    with pytest.raises(BadInput, match="'9999999D' is not a datatype of ECSV"):
        from_files.read(path, "passband_ecsv")
    path.write_text(text + "9" * 5000 + " 1\n")
    with pytest.raises(BadInput, match="more than 4096 characters"):
        from_files.read(path, "passband_ecsv")
    path.write_text(text.replace("datatype: float64", 'datatype: "float64"', 1))
    assert len(from_files.read(path, "passband_ecsv").value) == 21


def test_a_passband_narrower_than_the_steps_is_refused(tmp_path):
    """A curve that is 0 at all whole angstroms would give fluxes of NaN."""
    path = tmp_path / "narrow"
    path.write_text("5000 0\n5000.5 1\n5001 0\n")
    with pytest.raises(BadInput, match=r"narrow: the passband is 0 at all whole angstroms: it must be wider than 1 A"):
        from_files.passband(path, "own", "air")
    path.write_text("5000 0\n5000.7 1\n5001.5 0\n")
    assert from_files.passband(path, "own", "air").response[-1] > 0.0
