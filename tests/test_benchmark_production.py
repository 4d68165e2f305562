"""The forecast of a production from a few exposures agrees with the forecast from all."""

import pytest

from benchmarks import production as benchmark
from tests.truesky.validation.lake.suite import lakes


def test_a_few_exposures_represent_all():
    """The fields of the deep run are similar, so a few give the costs of all within a few per cent."""
    few, counts = benchmark.core_hours("sc8_deep", 2)
    assert counts == {"VIS": 120, "NISP-P": 360, "NISP-S": 120}
    some, _ = benchmark.core_hours("sc8_deep", 6)
    assert few == pytest.approx(some, rel=0.03)
    assert all(hours > 0.0 for hours in few.values())


@pytest.mark.nightly
def test_the_validation_of_a_lake_is_timed(tmp_path):
    found = benchmark.time_validation(lakes.lake(tmp_path / "lake"))
    assert found["validation_detectors"] == 2.0
    assert found["validation_s"] > 0.0
