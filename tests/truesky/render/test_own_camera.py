"""A ground camera from a user's folder is planned and rendered like those of the mission database."""

import shutil

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.errors import BadInput
from lake_schema.mission import camera_template
from lake_schema.mission.published import read_back
from lake_schema.store import publish, read
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.products import read_back as products
from truesky.request.from_toml import parse

RA, DEC, MAGNITUDE = 53.117, -27.808, 17.0
GAIN, ZERO_POINT, SECONDS = 1.7, 25.3, 40.0
# Two detectors of 300 x 260 pixels, side by side, each with two amplifiers.
LAYOUT = """detector,type,nx,ny,x_mm,y_mm,rotation_deg
left,mini,300,260,-2.5,0,0
right,mini,300,260,2.5,0,180
"""
AMPLIFIERS = """type,amplifier,x,y,nx,ny,read_right,read_top,prescan,overscan,overscan_rows,gain,read_noise,full_well
mini,A,0,0,150,260,0,0,4,16,8,1.7,5.0,100000
mini,B,150,0,150,260,1,0,4,16,8,1.7,5.0,100000
"""
BANDS = f"""band,curve,medium,zero_point,sky_brightness,extinction,fringes
narrow,narrow.dat,air,{ZERO_POINT},21.0,0.1,
sdss_r,,,26.0,21.0,0.1,
"""
REQUEST = f"""
accuracy = "draft"
[sources]
only = "table"
band = "lsst_r"
stars = "stars.csv"
[mission]
cameras = ["mini"]
[mission.overrides]
"ext.mini.pointing_error" = {{ value = 0, unit = "arcsec" }}
[[pointing]]
channel = "EXT"
camera = "mini"
band = "narrow"
ra = {RA}
dec = {DEC}
centre_on = "right"
exposure_time_s = {SECONDS}
mjd = 60905.25
[products]
truth = ["noise_free"]
"""


def written(folder, request=REQUEST, **tables):
    """Write a request and the folder of its camera, with DECam's values unless tables are given."""
    if not (folder / "mini").exists():
        camera_template.write_like("decam", folder / "mini")
    wavelength = np.arange(6000.0, 6801.0, 10.0)
    response = 0.6 * np.exp(-0.5 * ((wavelength - 6400.0) / 80.0) ** 2)
    np.savetxt(folder / "mini" / "narrow.dat", np.stack([wavelength, response], 1))
    for name, text in {"layout": LAYOUT, "amplifiers": AMPLIFIERS, "bands": BANDS, **tables}.items():
        (folder / "mini" / f"{name}.csv").write_text(text)
    (folder / "stars.csv").write_text(f"ra,dec,mag\n{RA},{DEC},{MAGNITUDE}\n")
    return requests.written(folder, request, requests.FIELD.format(0.2), seed=3)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("camera")
    wanted, lake = parse(written(folder)), folder / "lake"
    lake.mkdir()
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    return lake


@pytest.fixture(scope="module")
def files(rendered):
    version = read.version(rendered, "products")
    rows = version.rows().to_pylist()
    return {(row["content"], row["detector"]): version.sidecar_path(row["path"]) for row in rows}


def test_all_detectors_are_rendered_with_overscan(files):
    assert set(files) == {(content, name) for content in ("science", "noise_free") for name in ("left", "right")}
    raw, header = fits.getdata(files["science", "right"], header=True)
    assert raw.shape == (260 + 8, 300 + 2 * (4 + 16))
    assert (header["INSTRUME"], header["FILTER"], header["NAMPS"]) == ("mini", "narrow", 2)


def test_a_star_has_the_electrons_of_the_zero_point_where_the_header_says(rendered, files):
    noise_free, header = fits.getdata(files["noise_free", "right"], header=True)
    fluxes = read.version(rendered, "star_fluxes").rows(["f_nu_narrow"])["f_nu_narrow"].to_numpy()
    assert len(fluxes) == 1
    # The source has the colour of a star: its flux in the user's band differs slightly from that in lsst_r.
    assert -2.5 * np.log10(fluxes[0]) + 23.9 == pytest.approx(MAGNITUDE, abs=0.3)
    expected = fluxes[0] * 10 ** (0.4 * (header["ZEROPNT"] - 23.9)) * SECONDS
    assert noise_free.sum() == pytest.approx(expected, rel=0.01)
    x, y = WCS(header).world_to_pixel_values(RA, DEC)
    rows, columns = np.indices(noise_free.shape)
    centre = [(noise_free * axis).sum() / noise_free.sum() for axis in (columns, rows)]
    assert centre == pytest.approx([float(x), float(y)], abs=0.1)
    # Extinction is 0.1 mag per airmass; the zero point applies at airmass 1.2.
    assert header["ZEROPNT"] == pytest.approx(ZERO_POINT - 0.1 * (header["AIRMASS"] - 1.2), abs=2e-3)


