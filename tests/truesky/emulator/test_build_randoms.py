"""The job draws random points for a request, and refuses densities, bands and areas that it cannot fill."""

import shutil
from types import SimpleNamespace

import numpy as np
import pyarrow.compute as pc
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, publish, read, validate
from lake_schema.tables.survey.randoms import RANDOMS
from tests import requests
from tests.truesky.emulator import samples
from tests.truesky.survey_maps import depths
from truesky.emulator import build_randoms, model
from truesky.request.from_toml import from_table
from truesky.running import submitted_job

# Four order-5 cells meet here.
RA, DEC = 53.4375, -27.279613
CELLS = sky.cells_in_cone(RA, DEC, 0.3, GENERATION_ORDER)


def wanted(ra=RA, radius=0.3, **fields):
    table = {"name": "test", "seed": 1, "area": {"cone": {"ra": ra, "dec": DEC, "radius": radius}}}
    request = from_table(table | {"fluxes": {"bands": ["euclid_vis"]}})
    return submitted_job.replace(request, **fields)


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Depth in two bands; the second one covers only one cell."""
    root = tmp_path_factory.mktemp("lake")
    pixels = depths.pixels_of(CELLS)
    second = depths.columns_of(depths.pixels_of(CELLS[:1]), "lsst_r", depth_point=np.full(depths.PIXELS, 24.0))
    depths.publish_depth(root, depths.columns_of(pixels), second)
    return root


def made(lake, folder, request):
    """Rows of the table in a copy of the lake."""
    root = folder / f"{'-'.join(request.band)}-{request.density}"
    shutil.copytree(lake, root, symlinks=True)
    (step,) = build_randoms.steps(root, request)
    publish.make_version(root, step.plan, step.run_task)
    return read.version(root, "randoms")


def test_rows_do_not_depend_on_the_division_into_files(lake, tmp_path, monkeypatch):
    coarse = made(lake, tmp_path / "a", wanted(band=("euclid_vis",), density=3.0))
    monkeypatch.setattr(build_randoms, "_ROWS_A_FILE", 1)
    fine = made(lake, tmp_path / "b", wanted(band=("euclid_vis",), density=3.0))
    orders = [{layout.cell_of_file(name)[0] for name in version.partitions} for version in (coarse, fine)]
    assert orders == [{5}, {GENERATION_ORDER}]
    assert coarse.rows().num_rows > 500
    assert fine.rows().sort_by("_healpix_29").equals(coarse.rows().sort_by("_healpix_29"))


def test_all_bands_have_the_same_points(lake, tmp_path):
    rows = [made(lake, tmp_path, wanted(band=(band,), density=3.0)).rows() for band in ("euclid_vis", "lsst_r")]
    (deep, small), places = rows, ["id", "ra", "dec", "_healpix_29"]
    inside = np.isin(deep["_healpix_29"].to_numpy() >> 42, CELLS[:1])
    assert small.select(places).equals(deep.select(places).filter(inside))
    assert set(small["depth_point"].to_pylist()) == {24.0}
    assert set(small["band"].to_pylist()) == {"lsst_r"}


def test_several_bands_in_one_table(lake, tmp_path):
    """The rows of each band are those of a table of this band; each band has the detection of its own model."""
    file = samples.write(tmp_path / "vis.parquet")
    more = {"density": 3.0, "model": (str(file),), "magnitude": 25.0}
    both = made(lake, tmp_path / "c", wanted(band=("lsst_r", "euclid_vis"), **more)).rows()
    assert np.all(np.diff(both["_healpix_29"].to_numpy()) >= 0)
    assert validate.find_violations(both, RANDOMS) == []
    for band in ("euclid_vis", "lsst_r"):
        single = made(
            lake, tmp_path / "d", wanted(band=(band,), **(more if band == "euclid_vis" else {"density": 3.0}))
        )
        assert both.filter(pc.equal(both["band"], band)).equals(single.rows())
    assert both["detection"].null_count == np.count_nonzero(both["band"].to_numpy() == "lsst_r") > 0


def test_only_cells_of_the_request_are_filled(lake, tmp_path):
    request = wanted(radius=0.01, band=("euclid_vis",))
    index = made(lake, tmp_path, request).rows(["_healpix_29"])["_healpix_29"].to_numpy()
    assert set(index >> 42) == set(request.area.cells()) < set(CELLS.tolist())


@pytest.mark.parametrize(
    ("request_of_user", "words"),
    [
        (wanted(), "--band is missing: table depth has euclid_vis, lsst_r"),
        (wanted(band=("hsc_r",)), "--band hsc_r: table depth has only euclid_vis, lsst_r"),
        (wanted(band=("euclid_vis",), density=0.0), "density = 0.0 is outside [0.001, 10000.0] per arcmin2"),
        (wanted(band=("euclid_vis",), density=np.nan), "density = nan is outside"),
        (wanted(band=("euclid_vis",), ra=20.0), "no exposure in band euclid_vis covers it"),
    ],
)
def test_what_cannot_be_filled_is_refused(lake, request_of_user, words):
    with pytest.raises(BadInput) as error:
        build_randoms.steps(lake, request_of_user)
    assert words in str(error.value)


def test_a_density_that_would_fill_the_disc_is_refused(lake, monkeypatch):
    monkeypatch.setattr(build_randoms.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    with pytest.raises(BadInput, match=r"^--density: .* random points take .* MB, and 1 MB are free"):
        build_randoms.steps(lake, wanted(band=("euclid_vis",), density=1000.0))


def test_the_only_band_need_not_be_named(tmp_path):
    depths.publish_depth(tmp_path, depths.columns_of(depths.pixels_of(CELLS[:1])))
    (step,) = build_randoms.steps(tmp_path, wanted())
    assert step.plan.facts["bands"] == ["euclid_vis"]


def test_a_row_takes_about_as_many_bytes_as_forecast(lake, tmp_path):
    version = made(lake, tmp_path, wanted(band=("euclid_vis",)))
    size = sum(entry["bytes"] for entry in version.manifest["files"] if "Norder" in entry["path"])
    assert version.num_rows * build_randoms._ROW_BYTES == pytest.approx(size, rel=0.3)


def test_options_replace_density_and_band(lake, tmp_path, capsys):
    """The command refuses its input in one line, and writes nothing."""
    path = requests.written(tmp_path, area=f"cone = {{ ra = {RA}, dec = {DEC}, radius = 0.1 }}")
    arguments = ["--lake", str(lake), "--request", str(path), "--density", "1e9", "--band", "euclid_vis"]
    assert submitted_job.main(build_randoms.JOB, arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("build_randoms: density = 1000000000.0 is outside")
    assert len(err.splitlines()) == 1
    assert submitted_job.main(build_randoms.JOB, [*arguments[:-1], "hsc_r", "--density", "3"]) == 2
    assert "--band hsc_r" in capsys.readouterr().err
    assert not (lake / "randoms").exists()


def test_a_model_gives_the_detection_of_galaxies(lake, tmp_path):
    file = samples.write(tmp_path / "vis.parquet")
    request = wanted(band=("euclid_vis",), density=3.0)
    plain = made(lake, tmp_path / "a", request)
    with_model = made(lake, tmp_path / "b", submitted_job.replace(request, model=(str(file),), magnitude=25.0))
    assert with_model.key != plain.key
    rows = with_model.rows()
    assert rows.drop("detection").equals(plain.rows().drop("detection"))
    expected = model.read_model(file).detection_probability(25.0, rows["depth_point"].to_numpy())
    np.testing.assert_allclose(rows["detection"].to_numpy(), expected, rtol=1e-6)
    assert 0.0 < expected.min() < 1.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"model": ("{}",)}, "--magnitude is missing"),
        ({"magnitude": 25.0}, "--magnitude is of use only with --model"),
        ({"model": ("{}", "{}"), "magnitude": 25.0}, "another model is of band euclid_vis, too"),
        ({"model": ("{}",), "magnitude": 25.0, "band": ("lsst_r",)}, "it is of band euclid_vis, not of lsst_r"),
        ({"model": ("{}",), "magnitude": float("nan")}, "magnitude = nan"),
        ({"model": ("{}x",), "magnitude": 25.0}, "vis.parquetx"),
    ],
)
def test_wrong_models_are_refused(lake, tmp_path, fields, message):
    file = samples.write(tmp_path / "vis.parquet", n=200)
    fields = {"band": ("euclid_vis",), "density": 3.0} | fields
    fields["model"] = tuple(name.format(file) for name in fields.get("model", ()))
    with pytest.raises(BadInput, match=message):
        build_randoms.steps(lake, wanted(**fields))


def test_a_model_that_was_replaced_during_the_job_is_refused(lake, tmp_path):
    file = samples.write(tmp_path / "vis.parquet", n=200)
    (step,) = build_randoms.steps(lake, wanted(band=("euclid_vis",), density=3.0, model=(str(file),), magnitude=25.0))
    samples.write(file, n=300)
    with pytest.raises(BadInput, match="it was replaced during the job"):
        step.run_task(lake, {**step.plan.facts, **step.plan.tasks[0].facts})
