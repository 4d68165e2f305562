"""Every row of a user's tables is read; all mistakes are reported at once with the user's columns and rows."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lake_schema.errors import BadInput
from tests.truesky import nightly
from truesky.catalogue.external import ingest, mapping, reading
from truesky.cosmology import FIDUCIAL
from truesky.request.area import Area

GALAXIES = {"ra": "RA", "dec": "DEC", "z_true": "Z", "mag": "MAG", "band": "euclid_vis", "origin_id": "ID"}
HALOS = {"ra": "RA", "dec": "DEC", "z_true": "Z", "log_mass": "M", "origin_id": "ID"}


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))


def table(number=50, **changes):
    """Return columns of a user's table; `changes` gives (row, value) by column, with rows from 1."""
    rng = np.random.default_rng(4)
    columns = {
        "ID": np.arange(number), "RA": rng.uniform(53.0, 54.0, number), "DEC": rng.uniform(-28.0, -27.0, number),
        "Z": rng.uniform(0.1, 2.0, number), "MAG": rng.uniform(20.0, 25.0, number), "M": rng.uniform(12, 14, number),
    }  # fmt: skip
    for name, (row, value) in changes.items():
        columns[name][row - 1] = value
    return columns


def galaxies(entries=GALAXIES, **more):
    return mapping.galaxy_columns("", {key: json.dumps(value) for key, value in {**entries, **more}.items()}, FIDUCIAL)


def halos():
    return mapping.halo_columns({key: json.dumps(value) for key, value in HALOS.items()}, FIDUCIAL)


def written(folder, *tables):
    paths = [folder / f"{number}.parquet" for number in range(len(tables))]
    for path, columns in zip(paths, tables, strict=True):
        pq.write_table(pa.table(columns), path)
    return paths


def mistakes(folder, files, columns):
    """Return the lines of the error when the files are read."""
    with pytest.raises(BadInput) as caught:
        list(reading.read(files, columns))
    return [line.replace(f"{folder}/", "") for line in caught.value.messages]


def test_rows_beyond_the_first_batch_and_file_are_read(tmp_path):
    """A batch has at most 65,536 rows."""
    files = written(tmp_path, table(70_000, DEC=(66_001, -91.0)), table(Z=(7, np.nan), DEC=(8, 95.0)))
    assert mistakes(tmp_path, files, galaxies()) == [
        "0.parquet: column DEC (dec) of row 66001 is -91, but must be from -90 to 90 deg (1 more row in 2 files)",
        "1.parquet: column Z (z_true) of row 7 is NaN, but must be a number from 0 to 15",
    ]


def test_missing_columns_and_wrong_values_are_reported_together(tmp_path):
    columns = table(DEC=(3, 95.0), MAG=(4, 99.0))
    columns["Redshift"] = columns.pop("Z")
    lines = mistakes(tmp_path, written(tmp_path, columns), galaxies({**GALAXIES, "z_true": "redshift"}))
    assert lines == [
        "ingest.galaxies.columns.z_true: 0.parquet has no column redshift (did you mean Redshift?); "
        "it has ID, RA, DEC, MAG, M, Redshift",
        "0.parquet: column DEC (dec) of row 3 is 95, but must be from -90 to 90 deg",
        "0.parquet: column MAG (mag) of row 4 is 99, but must be from -5 to 60",
    ]


def test_known_names_of_missing_columns_are_suggested(tmp_path):
    columns = table()
    columns["RAJ2000"], columns["DEJ2000"] = columns.pop("RA"), columns.pop("DEC")
    lines = mistakes(tmp_path, written(tmp_path, columns), galaxies({**GALAXIES, "ra": "ra", "dec": "dec"}))
    assert [line.partition("; it has")[0] for line in lines] == [
        "ingest.galaxies.columns.ra: 0.parquet has no column ra (did you mean RAJ2000?)",
        "ingest.galaxies.columns.dec: 0.parquet has no column dec (did you mean DEJ2000?)",
    ]


def test_a_property_that_is_suggested_is_not_missing():
    with pytest.raises(BadInput) as caught:
        mapping.halo_columns(dict.fromkeys(("RAJ2000", "dec", "z_tru", "log_mass"), json.dumps("a")), FIDUCIAL)
    assert caught.value.messages == (
        "ingest.halos.columns.RAJ2000 is not a known property: did you mean ra?",
        "ingest.halos.columns.z_tru is not a known property: did you mean z_true? allowed: ra, dec, z_true, z_obs, "
        "velocity, log_mass, origin_id",
    )


