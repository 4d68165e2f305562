"""The render job on small detectors: products that are made, reused or refused."""

import copy
import json
import os
import shutil
import signal
import tomllib
from collections import Counter
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema import ids, sky, tables
from lake_schema.errors import BadInput, TasksFailed
from lake_schema.store import garbage, layout, publish, read, request_links, stage
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.strong_lenses import STRONG_LENSES
from tests import requests
from tests.faults.victims import CONTEXT
from tests.truesky import nightly
from tests.truesky.render.psf.test_from_file import cube, gaussian
from truesky.catalogue import build_galaxies, build_stars, build_strong_lenses
from truesky.catalogue.galaxies import strong_lenses
from truesky.commands import space
from truesky.fluxes import compute_fluxes
from truesky.render import archive, plan_exposures, product_plan, render_exposures
from truesky.render.camera import detectors
from truesky.render.exposure import truth_maps
from truesky.render.planning import preconditions
from truesky.render.products import keys as products_keys
from truesky.render.products import truth_table
from truesky.render.sources import catalogue_rows
from truesky.request.from_toml import from_table
from truesky.running import submitted_job

# Eight amplifiers next to one another.
SIDE = 304
SMALL = f"""
accuracy = "draft"
{requests.shallow(23.5, 20.0)}
[fluxes]
bands = ["lsst_r"]
[products]
truth = ["noise_free"]
[[pointing]]
channel = "EXT"
camera = "lsstcam"
band = "lsst_r"
ra = 53.117
dec = -27.808
centre_on = "R22_S11"
detectors = ["R22_S11", "R22_S12"]
mjd = 60905.25
"""
REQUEST = tomllib.loads(requests.text(SMALL, requests.FIELD.format(0.03), seed=7))


@contextmanager
def small_detectors():
    """Cut the detectors of LSSTCam to their centres, and move them close together."""
    listed = detectors._read_layout

    def smaller(section, mission):
        return tuple(replace(d, nx=SIDE, ny=SIDE, x=d.x / 20, y=d.y / 20) for d in listed(section, mission))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detectors, "_read_layout", smaller)
        yield


@pytest.fixture(scope="module", autouse=True)
def _small():
    with small_detectors():
        yield


@pytest.fixture(scope="module")
def catalogues(tmp_path_factory):
    root = layout.resolve_lake(tmp_path_factory.mktemp("render") / "lake")
    make(root, wanted(), build_galaxies, build_stars, compute_fluxes)
    return root


@pytest.fixture
def lake(catalogues, tmp_path):
    """Return a lake of catalogues and fluxes."""
    return layout.resolve_lake(shutil.copytree(catalogues, tmp_path / "lake", symlinks=True))


@pytest.fixture(scope="module")
def _once(catalogues, tmp_path_factory):
    root = layout.resolve_lake(shutil.copytree(catalogues, tmp_path_factory.mktemp("once") / "lake", symlinks=True))
    assert render(root, wanted()) == BOTH
    return root


@pytest.fixture
def rendered(_once, tmp_path):
    """Return a lake with the products of `wanted()`."""
    return layout.resolve_lake(shutil.copytree(_once, tmp_path / "rendered", symlinks=True))


def wanted(pointings=1, **sections):
    table = copy.deepcopy({**REQUEST, **sections})
    table["pointing"] = [{**table["pointing"][0], "mjd": 60905.25 + i} for i in range(pointings)]
    return from_table(table)


def make(root, request, *modules, spy=lambda work: work):
    for module in modules:
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, spy(step.run_task))


def render(root, request, fail=()):
    """Render and count the calls for each (exposure, detector)."""
    made = Counter()

    def spy(work):
        def watched(lake, facts):
            if getattr(work, "func", None) is WORK:
                made[facts["exposure_id"], facts["detector"]] += 1
                if facts["detector"] in fail:
                    raise ValueError("no light")
            return work(lake, facts)

        return watched

    make(root, request, plan_exposures)
    if fail:
        with pytest.raises(TasksFailed, match=r"1 of 2 tasks failed: .*ValueError: no light"):
            make(root, request, render_exposures, spy=spy)
    else:
        make(root, request, render_exposures, spy=spy)
    return made


def images(root):
    version = read.version(root, "products")
    return {row["path"]: version.sidecar_path(row["path"]).read_bytes() for row in version.rows().to_pylist()}


WORK = render_exposures.render_task
BOTH = Counter({(1, "R22_S11"): 1, (1, "R22_S12"): 1})


