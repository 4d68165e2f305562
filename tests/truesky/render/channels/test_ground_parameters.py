"""Planning or rendering uses every parameter of a ground camera."""

from fnmatch import fnmatchcase
from types import SimpleNamespace

import pytest

from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.mission.parameter import CAMERAS
from tests.truesky.render import fields
from truesky.fluxes import passbands
from truesky.render.camera import bands, detectors
from truesky.render.channels import ground
from truesky.render.effects.readout import crosstalk
from truesky.render.effects.scene import Scene
from truesky.render.exposure import board_neighbours
from truesky.render.planning import calibration_frames, ground_surveys, planned_exposures
from truesky.render.products import raw_pointing
from truesky.render.sky import diffuse_light, opsim
from truesky.request.area import Area
from truesky.request.exposures.observations import Observation

# Parameters that rendering does not use: zero points are checked with them.
WAITING = ("*.collecting_area", "*.throughput")


def seen(method, found):
    """Wrap a method so that it adds the requested key to the set `found`."""

    def see(self, key):
        found.add(key)
        return method(self, key)

    return see


def asked(camera, mission, monkeypatch):
    """Return the keys that planning and rendering request for a camera in all its bands."""
    found = set()
    for name in ("parameter", "model"):
        monkeypatch.setattr(MissionConfiguration, name, seen(getattr(MissionConfiguration, name), found))
    for band in bands.ground_bands(camera, mission):
        exposed = {"channel": "EXT", "camera": camera, "band": band, "seeing": 0.8}
        planned_exposures._Band.from_exposure(SimpleNamespace(**exposed), mission, None)
        planned_exposures.exposure_time("EXT", camera, band, mission)
        one = detectors.detectors(camera, mission)[0]
        shown = fields.exposure(**exposed, airmass=1.3, zenith=20.0)
        for profile in (1.0, 2.0):
            own = mission.with_overrides({f"ext.{camera}.psf.profile": (profile, "")})
            ground.CHANNEL.psf(shown, one, passbands.load(band), own, 1)
        zero_point = planned_exposures.zero_point_of(one.section, band, mission)
        assert diffuse_light.brightness_of_rate(10.0, one, band, zero_point, mission) > 15.0
    assert ground_surveys.earliest_date(camera, mission) >= 60126.0
    assert opsim.position_angle((10.0, None), 0.0, 60.0, one.section, mission) == 10.0
    if f"{one.section}.rotator.limit" in mission:
        assert opsim.position_angle((None, 10.0), 120.0, 60.0, one.section, mission) == 20.0
    raw_pointing.commanded_pointing(shown, one, mission, 1)
    surveys = [row["survey"] for row in mission.rows("survey.external") if row["camera"] == camera]
    block = Observation(("EXT",), survey=surveys[0], exposures=1)
    assert [*ground_surveys.exposures(block, Area(ra=60.0, dec=0.0, radius=1.0), mission, 1, 60500.0)]
    flat = Observation(("EXT",), "flat", surveys[0], exposures=1)
    assert [*calibration_frames.exposures(flat, camera, (60.0, 0.0), mission, 1, 60500.0)]
    board_neighbours.other_detectors(camera, one.name, mission)
    crossed = mission.with_overrides({"survey.satellites.rate": (0.1, "1 / (deg s)")})
    # A request that sets the crosstalk replaces the coefficients that were measured for each pair of amplifiers.
    coupled = mission.with_overrides({f"ext.{camera}.crosstalk": (2e-4, "")})
    crosstalk.coefficients(Scene(coupled, one.section, 90.0, 10.0, 1e6, one))
    every = {effect.name: effect for effects in ground.EFFECTS.values() for effect in effects}
    for band in bands.ground_bands(camera, mission):
        scene = Scene(crossed, one.section, 90.0, 10.0, 1e6, one, band=passbands.load(band))
        for effect in every.values():
            effect.parameters(scene)
            effect.contribution(scene)
    return found


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_parameter_is_asked_for(camera, monkeypatch):
    mission = resolve()
    keys = {record.key for record in (*mission.parameters, *mission.models) if record.key.startswith(f"ext.{camera}.")}
    unasked = keys - asked(camera, mission, monkeypatch)
    assert {key for key in unasked if not any(fnmatchcase(key, pattern) for pattern in WAITING)} == set()