def test_texts_in_columns_of_numbers_are_named(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("RA,DEC,Z,MAG,ID\n53,-27,0.5,21,1\n53,-27,half,-,2\n53,-27,+.5e0,1e1,3\n53,-27,,n/a,4\n")
    assert mistakes(tmp_path, [path], galaxies()) == [
        "x.csv: column Z of row 2 is 'half', but must be a number",
        "x.csv: column MAG of row 2 is '-', but must be a number (1 more row)",
    ]


def test_an_ellipticity_without_an_axis_ratio_is_named(tmp_path):
    columns = {**table(3), "E1": np.array([0.1, 0.9, 0.6]), "E2": np.array([0.1, 0.0, 0.8])}
    shapes = {"e1": "E1", "e2": "E2", "ellipticity": "shear"}
    (line,) = mistakes(tmp_path, written(tmp_path, columns), galaxies(**shapes))
    said = "0.parquet: the ellipticity |e| from columns E1 and E2 of row 3 is 1, but must be at most 0.9608, for an "
    assert line == f"{said}axis ratio of 0.02"


def test_an_impossible_absolute_magnitude_is_named(tmp_path):
    """A galaxy of 29 mag at z = 0 would be fainter than any galaxy; the job that computes fluxes would refuse it."""
    columns = table(MAG=(2, 29.0), Z=(2, 0.0))
    (line,) = mistakes(tmp_path, written(tmp_path, columns), galaxies())
    assert line.startswith("0.parquet: the absolute magnitude from columns MAG and Z of row 2 is 6.")
    assert line.endswith("must be from -30 to 5")


def test_a_flux_in_place_of_a_magnitude_is_explained(tmp_path):
    columns = {**table(), "MAG": np.full(50, 2.5e-28)}
    (line,) = mistakes(tmp_path, written(tmp_path, columns), galaxies())
    assert "row 1 is -" in line
    assert ' (mag = 2.5e-28), but must be from -30 to 5: if MAG is a flux, write mag = { column = "MAG"' in line
    assert line.endswith(
        ' = "MAG", log10 = true, scale = -2.5, offset = 23.9 } (microjansky; offset = -48.6 for erg/s/cm2/Hz)'
        " (49 more rows)"
    )
    scaled = galaxies(mag={"column": "MAG", "log10": True, "scale": -2.5, "offset": -48.6})
    (rows,) = reading.read(written(tmp_path, columns), scaled)
    assert rows.values["mag"] == pytest.approx(-2.5 * np.log10(2.5e-28) - 48.6)


@pytest.mark.parametrize(
    ("entries", "replaced", "line"),
    [
        (
            {"flux": "F"},
            ["mag", "band"],
            'flux is not a known property: write mag for AB magnitudes; for fluxes write mag = { column = "F", log10',
        ),
        ({"f_nu_lsst_i": "F"}, ["mag"], "f_nu_lsst_i is not a known property: write mag for AB magnitudes; "),
        ({"flux_halfa": "F"}, [], "flux_halfa is not a known property: did you mean flux_halpha"),
        (
            {"DEC": "dec"},
            ["dec"],
            'DEC is not a known property: the key is the property, and the value its column: write dec = "DEC"',
        ),
        (
            {"half_light_radius": {"column": "R", "unit": "pixel"}},
            [],
            "half_light_radius has the unit pixel, but must be in arcsec or a unit that converts to it",
        ),
    ],
)
def test_the_remedy_of_a_wrong_entry(entries, replaced, line):
    # The entry is meant for one of these properties, which is then not missing.
    given = {name: entry for name, entry in GALAXIES.items() if name not in replaced}
    with pytest.raises(BadInput) as caught:
        galaxies(given, **entries)
    assert [text.startswith(f"ingest.galaxies.columns.{line}") for text in caught.value.messages] == [True]


@pytest.mark.parametrize(("unit", "factor"), [("arcsec", 1.0), ("arcmin", 60.0), ("deg", 3600.0)])
def test_a_unit_that_the_request_states_is_converted(tmp_path, unit, factor):
    path = tmp_path / "x.csv"
    path.write_text("RA,DEC,Z,MAG,ID,R\n53,-27,0.5,21,1,0.01\n")
    (rows,) = reading.read([path], galaxies(half_light_radius={"column": "R", "unit": unit}))
    assert rows.values["disk_half_light_radius"] == pytest.approx(0.01 * factor)


def test_a_catalogue_without_rows_is_refused(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("RA,DEC,Z,MAG,ID\n")
    files, sha256 = ingest.files_with_checksums([path], galaxies())
    with pytest.raises(BadInput, match=r"x\.csv: the table has no rows"):
        ingest.split_by_cell(files, sha256, galaxies())


def test_properties_of_a_whole_galaxy_become_those_of_its_components(tmp_path):
    columns = {**table(2), "Q": np.array([0.5, 1.0]), "R": np.array([0.3, 0.4])}
    (rows,) = reading.read(written(tmp_path, columns), galaxies(axis_ratio="Q", half_light_radius="R"))
    for name, values in (("axis_ratio", [0.5, 1.0]), ("half_light_radius", [0.3, 0.4])):
        assert name not in rows.values
        assert rows.values[f"bulge_{name}"].tolist() == rows.values[f"disk_{name}"].tolist() == values


def test_a_table_is_checked_once(tmp_path, monkeypatch):
    """The second check of the same files reads no rows; identifiers of all files are compared."""
    files = written(tmp_path, table(), {**table(), "ID": np.arange(50) + 50})
    ingest.check_rows(*ingest.files_with_checksums(files, halos()), halos())
    with monkeypatch.context() as context:
        context.setattr(reading, "read", lambda *arguments: pytest.fail("rows were read again"))
        ingest.check_rows(*ingest.files_with_checksums(files, halos()), halos())
    written(tmp_path, table(), {**table(), "ID": np.arange(50) + 49})
    with pytest.raises(
        BadInput, match=r"1\.parquet: column ID: the value 49 is in row 1 and in row 50 of .*0\.parquet"
    ):
        ingest.check_rows(*ingest.files_with_checksums(files, halos()), halos())
    written(tmp_path, table(0), table(0))
    with pytest.raises(BadInput, match="the table has no rows"):
        ingest.check_rows(*ingest.files_with_checksums(files, halos()), halos())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"origin_id": "", "beside": ["a", "b"]}, "beside requires origin_id"),
        ({"a_v": {"column": "AV", "beside": True}}, "columns.a_v: beside = true requires the setting beside"),
        ({"beside": "a"}, "columns.beside = 'a' must be the beginnings of two file names"),
        ({"band": "euclid_viz"}, r"band = 'euclid_viz' must be the name of a passband \(did you mean euclid_vis\?\)"),
        ({"band": ""}, "mag requires band"),
        ({"seen_over_v": True}, "seen_over_v = True must be a number"),
        ({"lines_magnified": 1}, "lines_magnified = 1 must be true or false"),
        ({"frame": "south"}, "frame = 'south' must be one of east_north"),
        ({"e1": "E1", "e2": "E2", "ellipticity": "shear", "position_angle": "PA"}, "e1, e2 replaces position_angle"),
    ],
)
def test_wrong_settings_are_refused(more, message):
    with pytest.raises(BadInput, match=message):
        galaxies(**more)


