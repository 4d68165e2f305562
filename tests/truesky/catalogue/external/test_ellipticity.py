"""Ellipticities of all conventions and frames give the axis ratios and position angles that GalSim gives."""

import galsim
import numpy as np
import pytest

from truesky.catalogue.external import ellipticity

# Arguments of galsim.Shear that stand for each convention; GalSim has no name for 1 - q.
GALSIM = {"shear": ("g1", "g2"), "distortion": ("e1", "e2"), "conformal": ("eta1", "eta2")}
COMPONENTS = [(0.3, 0.2), (-0.4, 0.1), (0.05, -0.6), (-0.2, -0.3), (0.7, 0.0), (0.0, -0.5), (0.0, 0.0)]


@pytest.mark.parametrize("convention", GALSIM)
def test_conventions_agree_with_galsim(convention):
    """The frame of GalSim's world coordinates is (west, north), so its angle beta counts from west towards north."""
    e1, e2 = np.array(COMPONENTS).T
    ratio = ellipticity.axis_ratio(convention, e1, e2)
    angle = ellipticity.position_angle("west_north", e1, e2)
    for i, components in enumerate(COMPONENTS):
        shear = galsim.Shear(**dict(zip(GALSIM[convention], components, strict=True)))
        assert ratio[i] == pytest.approx(shear.q, abs=1e-12)
        if shear.q < 1.0:
            # North through east: west is at -90 deg.
            difference = angle[i] - (shear.beta / galsim.degrees - 90.0)
            assert (difference + 90.0) % 180.0 - 90.0 == pytest.approx(0.0, abs=1e-9)


def test_flattening_is_one_minus_the_axis_ratio():
    assert ellipticity.axis_ratio("flattening", np.array([0.3, 0.0]), np.array([0.0, -0.4])) == pytest.approx(
        [0.7, 0.6]
    )


@pytest.mark.parametrize("convention", ellipticity.CONVENTIONS)
@pytest.mark.parametrize("q", [0.02, 0.3, 0.999])
def test_the_size_of_an_ellipticity_follows_from_the_axis_ratio(convention, q):
    size = np.array([ellipticity.largest(convention, q)])
    assert ellipticity.axis_ratio(convention, 0.6 * size, 0.8 * size) == pytest.approx([q], abs=1e-12)


# Position angle (north through east) of a galaxy with (e1 > 0, e2 = 0), and with (e1 = 0, e2 > 0), by frame: along the
# first axis, and between both axes.
ANGLES = {
    "east_north": (90.0, 45.0),
    "west_north": (90.0, 135.0),
    "north_east": (0.0, 45.0),
    "north_west": (0.0, 135.0),
}


@pytest.mark.parametrize("frame", ellipticity.FRAMES)
def test_frames_are_named_by_their_axes(frame):
    angle = ellipticity.position_angle(frame, np.array([0.1, 0.0]), np.array([0.0, 0.1]))
    assert angle % 180.0 == pytest.approx(ANGLES[frame], abs=1e-12)


def test_impossible_ellipticities_are_recognised():
    for convention in ("shear", "distortion", "flattening"):
        assert not ellipticity.axis_ratio(convention, np.array([1.1]), np.array([0.0]))[0] > 0.0
