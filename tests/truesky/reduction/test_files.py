"""Names of master frames."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from truesky.reduction import files


def name(camera, band, detector, kind):
    exposure = SimpleNamespace(camera=camera, band=band, channel="EXT")
    frame = SimpleNamespace(exposure=exposure, detector=detector, scene=SimpleNamespace(ramp=None))
    return files.master_path(Path(), frame, kind).name


def test_masters_of_shipped_cameras_keep_their_names():
    assert name("megacam", "cfis_r", "ccd05", "flat") == "megacam_cfis_r_ccd05_flat.fits"
    assert name("megacam", "cfis_r", "ccd05", "bias") == "megacam_ccd05_bias.fits"


@pytest.mark.parametrize(
    ("first", "second", "kind"),
    [
        (("a", "b_c", "left"), ("a_b", "c", "left"), "flat"),
        (("a", "b", "c_left"), ("a", "b_c", "left"), "flat"),
        (("a", "r", "b_left"), ("a_b", "r", "left"), "bias"),
        (("decam_des", "r", "S29"), ("decam", "des_r", "S29"), "flat"),
    ],
)
def test_masters_of_two_cameras_never_have_one_name(first, second, kind):
    assert name(*first, kind) != name(*second, kind)