def test_all_mistakes_of_a_mapping_are_reported_at_once():
    with pytest.raises(BadInput) as caught:
        galaxies({"ra": "RA", "mag": {"column": "M", "times": 2}, "bulge_fracton": "B", "kappa": "K"})
    lines = caught.value.messages
    assert [line.removeprefix("ingest.galaxies.columns") for line in lines[2:]] == [
        ' must have dec, z_true or z_obs: add the name of its column, such as dec = ".."',
        ": kappa requires gamma1",
        ": kappa requires gamma2",
    ]
    assert lines[0].startswith("ingest.galaxies.columns.mag.times is not one of column")
    assert lines[1].endswith("did you mean bulge_fraction?")


def in_units(folder, **units):
    """Return a Parquet file whose columns have units in their metadata."""
    values = table(5)
    fields = [
        pa.field(name, pa.from_numpy_dtype(column.dtype), metadata={"unit": units[name]} if name in units else None)
        for name, column in values.items()
    ]
    path = folder / "units.parquet"
    pq.write_table(pa.table(values, schema=pa.schema(fields)), path)
    return path, values


SIZES = {**GALAXIES, "half_light_radius": "Z"}


@nightly.parametrize(
    ("column", "unit", "key", "factor"),
    [
        ("Z", "arcmin", "disk_half_light_radius", 60.0),
        ("Z", "mas", "disk_half_light_radius", 1e-3),
        ("Z", "Arcsecs", "disk_half_light_radius", 1.0),
        ("DEC", "arcmin", "dec", 1.0 / 60.0),
        ("MAG", "mag(AB)", "mag", 1.0),
        ("MAG", "--", "mag", 1.0),
        ("ID", "count", "origin_id", 1.0),
    ],
    (1, 4),
)
def test_stored_units_that_convert_are_converted(tmp_path, column, unit, key, factor):
    path, values = in_units(tmp_path, **{column: unit})
    entries = {**SIZES, "z_true": {"value": 0.5}}
    (piece,) = reading.read([path], galaxies(entries))
    assert piece.values[key] == pytest.approx(values[column] * factor, rel=1e-12, abs=0.0)


