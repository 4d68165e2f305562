"""Tables that list all sources of a request: the catalogue contains their values, and errors name their rows."""

from pathlib import Path

import galsim
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from lake_schema import sky, units
from lake_schema.errors import BadInput
from lake_schema.store import publish, read, validate
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from tests import requests
from tests.truesky import nightly
from truesky.catalogue import build_galaxies, build_stars, given_sources
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import integration, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table, stars_from_table
from truesky.request.from_toml import parse

TWO = "ra,dec,mag,position_angle,gamma1,stamp\n53.10,-27.80,20.0,30.0,0.05,3\n53.11,-27.81,24.5,140.0,-0.02,-1\n"
STAR = "ra,dec,mag,teff\n53.12,-27.80,18.0,4000\n"


def asked(folder, more='only = "table"', galaxies=TWO, stars=STAR, extra="", radius=0.05):
    names = {"galaxies": galaxies, "stars": stars}
    for name, text in names.items():
        (folder / f"{name}.csv").write_text(text or "")
    files = "".join(f'{name} = "{name}.csv"\n' for name, text in names.items() if text is not None)
    text = f"{extra}\n[sources]\n{more}\n{files}"
    return parse(requests.written(folder, text, requests.FIELD.format(radius)))


def made(folder, *args, **keys):
    """Return tables `galaxies` and `stars` of a request."""
    wanted, lake = asked(folder, *args, **keys), folder / "lake"
    lake.mkdir(exist_ok=True)
    for module in (build_galaxies, build_stars):
        for step in module.steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    rows = [read.version(lake, name).rows() for name in ("galaxies", "stars")]
    for found, table in zip(rows, (GALAXIES, STARS), strict=True):
        assert validate.find_violations(found, table) == []
    return rows


def vis_magnitudes(rows, stars):
    (vis,) = (passbands.load("euclid_vis"),)
    galaxies = integration.galaxy_fluxes(
        galaxies_from_table(rows, templates.galaxy_library()), [vis], templates.galaxy_library()
    )
    points = integration.star_fluxes(
        stars_from_table(stars, templates.stellar_library()), [vis], templates.stellar_library()
    )
    return tuple(units.mag_of_f_nu(found[:, 0]) for found in (galaxies, points))


def test_the_tables_are_the_catalogue(tmp_path):
    rows, points = made(tmp_path)
    rows = rows.sort_by("origin_id")
    assert rows["origin_id"].to_pylist() == [1, 2]
    assert rows["ra"].to_pylist() == rows["ra_true"].to_pylist() == [53.10, 53.11]
    assert rows["position_angle"].to_pylist() == [30.0, 140.0]
    assert rows["stamp"].to_pylist() == [3, None]
    assert rows["gamma1"].to_numpy() == pytest.approx([0.05, -0.02], abs=1e-8)
    for name in ("bulge_fraction", "bulge_sersic_index", "disk_half_light_radius", "a_v"):
        assert np.all(rows[name].to_numpy() == np.float32(given_sources.GALAXIES[name]))
    assert rows["flux_halpha"].null_count == 2
    assert (points["ra"].to_pylist(), points["dec"].to_pylist()) == ([53.12], [-27.80])
    galaxies, stars = vis_magnitudes(rows, points)
    magnified = -2.5 * np.log10(1.0 / (1.0 - np.array([0.05, 0.02]) ** 2))
    assert galaxies == pytest.approx(np.array([20.0, 24.5]) + magnified, abs=1e-3)
    assert stars == pytest.approx([18.0], abs=1e-4)


def test_lensing_and_rotation_apply_to_given_galaxies(tmp_path):
    keys = "[universe]\nlensing = { g1 = 0.0, g2 = 0.1 }\nrotation = 90.0"
    rows, points = made(tmp_path, stars=None, extra=keys)
    assert rows.sort_by("origin_id")["position_angle"].to_pylist() == [120.0, 50.0]
    assert np.all(rows["gamma1"].to_numpy() == 0.0)
    assert np.all(rows["gamma2"].to_numpy() == np.float32(0.1))
    assert len(points) == 0


