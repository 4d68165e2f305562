"""Masks of one bright star, against the light that the renderer puts into the pixels of a detector."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.mission.configuration import resolve
from lake_schema.tables.survey.depth import BRIGHT_STAR, ORDER, SATURATED, SPIKE
from tests.truesky.render import fields
from truesky.fluxes import passbands
from truesky.render.camera import astrometry
from truesky.request.accuracy import SURVEY
from truesky.survey_maps import star_masks
from truesky.survey_maps.pixel_overlap import PixelGrid, side_normals
from truesky.survey_maps.planned_footprints import VALUES, Footprints
from truesky.survey_maps.star_places import MaskExposures, Stars

# Magnitude of the star, and its position, the middle of a cell of order 7 (deg).
MAGNITUDE = 12.0
RA, DEC = (float(axis) for axis in sky.cell_centre(7, int(sky.cell_at([30.0], [-10.0], 7)[0])))
# Columns of the exposures by camera: detector, exposure and effective area of the PSF (arcsec^2).
CASES = {
    "lsstcam": (
        "R22_S11", 3.0,
        {"channel": "EXT", "band": "lsst_r", "exposure_time_s": 30.0, "sky": 33.0, "seeing": 0.8, "zero_point": 28.36},
    ),
    "vis": (
        "3-4", 0.13,
        {"channel": "VIS", "band": "euclid_vis", "exposure_time_s": 560.5, "sky": 0.3, "seeing": 0.0,
         "zero_point": 25.9},
    ),
}  # fmt: skip
# Rows of the table `exposures` that the cases do not give.
POINTING = {"ra": RA, "dec": DEC, "position_angle": 20.0, "zenith": 30.0, "airmass": 1.2}


def rendered_star(camera, side):
    """Render the star in the middle of a square detector; return the image, its pixels on the sky and the mask."""
    name, area, columns = CASES[camera]
    mission = resolve()
    own = {"camera": camera, **POINTING, **columns}
    detector = fields.small(camera, name, side)
    system = astrometry.wcs(detector, RA, DEC, own["position_angle"])
    middle = [0.5 * (side - 1)]
    ra, dec = astrometry.sky_of_pixel(system, middle, middle)
    body, points = fields.galaxies([], []), fields.stars(ra, dec)
    f_nu = 10.0 ** (-0.4 * (MAGNITUDE - 23.9))
    tables = body, fields.fluxes(body, own["band"], []), points, fields.fluxes(points, own["band"], f_nu)
    quiet = {"cosmic_rays": False, "hot_pixels": False}
    one = fields.rendered(own, detector, tables, mission, SURVEY, forced=quiet, truth=("noise_free", "saturation"))
    exposure = fields.exposure(**own)
    corners = np.stack(astrometry.sky_of_pixel(system, [0, side, side, 0], [0, 0, side, side]), axis=-1)[None]
    footprints = Footprints(
        np.array([own["band"]], object), np.array([camera], object), np.array([exposure.exposure_id]),
        np.array([name], object), sky.unit_vectors(ra, dec), np.array([0.01]), side_normals(corners),
        np.ones((1, len(VALUES))), np.full(1, None),
    )  # fmt: skip
    seen_by = MaskExposures([exposure], passbands.load(own["band"]), mission, area, footprints)
    grid = PixelGrid.from_cell(7, int(sky.cell_at(ra, dec, 7)[0]), ORDER)
    bits = star_masks.predict(Stars(ra, dec, np.array([MAGNITUDE])), seen_by, grid)
    y, x = np.mgrid[:side, :side]
    pixel = sky.cell_at(*astrometry.sky_of_pixel(system, x.ravel(), y.ravel()), ORDER) - grid.first_pixel
    return one, pixel.reshape(side, side), bits


@pytest.mark.nightly
@pytest.mark.parametrize("camera", [*CASES])
def test_light_of_a_bright_star_is_masked(camera):
    """Bits cover 99 % of the detector's pixels with 5 sigma of the star's light and all full ones, most as trails.

    The mask is not too large: in 65 % of its pixels on the map, the sum of the star's light exceeds 5 sigma.
    """
    one, pixel, bits = rendered_star(camera, 1200)
    masked = bits[pixel] & (BRIGHT_STAR | SPIKE | SATURATED) > 0
    light, noise = one.noise_free - np.median(one.noise_free[~masked]), one.scene.pixel_noise
    full = one.maps["saturation"] > 0
    assert full.sum() > 100
    assert masked[full].all()
    assert (bits[pixel[full]] & SPIKE > 0).mean() > 0.95
    assert masked[light > 5.0 * noise].mean() > 0.99
    of_map = np.unique(pixel[masked])
    sums, counts = (np.bincount(pixel.ravel(), weights, len(bits))[of_map] for weights in (light.ravel(), None))
    signal_to_noise = sums / (noise * np.sqrt(counts))
    assert (signal_to_noise > 5.0).mean() > 0.65
