"""Sections: pixels have the same positions in the mosaic of a camera as in its focal plane."""

import re

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS
from truesky.render.camera.detectors import detectors
from truesky.render.camera.sections import Section, Sections, mosaic_size, to_mosaic_section

MISSION = resolve()


def numbers(text):
    return [int(number) for number in re.fullmatch(r"\[(\d+):(\d+),(\d+):(\d+)\]", text).groups()]


def test_as_fits_counts():
    assert Section(0, 20, 300, 100).text == "[1:300,21:120]"
    assert Sections.full_frame(4, 3) == Sections(Section(0, 0, 4, 3), Section(0, 0, 4, 3))


@pytest.mark.parametrize("camera", ["vis", "nisp", *CAMERAS])
def test_no_two_detectors_share_a_pixel_and_all_are_inside(camera):
    every = detectors(camera, MISSION)
    _, right, _, top = numbers(mosaic_size(every))
    places = {d.name: to_mosaic_section(d, Section(0, 0, d.nx, d.ny), every) for d in every}
    # Detectors that are rotated by 90 deg have no such section. HSC has four of them.
    assert sum(place is None for place in places.values()) == (4 if camera == "hsc" else 0)
    found = [numbers(place) for place in places.values() if place]
    corners = np.array([(*sorted(one[:2]), *sorted(one[2:])) for one in found])
    if camera != "hsc":
        assert (corners[:, 0].min(), corners[:, 2].min()) == (1, 1)
        assert (corners[:, 1].max(), corners[:, 3].max()) == (right, top)
    assert (corners > 0).all()
    assert (corners[:, [1, 3]] <= (right, top)).all()
    for i, (x0, x1, y0, y1) in enumerate(corners):
        apart = (corners[:, 0] > x1) | (corners[:, 1] < x0) | (corners[:, 2] > y1) | (corners[:, 3] < y0)
        apart[i] = True
        assert apart.all()


@pytest.mark.parametrize("camera", ["vis", "nisp", "decam", "megacam"])
def test_a_pixel_of_the_mosaic_lies_where_it_lies_in_the_focal_plane(camera):
    """The offset between mosaic and focal plane is the same for all detectors within 8 pixels.

    The tolerance is needed because the rotation of mounted detectors has small errors.
    """
    every, corners = detectors(camera, MISSION), []
    for d in every:
        section = Section(3, 7, d.nx // 2, d.ny // 3)
        x0, x1, y0, y1 = numbers(to_mosaic_section(d, section, every))
        angle = np.radians(d.rotation)
        u, v = (3 - (d.nx - 1) / 2, 7 - (d.ny - 1) / 2)
        x = d.x / d.pixel_scale + np.cos(angle) * u - np.sin(angle) * v
        y = d.y / d.pixel_scale + np.sin(angle) * u + np.cos(angle) * v
        # The mosaic of DECam is rotated by 90 deg: its rows are parallel to columns of the detectors.
        corners.append((x0 - y, y0 + x) if camera == "decam" else (x0 - x, y0 - y))
        sign = -1 if d.upside_down and camera != "decam" else 1
        assert (x1 - x0, y1 - y0) == (sign * (section.nx - 1), sign * (section.ny - 1))
    assert np.ptp(np.array(corners), axis=0).max() < 8.0
