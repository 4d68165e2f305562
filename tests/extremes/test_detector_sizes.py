"""Detectors of 2 to 32,000 pixels a side, made by the jobs: all pixels are finite, and a star is the same on each."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.mission import camera_template
from lake_schema.store import publish, read
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import parse

RA, DEC, MAGNITUDE = 53.117, -27.808, 18.0
HEAD = """
accuracy = "draft"
[sources]
only = "table"
band = "des_r"
stars = "stars.csv"
[products]
truth = ["noise_free"]
[mission]
"""
POINTING = f"""
[[pointing]]
channel = "EXT"
camera = "NAME"
band = "des_r"
ra = {RA}
dec = {DEC}
centre_on = "chip"
exposure_time_s = 40.0
mjd = 60905.25
"""
USUAL = (300, 260)


def write_camera(folder, nx, ny):
    """Write a camera with DECam's values that has one detector with one amplifier."""
    camera_template.write_like("decam", folder)
    tables = {
        "layout": f"detector,type,nx,ny,x_mm,y_mm,rotation_deg\nchip,mini,{nx},{ny},0,0,0\n",
        "amplifiers": "type,amplifier,x,y,nx,ny,read_right,read_top,prescan,overscan,overscan_rows,gain,read_noise,"
        f"full_well\nmini,A,0,0,{nx},{ny},0,0,4,16,8,1.7,5.0,100000\n",
        "bands": "band,curve,medium,zero_point,sky_brightness,extinction,fringes\ndes_r,,,25.3,21.0,0.1,\n",
    }
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)


def rendered(folder, sizes):
    """Render a star in the middle of detectors of some sizes, each of its own camera.

    Returns the raw image, the noise-free image and its header by size.
    """
    cameras = {f"n{nx}x{ny}": (nx, ny) for nx, ny in sizes}
    for name, size in cameras.items():
        write_camera(folder / name, *size)
    # The star is in the middle, and the seeing is the same in all exposures.
    zero = {"pointing_error": "arcsec", "seeing_scatter": "dex"}
    overrides = [f'"ext.{name}.{key}" = {{ value = 0, unit = "{zero[key]}" }}\n' for name in cameras for key in zero]
    mission = f"cameras = {[*cameras]}\n".replace("'", '"') + "[mission.overrides]\n" + "".join(overrides)
    pointings = "".join(POINTING.replace("NAME", name) for name in cameras)
    (folder / "stars.csv").write_text(f"ra,dec,mag\n{RA},{DEC},{MAGNITUDE}\n")
    area = requests.FIELD.format(2.0)
    wanted, lake = parse(requests.written(folder, HEAD + mission + pointings, area, seed=3)), folder / "lake"
    lake.mkdir()
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    version = read.version(lake, "products")
    found = {}
    for row in version.rows().to_pylist():
        data, header = fits.getdata(version.sidecar_path(row["path"]), header=True)
        found[row["content"], cameras[header["INSTRUME"]]] = data, header
    return {size: (found["science", size][0], *found["noise_free", size]) for size in sizes}


def middle(frame):
    """Return the light of the four pixels in the middle of a frame."""
    y, x = (side // 2 for side in frame.shape)
    return frame[y - 1 : y + 1, x - 1 : x + 1].sum()


@pytest.mark.parametrize(
    "sizes",
    [
        [(2, 2)],
        pytest.param([(16, 16), (32_000, 16), (16, 32_000), (32_000, 2_000)], id="more", marks=pytest.mark.nightly),
    ],
)
def test_a_star_is_the_same_on_a_detector_of_any_size(tmp_path, sizes):
    images = rendered(tmp_path, [USUAL, *sizes])
    _, usual, _ = images.pop(USUAL)
    for (nx, ny), (raw, noise_free, header) in images.items():
        assert raw.shape == (ny + 8, nx + 4 + 16)
        assert raw.min() > 0
        assert noise_free.shape == (ny, nx)
        assert np.isfinite(noise_free).all()
        # The accuracy "draft" allows 5e-3 of the flux; 4e-4 were seen.
        assert middle(noise_free) == pytest.approx(middle(usual), rel=1e-3)
        assert noise_free.sum() <= usual.sum() * 1.001
        x, y = WCS(header).world_to_pixel_values(RA, DEC)
        assert [float(x), float(y)] == pytest.approx([(nx - 1) / 2, (ny - 1) / 2], abs=0.01)
