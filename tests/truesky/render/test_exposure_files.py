"""Files of whole exposures, made by the jobs: quadrants of VIS, signal and quality of NISP."""

import os
import shutil
import signal
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.store import layout, publish, read
from tests import requests
from tests.faults.victims import CONTEXT
from truesky.catalogue import build_galaxies, build_stars
from truesky.commands import run, space
from truesky.fluxes import compute_fluxes
from truesky.render import archive, plan_exposures, render_exposures
from truesky.render.channels import level1
from truesky.render.products import head_files
from truesky.request.from_toml import parse

SIDE = 64
DETECTORS = {"VIS": ("3-3", "3-4"), "NISP-P": ("DET22", "DET23")}
SIZES = ", ".join(
    f'"{camera}.fpa.{side}" = {{value = {SIDE}, unit = "pix"}}' for camera in ("vis", "nisp") for side in ("nx", "ny")
)
TEXT = f"""
accuracy = "draft"
[mission]
overrides = {{{SIZES}, "vis.fpa.charge_injection_rows" = {{value = 0, unit = "pix"}}}}
[sources]
only = "table"
band = "euclid_h"
stars = "stars.csv"
[products]
truth = ["noise_free"]
compression = "rice"
files = "exposure"
"""
for channel, camera, band in (("VIS", "vis", "euclid_vis"), ("NISP-P", "nisp", "euclid_h")):
    TEXT += f"""
[[pointing]]
channel = "{channel}"
camera = "{camera}"
band = "{band}"
ra = 53.117
dec = -27.808
mjd = 60905.0
detectors = {list(DETECTORS[channel])}
centre_on = "{DETECTORS[channel][0]}"
"""


@pytest.fixture(scope="module")
def request_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exposure")
    (folder / "stars.csv").write_text("ra,dec,mag\n53.117,-27.808,18.0\n53.1172,-27.8082,21.0\n")
    return requests.written(folder, TEXT, requests.FIELD.format(0.5), seed=5)


def make(root, steps, mapper=map):
    for step in steps:
        publish.make_version(root, step.plan, step.run_task, mapper, name="x")


@pytest.fixture(scope="module")
def whole(request_file):
    root, request = layout.resolve_lake(request_file.parent / "lake"), parse(request_file)
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        make(root, module.steps(root, request))
    return root


@pytest.fixture
def lake(whole, tmp_path):
    return layout.resolve_lake(shutil.copytree(whole, tmp_path / "lake", symlinks=True))


def opened(root):
    """Return row and images of each exposure, by channel."""
    version = read.version(root, "exposure_files")
    return {row["channel"]: (row, version.sidecar_path(row["path"])) for row in version.rows().to_pylist()}


