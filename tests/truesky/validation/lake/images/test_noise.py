"""The overscan of every frame is checked, also if the noise of a bright sky hides read noise in the pixels."""

import numpy as np
import pytest
from astropy.io import fits

from tests.truesky.render.fields import MISSION, small
from tests.truesky.render.products import test_tools as tools
from truesky.render.camera.sections import Section
from truesky.validation.lake.images import noise
from truesky.validation.lake.measure import frames
from truesky.validation.lake.measure.frame_context import FrameContext
from truesky.validation.lake.measure.rows import Place

# Sky in electrons per second and pixel whose noise in 100 s hides read noise, and one that does not.
BRIGHT, FAINT = 1e3, 0.1


def overscan_rows(path):
    frame = frames.open_frame(path)
    return frame, noise._overscan_rows(FrameContext(Place("EXT"), frame, None))


def written(folder, way, sky=BRIGHT, camera="lsstcam", name="R22_S11"):
    return tools.put(tools.stars_on(camera, sky, small(camera, name, 512), mission=MISSION, way=way), folder).path


@pytest.mark.parametrize(("way", "sky"), [("raw", BRIGHT), ("amplifiers", BRIGHT), ("amplifiers", FAINT)])
def test_the_overscan_is_checked_under_every_sky(way, sky, tmp_path):
    frame, rows = overscan_rows(written(tmp_path, way, sky))
    assert (frame.amplifiers[0].header_read_noise == 0.0) == (sky == BRIGHT)
    assert len(rows) == 16
    for row in rows:
        assert row.value == pytest.approx(1.0, abs=4.0 * row.error)
        assert abs(row.value - row.expected) < row.tolerance + 4.0 * row.error


def test_an_overscan_without_noise_fails(tmp_path):
    path = written(tmp_path, "amplifiers")
    with fits.open(path, mode="update") as units:
        for unit in units[1:]:
            part = Section.from_text(unit.header["BIASSEC"]).slices
            unit.data[part] = round(np.mean(unit.data[part]))
    _, rows = overscan_rows(path)
    assert [row.value for row in rows] == pytest.approx([0.0] * 16)
    assert all(abs(row.value - row.expected) > row.tolerance for row in rows)


def test_an_overscan_whose_noise_the_request_switches_off_is_skipped(tmp_path):
    path = written(tmp_path, "amplifiers")
    with fits.open(path, mode="update") as units:
        (card,) = (card for card in units[0].header.cards if str(card.value).startswith("read_noise: "))
        assert card.value.startswith("read_noise: off, margin ")
        card.value = card.value.replace("off", "off (forced)")
    assert overscan_rows(path)[1] == []
