"""The benchmark of the ground cameras with --quick, and a whole exposure of LSSTCam."""

import json

import pytest

from benchmarks import ext as benchmark
from truesky.render.products import run_log
from truesky.request.from_toml import parse


def test_a_field_that_all_sites_see(tmp_path):
    """The requests are valid, and all effects of a detector are requested."""
    file = tmp_path / "ext.toml"
    file.write_text(benchmark.request_text(tuple(benchmark.CAMERAS.values()), 0.2))
    wanted = parse(file)
    assert [pointing.camera for pointing in wanted.pointings] == ["lsstcam", "decam", "jpcam", "megacam", "hsc", "gpc1"]
    assert {"bleeding", "crosstalk", "tree_rings", "brighter_fatter"} < set(
        benchmark.with_all_effects(wanted).effects.on
    )
    file.write_text(benchmark.request_text([benchmark.LSST], 2.1, whole_cameras=True))
    (pointing,) = parse(file).pointings
    assert pointing.detectors == ()


@pytest.mark.nightly
def test_the_figures(tmp_path):
    file = tmp_path / "ext.json"
    assert benchmark.main(["--quick", "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert {"lsst_survey_s", "lsst_draft_s", "decam_survey_s", "lsst_peak_gb", "effect_bleeding_s"} <= set(figures)
    assert {"gpc1_s_error", "memory_error"} <= set(figures)
    # The time includes the effects, even if there are few sources.
    assert 0.2 < figures["lsst_survey_s"] < 15.0
    assert 0.3 < figures["lsst_peak_gb"] < 2.0


@pytest.mark.spark
@pytest.mark.nightly
def test_a_whole_exposure_of_lsstcam(tmp_path):
    """189 sensors are planned and rendered at draft accuracy on 2 cores. The target is 12 minutes.

    Only CPU time counts, because it does not depend on other processes.
    """
    assert benchmark.time_exposure(tmp_path, (24.0, 22.0))["lsst_exposure_s"] > 0.0
    images = [*tmp_path.rglob("EXT_lsst_r_*_science.fits")]
    assert len({image.name for image in images}) == 189
    lines = [line for log in run_log.logs_of_products(tmp_path / "exposure" / "lake") for line in run_log.lines(log)]
    seconds = [line["cpu_s"] for line in lines if "cpu_s" in line]
    assert len(seconds) == 189
    assert sum(seconds) / 2.0 < 720.0
