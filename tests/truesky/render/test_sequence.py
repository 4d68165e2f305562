"""A sequence of exposures with persistence, rendered by the job in any order and selection."""

import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest

from lake_schema.fits import images
from lake_schema.store import layout, publish, read
from lake_schema.tables.exposures import ExposureRow
from tests import requests
from tests.faults.victims import CONTEXT
from tests.truesky import nightly
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.randomness.rng import stream
from truesky.render import detector_inputs, plan_exposures, render_exposures
from truesky.render.effects.charge.persistence import PersistenceModel, variation_of_scene
from truesky.render.exposure import persistence, scene_factory
from truesky.render.exposure.records import PreviousSky, Variant
from truesky.render.previous_exposures import ChargeMaps, find_previous_exposures
from truesky.render.product_plan import RenderInputs
from truesky.request.from_toml import parse
from truesky.running import submitted_job

SIDE, COUNT = 256, 120
# First and second pointing of the telescope.
FIELDS = (57.5, -27.808), (53.117, -27.808)
SECOND = 1.0 / 86400.0
# Channel, band, field, seconds before the last exposure. Exposures more than two hours earlier do not matter.
SEQUENCE = [
    ("NISP-P", "euclid_y", 0, 9000.0), ("NISP-S", "nisp_red", 1, 900.0), ("NISP-P", "euclid_y", 0, 268.0),
    ("NISP-P", "euclid_j", 1, 134.0), ("NISP-P", "euclid_h", 1, 0.0),
]  # fmt: skip
BEFORE = {1: [], 2: [], 3: [2], 4: [2, 3], 5: [2, 3, 4]}
POINTING = """
[[pointing]]
channel = "{}"
camera = "nisp"
band = "{}"
ra = {}
dec = {}
mjd = {!r}
detectors = ["DET22"]
centre_on = "DET22"
"""
TEXT = f"""
accuracy = "draft"
[mission]
overrides = {{"nisp.fpa.nx" = {{value = {SIDE}, unit = "pix"}}, "nisp.fpa.ny" = {{value = {SIDE}, unit = "pix"}}}}
[sources]
only = "table"
band = "euclid_h"
stars = "stars.csv"
[products]
truth = ["noise_free", "sky", "ghosts", "persistence"]
files = "exposure"
"""