def test_products_of_every_detector_and_rows_of_every_source(rendered):
    tasks, products, truth = (read.version(rendered, name).rows() for name in ("tasks", "products", "rendered_truth"))
    for content in ("science", "noise_free"):
        rows = products.filter(pc.field("content") == content)
        assert sorted(rows["detector"].to_pylist()) == sorted(tasks["detector"].to_pylist())
        for row in rows.to_pylist():
            assert pc.sum(pc.equal(truth["detector"], row["detector"])).as_py() == row["sources"] > 10
    version = read.version(rendered, "products")
    for row in products.filter(pc.field("content") == "noise_free").to_pylist():
        drawn = truth.filter(pc.field("detector") == row["detector"])
        ids, x, y, expected, onto = (drawn[c].to_numpy() for c in ("id", "x", "y", "expected", "drawn"))
        assert (np.diff(ids) > 0).all()
        with fits.open(version.sidecar_path(row["path"])) as file:
            electrons, system = file[0].data.astype(float), WCS(file[0].header)
        # The image is the sum of the stamps and of wings fainter than the noise, which are 4 % with the aureole.
        assert onto.sum() <= electrons.sum() * (1 + 1e-5)
        assert onto.sum() > 0.94 * electrons.sum()
        assert (onto <= expected * 1.001).all()
        sky = {}
        exposed = read.version(rendered, "exposures").rows(where=pc.field("exposure_id") == row["exposure_id"])
        (middle,) = (one["mjd"] + 0.5 * one["exposure_time_s"] / 86400.0 for one in exposed.to_pylist())
        moving = read.version(rendered, "stars").rows(["id", "ra", "dec", "pm_ra", "pm_dec"])
        lensed = read.version(rendered, "galaxies").rows(["id", "ra", "dec"])
        for rows_ in (lensed, catalogue_rows.apply_proper_motion(moving, middle)):
            found = rows_.to_pydict()
            sky |= dict(zip(found["id"], zip(found["ra"], found["dec"], strict=True), strict=True))
        own = system.all_world2pix([sky[i] for i in ids.tolist()], 0)
        np.testing.assert_allclose(own, np.stack([x, y], 1), atol=1e-6)


def test_a_cone_search_finds_a_galaxy_of_an_image(rendered):
    """The header of the file alone gives the positions. A cross-match contains all sources of the image."""
    products, truth = (read.version(rendered, name) for name in ("products", "rendered_truth"))
    catalogues = [read.version(rendered, name) for name in ("galaxies", "galaxy_fluxes")]
    matched = 0
    for row in products.rows(where=pc.field("content") == "noise_free").to_pylist():
        drawn = truth.rows(where=pc.field("detector") == row["detector"])
        drawn = drawn.filter(pa.array(ids.kind_from_id(drawn["id"].to_numpy()) < 4))
        with fits.open(products.sidecar_path(row["path"])) as file:
            places = WCS(file[0].header).all_pix2world(drawn["x"].to_numpy(), drawn["y"].to_numpy(), 0)
        for source, ra, dec in zip(drawn["id"].to_pylist(), *(axis.tolist() for axis in places), strict=True):
            for catalogue in catalogues:
                assert source in catalogue.cone(ra % 360.0, dec, 0.01 / 3600.0, ["id"])["id"].to_pylist()
            matched += 1
    assert matched > 10
    rows = catalogues[0].rows()
    moved = sky.separation(*(rows[name].to_numpy() for name in ("ra", "dec", "ra_true", "dec_true")))
    assert 3600.0 * np.median(moved) > 10.0


def test_a_detector_rendered_alone_has_the_same_bytes(lake, rendered):
    among = images(rendered)
    alone = {**REQUEST["pointing"][0], "detectors": ["R22_S12"]}
    assert render(lake, wanted(pointing=[alone])) == Counter({(1, "R22_S12"): 1})
    one = images(lake)
    assert len(one) == 2
    assert all(among[path] == data for path, data in one.items())