def test_other_stored_units_are_refused_together(tmp_path):
    path, _ = in_units(tmp_path, RA="pix", Z="kpc", MAG="uJy", M="pix")
    entries = {**GALAXIES, "half_light_radius": "Z"}
    assert mistakes(tmp_path, [path], galaxies(entries)) == [
        "units.parquet: column RA (ra) has the unit pix, but must be in deg or a unit that converts to it",
        "units.parquet: column Z (z_true) has the unit kpc, but must be a number without a unit",
        "units.parquet: column MAG (mag) has the unit uJy, but must be in mag or a unit that converts to it",
        "units.parquet: column Z (half_light_radius) has the unit kpc, but must be in arcsec or a unit that converts "
        "to it",
    ]


def test_a_computed_column_is_not_converted(tmp_path):
    path, values = in_units(tmp_path, Z="pix")
    entries = {**SIZES, "z_true": {"value": 0.5}, "half_light_radius": {"column": "Z", "scale": 0.1}}
    (piece,) = reading.read([path], galaxies(entries))
    assert piece.values["disk_half_light_radius"] == pytest.approx(0.1 * values["Z"])


@pytest.mark.parametrize(("shift", "hint"), [(100.0, False), (-53.0, True)])
@pytest.mark.parametrize("kind", ["galaxies", "halos"])
def test_a_catalogue_outside_the_area_is_refused(tmp_path, kind, shift, hint):
    values = table()
    values["RA"] += shift
    values["DEC"] *= 0.02
    files = written(tmp_path, values)
    columns = galaxies() if kind == "galaxies" else halos()

    def check(area):
        files_and_sha256 = ingest.files_with_checksums(files, columns)
        if kind == "halos":
            return ingest.check_rows(*files_and_sha256, columns, area)
        return ingest.check_area(ingest.split_by_cell(*files_and_sha256, columns), files, columns, area)

    check(Area(ra=values["RA"][0], dec=values["DEC"][0], radius=0.1))
    with pytest.raises(BadInput) as caught:
        check(Area(ra=53.5, dec=-27.5, radius=0.2))
    message = str(caught.value).replace(f"{tmp_path}/", "")
    assert message.startswith("0.parquet: no row is in the area, the circle of 0.2 deg at ra 53.5, dec -27.5: the rows")
    assert f"have RA from {values['RA'].min():g} to {values['RA'].max():g} and DEC from" in message
    assert ("radians" in message) is hint


def test_right_ascensions_in_hours_are_recognised(tmp_path):
    values = table()
    values["RA"] /= 15.0
    files = written(tmp_path, values)
    with pytest.raises(
        BadInput, match=r"deg; if the right ascensions are in hours, write ra = \{ column = \.\., scale = 15 \}$"
    ):
        ingest.check_rows(*ingest.files_with_checksums(files, halos()), halos(), Area(ra=53.5, dec=-27.5, radius=0.2))
    assert ingest.unit_hint((3.0, 54.0), (-28.0, -27.0), Area(ra=53.5, dec=-27.5, radius=0.2)) == ""
    assert ingest.unit_hint((1.0, 10.0), (-28.0, -27.0), Area(ra=5.0, dec=-27.5, radius=0.2)) == ""
