"""Make a lake with calibration frames and dithers of a small detector by the jobs."""

import tomllib

from lake_schema.store import publish
from tests import requests
from tests.truesky.render.test_render_exposures_calibration import BLOCK, MODULES, small_detectors
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import from_table

RAYS_OFF = ["cosmic_rays", "readout_cosmic_rays"]


def request(
    bias=8, dark=4, flat=2, off=(), truth=("noise_free", "sky"), overrides=None, depth=(19.0, 19.0), dither="S"
):
    """Return a request with a visit of a field in four dithers, or other dithers, and calibration frames.

    `flat` flats are taken of each of the six lamps.
    """
    blocks = [{**BLOCK, "fields": 1, "dither": dither, "short": False, "flat": False}]
    for kind, count in (("bias", bias), ("dark", dark), ("flat", flat)):
        blocks += [{**BLOCK, "image_type": kind, "exposures": count}] if count else []
        if kind == "dark" and count:
            blocks[-1]["exposure_time_s"] = 1000.0
    # Halos about the field need not be drawn for a few sources that are not lensed.
    universe = requests.shallow(*depth, "lensing = { g1 = 0.0, g2 = 0.0 }\n")
    keys = f'accuracy = "draft"\n{universe}[fluxes]\nbands = ["euclid_vis"]\n'
    table = tomllib.loads(requests.text(keys, requests.FIELD.format(0.2), seed=7))
    mission = {"mission": {"overrides": overrides}} if overrides else {}
    products = {"products": {"truth": list(truth)}, "effects": {"off": list(off)}}
    return from_table({**table, **mission, **products, "observation": blocks})


def make(lake, wanted, side, name=None):
    """Run all jobs of a request for detectors of side x side pixels; `name` is the request's name or None."""
    with small_detectors(side):
        for job in MODULES:
            for step in job.steps(lake, wanted):
                publish.make_version(lake, step.plan, step.run_task, name=name)


__all__ = ["RAYS_OFF", "make", "plan_exposures", "render_exposures", "request"]
