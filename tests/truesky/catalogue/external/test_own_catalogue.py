"""The example of docs/ingest.md passes the check at the first attempt, becomes a catalogue and is rendered."""

import re
from pathlib import Path

import galsim
import numpy as np
import pytest

from lake_schema.store import publish, read, validate
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue import build_galaxies, build_stars
from truesky.catalogue.external import ingest
from truesky.commands import check
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import parse

PAGE = (Path(__file__).resolve().parents[4] / "docs" / "ingest.md").read_text()
SECTION = PAGE.split("## Bring your own catalogue")[1].split("\n## ")[0]


def block(language):
    """Return the first block of a language in the section."""
    return re.search(rf"```{language}\n(.*?)```", SECTION, re.DOTALL)[1]


@pytest.fixture
def request_file(tmp_path, monkeypatch):
    monkeypatch.setattr(ingest, "cache_dir", lambda: tmp_path / "cache")
    (tmp_path / "catalogue.csv").write_text(block("none"))
    path = tmp_path / "own_catalogue.toml"
    path.write_text(block("toml"))
    return path


def test_the_example_is_checked_and_becomes_a_catalogue(request_file, capsys):
    assert check.main([str(request_file)]) == 0
    assert "own_catalogue: good: 1 pointings" in capsys.readouterr().out
    lake = request_file.parent / "lake"
    lake.mkdir()
    for step in build_galaxies.steps(lake, parse(request_file)):
        publish.make_version(lake, step.plan, step.run_task)
    rows = read.version(lake, "galaxies").rows().sort_by("origin_id")
    assert validate.find_violations(rows, GALAXIES) == []
    columns = np.array([[float(text) for text in line.split(",")] for line in block("none").split()[1:]]).T
    assert rows["origin_id"].to_pylist() == columns[0].astype(int).tolist()
    shears = [galsim.Shear(e1=e1, e2=e2) for e1, e2 in columns[6:].T]
    for name in ("bulge_axis_ratio", "disk_axis_ratio"):
        assert rows[name].to_numpy() == pytest.approx([shear.q for shear in shears], rel=1e-6)
    # GalSim's angles count from west towards north.
    angle = np.array([shear.beta / galsim.degrees - 90.0 for shear in shears])
    assert rows["position_angle"].to_numpy() == pytest.approx(angle % 180.0, abs=1e-4)
    for name in ("bulge_half_light_radius", "disk_half_light_radius"):
        assert rows[name].to_numpy() == pytest.approx(columns[5], rel=1e-6)


def test_three_mistakes_are_reported_as_on_the_page(request_file, capsys):
    path = request_file.parent / "catalogue.csv"
    text = path.read_text()
    for old, new in (("-27.8047", "-97.8"), ("-0.42,", "-1.2,"), ("1.20,23.8", "-1,23.8")):
        text = text.replace(old, new)
    path.write_text(text)
    assert check.main([str(request_file)]) == 2
    assert capsys.readouterr().err.replace(f"{request_file.parent}/", "") == block("text")


@pytest.mark.nightly
def test_the_example_is_rendered(request_file):
    """One image is rendered from the example."""
    request, lake = parse(request_file), request_file.parent / "lake"
    lake.mkdir()
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(lake, request):
            publish.make_version(lake, step.plan, step.run_task)
    products = read.version(lake, "products")
    assert products.num_rows == 1
