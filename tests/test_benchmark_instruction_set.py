"""The cost of the common instruction set is measured, whatever it is on this machine."""

import contextlib
import json

import pytest

from benchmarks import _subjects
from benchmarks import instruction_set as benchmark


@pytest.mark.parametrize(
    "subjects", [["fluxes"], pytest.param(list(benchmark.SUBJECTS), marks=pytest.mark.nightly)], ids=["short", "all"]
)
def test_the_figures(tmp_path, subjects, monkeypatch):
    if subjects == ["fluxes"]:
        # The short version starts no processes: it gets the times of both sets of instructions.
        settings = []

        def started(subject, quick, environment):
            settings.append(environment[benchmark.instruction_set.SETTING])
            return contextlib.nullcontext()

        monkeypatch.setattr(_subjects, "start", started)
        monkeypatch.setattr(_subjects, "alternate", lambda processes, repeats: [[3.0], [2.0]])
    file = tmp_path / "figures.json"
    assert benchmark.main(["--quick", "--json", str(file), "--subjects", *subjects]) == 0
    figures = json.loads(file.read_text())
    for subject in subjects:
        ratio = figures[f"{subject}_portable_s"] / figures[f"{subject}_native_s"]
        assert figures[f"{subject}_ratio"] == pytest.approx(ratio)
        assert figures[f"{subject}_ratio_min"] <= figures[f"{subject}_ratio"] <= figures[f"{subject}_ratio_max"]
    if subjects == ["fluxes"]:
        assert settings == list(benchmark.SETTINGS) == ["portable", "native"]
        assert (figures["fluxes_portable_s"], figures["fluxes_native_s"]) == (3.0, 2.0)
