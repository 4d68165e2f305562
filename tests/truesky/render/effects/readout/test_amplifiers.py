"""Amplifiers with different parameters: each acts as if the whole detector had its parameters."""

import numpy as np
import pytest
from astropy.io import fits as astropy_fits

from lake_schema.errors import BadInput
from lake_schema.mission import detector_overrides
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render import nominal
from tests.truesky.render.fields import MISSION, small
from truesky.render.camera import detectors
from truesky.render.effects.readout import adc, bias_structure, nonlinearity, quadrants, read_noise
from truesky.render.effects.scene import Scene
from truesky.render.products import fits_files, headers, read_back

FRAME = np.random.default_rng(1).uniform(0.0, 1e5, (4, 30, 40))
GAIN = "electron / adu"
UNITS = {"gain": GAIN, "bias": "adu", "read_noise": "electron", "bias_offset": "adu", "nonlinearity.high": ""}
VALUES = ("vis.gain", "vis.read_noise", "vis.bias", "vis.full_well")
OWN = {
    "vis.gain.E": (3.0, GAIN), "vis.gain@3-4.H": (4.0, GAIN), "vis.bias.F": (700.0, "adu"),
    "vis.read_noise.G": (40.0, "electron"), "vis.dark_current@3-4": (0.05, "electron / (s pix)"),
    "vis.gain@1-1": (9.0, GAIN),
}  # fmt: skip


@pytest.mark.parametrize(
    ("apply", "numbers"),
    [
        (adc.apply, (np.array([1.0, 2.0, 3.0, 4.0]), 1000.0, np.array([6e4, 2e4, 6e4, 3e4]))),
        (nonlinearity.apply, (0.05, np.array([2e5, 1e5, 3e5, 2e5]), np.array([0.01, 0.0, 0.02, 0.1]), 2000.0)),
        (read_noise.apply, (np.array([1.0, 0.0, 5.0, 20.0]),)),
        (bias_structure.apply, (np.array([10.0, 0.0, 1.0, 2.0]), -3.0, np.array([40.0, 1.0, 2.0, 3.0]), 0.3)),
    ],
)
def test_each_amplifier_is_as_if_all_were_like_it(apply, numbers):
    found = apply(FRAME, *numbers, rng=np.random.default_rng(7))
    for q in range(4):
        own = [float(number[q]) if np.ndim(number) else number for number in numbers]
        np.testing.assert_array_equal(found[q], apply(FRAME, *own, rng=np.random.default_rng(7))[q])
    with pytest.raises((BadInput, ValueError)):
        apply(FRAME[:3], *numbers, rng=np.random.default_rng(7))


def test_the_inverse_of_the_response_is_by_amplifier_too():
    curve = (0.05, np.array([2e5, 1e5, 3e5, 2e5]), 0.01, np.array([2e3, 1e3, 2e3, 5e3]))
    np.testing.assert_allclose(nonlinearity.linearise(nonlinearity.apply(FRAME, *curve), *curve), FRAME, rtol=1e-9)


def test_the_camera_and_the_mission_name_the_same_places():
    assert detector_overrides.amplifiers("vis", MISSION) == tuple(quadrants.NAMES)
    for camera in ("vis", "nisp", *CAMERAS):
        section = detectors.detectors(camera, MISSION)[0].section
        assert detector_overrides.detectors(section, MISSION) == tuple(
            d.name for d in detectors.detectors(camera, MISSION)
        )


def test_a_scene_without_values_of_its_own_has_numbers():
    alike = resolve(overrides={key: (MISSION.value(key), MISSION.parameter(key).unit) for key in VALUES})
    scene = Scene(alike, "vis", 560.0, 0.25, 1e4, small("vis", "3-4"))
    for key, unit in UNITS.items():
        assert scene.amplifier_values(key, unit) == scene.value(key, unit)
        assert type(scene.amplifier_values(key, unit)) is float
    one = Scene(alike.with_overrides(OWN), "vis", 560.0, 0.25, 1e4, small("vis", "3-4"))
    np.testing.assert_array_equal(one.amplifier_values("gain", GAIN), [4.0, 3.48, 3.48, 3.0])
    assert one.dark_rate / scene.dark_rate == pytest.approx(0.05 / MISSION.value("vis.dark_current"))
    # The quietest amplifier tells what is noticed.
    assert one.pixel_noise == pytest.approx(np.sqrt(560 * 0.25 + one.dark_electrons + 4.4**2))
    assert Scene(one.mission, "vis", 560.0, 0.25, 1e4, small("vis", "1-1")).amplifier_values("gain", GAIN) == 9.0


def test_a_frame_is_read_with_them_and_says_so(tmp_path):
    """A bias in which every amplifier has its own level, noise and gain; its file, and the file's electrons."""
    alike = resolve(overrides={key: (MISSION.value(key), MISSION.parameter(key).unit) for key in VALUES})
    mission, detector = alike.with_overrides(OWN), small("vis", "3-4", 256)
    forced = nominal.off(*nominal.COSMIC_RAYS, "bias_structure", "bias_drift", "row_noise")
    quiet = {"sky": 0.0, "seconds": 0.0, "kind": "bias", "forced": forced}
    usual = nominal.rendered(detector, [], [], [], mission=alike, **quiet)
    one = nominal.rendered(detector, [], [], [], mission=mission, **quiet)
    gain, bias, noise = (4.0, 3.48, 3.48, 3.0), (1000.0, 1000.0, 700.0, 1000.0), (4.4, 40.0, 4.4, 4.4)
    for q in range(4):
        assert one.raw[q].mean() == pytest.approx(bias[q], abs=0.5)
        assert gain[q] * one.raw[q].std() == pytest.approx(np.hypot(noise[q], gain[q] / np.sqrt(12)), rel=0.02)
    assert headers.amplifier_cards(usual, 0) == ()
    rows, writers = fits_files.products(one, ())
    writers[rows["path"][0].as_py()](tmp_path / "own.fits")
    with astropy_fits.open(tmp_path / "own.fits") as units:
        assert not {"GAIN", "RDNOISE", "BIAS", "SATURATE"} & set(units[0].header)
        for q, name in enumerate("HGFE"):
            unit = units[f"3-4.{name}"]
            assert [unit.header[key] for key in ("GAIN", "BIAS", "RDNOISE")] == [gain[q], bias[q], noise[q]]
            assert unit.header["SATURATE"] == pytest.approx(min(2e5 / gain[q] + bias[q], 65535), rel=0.08)
        assert units[0].header["MISSION"] == mission.fingerprint != MISSION.fingerprint
    electrons = read_back.electrons(tmp_path / "own.fits").data
    for q, part in enumerate((electrons[128:, :128], electrons[128:, 128:], electrons[:128, 128:])):
        assert part.std() == pytest.approx(np.hypot(noise[q], gain[q] / np.sqrt(12)), rel=0.03)
