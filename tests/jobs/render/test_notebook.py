"""The notebook renders a field of small detectors from a request, and shows what it says."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[3]
NOTEBOOK = ROOT / "notebooks" / "03_render_one_field.ipynb"
# The detectors of the focal plane cut to a tenth of their area, two of them.
SMALL = """
name = "small"
seed = 7
accuracy = "draft"
[area]
cone = { ra = 53.117, dec = -27.808, radius = 0.2 }
[universe]
galaxy_limit = 22.0
star_limit = 22.0
box_cells = 192
lensing_nside = 64
[mission.overrides]
"vis.fpa.nx" = { value = 1300, unit = "pix" }
"vis.fpa.ny" = { value = 1306, unit = "pix" }
"vis.ghost.offset_y" = { value = 250, unit = "pix" }
[[pointing]]
channel = "VIS"
camera = "vis"
band = "euclid_vis"
ra = 53.117
dec = -27.808
detectors = ["3-3", "3-4"]
position_angle = 0.0
mjd = 60905.0
[products]
truth = []
"""


@pytest.mark.nightly
def test_every_cell_runs(tmp_path, monkeypatch):
    (tmp_path / "small.toml").write_text(SMALL)
    for name, value in {
        "TRUESKY_REQUEST": tmp_path / "small.toml",
        "TRUESKY_LAKE": tmp_path / "lake",
        "TRUESKY_PICTURE": tmp_path / "field.jpg",
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "PYTHONPATH": ROOT,
    }.items():
        monkeypatch.setenv(name, str(value))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert [output for output in outputs if output.output_type == "error"] == []
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    texts = [
        " ".join(output.data["text/plain"].split()) for output in outputs if "text/plain" in output.get("data", {})
    ]
    assert any("'tasks': 2, 'products': 2" in text for text in texts)
    assert 10_000 < (tmp_path / "field.jpg").stat().st_size < 500_000
