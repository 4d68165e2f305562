"""The benchmark of time against accuracy: approximations are measured, and the table of settings is up to date."""

import csv
from pathlib import Path

import numpy as np
import pytest

from benchmarks import _approximations as approximations
from benchmarks import _lensing as lensing
from benchmarks import _scenes as scenes
from benchmarks import trade
from benchmarks._scenes import VIS
from tests.benchmarks import run
from truesky.render.drawing.settings import settings_for
from truesky.render.sources import galaxy_shapes
from truesky.request import accuracy, lensing_resolution
from truesky.request.accuracy import SURVEY

RESULTS = Path(trade.__file__).with_name("results")
BY_NAME = {each.name: each for each in approximations.ALL}


def rows():
    with (RESULTS / "trade.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_settings_are_those_that_were_measured():
    assert trade.settings_table(rows()) == Path(accuracy.__file__).with_name("accuracy.csv").read_text()


def test_errors_of_the_truth_are_measured():
    """The error of the truth is measured, and galsim's default is compared with the same images as ours.

    We differ from galsim with tight parameters only by its interpolation of the PSF between samples.
    """
    told = {row["name"]: row for row in rows() if row["kind"] == "oracle"}
    assert "ours, the largest stamps" in told
    assert len(told) == 4
    series = told["the PSF by its Fourier series"]
    (ours,) = (row for row in rows() if row["kind"] == "series")
    assert float(ours["r2_rms"]) < 0.1 * float(series["r2_rms"])
    assert float(told["folding 1e-3"]["r2_rms"]) < 0.1 * float(series["r2_rms"])
    (default,) = (row for row in rows() if row["kind"] == "peer")
    mine = next(row for row in rows() if row["kind"] == "settings")
    assert default["galaxies"] == mine["galaxies"] == told["ours, the largest stamps"]["galaxies"]


def test_a_stratified_sample_has_bright_and_faint_galaxies_and_stars():
    some = scenes.stratified_sample(VIS, 3, 2)
    magnitudes, star = scenes.magnitudes(some, VIS), some.shape < 0
    for of in (star, ~star):
        counts, _ = np.histogram(magnitudes[of], scenes.LAYERS)
        assert (counts == 2).all()
    # Another seed gives other sources.
    assert not np.isin(magnitudes, scenes.magnitudes(scenes.stratified_sample(VIS, 4, 2), VIS)).any()


def test_every_approximation_was_measured():
    assert [row["name"] for row in rows() if row["kind"] == "approximation"] == list(BY_NAME)


@pytest.mark.parametrize("name", list(BY_NAME))
def test_an_approximation_keeps_what_it_should(name):
    """Sources, positions and light do not change, and the approximation applies to the selected galaxies."""
    approximation = BY_NAME[name]
    some = approximation.select_galaxies(VIS, 3, 6)
    simple = approximation.simplify(some)
    assert len(simple) == len(some) == 6
    np.testing.assert_array_equal(simple.electrons, some.electrons)
    np.testing.assert_array_equal(simple.column, some.column)
    size, index = galaxy_shapes.half_light(some.shapes), some.shapes.sersic_index
    if "below" in name:
        assert size[some.shape] == pytest.approx(approximations.TINY)
    if "down and up" in name:
        assert (size[some.shape] > approximations.HUGE).all()
    if "faint" in name:
        assert (scenes.magnitudes(some, VIS) > approximations.FAINT).all()
    if "rounded" in name:
        assert np.abs(simple.shapes.sersic_index - index).max() <= 0.05 + 1e-12
        assert 10 * simple.shapes.sersic_index == pytest.approx(np.rint(10 * simple.shapes.sersic_index))


def test_stamps_contain_the_light_above_the_folding_threshold():
    """The fraction of the PSF outside the stamp is below the folding threshold."""
    some, psf = scenes.sample(VIS, 3, 6), scenes.scene_psf(VIS, 1)
    settings = settings_for(SURVEY)
    sizes = BY_NAME["folding threshold 0.5 %"].sizes(some, psf, VIS, settings)
    outside = psf.outside[np.minimum(sizes // 2, len(psf.outside) - 1)]
    assert (outside < approximations.FOLDING).all()


def test_sampling_down_and_up_keeps_a_plane():
    """A biquadratic interpolation is exact if the light varies linearly."""
    y, x = np.mgrid[:32, :32]
    plane = 5.0 + 0.3 * x - 0.1 * y
    found = BY_NAME["sampled down and up"].process_image(plane)
    np.testing.assert_allclose(found[8:-8, 8:-8], plane[8:-8, 8:-8], rtol=1e-3)


@pytest.mark.nightly
def test_the_quick_benchmark(tmp_path):
    run("trade", "--quick", "--csv", tmp_path / "t.csv", "--figure", tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 10_000
    with (tmp_path / "t.csv").open() as file:
        found = {row["kind"]: row for row in csv.DictReader(file)}
    assert float(found["settings"]["shear_m_worst"]) < 1e-3
    assert float(found["approximation"]["seconds_before"]) > 0


@pytest.mark.nightly
def test_lensing_maps_are_compared_by_resolution(tmp_path):
    """Errors of small maps of a small box fall with the resolution, and the file can be read."""
    trade.main(["--lensing", str(tmp_path / "lensing.csv"), "--quick"])
    lines = (line for line in (tmp_path / "lensing.csv").read_text().splitlines() if line[0] != "#")
    coarse, fine, reference = csv.DictReader(lines)
    assert [row["nside"] for row in (coarse, fine, reference)] == ["16", "32", "64"]
    assert coarse.keys() == lensing_resolution.rows()[0].keys()
    assert 0.0 < float(fine["shear_rms"]) < float(coarse["shear_rms"])
    assert float(coarse["gb"]) < float(fine["gb"]) < float(reference["gb"])


def test_the_table_of_resolutions_is_as_the_benchmark_writes_it(tmp_path):
    file = Path(accuracy.__file__).with_name("lensing_resolution.csv")
    lensing.write_table(lensing_resolution.rows(), tmp_path / "lensing.csv")
    written, shipped = ((tmp_path / "lensing.csv").read_text(), file.read_text())
    # The last line of the comment names the machine.
    assert [line for line in written.splitlines() if " On " not in line] == [
        line for line in shipped.splitlines() if " On " not in line
    ]