def test_rows_stand_on_a_grid_in_turn(tmp_path):
    without = [",".join(line.split(",")[2:]) for line in TWO.splitlines()]
    star = "mag,teff\n18.0,4000\n"
    rows, points = made(tmp_path, 'only = "grid"\nspacing = 20.0', galaxies="\n".join(without), stars=star)
    numbers = np.array([np.sum(rows["origin_id"].to_numpy() == row) for row in (1, 2)] + [len(points)])
    assert numbers.sum() == pytest.approx(np.pi * (0.05 * 3600.0 / 20.0) ** 2, rel=0.05)
    assert np.ptp(numbers) <= 1
    ra = np.concatenate([rows["ra"].to_numpy(), points["ra"].to_numpy()])
    dec = np.concatenate([rows["dec"].to_numpy(), points["dec"].to_numpy()])
    apart = 3600.0 * sky.separation(ra[:, None], dec[:, None], ra[None], dec[None])
    np.fill_diagonal(apart, np.inf)
    assert apart.min(axis=1) == pytest.approx(20.0, rel=1e-4)


BAD = [
    ({"galaxies": TWO.replace("24.5", "")}, r"galaxies.csv: column mag of row 2 is NaN, but must be a number from "),
    ({"galaxies": TWO.replace("24.5", "faint")}, r"galaxies.csv: column mag of row 2 is 'faint', but must be a number"),
    ({"galaxies": TWO.replace("-27.81", "-97.81")}, r"galaxies.csv: column dec of row 2 is -97.81"),
    (
        {"galaxies": TWO.replace("53.11", "63.11")},
        r"galaxies.csv: columns ra and dec of row 2 are 63.11 and -27.81 deg, but must be in the area, the circle",
    ),
    (
        {"galaxies": TWO.replace("-0.02", "-0.95")},
        r"columns kappa, gamma1 and gamma2 of row 2 give an image near a caustic, but",
    ),
    ({"galaxies": TWO.replace("gamma1", "shear")}, r"unknown column shear \(rename it to gamma1 or gamma2\); remove"),
    ({"galaxies": TWO.replace("gamma1", "foo")}, r"galaxies.csv: unknown column foo; allowed are ra, dec, mag"),
    ({"galaxies": TWO.replace("gamma1", "mag")}, r"galaxies.csv: has column mag more than once"),
    (
        {"galaxies": TWO.replace("gamma1", "ext_law")},
        "ext_law of row 2 is -0.02",
    ),
    ({"galaxies": TWO.replace("gamma1", "ext_law").replace("-0.02", "2")}, "row 1 is 0.05, but must be a whole number"),
    ({"galaxies": "ra,dec\n53.1,-27.8\n"}, r"galaxies.csv: column mag is missing"),
    ({"galaxies": "ra,dec,mag\n"}, r"galaxies.csv: the table has no rows"),
    ({"galaxies": ""}, r"galaxies.csv: .*mpty"),
    ({"stars": STAR.replace("4000", "4")}, r"stars.csv: column teff of row 1 is 4"),
    (
        {"more": 'only = "grid"\nspacing = 20.0'},
        'columns ra and dec .* only = "grid", .*: remove them, or write only = "table"',
    ),
    ({"more": 'only = "grid"'}, r"sources.spacing is missing"),
    ({"more": 'only = "table"\nspacing = 20.0'}, r"sources.spacing requires only"),
    ({"more": 'only = "some"'}, r"sources.only = 'some'"),
    ({"more": 'only = "table"\nband = "johnson_q"'}, r"sources.band = 'johnson_q' is not one of"),
    ({"galaxies": None, "stars": None}, r"sources must have galaxies or stars"),
    ({"extra": "[stars]\nbright_limit = 15.0"}, r"sources: .* section stars"),
    ({"extra": '[ingest.halos]\nfiles = ["x.csv"]'}, r"sources: .* section ingest"),
]


