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


@pytest.mark.parametrize("camera", ["vis", "nisp", "decam", "megacam", "hsc"])
def test_a_pixel_of_the_mosaic_lies_where_it_lies_in_the_focal_plane(camera):
    """The offset between mosaic and focal plane is the same for all detectors within 8 pixels.

    The tolerance is needed because the rotation of mounted detectors has small errors. For HSC these are larger.
    """
    every, offsets = detectors(camera, MISSION), []
    for d in every:
        section = Section(3, 7, d.nx // 2, d.ny // 3)
        place = to_mosaic_section(d, section, every)
        if place is None:
            continue
        x0, x1, y0, y1 = numbers(place)
        x, y = np.array(d.to_focal_plane(*(d.pixel_scale * np.array([3 - (d.nx - 1) / 2, 7 - (d.ny - 1) / 2]))))
        x, y = x / d.pixel_scale, y / d.pixel_scale
        # Directions of the columns and rows of the mosaic in the focal plane (x west, y north): south and east for
        # DECam, as in its own headers, and north and west for HSC.
        across, up = {"decam": (-y, -x), "hsc": (y, x)}.get(camera, (x, y))
        offsets.append((x0 - across, y0 - up))
        turned = {"decam": False, "hsc": d.name.startswith("1_")}.get(camera, d.upside_down)
        sign = -1 if turned else 1
        assert (x1 - x0, y1 - y0) == (sign * (section.nx - 1), sign * (section.ny - 1))
    assert np.ptp(np.array(offsets), axis=0).max() < 8.0


def test_numbers_along_the_mosaic_of_decam_increase_as_in_its_headers():
    """DETSEC of S1 is [12289:14336,1:4096] in raw headers: the lowest rows, and columns near the middle."""
    every = detectors("decam", MISSION)
    s1, n31, s29 = (next(d for d in every if d.name == name) for name in ("S1", "N31", "S29"))
    x0, x1, y0, y1 = numbers(to_mosaic_section(s1, Section(0, 0, s1.nx, s1.ny), every))
    assert (x1 - x0, y1 - y0) == (2047, 4095)
    assert y0 < 10
    _, right, *_ = numbers(mosaic_size(every))
    assert x0 < right / 2 < x1 + 100
    assert numbers(to_mosaic_section(s29, Section(0, 0, 1, 1), every))[0] < 10
    assert numbers(to_mosaic_section(n31, Section(0, 0, 1, 1), every))[0] > right - 2060
