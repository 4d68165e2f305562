"""Test the files of models, and the detected fraction."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky.emulator import samples
from truesky.emulator import model
from truesky.emulator.examples import Examples
from truesky.emulator.features import Features


def test_a_model_is_read_as_it_was_written(tmp_path):
    path = samples.write(tmp_path / "m.parquet")
    found, expected = model.read_model(path), samples.examples()
    assert (found.band, found.camera, found.faintest) == ("euclid_vis", "vis", 1.5)
    assert found.depths == (25.5, 26.9)
    assert (found.examples.outcomes.flags == expected.outcomes.flags).all()
    assert found.examples.features.brightness == pytest.approx(expected.features.brightness, abs=1e-5)
    np.testing.assert_array_equal(found.examples.outcomes.mag_auto, expected.outcomes.mag_auto)


def test_a_file_that_was_replaced_is_read_again(tmp_path):
    first = model.read_model(samples.write(tmp_path / "m.parquet", 1000))
    second = model.read_model(samples.write(tmp_path / "m.parquet", 1100))
    assert (len(first.examples), len(second.examples)) == (1000, 1100)


def test_equal_examples_give_equal_bytes(tmp_path):
    first, second = (samples.write(tmp_path / name).read_bytes() for name in ("a.parquet", "b.parquet"))
    assert first == second
    assert samples.write(tmp_path / "c.parquet", seed=2).read_bytes() != first


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda data: data[: len(data) // 2], "damaged"),
        (lambda data: data[:2000] + bytes([data[2000] ^ 255]) + data[2001:], "damaged"),
        (lambda data: b"", "damaged"),
        (lambda data: b"text", "damaged"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(change, problem, tmp_path):
    path = samples.write(tmp_path / "m.parquet")
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(BadInput, match=problem) as caught:
        model.read_model(path)
    assert len(str(caught.value).splitlines()) == 1


def test_a_parquet_file_without_metadata_is_no_model(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = tmp_path / "other.parquet"
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(BadInput, match="not a model of truesky train"):
        model.read_model(path)
    with pytest.raises(BadInput, match="no such file"):
        model.read_model(tmp_path / "missing.parquet")


def test_detection_probability_follows_the_made_up_survey(tmp_path):
    """sample: 20,000 examples; significance: 0.05, four times the error of a bin"""
    found = model.read_model(samples.write(tmp_path / "m.parquet", 20_000))
    depth = np.array([26.0, 27.0])
    for brightness in (-3.0, -1.0, 0.0, 1.0):
        near = abs(found.examples.features.brightness - brightness) < 0.2
        near &= ~found.examples.features.is_point
        expected = samples.probability(found.examples.features.select(near)).mean()
        assert found.detection_probability(depth + brightness, depth) == pytest.approx([expected] * 2, abs=0.05)
    assert found.detection_probability(30.0, 26.0) == 0.0
    assert found.detection_probability(10.0, 26.0) > 0.95
    assert -1.0 < found.half_detected() < 0.5


def test_depths_outside_the_range_are_extrapolated(tmp_path):
    found = model.read_model(samples.write(tmp_path / "m.parquet"))
    assert list(found.is_extrapolated([25.4, 25.6, 26.8, 27.0])) == [True, False, False, True]


def test_a_file_that_is_replaced_is_read_again(tmp_path):
    path = samples.write(tmp_path / "m.parquet")
    first = model.read_model(path)
    samples.write(path, seed=2)
    assert model.read_model(path).sha256 != first.sha256


def test_few_galaxies_beyond_the_end_of_their_catalogue_do_not_extend_the_range():
    """Stars to 1.5 mag fainter than the depth say nothing of galaxies, and neither do 20 unusual galaxies."""
    found = samples.features(4000, 1, faintest=0.1)
    found.brightness[:20], found.is_point[:20] = 1.4, False
    found.brightness[20:40], found.is_point[20:40] = 1.4, True
    outcomes = samples.examples(4000).outcomes
    fitted = model.Model({**samples.FACTS, "faintest": 1.4}, Examples(found, outcomes), None, "")
    assert 0.0 < fitted.faintest_galaxy < 0.2
    both = Features(np.full(2, 1.0), np.zeros(2), np.full(2, -2.0), np.array([False, True]))
    assert fitted.has_examples(both).tolist() == [False, True]
    assert fitted.detection_probability(27.0, 26.0) == 0.0


def test_a_bright_bin_with_one_lost_galaxy_is_not_the_end_of_detection(tmp_path):
    examples = samples.examples(20_000)
    bright = np.flatnonzero(examples.features.brightness < -5.0)
    examples.features.is_point[bright] = True
    examples.features.is_point[bright[0]] = False
    examples.outcomes.detected[bright[0]] = False
    model.write_model(tmp_path / "m.parquet", examples, samples.FACTS)
    assert -1.0 < model.read_model(tmp_path / "m.parquet").half_detected() < 0.5
