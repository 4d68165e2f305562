"""The table `light_curves`: fluxes of the sources that change on the detectors of planned exposures, and refusals."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pytest

import truesky
from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import layout, plan, publish, read
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
from tests import requests
from truesky.catalogue import build_active_nuclei, build_galaxies, build_stars, build_transients
from truesky.fluxes import compute_fluxes
from truesky.light_curve_tables import build_light_curves
from truesky.render import plan_exposures, product_plan
from truesky.render.planning.mission import mission_of
from truesky.render.sources import varying_stars
from truesky.request import from_toml

PAGE = Path(__file__).resolve().parents[3] / "docs" / "light_curves.md"
CHANGES = "transients = { start = 61000.0, end = 61100.0, boost = 20.0 }\nvariables = true\nquasar_boost = 6.0\n"
AREA = requests.FIELD.format(0.1)
# Half the side and half the diagonal of a CCD of LSST with 0.2 arcsec and 4096 pixels, deg.
HALF_SIDE, HALF_DIAGONAL = 0.11, 0.165


def pointing(mjd):
    return f"""
[[pointing]]
channel = "EXT"
camera = "lsstcam"
band = "lsst_r"
ra = 53.117
dec = -27.808
mjd = {mjd}
centre_on = "R22_S11"
detectors = ["R22_S11"]
"""


TWO_DATES = pointing(61020.0) + pointing(61060.0)


def wanted(folder, changes=CHANGES, pointings=TWO_DATES):
    sections = f'{requests.shallow(21.5, 21.5, changes)}\n[fluxes]\nbands = ["lsst_r"]\n{pointings}'
    return from_toml.parse(requests.written(folder, sections, area=AREA, name="sky", seed=3))


def make(root, request, *jobs):
    for job in jobs:
        for step in job.steps(root, request):
            publish.make_version(root, step.plan, step.run_task, name=request.name)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Return the folder of a lake with light curves in two exposures of a detector."""
    folder = tmp_path_factory.mktemp("light_curves")
    root, request = layout.resolve_lake(folder / "lake"), wanted(folder)
    jobs = build_galaxies, build_stars, compute_fluxes, build_active_nuclei, build_transients, plan_exposures
    make(root, request, *jobs, build_light_curves)
    return root


@pytest.fixture(scope="module")
def lake(root):
    with truesky.open(root) as opened:
        yield opened


@pytest.fixture(scope="module")
def rows(root):
    return read.version(root, "light_curves").rows().to_pandas()


@pytest.mark.parametrize("source_type", [1, 2, 3, 4])
def test_fluxes_are_those_of_light_curve(lake, rows, source_type):
    chosen = rows[rows["source_type"] == source_type]
    assert len(chosen) > 1
    for mjd, group in chosen.groupby("mjd"):
        curve = lake.light_curve(group["id"].to_numpy(), "lsst_r", mjd)
        np.testing.assert_allclose(group["f_nu"], curve["f_nu"], rtol=1e-6)


def test_dates_are_the_middles_of_the_exposures(lake, rows):
    middles = lake.sql("SELECT exposure_id, mjd + exposure_time_s / 172800 AS middle FROM exposures")
    expected = middles.set_index("exposure_id")["middle"].loc[rows["exposure_id"]]
    np.testing.assert_allclose(rows["mjd"], expected, rtol=0.0, atol=1e-9)
    assert rows["mjd"].nunique() == 2


def test_mean_fluxes(lake, rows):
    """Stars and quasars have the flux of the catalogue; the light of nuclei is near their mean at both dates."""
    assert rows["f_nu_mean"].isna().equals(rows["source_type"] == 1)
    for source_type, table in ((2, "star_fluxes"), (3, "galaxy_fluxes")):
        chosen = rows[rows["source_type"] == source_type]
        mean = lake.sql(f"SELECT id, f_nu_lsst_r FROM {table}").set_index("id")["f_nu_lsst_r"].loc[chosen["id"]]
        np.testing.assert_array_equal(chosen["f_nu_mean"], mean)
        assert (chosen["f_nu"] != chosen["f_nu_mean"]).any()
    nuclei = rows[rows["source_type"] == 4]
    assert 0.5 < np.median(nuclei["f_nu"] / nuclei["f_nu_mean"]) < 2.0


@pytest.mark.parametrize(
    ("source_type", "query"),
    [
        (1, "SELECT id, ra, dec FROM transients"),
        (2, "SELECT id, ra, dec FROM stars WHERE variability IS NOT NULL"),
        (3, "SELECT id, ra, dec FROM active_nuclei WHERE kind = 2"),
        (4, "SELECT point_id AS id, ra, dec FROM active_nuclei WHERE kind < 2 AND type = 1 AND mag_1450 < 32"),
    ],
)
def test_sources_on_the_detector_have_rows_and_others_have_none(lake, rows, source_type, query):
    sources = lake.sql(query)
    distance = sky.separation(sources["ra"].to_numpy(), sources["dec"].to_numpy(), 53.117, -27.808)
    (mjd, *_) = rows["mjd"]
    inside, outside = sources[distance < HALF_SIDE], sources[distance > HALF_DIAGONAL]
    inside = inside[lake.light_curve(inside["id"].to_numpy(), "lsst_r", mjd)["f_nu"].to_numpy() > 0.0]
    present = set(rows["id"][(rows["mjd"] == mjd) & (rows["source_type"] == source_type)])
    assert len(inside) > 0
    assert len(outside) > 0
    assert set(inside["id"]) <= present <= set(sources["id"]) - set(outside["id"])
    assert rows["x"].between(-0.5, 4095.5).all()