@pytest.mark.parametrize(
    ("channel", "arrays"), [("VIS", ("E", "F", "G", "H")), ("NISP-P", ("SCI", "CHI2"))], ids=["VIS", "NISP-P"]
)
def test_an_exposure_has_the_arrays_of_its_detectors(whole, channel, arrays):
    row, path = opened(whole)[channel]
    assert (row["detectors"], row["planned"], row["sources"]) == (2, 2, 2 * (row["sources"] // 2))
    products = read.version(whole, "products")
    files = {
        one["detector"]: images.read_images(products.sidecar_path(one["path"]))
        for one in products.rows().to_pylist()
        if (one["channel"], one["content"]) == (channel, "science")
    }
    first, *found = images.read_images(path)
    assert [unit.name for unit in found] == [f"{name}.{array}" for name in DETECTORS[channel] for array in arrays]
    about = {key: value for key, value, _ in first.cards}
    assert (about["NDETECT"], about["NPLANNED"], about["CHANNEL"], about["RA"]) == (2, 2, channel, row["ra"])
    assert "DETECTOR" not in about
    assert "CRVAL1" not in about
    for unit, (name, number) in zip(
        found, ((n, i) for n in DETECTORS[channel] for i in range(len(arrays))), strict=True
    ):
        before = files[name][1 + number]
        np.testing.assert_array_equal(unit.data, before.data)
        own = {key: value for key, value, _ in unit.cards}
        assert own["DETECTOR"] == name
        # Every header value is kept unchanged.
        said = {key: value for key, value, _ in (*files[name][0].cards, *before.cards)}
        assert {key: {**about, **own}[key] for key in said} == said
        # Keywords that tools need are in each array, although they apply to the whole file.
        assert {"INHERIT", "EXPTIME", "FILTER", "MJD-OBS", "DATASEC", "CCDSEC", "DETSEC"} <= set(own)
        assert ("GAIN" in {key for key, *_ in before.cards}) == (number != 1 or channel == "VIS")
    heads = (
        read.version(whole, "exposure_files").sidecar_path(head_files.head_path(row["path"])).read_text().split("END\n")
    )
    for head, unit in zip(heads[:-1], found, strict=True):
        own = {key: value for key, value, _ in unit.cards}
        assert fits.Header.fromstring(head, sep="\n")["CRPIX1"] == own["CRPIX1"]
    with fits.open(path, checksum=True) as units:
        units.verify("exception")
        assert len(units) == 1 + 2 * len(arrays)
        assert units[1].shape == found[0].data.shape


def _killed(root, request):
    """Join files in a process that is killed while it writes the second one."""
    step = render_exposures.steps(root, request)[-1]

    def work(lake, facts):
        output = step.run_task(lake, facts)

        def torn(target):
            target.write_bytes(b"SIMPLE")
            os.kill(os.getpid(), signal.SIGKILL)

        last = facts["exposure_id"] == step.plan.tasks[-1].facts["exposure_id"]
        return replace(output, files=dict.fromkeys(output.files, torn)) if last else output

    publish.make_version(root, step.plan, work, name="x")


@pytest.mark.nightly
def test_the_same_bytes_in_any_order_and_after_a_kill(lake, whole, request_file):
    request = parse(request_file)
    shutil.rmtree(layout.table_folder(lake, "exposure_files"))
    layout.request_link(lake, "x", "exposure_files").unlink()
    child = CONTEXT.Process(target=_killed, args=(lake, request))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert layout.current_key(lake, "exposure_files") is None
    made = []

    def backwards(function, parts):
        made.extend(part.facts["exposure_id"] for part in parts)
        return [function(part) for part in reversed(parts)]

    make(lake, render_exposures.steps(lake, request), backwards)
    assert len(made) == 1
    names = ("products", "rendered_truth", "exposure_files")
    assert [read.version(lake, name).manifest for name in names] == [
        read.version(whole, name).manifest for name in names
    ]
    assert read.find_faults(read.version(lake, "exposure_files"), deep=True) == []


def test_a_file_of_some_detectors_has_their_number(lake, request_file, tmp_path):
    """A later run adds the other detectors and reuses existing images."""
    request = parse(request_file)
    for name in ("products", "rendered_truth", "exposure_files"):
        shutil.rmtree(layout.table_folder(lake, name))
        layout.request_link(lake, "x", name).unlink()
    make(lake, render_exposures.steps(lake, replace(request, detectors=("DET23",))))
    ((row, path),) = opened(lake).values()
    assert (row["channel"], row["detectors"], row["planned"]) == ("NISP-P", 1, 2)
    first, *found = images.read_images(path)
    assert {key: value for key, value, _ in first.cards}["NDETECT"] == 1
    assert [unit.name for unit in found] == ["DET23.SCI", "DET23.CHI2"]
    make(lake, render_exposures.steps(lake, request))
    assert {row["detectors"] for row, _ in opened(lake).values()} == {2}


def test_exposure_files_do_not_change_product_keys(lake, request_file):
    """Without exposure files no image is rendered again; exposure files of outdated images are refused."""
    request = replace(parse(request_file), files="detector")
    steps = render_exposures.steps(lake, request)
    assert [step.plan.table.name for step in steps] == ["products", "rendered_truth"]
    assert steps[0].plan.key == read.version(lake, "products").key
    assert archive.exposures(lake).num_rows == 2
    make(lake, render_exposures.steps(lake, replace(request, noise_seed=9)))
    with pytest.raises(BadInput, match="exposure_files has outdated images"):
        archive.exposures(lake)


def test_files_have_the_names_and_headers_of_raw_frames_of_euclid(lake, request_file):
    """Only names and cards change, but arrays of CCDs in columns 4 to 6 are turned; fitsverify finds no error."""
    request = replace(parse(request_file), file_names="euclid")
    before = {channel: images.read_images(path) for channel, (_, path) in opened(lake).items()}
    steps = render_exposures.steps(lake, request)
    assert steps[0].plan.key == read.version(lake, "products").key
    make(lake, steps)
    found = opened(lake)
    start = "20250818T000000.000000Z"
    assert [found[channel][1].name for channel in ("VIS", "NISP-P")] == [
        f"EUC_LE1_VIS-10000001-1-D_{start}.fits", f"EUC_LE1_NISP-10000002-1-D_{start}.fits",
    ]  # fmt: skip
    assert set(archive.exposures(lake)["path"].to_pylist()) == {row["path"] for row, _ in found.values()}
    for channel, (row, path) in found.items():
        files = read.version(lake, "exposure_files")
        heads = files.sidecar_path(head_files.head_path(row["path"])).read_text().split("END\n")[:-1]
        for head, unit in zip(heads, images.read_images(path)[1:], strict=True):
            known = {key: value for key, value, _ in unit.cards}
            of_head = fits.Header.fromstring(head, sep="\n")
            assert of_head["CRPIX1"] == pytest.approx(known["CRPIX1"], abs=1e-6)
            assert of_head["CD2_2"] * known["CD2_2"] > 0.0
        for old, new in zip(before[channel], images.read_images(path), strict=True):
            assert old.name == new.name
            expected = level1.turn_array(old) if new.name.startswith("3-4") else old
            assert (old.data is None and new.data is None) or np.array_equal(expected.data, new.data)
            stored = {key: value for key, value, _ in new.cards}
            for key, value, _ in expected.cards:
                # The sign of a turned number takes one of the 20 characters.
                assert stored[key] == (pytest.approx(value, rel=1e-12, abs=0) if isinstance(value, float) else value)
        with fits.open(path) as units:
            first = units[0].header
            assert {"OBSTYPE", "SEQID", "ORIENTAT", "DATAUNIT", "MJDATE", "RA", "DEC", "PA", "MJD-OBS"} <= set(first)
            assert first["N_CCD" if channel == "VIS" else "N_DET"] == 2
            for name in DETECTORS[channel]:
                for part in "EFGH" if channel == "VIS" else ("SCI", "CHI2"):
                    header = units[f"{name}.{part}"].header
                    assert header["RA"] == pytest.approx(first["RA"], abs=1e-6)
                    if channel == "VIS":
                        assert (header["CCDID"], header["QUADID"]) == (name, part)
                        sizes = [header[key] for key in ("PRESCANX", "OVRSCANX", "OVRSCANY")]
                        assert (header["NAXIS1"], header["NAXIS2"]) == (
                            SIDE // 2 + sizes[0] + sizes[1], SIDE // 2 + sizes[2],
                        )  # fmt: skip
        if shutil.which("fitsverify"):
            done = subprocess.run(["fitsverify", "-q", str(path)], capture_output=True, text=True, timeout=120)
            assert "0 warnings and 0 errors" in done.stdout or "OK" in done.stdout, done.stdout


def test_the_archive_lists_exposure_files(whole, capsys):
    version = read.version(whole, "exposure_files")
    for row in archive.exposures(whole).to_pylist():
        path = version.sidecar_path(row["path"])
        assert (row["sha256"], row["bytes"]) == (version.file_sha256(row["path"]), path.stat().st_size)
    assert archive.main(["--lake", str(whole), "--exposures", "--sql", "select sum(detectors) as n from products"]) == 0
    assert capsys.readouterr().out == '{"n": 4}\n'


def test_forecasts_include_exposure_files(whole, request_file):
    """Each science image counts twice, but existing images do not count."""
    request = parse(request_file)
    both, one = (plan_exposures.plan(whole, replace(request, files=files)) for files in ("exposure", "detector"))
    more = np.subtract(
        *(plan[2].sort_by([("exposure_id", "ascending"), ("detector", "ascending")])["bytes"] for plan in (both, one))
    )
    products, files = read.version(whole, "products"), read.version(whole, "exposure_files")
    assert more.min() > 0
    assert "exposure_files" in run.stages(request)[-1].tables
    assert "exposure_files" not in run.stages(replace(request, files="detector"))[-1].tables
    size = sum(entry["bytes"] for version in (products, files) for entry in version.manifest["files"])
    assert space._reusable_image_bytes(whole, request, *both[1:]) == size
