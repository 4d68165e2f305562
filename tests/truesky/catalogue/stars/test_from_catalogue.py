"""Stars of another model replace the drawn stars: a Besancon output whose columns the request names."""

import numpy as np
import pytest
from astropy.io.fits.verify import VerifyWarning
from astropy.table import Table

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.store import publish, read, validate
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.stars import STARS
from truesky.catalogue import build_stars
from truesky.catalogue.stars import from_catalogue, stars
from truesky.request.from_toml import from_table

COLUMNS = {
    "l": "l",
    "b": "b",
    "distance_kpc": "Dist",
    "log_teff": "LTef",
    "log_g": "logg",
    "metallicity": "[Fe/H]",
    "a_v": "Av",
    "mag_h_seen": "H",
    "age_class": "Age",
    "luminosity_class": "CL",
}
# Output of the model's server: a preamble, column names, stars, and text at the end.
BESANCON = """ Simulation of a field
 l =  283.7 b = 37.9
  Dist    Mv  CL Typ   LTef  logg Age   H       J-H  [Fe/H]    l         b        Av
  0.250  4.80  5 4.40 3.763  4.45  5  12.005   0.30  -0.10  283.7000   37.9000  0.0300
  2.100  8.10  5 6.50 3.600  4.70  8  18.020   0.60  -0.70  283.7200   37.9100  0.1100
 11.000  0.90  3 5.20 3.680  2.40  9  14.500   0.55  -1.80  283.6900   37.8900  0.1500
  0.040 12.10  6 9.00 4.000  8.00  6  15.700   0.05   0.00  283.7100   37.9300  0.0000
 Number of stars: 4
"""


def written(path, text=BESANCON):
    path.write_text(text)
    return path


def loaded(path, columns=COLUMNS):
    from_catalogue.check_columns(columns)
    return from_catalogue.load(path, file_sha256(path), columns)


def test_a_besancon_output(tmp_path):
    found = loaded(written(tmp_path / "field.resu"))
    order = np.argsort(found.values["distance"])
    values = {name: column[order] for name, column in found.values.items()}
    assert values["distance"] == pytest.approx([40.0, 250.0, 2100.0, 11_000.0])
    assert values["teff"] == pytest.approx(10.0 ** np.array([4.0, 3.763, 3.6, 3.68]))
    assert values["mag_h"] == pytest.approx(
        np.array([15.7, 12.005, 18.02, 14.5]) - 0.178 * np.array([0, 0.03, 0.11, 0.15])
    )
    assert values["component"].tolist() == [0, 0, 1, 2]
    assert values["stage"].tolist() == [2, 0, 0, 1]
    lon, lat = sky.galactic(values["ra"], values["dec"])
    assert lon == pytest.approx([283.71, 283.7, 283.72, 283.69])
    assert lat == pytest.approx([37.93, 37.9, 37.91, 37.89])
    assert np.all(np.diff(found.index) >= 0)


def test_comma_separated_and_fits_tables_give_the_same_stars(tmp_path):
    rows = [line.split() for line in BESANCON.splitlines()[2:-1]]
    text = loaded(written(tmp_path / "field.resu"))
    commas = loaded(written(tmp_path / "field.csv", "\n".join(", ".join(row) for row in rows)))
    table = Table({name: [float(row[k]) for row in rows[1:]] for k, name in enumerate(rows[0])})
    with pytest.warns(VerifyWarning, match="column names"):
        table.write(tmp_path / "field.fits")
    for other in (commas, loaded(tmp_path / "field.fits")):
        assert np.array_equal(other.index, text.index)
        for name, values in text.values.items():
            assert np.array_equal(other.values[name], values)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("3.763", "9.999"), r"LTef \(log_teff\) of row 1 is 9.999, but must be a number from 2.4 to 5$"),
        (("12.005", "nan   "), r"H \(mag_h_seen\) of row 1 is NaN"),
        (("18.020", "18.x20"), r"H of row 2 is '18.x20', must be a number"),
        (("  Dist ", "  Far  "), r"^stars.catalogue: .*field.resu has no column Dist; it has "),
        (("  Dist ", "\n" * 10_000 + "  Dist "), "none of the first 10000 lines has the columns"),
        (("  Mv ", " Av "), "the column name Av must not occur twice"),
    ],
)
def test_bad_tables_are_named(tmp_path, change, words):
    with pytest.raises(BadInput, match=words) as caught:
        loaded(written(tmp_path / "field.resu", BESANCON.replace(*change)))
    assert "field.resu" in str(caught.value)


