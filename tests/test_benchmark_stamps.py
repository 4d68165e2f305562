"""The benchmark of images of single places."""

import json

import pytest

from tests.benchmarks import run
from tests.test_field import field  # noqa: F401


@pytest.mark.spark
@pytest.mark.nightly
def test_the_benchmark(field, tmp_path):  # noqa: F811
    file = tmp_path / "stamps.json"
    run("stamps", "--quick", "--lake", field, "--json", file)
    figures = json.loads(file.read_text())
    assert figures["frame_differences"] == 0
    assert figures["largest_difference"] < 1.0 / 320.0
    assert figures["import_s"] < figures["first_s"]
