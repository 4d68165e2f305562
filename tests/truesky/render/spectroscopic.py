"""Nominal spectra on part of a NISP detector with given sources."""

from dataclasses import replace
from functools import cache

from lake_schema.mission.configuration import resolve
from tests.truesky.render import infrared
from truesky.render.camera import detectors

# Without moving bodies.
MISSION = resolve(overrides={"env.solar_system.density": (0.0, "deg-2")})
TIME = 14 * 27 * MISSION.value("nisp.frame_time", "s")
QUIET = dict.fromkeys(("ramp_cosmic_rays", "drift", "group_noise", "output_gain", "dark_map", "pixel_response"), False)


@cache
def strip(name="DET22", nx=640, ny=96):
    """Return a detector cut to nx x ny pixels about its centre; a first order is 512 pixels long."""
    return replace(detectors.detector("nisp", name, MISSION), nx=nx, ny=ny)


def exposed(detector, grism="RGS000", angle=0.0, **columns):
    """Return columns of an exposure with the red grisms."""
    usual = {"channel": "NISP-S", "band": "nisp_red", "seconds": TIME, "mission": MISSION}
    return infrared.exposed(detector, **{**usual, **columns}, grism=grism, grism_angle=angle)


def rendered(mags=(), x=(), y=(), detector=None, grism="RGS000", angle=0.0, **options):
    """Render a strip with stars (or galaxies `body`) of AB magnitudes in the band at undispersed positions x, y."""
    usual = {"channel": "NISP-S", "band": "nisp_red", "seconds": TIME, "mission": MISSION}
    return infrared.rendered(mags, x, y, detector or strip(), **{**usual, **options}, grism=grism, grism_angle=angle)