def test_gain_and_sky_are_those_of_the_folder(files):
    frame = products.electrons(files["science", "left"])
    with fits.open(files["science", "left"]) as units:
        header = units[-1].header
    # The gains have a spread of 0.05 rms, and their distribution ends at 3 rms.
    assert [header[f"GAIN{n}"] for n in (1, 2)] == pytest.approx([GAIN, GAIN], abs=3 * 0.05)
    scale = 3600.0 * np.sqrt(abs(np.linalg.det(WCS(header).pixel_scale_matrix)))
    sky = 10 ** (0.4 * (ZERO_POINT - 21.0)) * scale**2 * SECONDS
    # The night sky is close to the level of a dark one.
    assert np.median(frame.data) == pytest.approx(sky, rel=0.5)


def test_the_lake_contains_the_camera(rendered):
    mission = read_back(read.version(rendered, "mission"))
    assert [row["detector"] for row in mission.rows("ext.mini.layout")] == ["left", "right"]
    assert mission.value("ext.mini.narrow.zero_point") == ZERO_POINT
    names = read.version(rendered, "star_fluxes").schema.names
    # Bands without exposures have no fluxes.
    assert "f_nu_narrow" in names
    assert "f_nu_sdss_r" not in names


def test_the_plan_depends_on_the_content_of_the_folder(lake, tmp_path):
    def keys():
        return [step.plan.key for step in plan_exposures.steps(lake, parse(written(tmp_path)))]

    first = keys()
    assert keys() == first
    layout = tmp_path / "mini" / "layout.csv"
    moved = written(tmp_path, layout=LAYOUT.replace("-2.5", "-2.6"))
    assert "-2.6" in layout.read_text()
    assert all(new != old for new, old in zip(
        [step.plan.key for step in plan_exposures.steps(lake, parse(moved))], first, strict=True
    ))  # fmt: skip


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"layout": LAYOUT.replace("-2.5", "1.0")}, r"mission\.cameras\[0\]: .*layout\.csv line 3: detectors left and"),
        ({"amplifiers": AMPLIFIERS.replace("1.7", "0")}, r"mission\.cameras\[0\]: .*amplifiers\.csv line 2: gain = 0"),
        ({"bands": BANDS.replace("fringes", "fringe")}, r"mission\.cameras\[0\]: .*unknown column 'fringe'"),
        ({"bands": BANDS.replace("narrow.dat", "x.dat")}, r"mission\.cameras\[0\]: .*bands\.csv line 2: .*no such"),
        ({"bands": BANDS.replace("25.3", "99")}, r"mission\.cameras\[0\]: .*bands\.csv line 2: .*narrow\.zero_point"),
    ],
)  # fmt: skip
def test_an_invalid_folder_is_refused_before_anything_is_written(tmp_path, tables, words):
    with pytest.raises(BadInput, match=words) as refused:
        parse(written(tmp_path, **tables))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('cameras = ["mini"]', 'cameras = ["mini", "mini/"]', r"mission\.cameras\[1\]: two cameras have the n"),
        ('cameras = ["mini"]', 'cameras = ["none"]', r"mission\.cameras\[0\]: .*none: no such folder"),
        ('cameras = ["mini"]', "cameras = 3", r"mission\.cameras"),
        ('cameras = ["mini"]', f'cameras = ["{"x" * 300}"]', r"mission\.cameras\[0\]: .*: File name too long$"),
        ('cameras = ["mini"]', 'cameras = ["loop"]', r"mission\.cameras\[0\]: .*loop: no such folder"),
    ],
)
def test_a_camera_without_folder_is_refused(tmp_path, old, new, words):
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(BadInput, match=words):
        parse(written(tmp_path, REQUEST.replace(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            'band = "narrow"',
            'band = "wide"',
            r"pointing\[0\]\.band: camera mini has no band 'wide': allowed: narrow, s",
        ),
        (
            '"mini"\nband = "narrow"',
            '"maxi"\nband = "sdss_r"',
            r"pointing\[0\]\.camera: channel EXT has no camera",
        ),
        ('centre_on = "right"', 'centre_on = "top"', r"pointing\[0\]\.centre_on: camera mini has no detector 'top'"),
    ],
)
def test_invalid_pointings_of_the_camera_are_refused(lake, tmp_path, old, new, words):
    with pytest.raises(BadInput, match=words):
        plan_exposures.steps(lake, parse(written(tmp_path, REQUEST.replace(old, new))))