def test_a_failed_detector_does_not_end_the_run(lake, monkeypatch, tmp_path, capsys):
    def here(function, parts, *options):
        return map(function, parts)

    def bad(root, facts):
        raise ValueError("no light")

    monkeypatch.setattr(submitted_job, "_spark_map", here)
    make(lake, wanted(), plan_exposures)
    step, part = render_exposures.steps(lake, wanted())[0], "000001-r22_s11.parquet"
    with monkeypatch.context() as patch:
        patch.setattr(
            render_exposures,
            "render_task",
            lambda root, facts, **_: (bad if facts["detector"] == "R22_S11" else WORK)(root, facts),
        )
        with pytest.raises(TasksFailed, match=rf"1 of 2 tasks failed: {part}: ValueError: no light"):
            submitted_job.run(render_exposures.JOB, lake, wanted())
    assert layout.current_key(lake, "products") is None
    # Planned = made + failed.
    (failed,) = archive.failures(lake).to_pylist()
    assert (failed["part"], failed["error"]) == (part, "ValueError: no light")
    assert archive.main(["--lake", str(lake), "--failures", "--sql", "select error from products"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"error": failed["error"]}
    assert failed["seconds"] >= 0
    assert 0 < failed["peak_gb"] < 100
    assert len(stage.missing_tasks(layout.stage_folder(lake, "products", step.plan.key), step.plan)) == 1
    # The next run makes only failed detectors, which are then no longer listed as failures.
    made = []
    monkeypatch.setattr(
        render_exposures, "render_task", lambda root, facts, **_: made.append(facts) or WORK(root, facts)
    )
    submitted_job.run(render_exposures.JOB, lake, wanted())
    assert [facts["detector"] for facts in made] == ["R22_S11"]
    assert archive.failures(lake).num_rows == 0
    _check_archive(lake, capsys)


def _check_archive(lake, capsys):
    version, rows = read.version(lake, "products"), archive.products(lake)
    for row in rows.to_pylist():
        assert row["sha256"] == file_sha256(version.sidecar_path(row["path"]))
        assert row["bytes"] == version.sidecar_path(row["path"]).stat().st_size
        assert row["seconds"] > 0.01
        assert 0 < row["peak_gb"] < 100
        assert row["path"] in archive.rows_at_place(rows, row["ra"], row["dec"])["path"].to_pylist()
        # Corners of the footprint belong to it; positions half a degree away, or at the antipode, do not.
        ra, dec = map(float, row["s_region"].split()[2:4])
        edge = row["ra"] + (ra - row["ra"]) * 0.999, row["dec"] + (dec - row["dec"]) * 0.999
        assert row["path"] in archive.rows_at_place(rows, *edge)["path"].to_pylist()
        out = row["ra"] + (ra - row["ra"]) * 1.001, row["dec"] + (dec - row["dec"]) * 1.001
        assert row["path"] not in archive.rows_at_place(rows, *out)["path"].to_pylist()
    assert archive.rows_at_place(rows, 53.117, -27.3).num_rows == 0
    assert archive.rows_at_place(rows, (rows["ra"][0].as_py() + 180) % 360, -rows["dec"][0].as_py()).num_rows == 0
    capsys.readouterr()
    query = "select detector from products where content = 'science' order by detector"
    assert archive.main(["--lake", str(lake), "--sql", query]) == 0
    assert [json.loads(line)["detector"] for line in capsys.readouterr().out.splitlines()] == ["R22_S11", "R22_S12"]
    for sql in ("select * from '/etc/passwd'", "selec", "copy products to 'x.csv'", "select * from rows"):
        assert archive.main(["--lake", str(lake), "--sql", sql]) == 2
        assert capsys.readouterr().err.startswith("archive: --sql: ")


def test_distant_sources_do_not_change_the_image(lake, rendered):
    """Sources 8 arcmin or more from the detectors are removed from the lake, in cells that the detectors read.

    Bright stars are kept, because their ghosts are seen from outside the detector.
    """
    for name in ("galaxies", "stars"):
        version = read.version(lake, name)
        table, whole = tables.find_table(name, version.schema.names), version.manifest
        parts = tuple(Task(part["name"], {**part["facts"], "part": part["name"]}) for part in whole["parts"])

        def near(root, facts, version=version):
            rows = version.rows(partitions=[facts["part"]])
            distance = sky.separation(rows["ra"].to_numpy(), rows["dec"].to_numpy(), 53.117, -27.808)
            is_bright = rows["mag_h"].to_numpy() < 14.0 if "mag_h" in rows.column_names else np.zeros(len(rows), bool)
            return Output(rows.filter((distance < 8 / 60) | is_bright))

        publish.make_version(lake, Plan(table, {**whole["facts"], "without": "the far ones"}, parts), near)
        assert 20 < read.version(lake, name).num_rows < 0.95 * version.num_rows
    make(lake, wanted(), compute_fluxes)
    # The files differ, so the detectors are rendered again. The bytes are the same.
    assert render(lake, wanted()) == BOTH
    assert images(lake) == images(rendered)
    drawn = [read.version(root, "rendered_truth").rows() for root in (lake, rendered)]
    assert drawn[0].equals(drawn[1])


def _killed(root, request):
    """Render in a process that is killed while it writes its last image."""

    def work(lake, facts):
        output = step.run_task(lake, facts)
        (path,) = (path for path in output.files if path.endswith("science.fits"))

        def torn(target):
            output.files[path](target)
            os.truncate(target, target.stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)

        last = facts["detector"] == step.plan.tasks[-1].facts["detector"]
        return replace(output, files={**output.files, path: torn}) if last else output

    with small_detectors():
        step = render_exposures.steps(root, request)[0]
        publish.make_version(root, step.plan, work)


def test_an_interrupted_run_ends_with_the_same_bytes(lake, rendered):
    make(lake, wanted(), plan_exposures)
    child = CONTEXT.Process(target=_killed, args=(lake, wanted()))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert layout.current_key(lake, "products") is None
    assert list(layout.table_folder(lake, "products").glob(".stage-*/**/.*tmp*"))
    # Finished work is not repeated.
    (made,) = render(lake, wanted()).items()
    assert made[1] == 1
    assert images(lake) == images(rendered)
    assert _manifests(lake) == _manifests(rendered)


def _manifests(root):
    return [(read.version(root, name).folder / "manifest.json").read_bytes() for name in ("products", "rendered_truth")]


@pytest.mark.nightly
def test_a_staged_image_that_changed_is_rendered_again(lake, rendered):
    render(lake, wanted(), fail=["R22_S11"])
    (image,) = layout.table_folder(lake, "products").glob(".stage-*/images/*/*science.fits")
    data = bytearray(image.read_bytes())
    data[-5000] ^= 1
    image.write_bytes(data)
    assert render(lake, wanted()) == BOTH
    assert images(lake) == images(rendered)


def test_images_of_an_older_version_are_reused(rendered):
    lake = rendered
    first = images(lake)
    assert render(lake, wanted(pointings=2)) == Counter({(2, "R22_S11"): 1, (2, "R22_S12"): 1})
    both = images(lake)
    assert len(both) == 8
    assert all(both[path] == data for path, data in first.items())
    assert read.find_faults(read.version(lake, "products"), deep=True) == []
    assert read.version(lake, "rendered_truth").num_rows == sum(
        row["sources"] for row in read.version(lake, "products").rows().to_pylist() if row["content"] == "science"
    )
    # The older version can be removed; reused files remain.
    garbage.collect(lake, "products", delete=True)
    assert images(lake) == both


def named(root, request, *modules):
    """Make the tables like `make`, for the name of the request."""
    for module in modules:
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, step.run_task, name=request.name)


