"""The cost of the common instruction set is measured, whatever it is on this machine."""

import json

import pytest

from benchmarks import instruction_set as benchmark


@pytest.mark.parametrize(
    "subjects", [["fluxes"], pytest.param(list(benchmark.SUBJECTS), marks=pytest.mark.nightly)], ids=["fluxes", "all"]
)
def test_the_figures(tmp_path, subjects):
    file = tmp_path / "figures.json"
    assert benchmark.main(["--quick", "--json", str(file), "--subjects", *subjects]) == 0
    figures = json.loads(file.read_text())
    for subject in subjects:
        ratio = figures[f"{subject}_portable_s"] / figures[f"{subject}_native_s"]
        assert figures[f"{subject}_ratio"] == pytest.approx(ratio)
        assert figures[f"{subject}_ratio_min"] <= figures[f"{subject}_ratio"] <= figures[f"{subject}_ratio_max"]
