"""Small plans of exposures in a lake, and the depth maps made from them."""

import pytest

from lake_schema.store import publish, read
from truesky.render import plan_exposures
from truesky.render.camera import detectors
from truesky.request.from_toml import from_table
from truesky.survey_maps import build_depth, psf_sizes

# Effective area (arcsec^2) and FWHM (arcsec) of the PSF of all detectors in space, whose PSFs take seconds to compute.
SIZES = (0.13, 0.16)

RA, DEC = 53.117, -27.808


def pointing(channel, camera, band, detectors, **keys):
    """Return the TOML table of a pointing whose first detector is at (RA, DEC)."""
    target = {"ra": RA, "dec": DEC, "centre_on": detectors[0], "position_angle": 0.0, "mjd": 60905.0}
    return {"channel": channel, "camera": camera, "band": band, "detectors": list(detectors), **target, **keys}


POINTINGS = (
    pointing("VIS", "vis", "euclid_vis", ["3-4", "3-5"]),
    pointing("VIS", "vis", "euclid_vis", ["3-4", "3-5"], dec=DEC + 0.03, mjd=60905.05),
    pointing("NISP-P", "nisp", "euclid_j", ["DET22"]),
    pointing("EXT", "lsstcam", "lsst_r", ["R22_S11"], mjd=60905.25),
)


def request(pointings=POINTINGS, name="x", **keys):
    """Return a request with pointings; `keys` are further sections."""
    area = {"cone": {"ra": RA, "dec": DEC, "radius": 1.0}}
    return from_table({"name": name, "seed": 3, "area": area, "pointing": list(pointings), **keys})


def make(lake, wanted, job=plan_exposures):
    """Make the tables of a job in a lake, in this process."""
    for step in job.steps(lake, wanted):
        publish.make_version(lake, step.plan, step.run_task, name=wanted.name)


def depth(lake, wanted):
    """Make the table `depth` of a request, with the PSF `SIZES` in space, and return its version."""
    make(lake, wanted)

    def in_field(exposure, band, mission, seed):
        return {detector.name: SIZES for detector in detectors.detectors(exposure.camera, mission)}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(psf_sizes, "in_field", in_field)
        make(lake, wanted, build_depth)
    return read.version(lake, "depth", request=wanted.name)