def planned_parts(root, request):
    """Return the tasks of the next version, for images and truth tables."""
    return [sorted(part.name for part in step.plan.tasks) for step in render_exposures.steps(root, request)]


def test_new_products_are_added_to_existing_ones(rendered):
    """Products requested later are added to the existing ones; products with changed inputs are dropped."""
    lake, whole = rendered, wanted()
    named(lake, whole, plan_exposures, render_exposures)
    before, key = images(lake), request_links.linked_key(lake, whole.name, "products")
    for part in ({"limit": 1}, {"detectors": ("R22_S12",)}):
        named(lake, replace(whole, **part), render_exposures)
        assert request_links.linked_key(lake, whole.name, "products") == key
    assert garbage.collect(lake, "products", delete=True) == []
    assert images(lake) == before
    one = ["000001-r22_s12.parquet"]
    both = ["000001-r22_s11.parquet", *one]
    # A later exposure of the plan is added to the images of the first one.
    named(lake, two := wanted(pointings=2), plan_exposures)
    assert planned_parts(lake, replace(two, limit=1)) == [both, both]
    assert planned_parts(lake, replace(two, limit=3)) == [[*both, "000002-r22_s11.parquet"]] * 2
    # Another noise seed gives other images; another request does not have these images.
    named(lake, other := replace(whole, noise_seed=8), plan_exposures)
    assert planned_parts(lake, replace(other, detectors=("R22_S12",))) == [one, one]
    named(lake, other := replace(whole, name="y"), plan_exposures)
    assert planned_parts(lake, replace(other, detectors=("R22_S12",))) == [one, one]


