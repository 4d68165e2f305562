"""A task has at least the memory that its forecast says, whatever the detector's size."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import aimed, small
from truesky.render.camera import detectors
from truesky.render.camera.windows import Window
from truesky.render.channels.registry import CHANNELS
from truesky.render.drawing import cost
from truesky.render.exposure import limits, render
from truesky.render.planning import detector_costs


def refused(camera, count, monkeypatch):
    """Return True if this number of sources, one of them with the largest stamp, is too large for a detector."""
    monkeypatch.setattr(cost, "seconds", lambda *scene: 0.0)
    detector, rng = detectors.detectors(camera, resolve())[0], np.random.default_rng(1)
    sizes = np.full(count, 64)
    sizes[0] = 2048
    sources = SimpleNamespace(
        column=rng.uniform(0, detector.nx, count),
        row=rng.uniform(0, detector.ny, count),
        electrons=np.full(count, 1e4),
        picture=None,
        trail=None,
        trail_length=np.zeros(count),
    )
    whole = Window(0, 0, detector.nx, detector.ny)
    exposure = SimpleNamespace(exposure_id=1)
    aim = SimpleNamespace(channel=CHANNELS["EXT"], detector=detector, drawn=whole, exposure=exposure)
    try:
        limits.refuse_too_large(aim, SimpleNamespace(psf=1, dispersed=None, sources=sources, sizes=sizes))
    except BadInput:
        return True
    return False


@pytest.mark.parametrize(("camera", "count"), [("jpcam", 140_000), ("lsstcam", 60_000)])
def test_a_deep_field_is_drawn(camera, count, monkeypatch):
    """Of 85 million pixels the frames alone take more than tasks of other cameras have."""
    assert not refused(camera, count, monkeypatch)
    assert refused(camera, 2_000_000, monkeypatch)


def test_it_is_what_the_forecast_says():
    assert detector_costs.cost_model("EXT", True, ()).memory(9216 * 9232) == pytest.approx(4.19, abs=0.05)


def test_a_detector_larger_than_the_memory_is_refused_before_it_is_drawn(monkeypatch):
    """A detector of 32,000 x 32,000 pixels takes 59 GB."""
    monkeypatch.setattr(limits, "_installed_bytes", lambda: 25e9, raising=False)
    large = replace(small("vis", "3-4", 16), nx=32_000, ny=32_000)
    with pytest.raises(BadInput, match=r"detector 3-4: 32000 x 32000 pixels take 58.9 GB, this machine has 25.0 GB"):
        render.render(aimed(large, None, None), None, None, 1)
    limits.refuse_too_many_pixels(aimed(replace(large, ny=16), None, None))


def test_the_installed_memory_is_known():
    assert limits._installed_bytes() > 5e8
