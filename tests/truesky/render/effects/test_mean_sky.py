"""SKYRATE of the header is the mean of the sky that is drawn, in all channels: the truth map `sky` shows it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.truesky.render import fields, infrared, nominal, spectroscopic
from tests.truesky.render.fields import MISSION, small
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.channels.aim import Aim
from truesky.render.effects.light import dispersed_sky, mean_sky, straylight
from truesky.render.effects.scene import Lights
from truesky.render.exposure import scene_factory, sky_through_grism
from truesky.render.exposure.records import Variant
from truesky.render.products import headers
from truesky.request.accuracy import SURVEY

# Agreement of SKYRATE with the mean of the map that is required of all channels.
TOLERANCE = 3e-3
SECONDS = 200.0


def of_camera(channel, camera, name, band, sky=30.0, magnitude=None, side=192, **columns):
    """Render part of a detector with a star of a magnitude beside it, or without sources."""
    detector = small(camera, name, side)
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 12.0)
    exposed = {
        "channel": channel, "camera": camera, "band": band, "exposure_time_s": SECONDS, "sky": sky, "ra": ra,
        "dec": dec, "position_angle": angle, "seeing": 0.7 * (channel == "EXT"), **columns,
    }  # fmt: skip
    system = Aim.from_exposure(fields.exposure(**exposed), detector).wcs
    where = astrometry.sky_of_pixel(system, *np.full((2, 0 if magnitude is None else 1), 1.2 * side))
    bodies, points = fields.galaxies([], []), fields.stars(*where)
    f_nu = [] if magnitude is None else [10.0 ** (-0.4 * (magnitude - 23.9))]
    tables = bodies, fields.fluxes(bodies, band, []), points, fields.fluxes(points, band, f_nu)
    forced = nominal.off(*nominal.COSMIC_RAYS)
    return fields.rendered(exposed, detector, tables, MISSION, SURVEY, forced=forced, truth=("sky",))


def of_spectra(name="DET22", nx=640, ny=96, sky=1.09, **columns):
    detector = replace(detectors.detector("nisp", name, spectroscopic.MISSION), nx=nx, ny=ny)
    return spectroscopic.rendered(
        detector=detector, forced=spectroscopic.QUIET, truth=("sky",), sky=sky, seconds=spectroscopic.TIME, **columns
    )


CASES = {
    "VIS": lambda: of_camera("VIS", "vis", "3-4", "euclid_vis", 0.24),
    "VIS at the edge": lambda: of_camera("VIS", "vis", "1-1", "euclid_vis", 0.24),
    "VIS with a bright star": lambda: of_camera("VIS", "vis", "6-6", "euclid_vis", 0.24, 4.0),
    "NISP-P": lambda: infrared.rendered(detector=small("nisp", "DET44", 192), truth=("sky",)),
    "NISP-P with a bright star": lambda: infrared.rendered(
        [5.0], [230.0], [100.0], detector=small("nisp", "DET11", 192), truth=("sky",)
    ),
    "NISP-S": of_spectra,
    "NISP-S, tilted, at the edge": lambda: of_spectra("DET41", grism="RGS180", angle=184.0),
    "NISP-S, blue": lambda: of_spectra("DET14", grism="BGS000", band="nisp_blue"),
    "LSSTCam": lambda: of_camera("EXT", "lsstcam", "R01_S00", "lsst_r"),
    "LSSTCam in twilight": lambda: of_camera(
        "EXT", "lsstcam", "R34_S21", "lsst_r", sky_slope_x=0.2, sky_slope_y=-0.1
    ),
    "DECam": lambda: of_camera("EXT", "decam", detectors.detectors("decam", MISSION)[0].name, "des_z"),
    "HSC": lambda: of_camera("EXT", "hsc", detectors.detectors("hsc", MISSION)[0].name, "hsc_z", side=512),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_skyrate_is_the_mean_of_what_is_drawn(case):
    one = CASES[case]()
    header = {keyword: value for keyword, value, _ in headers.science_cards(one)}
    sky = np.asarray(one.maps["sky"], float)
    read = np.ones(sky.shape, bool)
    read[slice(*one.scene.unread_rows)] = False
    if one.scene.layout is not None:
        read[one.scene.layout.unread_pixels] = False
    assert header["SKYRATE"] * header["EXPTIME"] / sky[read].mean() == pytest.approx(1.0, abs=TOLERANCE)


def test_the_orders_of_a_grism_add_sky():
    """An audit found the first order to have 0.946 of the light of the sky, from the truth map of a whole detector."""
    detector = detectors.detector("nisp", "DET22", spectroscopic.MISSION)
    aim = Aim.from_exposure(fields.exposure(**spectroscopic.exposed(detector)), detector)
    scene = scene_factory.from_aim(aim, Variant(spectroscopic.MISSION, SURVEY, {}))
    scene = sky_through_grism.with_sky_change(scene, aim, infrared.SEED)
    drawn = mean_sky.mean_electrons(scene, {"background", "dispersed_sky", "pixel_area"})
    assert scene.sky_electrons / drawn == pytest.approx(0.946, abs=0.003)


def test_there_is_no_sky_without_light():
    one = fields.rendered(
        {"channel": "VIS", "camera": "vis", "band": "euclid_vis", "image_type": "bias", "exposure_time_s": 0.0},
        small("vis", "3-4", 64), (fields.galaxies([], []), fields.fluxes(fields.galaxies([], []), "euclid_vis", []),
        fields.stars([], []), fields.fluxes(fields.stars([], []), "euclid_vis", [])), MISSION, SURVEY,
    )  # fmt: skip
    assert dict((card[0], card[1]) for card in headers.science_cards(one))["SKYRATE"] == 0.0


@pytest.mark.parametrize("shape", [(97, 150), (64, 2), (300, 41)])
def test_means_are_those_of_frames(shape):
    """The mean of a grid between its nodes is that of the frame on which the effect draws it."""
    nodes = np.random.default_rng(3).normal(size=(4, 3))
    frame = dispersed_sky.apply(np.zeros(shape), nodes)
    places = (np.linspace(0.0, count - 1.0, n) for count, n in zip(nodes.shape, shape, strict=True))
    assert mean_sky.mean_between_nodes(nodes, *places) == pytest.approx(frame.mean(), rel=1e-10)
    lights = Lights(np.array([20.0, 130.0]), np.array([-10.0, 70.0]), np.array([1e8, 2e7]))
    halo = straylight.apply(np.zeros(shape), lights, 0.01, 160.0)
    grid, step = straylight.halo_nodes(shape, lights, 0.01, 160.0)
    assert step == 10
    found = mean_sky.mean_between_nodes(grid, np.arange(shape[0]) / step, np.arange(shape[1]) / step)
    assert found == pytest.approx(halo.mean(), rel=1e-10)