@pytest.mark.parametrize(("keys", "words"), BAD, ids=range(len(BAD)))
def test_bad_tables_are_refused(tmp_path, keys, words):
    with pytest.raises(BadInput, match=words) as caught:
        made(tmp_path, **keys)
    assert all(line.strip() for line in str(caught.value).splitlines())
    assert not (tmp_path / "lake" / "galaxies").exists()


MAPPED = """
[sources]
only = "table"
[sources.galaxies]
file = "theirs.{}"
[sources.galaxies.columns]
ra = "RA"
dec = "DEC"
mag = {{ column = "FLUX", log10 = true, scale = -2.5, offset = 23.9 }}
z_true = "Z"
half_light_radius = "R"
e1 = "E1"
e2 = "E2"
ellipticity = "distortion"
frame = "west_north"
"""


def written_as(form, path, columns):
    """Write columns to a file in one of the formats of [ingest]."""
    if form == "parquet":
        pq.write_table(pa.table(columns), path)
    elif form == "hdf5":
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file.create_dataset(f"data/{name}", data=values)
    else:
        Table(columns).write(path)


@nightly.parametrize("form", ["csv", "fits", "parquet", "hdf5"], (0, 1, 2))
def test_every_format_of_ingest_is_read_with_a_mapping(tmp_path, form):
    """Columns that are not mapped are ignored; ellipticities become axis ratios and position angles."""
    columns = {
        "RA": np.array([53.1, 53.11]), "DEC": np.array([-27.8, -27.81]), "Z": np.array([0.3, 0.5]),
        "FLUX": 10.0 ** (0.4 * (23.9 - np.array([20.0, 24.5]))), "R": np.array([0.5, 0.7]), "flag": np.array([1, 2]),
        "E1": np.array([0.3, 0.0]), "E2": np.array([0.4, 0.0]),
    }  # fmt: skip
    written_as(form, tmp_path / f"theirs.{form}", columns)
    request = parse(requests.written(tmp_path, MAPPED.format(form), requests.FIELD.format(0.05)))
    sources = given_sources.load(request.sources, request.area, FIDUCIAL)
    rows = {name: values[np.argsort(sources.galaxies["origin_id"])] for name, values in sources.galaxies.items()}
    assert len(sources.stars["mag"]) == 0
    assert rows["mag"] == pytest.approx([20.0, 24.5], abs=1e-10)
    for name in ("bulge_half_light_radius", "disk_half_light_radius"):
        assert rows[name].tolist() == [0.5, 0.7]
    shear = galsim.Shear(e1=0.3, e2=0.4)
    for name in ("bulge_axis_ratio", "disk_axis_ratio"):
        assert rows[name] == pytest.approx([shear.q, 1.0], abs=1e-12)
    assert rows["position_angle"][0] == pytest.approx(shear.beta / galsim.degrees - 90.0, abs=1e-9)
    assert rows["bulge_sersic_index"].tolist() == [4.0, 4.0]
    assert request.sources.count_rows() == {"galaxies": 2}
    assert set(request.sources.facts((0.0, 0.0, 1.0))) == {"sha256", "band", "columns"}


