"""The benchmark of stages measures all of them, and the errors of accuracies."""

import json

import pytest

from benchmarks import stages
from tests import benchmarks


@pytest.mark.nightly
def test_the_figures(tmp_path):
    benchmarks.run("stages", "--quick", "--json", tmp_path / "figures.json")
    figures = json.loads((tmp_path / "figures.json").read_text())
    for scene in stages.SCENES:
        for accuracy in ("quicklook", "reference"):
            of = {key: figures[f"{scene}_{accuracy}_{key}"] for key in ("s", *(f"{name}_s" for name in stages.STAGES))}
            assert min(of.values()) >= 0.0
            assert sum(of.values()) == pytest.approx(2.0 * of["s"])
            assert of["draw_s"] > 0.0
        assert figures[f"{scene}_reference_misplaced"] == figures[f"{scene}_reference_sky_sigma"] == 0.0
        assert 0.0 < figures[f"{scene}_quicklook_misplaced"] < 0.2
