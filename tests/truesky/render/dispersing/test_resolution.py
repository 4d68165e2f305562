"""Resolving powers of the grisms, from the width of a line of a source of half an arcsecond."""

import numpy as np
import pytest

from benchmarks import _scenes as scenes
from lake_schema.mission.parameter import read_all_parameters
from tests.truesky import nightly
from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import DETECTOR, MISSION, drawn, one, order
from truesky.render.camera import traces
from truesky.render.dispersing import draw, images
from truesky.render.psf import euclid
from truesky.request.accuracy import SURVEY

SIDE, MIDDLE, PHASES = 64, 32.0, 8
# FWHM of the source, arcsec. The half-light radius of a Gaussian is half of its FWHM.
WIDE = 0.5


def source(gaussian):
    """Return a Gaussian of this FWHM, or a disc with the same half-light radius."""
    some = scenes.sources(scenes.NISP, 4, galaxies=1, stars=0)
    known = {
        "bulge_radius": 0.5 * WIDE, "disk_radius": 0.5 * WIDE, "bulge_fraction": float(gaussian), "sersic_index": 0.5,
        "bulge_axis_ratio": 1.0, "inclination": 0.0, "g1": 0.0, "g2": 0.0, "magnification": 1.0,
    }  # fmt: skip
    for name, value in known.items():
        getattr(some.shapes, name)[:] = value
    return one(some, 0)


def width(path, wavelength, gaussian, psf):
    """Return the FWHM (A) of a line along the dispersion.

    Images at many phases of a pixel together give a finely sampled profile.
    """
    first, count = int(path.first), int(path.last - path.first) + 1
    spectrum = np.zeros((1, count), np.float32)
    spectrum[0, int(wavelength) - first] = 1000.0
    x, y = path.offsets(0.0, 0.0, np.array([wavelength, wavelength + 1.0]))
    found = np.empty((SIDE, PHASES))
    for phase in range(PHASES):
        at = MIDDLE - float(x[0]) - phase / PHASES, MIDDLE - float(y[0])
        part = order(path, 1.0, first, count)
        frame = drawn(fine.placed(source(gaussian), *at), lambda _: spectrum, [part], psf, (SIDE, SIDE), 28.0, SETTINGS)
        found[:, phase] = frame.sum(axis=0)
    profile = found.ravel()
    peak, half = int(profile.argmax()), 0.5 * profile.max()
    left = np.interp(half, profile[: peak + 1], np.arange(peak + 1))
    right = peak + np.interp(-half, -profile[peak:], np.arange(len(profile) - peak))
    return (right - left) / PHASES / abs(float(np.hypot(*np.diff([x, y], axis=1)[:, 0])))


SETTINGS = draw.settings_for(SURVEY)


@nightly.parametrize(
    ("grism", "tilt"), [("RGS000", 0.0), pytest.param("RGS180", 4.0, marks=pytest.mark.nightly), ("BGS000", 0.0)], (0,)
)
def test_lines_are_resolved_as_required(grism, tilt):
    required = {record.key: record.value for record in read_all_parameters() if record.status == "REQ"}
    least = required[f"nisp.{grism.lower()}.resolving_power"]
    path = next(part for part in traces.traces(grism, tilt, DETECTOR, MISSION) if part.order == 1)
    psf = euclid.nisp_psf_at(DETECTOR, images.nodes(path.first, path.last, 3), MISSION, 1)
    waves = np.linspace(path.first + 100.0, path.last - 100.0, 4).round()
    found = [[wave / width(path, wave, gaussian, psf) for wave in waves] for gaussian in (True, False)]
    print(grism, np.round(found))
    assert np.min(found) > least
    # Powers are close to the published ones of the gratings (REQ 480 red, 400 blue in the middle).
    assert np.max(found) < 3.0 * least