def test_the_columns_of_a_table_with_other_names_are_listed(tmp_path):
    file = tmp_path / "own.txt"
    file.write_text("Made in 2020\nRAJ2000 DEJ2000 Gmag Teff\n53.1 -27.8 15.2 5800\n53.2 -27.9 16.2 5100\n")
    with pytest.raises(BadInput) as caught:
        from_catalogue.load(file, "0", {"ra": "RA", "dec": "DEC", "mag_h": "Hmag", "teff": "T_EFF"})
    assert str(caught.value) == (
        f"stars.catalogue: {file} has no column RA (did you mean RAJ2000?), DEC (did you mean DEJ2000?), "
        "Hmag (did you mean Gmag?), T_EFF (did you mean Teff?); it has RAJ2000, DEJ2000, Gmag, Teff"
    )


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({**COLUMNS, "colour": "J-H"}, "columns.colour is not a known property"),
        ({k: v for k, v in COLUMNS.items() if k != "l"}, "must have one of ra and l"),
        ({**COLUMNS, "ra": "ra"}, "must have one of ra and l"),
        ({k: v for k, v in COLUMNS.items() if k != "a_v"}, "mag_h_seen requires a_v"),
        ({**{k: v for k, v in COLUMNS.items() if k != "l"}, "ra": "l"}, "must have ra and dec, or l and b"),
    ],
)
def test_bad_mappings_are_named(columns, words):
    with pytest.raises(BadInput, match=words):
        from_catalogue.check_columns(columns)


def asked(path, **keys):
    ra, dec = sky.equatorial(283.7, 37.9)
    area = {"cone": {"ra": float(ra), "dec": float(dec), "radius": 0.2}}
    given = {"catalogue": {"file": str(path), "columns": COLUMNS}, "brown_dwarf_boost": 0.0, **keys}
    return from_table({"name": "x", "seed": 1, "area": area, "stars": given})


def test_they_become_the_table(lake, tmp_path):
    (step,) = build_stars.steps(lake, asked(written(tmp_path / "field.resu")))
    publish.make_version(lake, step.plan, step.run_task)
    version = read.version(lake, "stars")
    rows = version.rows()
    assert rows.num_rows == 4
    assert validate.find_violations(rows, STARS) == []
    assert sorted(rows["a_v"].to_pylist()) == pytest.approx([0.0, 0.03, 0.11, 0.15])
    assert version.manifest["facts"]["catalogue"]["columns"] == COLUMNS
    again = written(tmp_path / "moved.resu")
    assert build_stars.steps(lake, asked(again))[0].plan.key == version.key
    other = written(tmp_path / "other.resu", BESANCON.replace("12.005", "12.006"))
    assert build_stars.steps(lake, asked(other))[0].plan.key != version.key


def test_missing_columns_are_null_and_dust_is_computed(tmp_path, dust):
    columns = {"ra": "l", "dec": "b", "mag_h": "H", "teff": "T"}
    path = written(tmp_path / "few.txt", "l b H T\n53.1 -27.8 20.0 5000\n53.2 -27.9 21.0 4000\n")
    universe = stars.model(26.0, brown_dwarf_boost=0.0, catalogue=loaded(path, columns))
    (cell,) = {*sky.cell_at([53.1], [-27.8], 8).tolist()}
    rows = stars.draw(cell, 1, universe, dust)
    assert rows["mag_h"].to_pylist() == [20.0]
    assert rows["distance"].null_count == rows["metallicity"].null_count == rows["stage"].null_count == 1
    assert rows["a_v"].to_numpy()[0] > 0.0
    assert stars.expected_counts([cell, cell + 7], universe).tolist() == [1.0, 0.0]


def test_no_file(lake):
    with pytest.raises(BadInput, match=r"stars\.catalogue\.file: .*no such file"):
        build_stars.steps(lake, asked("/nowhere/field.resu"))
