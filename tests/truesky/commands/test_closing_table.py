"""The tables at the end of a run: rows, sizes, times, and the area that the catalogues cover."""

from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lake_schema.store import publish
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from truesky.commands import closing_table
from truesky.render.forecasting.actual_costs import Line, format_table
from truesky.request import area
from truesky.request.from_toml import parse

DEMO = Path(__file__).resolve().parents[3] / "requests" / "demo.toml"
Stage = namedtuple("Stage", "name tables")


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({"cone": {"ra": 10.0, "dec": 60.0, "radius": 0.2}}, 2 * np.pi * (1 - np.cos(np.radians(0.2)))),
        ({"cone": {"ra": 10.0, "dec": 60.0, "radius": 0.01}}, 2 * np.pi * (1 - np.cos(np.radians(0.01)))),
        ({"box": {"ra": [359.0, 1.0], "dec": [0.0, 30.0]}}, np.radians(2.0) * 0.5),
    ],
)
def test_the_size_of_an_area(section, expected):
    assert area.parse(section).square_degrees() == pytest.approx(expected * np.degrees(1.0) ** 2, rel=1e-7, abs=0.0)


def test_the_area_of_whole_cells_is_told():
    line = closing_table.describe_area(parse(DEMO).area)
    assert line.startswith("area: 0.126 deg2 are requested; the catalogues cover 0.472 deg2 (9 whole HEALPix cells)")
    assert "in_area(ra, dec)" in line


def test_every_table_has_its_rows_and_size(lake, capsys):
    publish.make_version(lake, plain_plan(), plain_work, name="demo")
    publish.make_version(lake, toy_plan(), toy_work, name="demo")
    jobs = [(Stage("build_x", ("plain", "toy")), 12.34)]
    closing_table.print_catalogues(lake, parse(DEMO), jobs, 1234.5)
    _, head, first, second, total, _, about_area, *_ = capsys.readouterr().out.splitlines()
    assert head.split() == ["job", "table", "rows", "size,", "MB", "time,", "s"]
    assert first.split()[:3] == ["build_x", "plain", "60"]
    assert first.split()[-1] == "12.3"
    assert second.split()[:2] == ["toy", "550"]
    assert total.split() == ["all", "1,234.5"]
    assert about_area.startswith("area: ")


VIS = Line("VIS", "vis", "science", 4, 4, 4, 30.0, 40.0, 1.5, 0.2, 0.21, 0.005, 1.6)
EMPTY = Line("EXT", "lsstcam", "science", 2, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def totals(channel):
    return replace(VIS, channel=channel, camera="all", image_type="", deg2=0.0)


def test_lines_and_columns_without_values_are_left_out(monkeypatch):
    monkeypatch.setenv("COLUMNS", "0")
    head, line = format_table([VIS, EMPTY, totals("VIS"), replace(EMPTY, camera="all", image_type=""), totals("all")])
    assert "planned" not in head
    assert line.split() == ["VIS", "vis", "science", "4", "30.0", "40.0", "1.50", "0.200", "0.210", "0.005", "1.60"]
    dark = replace(VIS, image_type="dark", rendered=1, deg2=0.0, core_hours_deg2=0.0, gb=2e-5)
    head, *lines = format_table([dark, VIS, totals("VIS"), totals("all")])
    assert len(lines) == 4
    assert "planned" in head
    assert lines[0].split()[3:5] == ["1", "4"]
    assert "2e-05" in lines[0]
    assert lines[0].split()[-2:] == ["-", "-"]
    assert "area" not in format_table([dark])[0]
