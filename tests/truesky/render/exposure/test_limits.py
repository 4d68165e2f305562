"""A task has at least the memory that its forecast says, whatever the detector's size."""

from types import SimpleNamespace

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.render.camera import detectors
from truesky.render.camera.windows import Window
from truesky.render.channels.registry import CHANNELS
from truesky.render.drawing import cost
from truesky.render.exposure import limits
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
