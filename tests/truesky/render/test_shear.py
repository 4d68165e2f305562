"""Response of measured shapes to shear, from noise-free 90-degree pairs with shear +-0.02."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks import _errors as errors
from benchmarks._scenes import LSST, VIS, Scene
from tests.truesky.render.fields import galaxies, psf_of
from truesky.render.drawing import reference
from truesky.render.drawing.settings import settings_for
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import DRAFT, SURVEY

BOUNDS = {"survey": (SURVEY, 1e-4, 1e-5), "draft": (DRAFT, 1e-3, 1e-3)}
# Half-light radius, arcsec, and Sersic index: a disc, a bulge in a disc, a steep bulge.
KINDS = {
    "disc": {"disk_half_light_radius": 0.3, "inclination": 55.0},
    "small disc": {"disk_half_light_radius": 0.1, "inclination": 20.0},
    "both": {"bulge_fraction": 0.3, "bulge_sersic_index": 2.6, "bulge_half_light_radius": 0.2, "inclination": 40.0},
    "bulge": {
        "bulge_fraction": 1.0, "bulge_sersic_index": 4.0, "bulge_half_light_radius": 0.3, "bulge_axis_ratio": 0.6,
    },
}  # fmt: skip


def galaxy(scene: Scene, kind: str, magnitude: float) -> Sources:
    electrons = scene.exposure * 10 ** (0.4 * (scene.zero_point - magnitude))
    middle = np.array([float(errors.COMPARED_SIDE)])
    form = galaxy_shapes.shapes(galaxies(0.0, 0.0, position_angle=31.0, **KINDS[kind]))
    jacobian = scene.scale * np.array([[[1.001, 0.002], [-0.003, 0.998]]])
    return Sources(np.array([1]), middle + 0.3, middle - 0.2, jacobian, np.array([electrons]), np.array([0]), form)


def psf_in(scene):
    return psf_of("vis" if scene is VIS else "lsstcam")


@cache
def truth(scene, kind, magnitude):
    one = galaxy(scene, kind, magnitude)
    found = errors.response(errors.make_drawer(psf_in(scene), scene, errors.FULL_SETTINGS), one, scene.scale)
    # The weight function of the moments halves the response to shear; there is no other bias.
    assert 0.2 < found[:2].min() <= found[:2].max() < 2.0
    return found


def biases(scene, kind, magnitude, settings) -> tuple[float, float]:
    draw = errors.make_drawer(psf_in(scene), scene, settings)
    return errors.bias(
        errors.response(draw, galaxy(scene, kind, magnitude), scene.scale), truth(scene, kind, magnitude)
    )


def some_more(*cases):
    """The faintest small galaxies always, the others nightly."""
    for kind in KINDS:
        for magnitude in (20.0, 22.0, 24.5):
            yield pytest.param(kind, magnitude, marks=() if (kind, magnitude) in cases else pytest.mark.nightly)


@pytest.mark.parametrize("tier", BOUNDS)
@pytest.mark.parametrize(("kind", "magnitude"), tuple(some_more(("small disc", 24.5))))
def test_response_to_shear(tier, kind, magnitude):
    accuracy, most_m, most_c = BOUNDS[tier]
    m, c = biases(VIS, kind, magnitude, settings_for(accuracy))
    assert abs(m) <= most_m
    assert abs(c) <= most_c


@pytest.mark.nightly
@pytest.mark.parametrize("tier", BOUNDS)
@pytest.mark.parametrize("scene", [VIS, LSST], ids=lambda scene: scene.name)
def test_response_of_many_galaxies_with_separate_psfs(scene, tier):
    accuracy, most_m, most_c = BOUNDS[tier]
    found, some = errors.shear_response(scene, {tier: settings_for(accuracy)}, 92, 24)
    kinds = errors.worst_by_group(found[tier], some, scene)
    for kind, (_, m, c) in kinds.items():
        assert (m <= most_m, c <= most_c) == (True, True), (kind, m, c)


def test_small_stamps_bias_the_response():
    """Test the measurement itself: stamps of half the size bias the response."""
    small = replace(settings_for(DRAFT), edge=1.0, aliased=1.0, min_size_arcsec=1.6)
    assert abs(biases(VIS, "bulge", 20.0, small)[0]) > 1e-3


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["disc", "both"])
def test_galsim_has_the_same_response(kind):
    """Test the reference itself with images drawn by GalSim."""

    def by_galsim(one):
        return reference.draw_reference(one, 0, psf_in(VIS), 2 * errors.COMPARED_SIDE)

    found = errors.response(by_galsim, galaxy(VIS, kind, 20.0), VIS.scale)
    m, c = errors.bias(found, truth(VIS, kind, 20.0))
    assert abs(m) <= 1e-5
    assert abs(c) <= 1e-6
