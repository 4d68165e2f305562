"""Validation of a lake: table and report, rows that do not apply, and detected faults."""

import re

import pytest

from lake_schema.errors import BadInput
from lake_schema.store import read
from tests.truesky.validation.lake.suite import lakes
from truesky.validation import __main__
from truesky.validation.lake.suite import inventory, publishing


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Two frames; the WCS of the second is off by a tenth of a pixel."""
    return lakes.lake(tmp_path_factory.mktemp("validated") / "lake", shift=(0.1, 0.0))


@pytest.fixture(scope="module")
def version(lake):
    return publishing.publish(lake, processes=1)


def test_the_fault_is_found_where_it_is(version):
    rows = version.rows().to_pylist()
    failed = {(row["check_name"], row["quantity"], row["exposure_id"]) for row in rows if row["verdict"] == "fail"}
    assert ("astrometry", "offset_x", 2) in failed
    assert not any(check == "astrometry" and number == 1 for check, _, number in failed)
    passed = {row["check_name"] for row in rows if row["verdict"] == "pass"}
    assert {"astrometry", "photometry", "noise", "gain", "psf", "cosmic_rays", "background", "saturation"} <= passed


def test_not_applicable_rows_have_reasons(version):
    rows = [row for row in version.rows().to_pylist() if row["verdict"] == "not_applicable"]
    assert {"observed", "quality"} <= {row["check_name"] for row in rows}
    assert all(row["note"] for row in rows)


def test_report_requires_no_network(version):
    page = version.sidecar_path(publishing.REPORT).read_text()
    assert len(re.findall(r"src='data:image/png;base64,[A-Za-z0-9+/=]+'", page)) >= 4
    assert not re.search(r"https?://|<script|<link|@import|url\(", page)
    assert "offset_x" in page


def test_second_run_reuses_the_table(lake, version, capsys, tmp_path):
    report = tmp_path / "r.html"
    assert __main__.main([str(lake), "--report", str(report)]) == 1
    assert report.read_bytes() == version.sidecar_path(publishing.REPORT).read_bytes()
    said = capsys.readouterr().out
    assert re.search(r"^skipped +\d+ figures? +\w+: ", said, re.M)
    assert re.search(r"^fail +VIS/euclid_vis/000002/1-1 +astrometry offset_x: -(9|10)\.", said, re.M)


def test_version_key_depends_on_inputs(lake, version):
    held = inventory.read_contents(lake)
    assert publishing.plan(held).key == version.key
    assert publishing.plan(inventory.read_contents(lake, exposures=[1]), [1]).key != version.key
    assert set(version.manifest["facts"]["inputs"]) == {
        "exposures", "products", "rendered_truth", "star_fluxes", "stars",
    }  # fmt: skip
    assert read.version(lake, "validation").key == version.key


def test_frames_in_several_processes_give_the_same(lake, version):
    from truesky.validation.lake.suite import running

    found = running.run_checks(inventory.read_contents(lake), processes=2)
    assert publishing.build_table(found.rows).to_pylist() == version.rows().to_pylist()


def test_missing_inputs_are_refused(lake, tmp_path, capsys):
    with pytest.raises(BadInput, match="no image of exposure 7"):
        inventory.read_contents(lake, exposures=[7])
    capsys.readouterr()
    assert __main__.main([str(lake), "--name", "demoo"]) == 2
    assert capsys.readouterr().err.startswith(f"truesky validate: lake {lake} has no request demoo")
    assert not (lake / "names" / "demoo").exists()
    (tmp_path / "empty").mkdir()
    for words in ([str(tmp_path / "empty")], [str(lake), "--processes", "0"], ["--exposures", "1"]):
        assert __main__.main(words) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