def test_blocks_of_exposures_do_not_matter(root, rows, tmp_path, monkeypatch):
    request = wanted(tmp_path)
    monkeypatch.setattr(build_light_curves, "_MAX_DETECTORS", 1)
    (step,) = build_light_curves.steps(root, request)
    blocks = [step.run_task(root, {**step.plan.facts, **task.facts}).rows for task in step.plan.tasks]
    assert len(blocks) == 2
    assert pa.concat_tables(blocks).equals(pa.Table.from_pandas(rows, blocks[0].schema, preserve_index=False))


def test_images_of_a_lensed_supernova_replace_it(root, rows, tmp_path):
    """A copy of the lake has an image of one supernova, twice as bright and at the same place."""
    request, root = wanted(tmp_path), layout.resolve_lake(shutil.copytree(root, tmp_path / "lake", symlinks=True))
    supernova = int(rows[rows["source_type"] == 1].sort_values("f_nu")["id"].iloc[-1])
    transients = read.version(root, "transients")
    (source,) = transients.rows(where=pc.field("id") == supernova).to_pylist()
    (cell,) = sky.parent(np.array([source["_healpix_29"]]), sky.MAX_ORDER, ids.FILE_ORDER).tolist()
    image = {column.name: column.lo or 0 for column in LENSED_IMAGES.columns if not column.nullable}
    image |= {name: value for name, value in source.items() if name in LENSED_IMAGES.names}
    image |= {"id": supernova ^ 1, "source_id": supernova, "magnification": 2.0 * source["magnification"], "parity": 1}
    task = plan.Task(
        layout.cell_file(ids.FILE_ORDER, cell), {"generation_cells": list(range(cell << 6, cell + 1 << 6))}
    )
    facts = {"galaxies": read.version(root, "galaxies").key, "transients": transients.key}
    output = plan.Output(LENSED_IMAGES.build({name: [value] for name, value in image.items()}))
    publish.make_version(root, plan.Plan(LENSED_IMAGES, facts, (task,)), lambda *_: output, name=request.name)
    (step,) = build_light_curves.steps(root, request)
    lensed = step.run_task(root, {**step.plan.facts, **step.plan.tasks[0].facts}).rows.to_pandas()
    images = lensed[lensed["id"] == supernova ^ 1]
    assert set(images["source_type"]) == {5}
    np.testing.assert_allclose(images["f_nu"], 2.0 * rows[rows["id"] == supernova]["f_nu"], rtol=1e-5)
    assert supernova not in set(lensed["id"])
    assert set(rows["id"]) - set(lensed["id"]) == {supernova}


def test_queries_of_the_page_run(lake):
    queries = re.findall(r"```sql\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(queries) == 3
    assert all(len(lake.sql(query)) > 0 for query in queries)


@pytest.mark.parametrize(
    ("changes", "pointings", "message"),
    [
        (CHANGES, "", r"request sky: it has no exposures for light curves"),
        ("", pointing(61020.0), r"request sky: no source changes: set universe.transients or universe.variables"),
    ],
)
def test_requests_without_light_curves_are_refused(tmp_path, changes, pointings, message):
    with pytest.raises(BadInput, match=message):
        build_light_curves.steps(tmp_path, wanted(tmp_path, changes, pointings))


def test_a_plan_without_images_of_the_sky_is_refused(root, tmp_path, monkeypatch):
    monkeypatch.setattr(build_light_curves, "sky_images", lambda exposures: exposures.slice(0, 0))
    with pytest.raises(BadInput, match="its plan has no image of the sky in a passband for light curves"):
        build_light_curves.steps(root, wanted(tmp_path))


def test_a_lake_may_lack_sources_that_change(root, rows, tmp_path, monkeypatch):
    """Without nuclei, or with constant stars, the other rows stay the same."""
    versions = product_plan.input_versions(root, wanted(tmp_path))
    maker = build_light_curves.LightCurveMaker(3, mission_of(wanted(tmp_path).mission))
    monkeypatch.setattr(varying_stars, "add_columns", lambda columns, present: tuple(columns))
    facts = {"plan_part": versions["tasks"].partitions[0], "exposures": [1, 2]}
    for left_out, types in (("active_nuclei", {1}), ("transients", {3, 4})):
        inputs = {name: version.key for name, version in versions.items() if name not in (left_out, "lensed_images")}
        found = maker.make_block(root, {**facts, "inputs": inputs}).rows.to_pandas()
        expected = rows[rows["source_type"].isin(types)].reset_index(drop=True)
        pd.testing.assert_frame_equal(found, expected)