def test_all_mistakes_of_both_tables_are_reported_at_once(tmp_path):
    galaxies = "ra,dec,mag,z_true,bulge_fraction\n" + "53.1,-27.8,20,0.2,0.5\n" + "153.1,-27.8,20,-1,2\n" * 3
    request = asked(
        tmp_path, more='only = "table"\nband = "lsst_q"', galaxies=galaxies, stars=STAR.replace("4000", "4")
    )
    with pytest.raises(BadInput) as caught:
        given_sources.load(request.sources, request.area, FIDUCIAL)
    lines = [line.replace(f"{tmp_path}/", "") for line in caught.value.messages]
    assert lines[0].startswith("sources.band = 'lsst_q' is not allowed: allowed with lsst: lsst_u, lsst_g, ")
    assert lines[1:] == [
        "sources.galaxies: galaxies.csv: column z_true of row 2 is -1, but must be from 0 to 15 (2 more rows)",
        "sources.galaxies: galaxies.csv: column bulge_fraction of row 2 is 2, but must be from 0 to 1 (2 more rows)",
        "sources.stars: stars.csv: column teff of row 1 is 4, but must be from 300 to 100000",
    ]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ('ra = "RA", mag = "MAG"', "sources.galaxies.columns must have dec"),
        ('ra = "ra", dec = "dec", mag = "mag", e1 = "z_true", e2 = "mag"', "e1, e2 require ellipticity"),
        ('ra = "ra", dec = "dec", mag = "mag", e1 = "mag", ellipticity = "shear"', "e1 requires e2"),
        ('ra = "ra", dec = "dec", mag = "mag", e1 = "mag", e2 = "mag", ellipticity = "shears"', "did you mean shear"),
        (
            'ra = "ra", dec = "dec", mag = "mag", axis_ratio = "mag", disk_axis_ratio = "mag"',
            "axis_ratio replaces disk",
        ),
        ('ra = "ra", dec = "dec", mag = "mag", frame = "north_east"', "frame requires e1 and e2"),
        ('ra = "ra", dec = "dec", mag = "mag", bulge_fracton = "x"', "did you mean bulge_fraction"),
        (
            'ra = "ra", dec = "dec", mag = "MAG_I"',
            r"^sources.galaxies.columns.mag: .*galaxies.csv has no column MAG_I \(did you mean mag\?\); it has ra",
        ),
        ('ra = "ra", dec = "dec", mag = "mag", r_e = "mag"', r"columns.r_e .* did you mean half_light_radius\?$"),
    ],
)
def test_a_wrong_mapping_is_refused(tmp_path, columns, message):
    (tmp_path / "galaxies.csv").write_text("ra,dec,mag,z_true\n53.1,-27.8,20,0.2\n")
    text = f'[sources]\nonly = "table"\n[sources.galaxies]\nfile = "galaxies.csv"\ncolumns = {{ {columns} }}\n'
    request = parse(requests.written(tmp_path, text, requests.FIELD.format(0.05)))
    with pytest.raises(BadInput, match=message):
        given_sources.load(request.sources, request.area, FIDUCIAL)


def test_a_column_of_another_name_is_one_line(tmp_path):
    request = asked(tmp_path, galaxies=TWO.replace("mag,", "MAG_AUTO,"), stars=None)
    with pytest.raises(BadInput) as caught:
        given_sources.load(request.sources, request.area, FIDUCIAL)
    (line,) = caught.value.messages
    assert "galaxies.csv: column mag is missing; did you mean MAG_AUTO? Rename it to mag, or map all columns" in line
    assert 'columns = { mag = "MAG_AUTO", .. }' in line


def test_a_longer_name_of_a_column_is_one_line(tmp_path):
    request = asked(tmp_path, galaxies=TWO.replace("mag,", "magnitude,"), stars=None)
    with pytest.raises(BadInput) as caught:
        given_sources.load(request.sources, request.area, FIDUCIAL)
    (line,) = caught.value.messages
    assert "galaxies.csv: column mag is missing; did you mean magnitude? Rename it to mag" in line