def pointings(sequence):
    return "".join(
        POINTING.format(channel, band, *FIELDS[field], 60905.0 - before * SECOND)
        for channel, band, field, before in sequence
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of a request: stars of AB 13 to 24 in both fields."""
    folder, rng = tmp_path_factory.mktemp("sequence"), np.random.default_rng(3)
    lines = ["ra,dec,mag"]
    for ra, dec in FIELDS:
        x, y = rng.uniform(-0.5, 0.5, (2, COUNT)) * SIDE * 0.3 / 3600.0
        mags = rng.uniform(13.0, 24.0, COUNT)
        lines += [f"{ra + i / np.cos(np.radians(dec))},{dec + j},{m}" for i, j, m in zip(x, y, mags, strict=True)]
    (folder / "stars.csv").write_text("\n".join(lines) + "\n")
    return folder


def wanted(folder, sequence=SEQUENCE):
    area = f"patches = [{', '.join(f'[{ra}, {dec}, 0.15]' for ra, dec in FIELDS)}]"
    return parse(requests.written(folder, TEXT + pointings(sequence), area, seed=5))


@pytest.fixture(scope="module")
def planned(folder):
    """A lake with everything except images."""
    root, request = layout.resolve_lake(folder / "lake"), wanted(folder)
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures):
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)
    return root


def backwards(function, parts):
    return [function(part) for part in reversed(parts)]


@pytest.fixture(scope="module")
def whole(planned, folder):
    """A lake with all images, the last exposure rendered first."""
    root = layout.resolve_lake(shutil.copytree(planned, folder / "whole", symlinks=True))
    for step in render_exposures.steps(root, wanted(folder)):
        publish.make_version(root, step.plan, step.run_task, backwards)
    return root


@pytest.fixture
def lake(planned, tmp_path):
    return layout.resolve_lake(shutil.copytree(planned, tmp_path / "lake", symlinks=True))


def _killed(root, request):
    """Render in a process that is killed while it writes an image of the penultimate exposure."""
    step = render_exposures.steps(root, request)[0]

    def work(lake, facts):
        output = step.run_task(lake, facts)

        def torn(target):
            target.write_bytes(b"SIMPLE")
            os.kill(os.getpid(), signal.SIGKILL)

        return replace(output, files=dict.fromkeys(output.files, torn)) if facts["exposure_id"] == 4 else output

    publish.make_version(root, step.plan, work)


@pytest.mark.spark
@pytest.mark.nightly
def test_the_same_bytes_in_any_order_and_after_a_kill(spark, lake, whole, folder):
    request = wanted(folder)
    child = CONTEXT.Process(target=_killed, args=(lake, request))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    left = len(list(layout.table_folder(lake, "products").glob(".receipts-*/[!.]*.json")))
    assert 0 < left < len(BEFORE)
    submitted_job.run(render_exposures.JOB, lake, request)
    for name in ("products", "rendered_truth", "rendered_spectra", "exposure_files"):
        assert read.version(lake, name).manifest == read.version(whole, name).manifest
        assert read.find_faults(read.version(lake, name), deep=True) == []


def parts(root, request):
    step = render_exposures.steps(root, request)[0]
    return step, {part.facts["exposure_id"]: part for part in step.plan.tasks}


@nightly.parametrize(
    ("numbers", "megabytes", "drawings"),
    [
        ((5,), "0", [2, 3, 4]), ((4, 5), "500", [2, 3, 4]),
        pytest.param((2, 4, 5), "0", [2, 3, 2, 3, 4], marks=pytest.mark.nightly),
        pytest.param((4, 5, 3), "0.6", [2, 3, 4, 2], marks=pytest.mark.nightly),
    ], (0,),
)  # fmt: skip
def test_the_same_bytes_in_any_order_with_any_memory(lake, whole, folder, monkeypatch, numbers, megabytes, drawings):
    """Compare with all exposures rendered backwards. A charge map has 0.26 MB; each is drawn once if it is kept."""
    monkeypatch.setenv("TRUESKY_CHARGE_MAPS", megabytes)
    found, draw = [], persistence.draw_charge_map
    monkeypatch.setattr(
        persistence, "draw_charge_map", lambda aim, *rest: found.append(aim.exposure.exposure_id) or draw(aim, *rest)
    )
    step, tasks = parts(lake, wanted(folder))
    publish.make_version(lake, replace(step.plan, tasks=tuple(tasks[number] for number in numbers)), step.run_task)
    some, among = (read.version(root, "products") for root in (lake, whole))
    rows = some.rows().to_pylist()
    assert {row["exposure_id"] for row in rows} == {*numbers}
    assert {row["content"] for row in rows} == {"science", "noise_free", "sky", "ghosts", "persistence"}
    assert all(some.file_sha256(row["path"]) == among.file_sha256(row["path"]) for row in rows)
    kept = step.run_task.keywords["charge_maps"]
    assert kept.megabytes <= kept.limit_mb == float(megabytes)
    assert found == drawings


def test_the_exposures_of_two_hours_are_a_chain(lake, folder):
    """In order of time; the first exposure of a part of the sequence begins a chain, though it has earlier ones."""
    step, found = parts(lake, wanted(folder))
    links = {number: step.link_of(part) for number, part in found.items()}
    assert [number for number in links if links[number].chain == links[1].chain] == [1]
    assert len({links[number].chain for number in (2, 3, 4, 5)}) == 1
    assert sorted(links, key=lambda number: links[number].order) == [1, 2, 3, 4, 5]
    rows = read.version(lake, "tasks").rows().to_pylist()
    assert {number: link.seconds for number, link in links.items()} == {
        row["exposure_id"]: row["seconds"] for row in rows
    }
    inputs = RenderInputs.from_request(lake, wanted(folder))
    later = [task for task in inputs.selection.tasks if task["exposure_id"] > 3]
    link_of = replace(inputs, selection=replace(inputs.selection, tasks=later)).chain_links()
    assert link_of(found[4]).chain == link_of(found[5]).chain == (4, "DET22")


def keys(root, request):
    return {number: part.facts["product"] for number, part in parts(root, request)[1].items()}


def changed(lake, folder, sequence):
    """Return the exposures whose products change with another sequence."""
    before, request = keys(lake, wanted(folder)), wanted(folder, sequence)
    for step in plan_exposures.steps(lake, request):
        publish.make_version(lake, step.plan, step.run_task)
    after = keys(lake, request)
    return {number for number in before if before[number] != after[number]}


@nightly.parametrize("number", range(1, len(SEQUENCE) + 1), (0, 3))
def test_products_depend_on_earlier_exposures(lake, folder, number):
    """Products depend on earlier exposures and on no others."""
    channel, band, field, before = SEQUENCE[number - 1]
    other = [*SEQUENCE[: number - 1], (channel, band, field, before + 20.0), *SEQUENCE[number:]]
    later = {one for one, some in BEFORE.items() if number in some}
    assert changed(lake, folder, other) == later | {number}


def test_products_depend_on_the_catalogue_of_earlier_exposures(lake, folder, monkeypatch):
    """First change the catalogue at the pointing of exposures 1 and 3, then at that of the others."""
    request = wanted(folder)
    before = keys(lake, request)
    stars = read.version(lake, "stars").manifest["parts"]
    tasks = {task["exposure_id"]: set(task["cells"]) for task in read.version(lake, "tasks").rows().to_pylist()}
    there = {part["name"] for part in stars if set(part["facts"]["generation_cells"]) & tasks[3]}
    here = {part["name"] for part in stars if set(part["facts"]["generation_cells"]) & tasks[5]}
    assert there
    assert not there & here
    sums = read.Version.partition_sha256

    def other(self, part):
        return "another" if self.table == "stars" and part in there else sums(self, part)

    monkeypatch.setattr(read.Version, "partition_sha256", other)
    after = keys(lake, request)
    assert {number for number in before if before[number] != after[number]} == {1, 3, 4, 5}
    monkeypatch.setattr(
        read.Version,
        "partition_sha256",
        lambda self, part: "another" if self.table == "stars" and part in here else sums(self, part),
    )
    after = keys(lake, request)
    assert {number for number in before if before[number] != after[number]} == {2, 3, 4, 5}


def test_persistence_agrees_with_complete_earlier_images(whole, folder):
    """Compare with all expected light of each earlier image, including spectra: 1 e- in any pixel."""
    resolved = RenderInputs.from_request(whole, wanted(folder))
    inputs, mission = resolved.versions, resolved.mission
    exposures = {row.exposure_id: row for row in map(ExposureRow.from_row, inputs["exposures"].rows().to_pylist())}
    version = read.version(whole, "products")
    files = {
        (row["exposure_id"], row["content"]): version.sidecar_path(row["path"]) for row in version.rows().to_pylist()
    }
    now, facts = exposures[5], {**version.manifest["facts"], "exposure_id": 5, "detector": "DET22"}
    earlier = find_previous_exposures(whole, facts, now, "DET22", mission, ChargeMaps())
    assert [before.exposure.exposure_id for before in earlier] == BEFORE[5]
    assert not any(isinstance(before, PreviousSky) for before in earlier)
    aim = detector_inputs.load_aim(whole, facts)[0]
    variant = Variant(mission, wanted(folder).accuracy, {})
    found = persistence.total_charge(aim, earlier, variant, 5)
    scene = scene_factory.from_aim(aim, variant)
    traps, expected = PersistenceModel.from_scene(scene), np.zeros_like(found)
    own = variation_of_scene(scene, stream(5, "nisp", aim.detector.name, "persistence_pixels"))
    for number in BEFORE[5]:
        row = exposures[number]
        maps = [files.get((number, content)) for content in ("noise_free", "sky", "ghosts")]
        light = sum(images.read_images(file)[0].data.astype(float) for file in maps if file is not None)
        times = (now.mjd - row.mjd) / SECOND, now.exposure_time_s, row.exposure_time_s
        expected += traps.released_charge(light, *times, own)
    assert expected.max() > 100.0
    assert np.abs(found - expected).max() < 1.0
    # The image contains the variation of each pixel.
    shown = images.read_images(files[5, "persistence"])[0].data
    assert shown.mean() == pytest.approx(found.mean(), rel=0.05)
