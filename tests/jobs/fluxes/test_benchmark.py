"""The benchmark in haste: its figures, on a thousandth of its objects; accuracy holds whatever the machine."""

import json
from pathlib import Path

import pytest

from benchmarks import fluxes as benchmark
from jobs.accuracy import SURVEY

NOTEBOOK = Path(__file__).parents[3] / "notebooks" / "02_speed_for_accuracy.ipynb"
KEYS = (
    "rms_mag_all", "rms_mag_worst_band", "max_mag", "galaxies_per_s_core", "speedup_vs_integration",
    "job_galaxies_per_s_core", "table_mb", "build_s", "oracle_mag_max",
)  # fmt: skip


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    file = tmp_path_factory.mktemp("benchmark") / "fluxes.json"
    assert benchmark.main(["--quick", "--json", str(file)]) == 0
    return json.loads(file.read_text())


def test_the_keys_are_there(figures):
    assert set(KEYS) <= set(figures)
    assert {"name", "commit", "machine", "repeats"} <= set(figures)
    assert figures["name"] == "fluxes"


def test_the_accuracy_holds_on_galaxies_that_were_not_used_to_choose(figures):
    assert figures["rms_mag_all"] <= 1e-4
    assert figures["rms_mag_worst_band"] <= 5e-4
    assert figures["max_mag"] <= min(0.01, 1.0857 * SURVEY.flux)
    assert figures["draft_rms_mag_all"] <= 5e-4
    assert figures["stars_max_mag"] <= 1e-5


def test_speclite_agrees(figures):
    # Synthetic photometry by other people's code, of the same spectra.
    assert 0.0 < figures["oracle_mag_max"] <= 1e-4


def test_tables_are_small(figures):
    assert figures["table_mb"] <= 4.5


def test_the_notebook_draws_the_figures(monkeypatch):
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(NOTEBOOK.parent)
    monkeypatch.delenv("TRUESKY_BENCHMARKS", raising=False)
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    space = {}
    for cell in cells:
        exec("".join(cell["source"]), space)
    assert space["fluxes"]["speedup_vs_integration"] > 100.0
    assert len(space["bands"]) == len(benchmark.BANDS)
    space["plt"].close("all")
