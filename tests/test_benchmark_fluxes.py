"""The benchmark of fluxes with --quick: figures of few objects. The accuracy does not depend on the machine."""

import json
import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import pytest
from nbclient import NotebookClient

from benchmarks import fluxes as benchmark
from truesky.request.accuracy import SURVEY

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "notebooks" / "02_speed_for_accuracy.ipynb"
INLINE = "module://matplotlib_inline.backend_inline"
KEYS = (
    "rms_mag_all", "rms_mag_worst_band", "max_mag", "galaxies_per_s_core", "speedup_vs_integration",
    "job_galaxies_per_s_core", "table_mb", "build_s", "oracle_mag_max",
)  # fmt: skip


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    file = tmp_path_factory.mktemp("benchmark") / "fluxes.json"
    assert benchmark.main(["--quick", "--json", str(file)]) == 0
    return json.loads(file.read_text())


@pytest.mark.nightly
def test_all_figures_are_present(figures):
    assert set(KEYS) <= set(figures)
    assert {"name", "commit", "machine", "repeats"} <= set(figures)
    assert figures["name"] == "fluxes"


@pytest.mark.nightly
def test_the_accuracy_holds_on_galaxies_that_were_not_used_to_choose(figures):
    assert figures["rms_mag_all"] <= 1e-4
    assert figures["rms_mag_worst_band"] <= 5e-4
    assert figures["max_mag"] <= min(0.01, 1.0857 * SURVEY.flux)
    assert figures["draft_rms_mag_all"] <= 5e-4
    assert figures["stars_max_mag"] <= 1e-5


@pytest.mark.nightly
def test_speclite_agrees(figures):
    # speclite is independent code for synthetic photometry of the same spectra.
    assert 0.0 < figures["oracle_mag_max"] <= 1e-4


@pytest.mark.nightly
def test_tables_are_small(figures):
    assert figures["table_mb"] <= 4.5


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Copies of the benchmarks' files with two numbers changed, for the notebook."""
    results = shutil.copytree(ROOT / "benchmarks" / "results", tmp_path / "results")
    written, drawn = (json.loads((results / f"{name}.json").read_text()) for name in ("fluxes", "render"))
    (results / "fluxes.json").write_text(json.dumps(written | {"galaxies_per_s_core": 123_400.0}))
    (results / "render.json").write_text(json.dumps(drawn | {"vis_survey_s": 12.34}))
    monkeypatch.setenv("TRUESKY_BENCHMARKS", str(results))
    return written


def check(printed, written):
    """The notebook shows the numbers of the benchmark: changed numbers in the files appear in it."""
    assert "galaxies_per_s_core          1.234e+05" in printed
    assert "vis_survey_s                 12.34" in printed
    assert f"{written['speedup_vs_integration']:.4g}" in printed
    assert written["speedup_vs_integration"] >= 150.0


def test_the_notebook_shows_what_was_measured(results, capsys):
    """Run the cells that read the two files."""
    cells = [cell.source for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    plt.switch_backend("Agg")
    names, before = {}, set(plt.get_fignums())
    for cell in (*cells[:4], "render = json.loads((folder / 'render.json').read_text())", cells[-1]):
        exec(compile(cell, NOTEBOOK.name, "exec"), names)
    shown = set(plt.get_fignums()) - before
    assert len(shown) == 2
    for number in shown:
        plt.close(number)
    check(capsys.readouterr().out, results)


@pytest.mark.nightly
def test_the_notebook_draws_the_figures(results, monkeypatch):
    for name, value in {"PYTHONPATH": str(ROOT), "MPLBACKEND": INLINE}.items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert [output for output in outputs if output.output_type == "error"] == []
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 13
    check("".join(output.text for output in outputs if output.output_type == "stream"), results)