def test_a_band_without_a_curve_must_be_embedded(lake, tmp_path):
    request = parse(written(tmp_path, REQUEST.replace('band = "narrow"', 'band = "sdss_r"')))
    assert request.bands == ("sdss_r",)
    plan_exposures.steps(lake, request)
    unknown = written(
        tmp_path, REQUEST.replace('band = "narrow"', 'band = "odd"'), bands=BANDS.replace("sdss_r", "odd")
    )
    with pytest.raises(
        BadInput, match="band odd: truesky has no passband of this name, and the request has no curve for it"
    ):
        plan_exposures.steps(lake, parse(unknown))


@pytest.mark.parametrize(
    ("band", "curve", "words"),
    [
        ("des_r", None, "truesky has a passband des_r: choose another name for this curve"),
        ("narrow", "# nothing\n\n", r".*narrow\.dat: has no rows"),
        ("narrow", "6000 0\n6100 -1\n", r".*narrow\.dat: row 2 is negative"),
        ("narrow", "6000 0\n6100 50\n6200 50\n", r"response must be the fraction of photons detected"),
    ],
)
def test_errors_of_a_curve_name_its_table(lake, tmp_path, band, curve, words):
    path = written(tmp_path, REQUEST.replace("narrow", band), bands=BANDS.replace("narrow,", f"{band},"))
    if curve is not None:
        (tmp_path / "mini" / "narrow.dat").write_text(curve)
    with pytest.raises(BadInput, match=rf"^mission\.cameras\[0\]: .*mini/bands\.csv line 2: {words}"):
        plan_exposures.steps(lake, parse(path))


def test_two_curves_of_one_name_are_refused_with_both_places(tmp_path):
    request = written(tmp_path, REQUEST.replace('["mini"]', '["mini", "maxi"]'))
    shutil.copytree(tmp_path / "mini", tmp_path / "maxi")
    words = (
        r"mission\.cameras\[1\]: .*maxi/bands\.csv line 2: band narrow has another curve in "
        r"mission\.cameras\[0\]: .*mini/bands\.csv line 2: all curves must have different names$"
    )
    with pytest.raises(BadInput, match=words):
        parse(request)
    passband = '[fluxes.passbands.narrow]\nfile = "mini/narrow.dat"\nformat = "passband_ascii"\nmedium = "air"\n'
    with pytest.raises(BadInput, match=r"mission\.cameras\[0\]: .* has another curve in fluxes\.passbands\.narrow"):
        parse(written(tmp_path, REQUEST + passband))


def test_a_table_of_pointings_may_use_the_camera(lake, tmp_path):
    head, _, tail = REQUEST.partition("[[pointing]]")
    block = '[[observation]]\nchannels = ["EXT"]\npointings = "pointings.csv"\nsurvey = "des"\n'
    request = head + block + "[products]" + tail.partition("[products]")[2]
    (tmp_path / "pointings.csv").write_text(
        f"channel,camera,band,ra,dec,mjd,exposure_time_s\nEXT,mini,narrow,{RA},{DEC},60905.25,40\n"
    )
    wanted = parse(written(tmp_path, request))
    assert "narrow" in wanted.bands
    _, exposures, rows = plan_exposures.plan(lake, wanted)
    assert exposures["camera"].to_pylist() == ["mini"]
    assert rows["detector"].to_pylist() == ["left", "right"]
