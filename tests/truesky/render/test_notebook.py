"""Notebooks that render images: small detectors, known shear, spectra, and added sources; their claims hold.

tests/house/test_public_interface.py checks daily that they use only the public interface.
"""

import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from truesky.request.accuracy import PRESETS

ROOT = Path(__file__).resolve().parents[3]
NOTEBOOKS = ROOT / "notebooks"
# Two detectors, cut to a tenth of their area.
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
# Two NISP detectors of the same size, and a dark.
INFRARED = (
    SMALL.replace("vis.fpa.nx", "nisp.fpa.nx").replace("vis.fpa.ny", "nisp.fpa.ny").replace("130", "60")
    .replace('"vis.ghost.offset_y" = { value = 250', '"nisp.ghost.offset_y" = { value = 100')
    .replace('"VIS"', '"NISP-P"').replace('"vis"', '"nisp"').replace("euclid_vis", "euclid_h")
    .replace('["3-3", "3-4"]\nposition_angle = 0.0', '["DET22"]')
    + """
[[observation]]
channels = ["NISP-P"]
image_type = "dark"
exposures = 1
detectors = ["DET22"]
"""
)  # fmt: skip

# The shipped field of spectra, with the detector cut to a strip; without VIS, faint stars and some faint galaxies.
SPECTRA = (NOTEBOOKS.parent / "requests" / "slitless.toml").read_text()
STRIP = re.sub(r"# Twice.*?\n\n", "", SPECTRA, flags=re.DOTALL)
for usual, small in (
    ("galaxy_limit = 25.5", "galaxy_limit = 24.0"), ("star_limit = 25.0", "star_limit = 16.0"),
    ("lensing_nside = 256", "lensing_nside = 64"),
    ("[products]", '[mission.overrides]\n"nisp.fpa.nx" = { value = 760, unit = "pix" }\n'
     '"nisp.fpa.ny" = { value = 160, unit = "pix" }\n[products]'),
):  # fmt: skip
    assert STRIP.count(usual) == 1
    STRIP = STRIP.replace(usual, small)


def printed(outputs):
    """Return what the cells print."""
    return "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")


def run(monkeypatch, name, **environment):
    """Return the outputs of a notebook's cells."""
    environment |= {"MPLBACKEND": "module://matplotlib_inline.backend_inline", "PYTHONPATH": ROOT}
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    # A cell that takes three minutes alone has taken ten next to other programs.
    NotebookClient(notebook, timeout=3000, resources={"metadata": {"path": str(NOTEBOOKS)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert [output for output in outputs if output.output_type == "error"] == []
    return outputs


@pytest.mark.nightly
def test_shear_of_known_galaxies_agrees_with_galsim(tmp_path, monkeypatch):
    """The renderer's m and c minus GalSim's are within the limits of each accuracy."""
    outputs = run(monkeypatch, "04_measure_shear", TRUESKY_LAKE=tmp_path / "shear")
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 1
    text = printed(outputs)
    rows = [line.split() for line in text.partition("less GalSim, without noise")[2].splitlines() if line]
    found = {name: [float(value) for value in values[::3]] for name, *values in rows}
    assert list(found) == ["quicklook", "survey"]
    for name, biases in found.items():
        assert np.abs(biases).max() < PRESETS[name].shape
    (m,) = (float(line.split()[3]) for line in text.splitlines() if line.startswith("GalSim "))
    # Re-Gaussianisation is accurate to a few per cent; without pairs the result would be far off.
    assert -0.05 < m < 0.01


@pytest.mark.nightly
@pytest.mark.parametrize("request_text", [SMALL, INFRARED], ids=["VIS", "NISP-P"])
def test_every_cell_runs(tmp_path, monkeypatch, request_text):
    (tmp_path / "small.toml").write_text(request_text)
    outputs = run(
        monkeypatch,
        "03_render_one_field",
        TRUESKY_REQUEST=tmp_path / "small.toml",
        TRUESKY_LAKE=tmp_path / "lake",
        TRUESKY_PICTURE=tmp_path / "field.jpg",
    )
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    texts = [
        " ".join(output.data["text/plain"].split()) for output in outputs if "text/plain" in output.get("data", {})
    ]
    assert any("'tasks': 2, 'products': 2" in text for text in texts)
    assert 10_000 < (tmp_path / "field.jpg").stat().st_size < 500_000


@pytest.mark.nightly
@pytest.mark.parametrize("whole", [False, True], ids=["strip", "detector"])
def test_redshifts_and_line_fluxes_agree_with_the_catalogue(tmp_path, monkeypatch, whole):
    """The claims hold for the shipped field; every cell also runs for a strip of it."""
    (tmp_path / "spectra.toml").write_text(SPECTRA if whole else STRIP)
    outputs = run(
        monkeypatch,
        "05_slitless",
        TRUESKY_REQUEST=tmp_path / "spectra.toml",
        TRUESKY_LAKE=tmp_path / "lake",
        TRUESKY_PICTURE=tmp_path / "spectra.jpg",
    )
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert 10_000 < (tmp_path / "spectra.jpg").stat().st_size < 150_000
    text = printed(outputs)
    emitters = int(re.search(r"(\d+) galaxies with H alpha", text)[1])
    seen, claimed, right = map(
        int, re.search(r"(\d+) galaxies in all 4 .* (\d+) claimed, (\d+) of them right", text).groups()
    )
    assert 0 <= right <= claimed <= seen <= emitters
    if not whole:
        assert emitters >= 3
        return
    assert claimed >= 50
    assert right >= 0.93 * claimed
    offset, scatter, flux, snr = (
        float(re.search(rf"{name} ([-+.\de]+)", text)[1])
        for name in ("median", "scatter", "measured / true", "exposures:")
    )
    assert abs(offset) < 2e-4
    assert scatter < 4e-4
    assert flux == pytest.approx(1.0, abs=0.06)
    assert snr == pytest.approx(1.0, abs=0.2)


@pytest.mark.nightly
def test_arcs_and_added_galaxies_are_found(tmp_path, monkeypatch):
    outputs = run(
        monkeypatch,
        "06_with_and_without",
        TRUESKY_LAKE=tmp_path / "lenses",
        TRUESKY_PICTURE=tmp_path / "completeness.jpg",
    )
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert 10_000 < (tmp_path / "completeness.jpg").stat().st_size < 300_000
    text = printed(outputs)
    arcs = [(int(a), int(b)) for a, b in re.findall(r"(\d+) electrons in the difference, (\d+) expected", text)]
    assert len(arcs) == 2
    for found, expected in arcs:
        assert found == pytest.approx(expected, rel=0.03)
    found, added, chance = map(int, re.search(r"(\d+) of (\d+) galaxies recovered, (\d+) by chance", text).groups())
    assert added == 900
    assert chance < 0.05 * added < 0.7 * added < found
    assert 25.8 < float(re.search(r"recovered at I_E = ([\d.]+)", text)[1]) < 26.8
