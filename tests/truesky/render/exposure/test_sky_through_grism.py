"""The sky through a grism: light of other orders, and none from beyond the field stop."""

from dataclasses import replace

import numpy as np
import pytest

from tests.truesky import nightly
from tests.truesky.render import fields, spectroscopic
from tests.truesky.render.infrared import SEED
from tests.truesky.render.spectroscopic import MISSION
from truesky.render.camera.detectors import detector
from truesky.render.channels.aim import Aim
from truesky.render.effects.light import dispersed_sky
from truesky.render.exposure import scene_factory, sky_through_grism
from truesky.render.exposure.records import Variant
from truesky.render.sky import diffuse_light
from truesky.request.accuracy import SURVEY


def seen(name, mission=MISSION, **columns):
    """(scene, aim, what orders change)."""
    own = detector("nisp", name, mission)
    aim = Aim.from_exposure(fields.exposure(**spectroscopic.exposed(own, **columns)), own)
    scene = scene_factory.from_aim(aim, Variant(mission, SURVEY, {}))
    return scene, aim, sky_through_grism.sky_change(scene, aim, SEED)


def exact(scene, aim, column, row):
    """The same at one pixel, angstrom by angstrom."""
    band, own = aim.band, aim.detector
    zodi = diffuse_light.photons("nisp", scene.sky_rate, band, MISSION) - diffuse_light.thermal_photons(
        "nisp", band, MISSION
    )
    total = -zodi.sum()
    for trace in aim.channel.dispersion.traces(aim.exposure, own, MISSION, SEED):
        light = zodi * aim.channel.dispersion.throughput(aim.exposure, trace.order, band.wavelength, own, MISSION)
        x, y = trace.offsets(column, row, band.wavelength)
        sign = -1.0 if own.upside_down else 1.0
        across = own.x + sign * 0.3 * (column - x - 1019.5)
        up = own.y + sign * 0.3 * (row - y - 1019.5)
        light *= aim.channel.dispersion.vignetting(aim.exposure, own, column - x, row - y, MISSION)
        total += light[(np.abs(across) <= 0.395 * 3600) & (np.abs(up) <= 0.58 * 3600)].sum()
    return total * scene.exposure_time_s


@nightly.parametrize(("name", "angle"), [("DET22", 0.0), ("DET14", 0.0), ("DET41", 0.0), ("DET14", -4.0)], (0, 3))
def test_it_is_the_sum_over_orders_of_what_the_field_stop_lets_through(name, angle):
    """Wavelength steps of 100 A have an error of 2 % of the second order's light."""
    scene, aim, found = seen(name, angle=angle)
    for i, j in ((0, 0), (0, -1), (16, 16), (-1, 0), (-1, -1)):
        column, row = (np.linspace(0.0, 2039.0, n)[k] for n, k in ((found.shape[1], j), (found.shape[0], i)))
        assert found[i, j] == pytest.approx(exact(scene, aim, column, row), abs=0.002 * scene.sky_electrons)


def test_in_the_middle_other_orders_add_a_few_percent_and_at_the_edge_they_are_gone():
    _, _, middle = seen("DET22")
    scene, _, edge = seen("DET14")
    assert 0.03 < middle.max() / scene.sky_electrons < 0.08
    assert edge.min() < middle.max() - 0.01 * scene.sky_electrons


@nightly.parametrize("name", ["DET14", "DET44", "DET11", "DET41"], (0, 2))
def test_a_turned_grism_vignettes_the_sky_as_sources(name):
    """A corner detector receives less sky than with the grism straight, by the fraction by which sources are dimmed."""
    (scene, _, straight), (_, turned, tilted) = seen(name), seen(name, angle=-4.0)
    x, y = np.meshgrid(*(np.linspace(0.0, 2039.0, n) for n in straight.shape[::-1]))
    left = turned.channel.dispersion.vignetting(turned.exposure, turned.detector, x.ravel(), y.ravel(), MISSION)
    lost = (straight - tilted).mean() / scene.sky_electrons
    assert lost == pytest.approx(1.0 - left.mean(), abs=0.02)


def test_the_noise_of_a_pixel_is_of_all_orders():
    scene, aim, added = seen("DET22")
    more = sky_through_grism.with_sky_change(scene, aim, SEED).pixel_noise ** 2 - scene.pixel_noise**2
    assert more == pytest.approx(added.mean())
    # Pixels differ in area, too.
    found = spectroscopic.rendered(truth=("sky",), forced={"pixel_area": False})
    assert found.scene.pixel_noise**2 == pytest.approx(
        found.maps["sky"].mean() + found.scene.dark_electrons + found.scene.reading_noise**2, rel=2e-3
    )


def test_no_sky_and_no_grism_change_nothing():
    assert seen("DET22", sky=0.0)[2] is None
    assert seen("DET22", kind="dark")[2] is None
    _, aim, _ = seen("DET22")
    image = replace(aim.exposure, channel="NISP-P", band="euclid_h")
    other = Aim.from_exposure(image, aim.detector)
    assert (
        sky_through_grism.sky_change(scene_factory.from_aim(other, Variant(MISSION, SURVEY, {})), other, SEED) is None
    )


def test_it_is_in_the_image_and_in_the_truth_of_the_sky():
    found = spectroscopic.rendered(truth=("sky",))
    added = found.maps["sky"].mean() / found.scene.sky_electrons
    assert {d.name: d.applied for d in found.decisions}["dispersed_sky"]
    assert 1.03 < added < 1.08


def test_between_the_nodes_it_is_linear():
    nodes = np.array([[0.0, 2.0], [4.0, 6.0]])
    found = dispersed_sky.apply(np.ones((5, 3)), nodes)
    np.testing.assert_allclose(found[0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found[:, 0], [1.0, 2.0, 3.0, 4.0, 5.0])
