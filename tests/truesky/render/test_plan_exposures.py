"""Warnings of the planner about exposures that lack supernovae."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

from truesky.render import plan_exposures
from truesky.render.planning.exposure_chunks import Layout
from truesky.render.planning.mission import mission_of
from truesky.request.from_toml import from_table

PAGE = Path(__file__).resolve().parents[3] / "docs" / "supernovae.md"


def example():
    """Return the request of the page, which has two exposures in the window of its supernovae."""
    (text,) = re.findall(r"```toml\n(name = .*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return from_table(tomllib.loads(text))


def exposures(request):
    layout = Layout.from_request(request, mission_of(request.mission))
    return [exposure for exposure, _ in layout.representative_exposures()]


def test_exposures_outside_the_window_are_named():
    request = example()
    two = exposures(request)
    assert len(two) == 2
    assert not list(plan_exposures.window_warnings(two, request.transients))
    assert not list(plan_exposures.window_warnings(two, None))
    late = [two[0], replace(two[1], mjd=61060.1)]
    (line,) = plan_exposures.window_warnings(late, request.transients)
    assert "1 of 2 exposures of the sky are outside the window MJD 61000 to 61060" in line
    assert "lsstcam on MJD 61060.100" in line
    dark = [two[0], replace(two[1], mjd=61060.1, image_type="dark")]
    assert not list(plan_exposures.window_warnings(dark, request.transients))
