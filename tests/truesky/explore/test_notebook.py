"""The notebook runs on a small field from the real jobs, and its text agrees with its results."""

from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from astropy.table import Table

from lake_schema.store import layout, publish
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.request.from_toml import parse

nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed (extra notebooks)")
nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed (extra notebooks)")
NOTEBOOK = Path(__file__).resolve().parents[3] / "notebooks" / "01_explore_catalogue.ipynb"
SMALL = requests.shallow(23.5, 20.0) + '[fluxes]\nbands = ["euclid_vis", "lsst_r"]\n'


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Galaxies, stars and fluxes, made without Spark."""
    folder = tmp_path_factory.mktemp("field")
    wanted = parse(requests.written(folder, SMALL, requests.FIELD.format(0.02), seed=7))
    root = layout.resolve_lake(folder / "lake")
    root.mkdir()
    for job in (build_galaxies.JOB, build_stars.JOB, compute_fluxes.JOB):
        for step in job.steps(root, wanted):
            publish.make_version(root, step.plan, step.run_task)
    return root


@pytest.fixture
def cells(field, tmp_path, monkeypatch):
    """Cells of the notebook, with an environment that points to the field."""
    monkeypatch.setenv("TRUESKY_LAKE", str(field))
    monkeypatch.setenv("TRUESKY_DOWNLOADS", str(tmp_path))
    return [cell.source for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]


def check(folder):
    """Files that the notebook exports."""
    taken = Table.read(folder / "redshift_one.fits")
    assert len(taken) > 100
    assert taken["ra"].unit == "deg"
    assert 0.9 <= taken["z_obs"].min() <= taken["z_obs"].max() <= 1.1


def test_every_cell_runs(cells, tmp_path, capsys):
    """Cells run in this process; at night they run in a kernel, which draws the figures."""
    plt.switch_backend("Agg")
    names, before = {}, set(plt.get_fignums())
    for cell in cells:
        exec(compile(cell, NOTEBOOK.name, "exec"), names)
    drawn = set(plt.get_fignums()) - before
    for number in drawn:
        plt.close(number)
    assert len(drawn) == 8
    assert capsys.readouterr().out == ""
    check(tmp_path)


@pytest.mark.nightly
def test_every_cell_runs_in_a_kernel(cells, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOK.parents[1]))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert [output for output in outputs if output.output_type in ("error", "stream")] == []
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 8
    check(tmp_path)