def test_names_of_other_catalogues_are_answered_with_names_of_columns(tmp_path):
    text = "RAJ2000,DEJ2000,mag_r,r_e,n,foo\n53.1,-27.8,20,0.3,4,1\n"
    request = asked(tmp_path, galaxies=text, stars=None)
    with pytest.raises(BadInput) as caught:
        given_sources.load(request.sources, request.area, FIDUCIAL)
    lines = [line.partition("galaxies.csv: ")[2].partition(", or map")[0] for line in caught.value.messages]
    assert lines[:3] == [
        "column ra is missing; did you mean RAJ2000? Rename it to ra",
        "column dec is missing; did you mean DEJ2000? Rename it to dec",
        "column mag is missing; did you mean mag_r? Rename it to mag",
    ]
    renamed = "r_e (rename it to half_light_radius), n (rename it to bulge_sersic_index), foo; allowed are "
    assert lines[3].startswith(f"unknown columns {renamed}")
    assert 'columns = { half_light_radius = "r_e", .. }' in caught.value.messages[3]


def test_ellipticities_of_tables_in_memory_are_refused_with_the_remedy():
    columns = {"ra": np.array([1.0]), "dec": np.array([2.0]), "mag": np.array([20.0]), "e1": np.array([0.1])}
    with pytest.raises(
        BadInput, match="rows: columns e1 and e2 are not possible here: give axis_ratio and position_an"
    ):
        given_sources.from_arrays({"galaxies": (Path("rows"), columns)}, FIDUCIAL)


def test_positions_in_radians_are_named(tmp_path):
    request = asked(tmp_path, galaxies="ra,dec,mag\n0.927,-0.485,24\n0.9271,-0.4851,24\n", stars=None)
    with pytest.raises(BadInput, match=r"of row 1 are 0.927 and -0.485 deg, .*in radians, convert .*\(1 more row\)"):
        given_sources.load(request.sources, request.area, FIDUCIAL)


def test_sizes_in_another_unit_are_converted_or_refused(tmp_path):
    request = asked(tmp_path, more='only = "table"\n[sources.galaxies]\nfile = "sizes.fits"', galaxies=None, stars=None)
    for unit, factor in (("arcmin", 60.0), ("pix", None)):
        table = Table({"ra": [53.1], "dec": [-27.8], "mag": [24.0], "disk_half_light_radius": [0.01]})
        table["disk_half_light_radius"].unit = unit
        table.write(tmp_path / "sizes.fits", overwrite=True)
        if factor:
            sources = given_sources.load(request.sources, request.area, FIDUCIAL)
            assert sources.galaxies["disk_half_light_radius"] == pytest.approx([0.01 * factor])
            continue
        with pytest.raises(BadInput, match="column disk_half_light_radius has the unit pix, but must be in arcsec or"):
            given_sources.load(request.sources, request.area, FIDUCIAL)


def test_an_impossible_absolute_magnitude_is_named(tmp_path):
    """The job that computes fluxes would refuse it."""
    galaxies = "ra,dec,mag,z_true\n53.1,-27.8,24,0.2\n53.1,-27.8,28.5,0\n"
    request = asked(tmp_path, galaxies=galaxies, stars=None)
    with pytest.raises(BadInput, match=r"magnitude from columns mag and z_true of row 2 is 6\.\d+, but must be from"):
        given_sources.load(request.sources, request.area, FIDUCIAL)


def test_a_table_that_changes_while_it_is_read_is_refused(tmp_path):
    wanted = asked(tmp_path)
    step = build_galaxies.steps(tmp_path, wanted)[0]
    asked(tmp_path, galaxies=TWO.replace("20.0", "20.1"))
    with pytest.raises(BadInput, match="has changed since the job began"):
        step.run_task(tmp_path, {**step.plan.facts, **step.plan.tasks[0].facts})
    assert build_galaxies.steps(tmp_path, wanted)[0].plan.key != step.plan.key


def test_a_grid_of_too_many_places_is_refused(tmp_path):
    with pytest.raises(
        BadInput, match=r"sources.spacing = 0.01: the grid around the area must have at most 4000000 positions"
    ):
        made(tmp_path, 'only = "grid"\nspacing = 0.01', galaxies="mag\n20\n", stars=None)