def size_of(root, *tables):
    folders = [layout.current_link(root, table).resolve() for table in tables]
    return sum(path.stat().st_size for folder in folders for path in folder.rglob("*") if path.is_file())


@pytest.mark.nightly
def test_reused_files_need_no_disk_space(rendered):
    """Reused catalogues and images with unchanged keys need no space; products of other requests do not count."""
    lake, whole, files = rendered, wanted(), read.version(rendered, "products").manifest["files"]
    # The version belongs to the request, as after a job.
    request_links.link_version(lake, whole.name, "products", str(layout.current_key(lake, "products")))
    catalogues = size_of(lake, "halos", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")
    products = sum(entry["bytes"] for entry in files)
    one = sum(entry["bytes"] for entry in files if "R22_S12" in entry["path"] or "r22_s12" in entry["path"])

    def there(request, limit=None, detectors=()):
        plan = plan_exposures.plan(lake, request)[1:]
        return space._reusable_bytes(lake, replace(request, limit=limit, detectors=detectors), plan)

    assert there(whole) == there(wanted(pointings=2)) == catalogues + products
    assert there(whole, detectors=("R22_S12",)) == catalogues + one
    assert 0 < one < products
    assert there(replace(whole, noise_seed=8)) == catalogues
    assert there(replace(whole, area=replace(whole.area, radius=0.9))) == 0
    assert there(replace(whole, seed=8)) == 0


def test_a_damaged_image_is_not_reused(rendered):
    lake = rendered
    image = min(layout.current_link(lake, "products").resolve().glob("images/*/*R22_S12*science.fits"))
    data = bytearray(image.read_bytes())
    data[-5000] ^= 1
    image.write_bytes(data)
    again = render(lake, wanted(pointings=2))
    assert again == Counter({(1, "R22_S12"): 1, (2, "R22_S11"): 1, (2, "R22_S12"): 1})


def keys(root, request, plan=False):
    """Return the product key of each partition, as in a run with a new plan or the existing one."""
    if plan:
        make(root, request, plan_exposures)
    return {part.name: part.facts["product"] for part in render_exposures.steps(root, request)[0].plan.tasks}


def test_product_keys_depend_on_all_inputs(rendered, monkeypatch, tmp_path):
    there = read.version(rendered, "products").manifest["parts"]
    assert keys(rendered, wanted()) == {part["name"]: part["facts"]["product"] for part in there}
    found = [keys(rendered, wanted(**some)) for some in ({}, {"effects": {"off": ["poisson"]}}, {"accuracy": "survey"})]
    for table in ("galaxies", "galaxy_fluxes", "stars", "star_fluxes"):
        with monkeypatch.context() as patch:
            patch.setattr(read.Version, "partition_sha256", lambda self, part, name=table: f"{self.table == name}")
            found.append(keys(rendered, wanted()))
    with monkeypatch.context() as patch:
        patch.setattr(product_plan, "code_version", lambda: "another")
        found.append(keys(rendered, wanted()))
    noise = {"ext.lsstcam.read_noise": {"value": 7.0, "unit": "electron"}}
    found.append(keys(rendered, wanted(mission={"overrides": noise}), plan=True))
    for width in (0.3, 0.4):
        own = cube(tmp_path / "psf.fits", gaussian(width))
        found.append(keys(rendered, wanted(psf={"lsst_r": str(own)}), plan=True))
    with monkeypatch.context() as patch:
        patch.setattr(products_keys, "file_sha256", lambda path: "another")
        step = render_exposures.steps(rendered, wanted(psf={"lsst_r": str(own)}))[0]
    with pytest.raises(BadInput, match=r"psf.fits: has changed since the rendering began"):
        render_exposures.render_task(rendered, {**step.plan.facts, **step.plan.tasks[0].facts})
    assert all(len({some[part] for some in found}) == len(found) for part in found[0])
    # Other options do not change the key.
    assert found[0].items() < keys(rendered, wanted(pointings=2), plan=True).items()


@pytest.mark.nightly
def test_another_mission_changes_all_keys(rendered):
    before = images(rendered)
    noise = {"ext.lsstcam.read_noise": {"value": 7.0, "unit": "electron"}}
    assert render(rendered, wanted(mission={"overrides": noise})) == BOTH
    for path, data in images(rendered).items():
        assert ("noise_free" in path) or data != before[path]


def two_lenses(cell, galaxies, seed, boost, cosmology):
    """Replace ray shooting: use the two galaxies of a cell that are closest to the pointing."""
    away = sky.separation(*(galaxies[name].to_numpy() for name in ("ra", "dec")), 53.117, -27.808)
    rows = galaxies.take(np.argsort(away)[:2])
    rest = {c.name: np.ones(2, int if c.type.startswith("int") else float) for c in STRONG_LENSES.columns}
    placed = {name: rows[name].to_numpy() for name in ("ra", "dec", "_healpix_29", "ra_true", "dec_true")}
    named = {"id": ids.source_id(np.full(2, 4), cell, 4_000_000 + np.arange(2)), "lens_id": rows["id"].to_numpy()}
    drawn = {"stamp_side": np.full(2, 20), "stamp": pa.array([[0.01] * 400] * 2, pa.list_(pa.float32()))}
    order = np.argsort(placed["_healpix_29"])
    table = {**rest, **placed, **named, **drawn, "source_id": named["lens_id"], "kind": np.full(2, 4)}
    return STRONG_LENSES.build({**table, "velocity_dispersion": np.full(2, 200.0)}).take(order)


def test_strong_lenses_of_the_lake_are_drawn(rendered, monkeypatch):
    lake, before = rendered, keys(rendered, wanted())
    plain = images(lake)
    crowded = wanted(strong_lenses={"boost": 2.0})
    monkeypatch.setattr(strong_lenses, "draw", two_lenses)
    make(lake, crowded, build_strong_lenses)
    version = read.version(lake, "strong_lenses")
    after = keys(lake, crowded)
    assert all(after[part] != key for part, key in before.items())
    assert render(lake, crowded) == BOTH
    drawn = read.version(lake, "rendered_truth").rows(where=pc.field("method") == truth_table.PICTURE)
    assert len(drawn) > 0
    # An exposure of 0 s has no light: neither galaxies nor lensed images are read.
    for least, shows in ((0.0, True), (np.inf, False)):
        tasks = read.version(lake, "tasks").rows().to_pylist()
        found = sum(catalogue_rows.read_lenses(version, task, 0.1, 0.0, least).num_rows for task in tasks)
        assert (found > 0) == shows
    assert set(drawn["id"].to_pylist()) <= set(version.rows(["id"])["id"].to_pylist())
    changed = {path for path, data in images(lake).items() if data != plain[path]}
    for detector in set(drawn["detector"].to_pylist()):
        assert sum(f"_{detector}_" in path for path in changed) == 2
    ahead = preconditions.refuse_other_plan
    # Lenses of other galaxies are not drawn.
    facts = {**version.manifest["facts"], "galaxies": "0" * 64}
    other = replace(version, manifest={**version.manifest, "facts": facts})
    monkeypatch.setattr(
        preconditions,
        "refuse_other_plan",
        lambda inputs, *others: ahead({**inputs, "strong_lenses": other}, *others),
    )
    with pytest.raises(
        BadInput, match="strong_lenses was drawn in another version of galaxies: run truesky lenses first"
    ):
        render_exposures.steps(lake, crowded)


ARMS = {"arms": {"least_radius": 0.3}}


def test_arms_of_discs_change_the_version(rendered):
    """Without arms in the request, nothing is made again."""
    before = keys(rendered, wanted())
    assert keys(rendered, wanted(structure={"arms": False})) == before
    assert all(keys(rendered, wanted(structure=ARMS))[part] != key for part, key in before.items())


@pytest.mark.nightly
def test_arms_are_drawn_if_requested(rendered, lake):
    """The result is the same in any process."""
    plain = images(rendered)
    assert render(rendered, wanted(structure=ARMS)) == BOTH
    found, truth = images(rendered), read.version(rendered, "rendered_truth").rows()
    assert all(found[path] != data for path, data in plain.items())
    assert truth_table.PICTURE not in truth["method"].to_pylist()
    alone = {**REQUEST["pointing"][0], "detectors": ["R22_S12"]}
    render(lake, wanted(pointing=[alone], structure=ARMS))
    assert all(found[path] == data for path, data in images(lake).items())


def test_galaxies_of_a_library_are_drawn(rendered, tmp_path):
    """The sha256 of the library is part of the key, and is checked while an image is rendered."""
    before, path = keys(rendered, wanted()), tmp_path / "library.fits"
    y, x = np.mgrid[:32, :32] - 15.5
    fits.writeto(path, np.array([np.exp(-np.hypot(x, q * y) / 3.0) for q in (1.0, 2.0)], np.float32))
    asked = wanted(structure={"stamps": {"file": str(path), "nearest": True, "least_radius": 0.2}})
    found = keys(rendered, asked)
    assert all(found[part] != key for part, key in before.items())
    assert render(rendered, asked) == BOTH
    truth = read.version(rendered, "rendered_truth").rows()
    drawn = truth.filter(pc.equal(truth["method"], truth_table.PICTURE))
    assert set(drawn["id"].to_pylist()) <= set(read.version(rendered, "galaxies").rows(["id"])["id"].to_pylist())
    assert drawn.num_rows > 5
    step = render_exposures.steps(rendered, asked)[0]
    fits.writeto(path, np.exp(-np.hypot(x, y) / 3.0)[None].astype(np.float32), overwrite=True)
    assert all(keys(rendered, asked)[part] != key for part, key in found.items())
    with pytest.raises(BadInput, match=r"library.fits: has changed since the rendering began"):
        render_exposures.render_task(rendered, {**step.plan.facts, **step.plan.tasks[0].facts})


def test_a_product_is_rendered_again_from_its_manifest(rendered, tmp_path):
    version = read.version(rendered, "products")
    rebuilt = 0
    for part in version.manifest["parts"]:
        output = render_exposures.render_task(rendered, {**version.manifest["facts"], **part["facts"]})
        for path, writer in output.files.items():
            writer(tmp_path / "again")
            assert file_sha256(tmp_path / "again") == file_sha256(version.sidecar_path(path))
            rebuilt += path.endswith(".fits")
    assert rebuilt == 4


@pytest.mark.nightly
def test_an_old_product_is_rendered_again_with_its_mission(rendered, tmp_path, capsys):
    old = read.version(rendered, "products")
    before = images(rendered)
    noise = {"ext.lsstcam.read_noise": {"value": 7.0, "unit": "electron"}}
    render(rendered, wanted(mission={"overrides": noise}))
    path = next(path for path in sorted(before) if "science" in path)
    assert images(rendered)[path] != before[path]
    command = ["--lake", str(rendered), "--again", path, "--out", str(tmp_path / "again.fits")]
    assert archive.main([*command, "--version", old.key]) == 0
    assert (tmp_path / "again.fits").read_bytes() == before[path]
    assert archive.main(command) == 0
    assert (tmp_path / "again.fits").read_bytes() == images(rendered)[path]
    assert archive.main([*command[:3], "images/no.fits", *command[4:]]) == 2
    assert "has no product images/no.fits" in capsys.readouterr().err
    # Garbage collection removes a table from which the product was made.
    garbage.collect(rendered, "mission", delete=True)
    assert archive.main([*command, "--version", old.key]) == 2
    assert "no table mission of version" in capsys.readouterr().err


def test_variants_are_rendered_with_their_parameters(lake):
    explore = {"ext.lsstcam.read_noise": {"values": [5.0, 50.0], "unit": "electron"}, "effects.poisson": [True, False]}
    one = {**REQUEST["pointing"][0], "detectors": ["R22_S11"]}
    assert sum(render(lake, wanted(pointing=[one], explore=explore)).values()) == 4
    version = read.version(lake, "products")
    settings = {
        row["exposure_id"]: json.loads(row["settings"]) for row in read.version(lake, "exposures").rows().to_pylist()
    }
    rows = [row for row in version.rows().to_pylist() if row["content"] == "science"]
    assert len({row["mission"] for row in rows}) == 2
    assert len({version.sidecar_path(row["path"]).read_bytes() for row in rows}) == 4
    for row in rows:
        asked, header = settings[row["exposure_id"]], fits.getheader(version.sidecar_path(row["path"]))
        assert header["RDNOISE"] == asked["ext.lsstcam.read_noise"][0]
        states = {header[key].split(":")[0]: header[key].split(":")[1] for key in header if key.startswith("EFFECT")}
        assert states["poisson"].startswith(" on" if asked["effects.poisson"] else " off (forced)")


def test_requested_truth_maps_of_each_channel(lake):
    everything = ["noise_free", "stars", "sky", "cosmic_rays", "ghosts", "saturation"]
    request = wanted(products={"truth": everything})
    render(lake, request)
    version, tasks = read.version(lake, "products"), read.version(lake, "tasks").rows().to_pylist()
    assert Counter(version.rows()["content"].to_pylist()) == dict.fromkeys(("science", *everything), 2)
    others = {"persistence", "ramp", "satellites", "traps", "dipoles", *truth_maps.ORDER_MAPS.values()}
    assert set(everything) | others == set(truth_maps.BYTES_PER_PIXEL)
    maps = {row["content"]: fits.getdata(version.sidecar_path(row["path"])) for row in version.rows().to_pylist()}
    exposed = read.version(lake, "exposures").rows().to_pylist()[0]
    np.testing.assert_allclose(maps["sky"], exposed["sky"] * exposed["exposure_time_s"], rtol=1e-6)
    assert (maps["stars"] <= maps["noise_free"] + 1e-3).all()
    for task in tasks:
        mine = [row for row in version.rows().to_pylist() if row["detector"] == task["detector"]]
        measured = sum(version.sidecar_path(row["path"]).stat().st_size for row in mine)
        assert task["bytes"] == pytest.approx(measured, rel=0.05)


def test_missing_cells_are_refused_before_rendering(lake):
    far = {**REQUEST["pointing"][0], "dec": -29.0}
    request = wanted(pointing=[far])
    make(lake, request, plan_exposures)
    with pytest.raises(BadInput, match=r"table galaxies lacks \d+ order-8 cells .*: run truesky build over an area"):
        render_exposures.steps(lake, request)
    assert not (lake / "products").exists()


@nightly.parametrize(
    ("other", "words"),
    [
        ({"seed": 8}, "table galaxies has seed 7, the request 8: run truesky build first"),
        ({"galaxy_limit": 24.0}, "table galaxies has galaxy_limit 23.5, the request 24.0: run truesky build first"),
        ({"lensing": "none"}, r"table galaxies has lensing None, the request \(0.0, 0.0\): run truesky build first"),
        ({"star_limit": 21.0}, "table stars has star_limit 20.0, the request 21.0: run truesky build first"),
    ],
    (0, 2),
)
def test_a_catalogue_of_another_universe_is_refused(lake, other, words):
    universe = {**REQUEST["universe"], **{key: value for key, value in other.items() if key != "seed"}}
    request = wanted(universe=universe, seed=other.get("seed", REQUEST["seed"]))
    make(lake, wanted(), plan_exposures)
    for module in (compute_fluxes, plan_exposures, render_exposures):
        with pytest.raises(BadInput, match=words):
            module.steps(lake, request)
    assert not (lake / "products").exists()


def images_of(lake, name):
    folder = lake / "names" / name / "products"
    return {path.relative_to(folder).as_posix() for path in folder.glob("images/*/*.fits")}


def test_requests_with_the_same_universe(lake, tmp_path, capsys):
    """Two plans of one universe: their images are kept apart, and garbage collection keeps both."""
    found = {}
    for name, mjd in (("a", 60905.25), ("b", 60906.25)):
        request = replace(wanted(), name=name)
        request = replace(request, pointings=tuple(replace(p, mjd=mjd) for p in request.pointings))
        for module in (plan_exposures, render_exposures):
            for step in module.steps(lake, request):
                publish.make_version(lake, step.plan, step.run_task, name=name)
        found[name] = archive.products(lake, name).to_pylist()
        assert {row["path"] for row in found[name]} == images_of(lake, name)
    assert request_links.tables_of_request(lake, "b") == sorted((*preconditions.INPUTS, "products", "rendered_truth"))
    assert read.version(lake, "galaxies", request="a").key == read.version(lake, "galaxies", request="b").key
    assert not {row["sha256"] for row in found["a"]} & {row["sha256"] for row in found["b"]}
    assert garbage.collect(lake, delete=True) == []
    assert [archive.products(lake, name).to_pylist() for name in "ab"] == [found["a"], found["b"]]
    assert archive.main(["--lake", str(lake)]) == 2
    assert "requests a, b have different versions of table products" in capsys.readouterr().err
    path = found["a"][0]["path"]
    assert archive.main(["--lake", str(lake), "--name", "a", "--again", path, "--out", str(tmp_path / "x.fits")]) == 0
    assert f"equals {path}" in capsys.readouterr().out
    # A new plan of the same name releases only the old products of that name.
    for step in plan_exposures.steps(lake, replace(wanted(), name="b")):
        publish.make_version(lake, step.plan, step.run_task, name="b")
    assert {path.parent.name for path in garbage.collect(lake)} <= {"exposures", "tasks"}
