"""Compare level 2 files of ground cameras with the rendered truth."""

import re
import shutil
import subprocess
import tracemalloc
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from scipy import ndimage
from scipy.spatial import cKDTree

from lake_schema.fits import images
from lake_schema.ids import kind_from_id
from lake_schema.store import layout, publish, read
from tests import requests
from tests.truesky.reduction import ground_frames
from tests.truesky.render import fields
from tests.truesky.render.products import test_tools
from tests.truesky.render.test_render_exposures_calibration import MODULES
from truesky.reduction import (
    amplifiers,
    calibration,
    catalogue,
    cosmic_rays,
    files,
    fringe_masters,
    masters,
    reduce,
    stack,
)
from truesky.reduction import frames as lake_frames
from truesky.reduction.calibration import COSMIC_RAY, EDGE, NO_DATA, SATURATED
from truesky.reduction.combining import CombinedFrame
from truesky.render.camera import astrometry, detectors
from truesky.render.effects.light import pixel_area
from truesky.request.from_toml import parse

BLOCK = 64
# Side of frames with fringes, pixels.
SIDE = 256
# Smallest S/N of the stars that are compared, and S/N above which positions are correct within 5 mas.
SIGNAL, SHARP = 50.0, 200.0


@dataclass(frozen=True)
class Made:
    """Rendered frame and its level 2 files."""

    ground: ground_frames.Ground
    folder: object
    path: object
    image: files.ImageFile

    @property
    def catalogue(self):
        return fits.getdata(self.path.with_suffix(".cat"), "LDAC_OBJECTS")


def reduced(ground, out, *more, wanted=0):
    """Run the level 2 command on a frame as if it were in a lake."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lake_frames, "from_lake", lambda *_: {("camera", "detector"): [ground.frame]})
        call = ["--lake", str(out.parent), "--masters", str(ground.masters), "--without", "dark", "--out", str(out)]
        assert reduce.main([*call, *more]) == wanted
    return out / f"{ground.frame.stem}.fits"


def of(folder, camera, side, **field):
    ground = ground_frames.made(folder, camera, side, **field)
    # Fringes need a master of several exposures.
    without = ("fringes",) if "fringes" in ground.frame.applied else ()
    path = reduced(ground, folder / "level2", "--level2", "--without", "dark", *without)
    return Made(ground, folder, path, files.read_image(path))


@pytest.fixture(scope="module")
def jpcam(tmp_path_factory):
    """Render stars from faint to saturated, with fifty times the usual number of cosmic rays."""
    field = {"electrons": (2e4, 4e5), "pitch": 64, "rays": 50.0}
    return of(tmp_path_factory.mktemp("level2"), "jpcam", 448, **field)


def check_files(made):
    """Check the four files against their standards."""
    names = sorted(path.name for path in made.path.parent.iterdir())
    assert names == sorted(made.path.with_suffix(end).name for end in (".fits", ".cat", ".psf", ".head"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for end in (".fits", ".cat", ".psf"):
            with fits.open(made.path.with_suffix(end), checksum=True) as units:
                units.verify("exception")
    with fits.open(made.path.with_suffix(".cat")) as units:
        assert [unit.name for unit in units] == ["PRIMARY", "LDAC_IMHEAD", "LDAC_OBJECTS"]
        raw = units["LDAC_IMHEAD"].fileinfo()
    # Readers in C expect cards of 80 characters up to END.
    with made.path.with_suffix(".cat").open("rb") as stream:
        stream.seek(raw["datLoc"])
        text = stream.read(raw["datSpan"]).rstrip(b"\0").decode("ascii")
    assert len(text) % 80 == 0
    assert text[-80:] == "END".ljust(80)
    header, image = fits.Header.fromstring(text), fits.getheader(made.path, "SCI")
    assert header["NDETECT"] == len(made.catalogue)
    assert [header[f"NAXIS{i}"] for i in (1, 2)] == [image[f"NAXIS{i}"] for i in (1, 2)]
    assert header["GAIN"] == made.image.card("GAIN")
    for system in (header, image):
        there = WCS(system).all_pix2world([[7.0, 90.0]], 0)
        assert 3.6e6 * np.abs(there - np.transpose(astrometry.sky_of_pixel(made.ground.wcs, [7.0], [90.0]))).max() < 0.1


def check_flags(made):
    """Flags agree with the truth in 99 % of the pixels, and in most of the affected pixels."""
    flags, maps = made.image.reduced.flags, made.ground.one.maps
    full = maps["saturation"] > 0
    said = flags & SATURATED > 0
    assert np.mean(said == full) >= 0.99
    if full.any():
        assert np.mean(said[full]) >= 0.95
    sigma = noise(made) * made.image.card("GAIN")
    hits = maps["cosmic_rays"]
    found = flags & COSMIC_RAY > 0
    assert np.mean(found == (hits > 5.0 * sigma)) >= 0.99
    clear = (hits > 10.0 * sigma) & ~full & (made.ground.one.noise_free < sigma)
    if clear.sum() > 20:
        assert np.mean(found[clear]) >= 0.9
    # Cores of stars are not flagged. Hot pixels may be, since they are as sharp as cosmic rays.
    near = ndimage.binary_dilation(hits > 0.0, np.ones((3, 3), bool))
    assert np.mean(found & ~near) < 1e-4
    assert np.all((flags & NO_DATA > 0) == made.ground.frame.scene.layout.unread_pixels)
    inner = flags[10:-10, 10:-10]
    assert not (inner & EDGE).any()
    assert np.all(flags[:10][flags[:10] & NO_DATA == 0] & EDGE)
    weight = made.image.reduced.weight
    assert np.all((weight > 0.0) == (flags & ~np.uint8(EDGE) == 0))


def noise(made):
    """Return the noise of a sky pixel in the image's unit."""
    weight = made.image.reduced.weight
    return float(np.sqrt(1.0 / np.median(weight[weight > 0.0])))


def check_stars(made, least):
    """Check magnitudes, their scatter and positions of isolated stars, of which there must be at least `least`."""
    rows, (x, y, mag) = made.catalogue, ground_frames.truth(made.ground)
    distance, which = cKDTree(np.transpose([x, y])).query(np.transpose([rows["XWIN_IMAGE"], rows["YWIN_IMAGE"]]) - 1.0)
    signal = rows["FLUX_APER"] / rows["FLUXERR_APER"]
    clean = (distance < 1.5) & (rows["FLAGS"] == 0) & (rows["IMAFLAGS_ISO"] == 0) & (signal > SIGNAL)
    assert clean.sum() >= least
    off = rows["MAG_APER"] + made.image.card("APERCOR") - mag[which]
    pull = (off / rows["MAGERR_APER"])[clean]
    spread = float(np.std(pull[np.abs(pull) < 5.0]))
    east = (rows["ALPHAWIN_J2000"] - astrometry.sky_of_pixel(made.ground.wcs, x[which], y[which])[0]) * np.cos(
        np.radians(rows["DELTA_J2000"])
    )
    north = rows["DELTAWIN_J2000"] - astrometry.sky_of_pixel(made.ground.wcs, x[which], y[which])[1]
    sharp = clean & (signal > SHARP)
    places = 3.6e6 * np.sqrt(np.mean(east[sharp] ** 2 + north[sharp] ** 2) / 2.0)
    print(
        f"{clean.sum()} stars: {np.median(off[clean]):.4f} mag, scatter {spread:.2f}; {sharp.sum()}: {places:.2f} mas"
    )
    assert abs(np.median(off[clean])) < 0.01
    # The relative error of the scatter of n stars is the root of 1 / 2 n.
    assert 0.9 - np.sqrt(2.0 / clean.sum()) < spread < 1.3
    assert sharp.sum() >= least // 3
    assert places < 5.0
    # The isophote cuts the wings of a star, so the agreement is limited.
    width = np.median(rows["FWHM_IMAGE"][sharp]) * made.image.card("PIXSCALE")
    assert width == pytest.approx(made.image.card("PSFFWHM"), rel=0.15)


def check_sky(made):
    """The sky has no steps, and its noise agrees with the weights."""
    found, maps = made.image.reduced, made.ground.one.maps
    gain, light, sky = made.image.card("GAIN"), made.ground.one.noise_free, float(np.median(maps["sky"]))
    sources = ndimage.binary_dilation(light > 1e-3 * sky, iterations=2)
    good = (found.weight > 0.0) & ~sources & (maps["cosmic_rays"] == 0)
    # The reduced sky has the pixel area of the boresight.
    area = 1.0 + pixel_area.area_change(*pixel_area.parameters(made.ground.one.scene)[1:])
    area = area if made.image.card("CALAREA") else 1.0
    left = np.where(good, found.image * gain - light - maps["sky"] / area, np.nan)
    dark = made.ground.one.scene.dark_electrons * ("dark_current" in made.ground.frame.applied)
    left = left - dark
    product = np.nanmean((left - np.nanmedian(left)) ** 2 * found.weight / gain**2)
    ny, nx = (n // BLOCK for n in left.shape)
    each = left[: ny * BLOCK, : nx * BLOCK].reshape(ny, BLOCK, nx, BLOCK)
    count = np.isfinite(each).sum(axis=(1, 3))
    means = np.nansum(each, axis=(1, 3)) / np.maximum(count, 1)
    enough = count > 0.25 * BLOCK**2
    relative = (means / sky)[enough]
    print(f"{enough.sum()} blocks: mean {relative.mean():.5f}, largest {np.abs(relative).max():.5f}; {product:.4f}")
    assert enough.sum() >= 5
    # Deviation of a block due to noise alone.
    alone = noise(made) * gain / sky / np.sqrt(count[enough])
    assert np.all(np.abs(relative) <= 0.003 + 2.0 * alone)
    assert product == pytest.approx(1.0, abs=0.03)


def test_level_2_files_are_in_one_folder(jpcam):
    check_files(jpcam)


def test_scamp_reads_the_catalogue(jpcam, tmp_path):
    """With the .head file and its usual columns, SCAMP finds the positions that the catalogue contains."""
    command = test_tools.tool("scamp")
    for end in (".cat", ".head"):
        shutil.copy(jpcam.path.with_suffix(end), tmp_path / f"a{end}")
    rows = jpcam.catalogue
    clean = rows[(rows["FLAGS"] == 0) & (rows["FLUX_AUTO"] > 100.0 * rows["FLUXERR_AUTO"])]
    stars = SkyCoord(clean["ALPHAWIN_J2000"], clean["DELTAWIN_J2000"], unit="deg")
    test_tools.reference(tmp_path / "reference.cat", stars)
    done = subprocess.run(
        [command, "a.cat", "-c", "none", "-AHEADER_SUFFIX", ".head", "-HEADER_SUFFIX", ".out",
         "-ASTREF_CATALOG", "FILE", "-ASTREFCAT_NAME", "reference.cat", "-MATCH", "N", "-SOLVE_ASTROM", "N",
         "-SOLVE_PHOTOM", "N", "-CHECKPLOT_TYPE", "NONE", "-CROSSID_RADIUS", "1",
         "-WRITE_XML", "N", "-VERBOSE_TYPE", "NORMAL"],
        cwd=tmp_path, check=True, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    external = (done.stdout + done.stderr).split("(external)")[1]
    across, up, _, many = re.search(r"Group +1: ([\d.e+-]+)\" ([\d.e+-]+)\" +([\d.e+-]+) +(\d+)", external).groups()
    assert int(many) == len(clean) > 20
    assert max(float(across), float(up)) < 1e-4


def test_flags_agree_with_the_truth(jpcam):
    check_flags(jpcam)


def test_positions_and_magnitudes_of_stars_are_correct(jpcam):
    check_stars(jpcam, 20)


def test_the_sky_is_flat_and_its_noise_agrees_with_the_weights(jpcam):
    check_sky(jpcam)


def test_the_catalogue_depends_only_on_pixels(jpcam, tmp_path):
    """Detection uses only the pixels: sources are complete, and a higher threshold gives fewer."""
    rows = jpcam.catalogue
    assert len(rows) >= len(ground_frames.truth(jpcam.ground)[0]) - 5
    path = reduced(jpcam.ground, tmp_path / "out", "--level2", "--threshold", "30", "--aperture", "4")
    bright = fits.getdata(path.with_suffix(".cat"), "LDAC_OBJECTS")
    assert 0 < len(bright) < len(rows)
    assert bright["FLUX_MAX"].min() > 20.0 * noise(jpcam)
    header = fits.getheader(path)
    assert header["APERDIAM"] == pytest.approx(4.0 / header["PIXSCALE"], rel=1e-5)
    # A larger aperture contains more of a star's light.
    assert jpcam.image.card("APERCOR") < header["APERCOR"] < 0.0


def test_counts_are_electrons_over_the_mean_gain(jpcam, tmp_path):
    path = reduced(jpcam.ground, tmp_path / "out")
    electrons = files.read_image(path)
    assert (electrons.card("BUNIT"), jpcam.image.card("BUNIT")) == ("electron", "adu")
    assert sorted(file.suffix for file in path.parent.iterdir()) == [".fits"]
    gain = float(np.mean(jpcam.ground.frame.scene.amplifier_values("gain", "electron / adu")))
    assert jpcam.image.card("GAIN") == pytest.approx(gain)
    np.testing.assert_allclose(jpcam.image.reduced.image * gain, electrons.reduced.image, rtol=1e-5)
    assert jpcam.image.card("MAGZERO") == pytest.approx(electrons.card("MAGZERO") - 2.5 * np.log10(gain))
    rates = [stack.to_rate(image).image for image in (jpcam.image, electrons)]
    np.testing.assert_allclose(*rates, rtol=1e-5)
    assert not any(key.startswith(("DSEC", "CSEC", "BSEC", "DATASEC")) for key, *_ in electrons.cards)


@pytest.mark.nightly
def test_memory_is_bounded_for_each_pixel(tmp_path, monkeypatch):
    """A CCD of JPCam with 85 million pixels takes less than 5 GB: 50 bytes per pixel, and 0.5 GB of programs.

    Strips and tiles are as small relative to this frame as they are for a whole CCD.
    """
    for module, name, value in (
        (calibration, "_ROWS", 32), (amplifiers, "_ROWS", 8), (cosmic_rays, "_ROWS", 64), (cosmic_rays, "_MARGIN", 8),
        (catalogue, "_TILE", 256), (catalogue, "_TILE_MARGIN", 32), (catalogue, "_WINDOW_PIXELS", 1 << 14),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    frame, folder = ground_frames.made(tmp_path, "jpcam", 1024, (2e4, 4e5), 64).frame, tmp_path / "all"
    folder.mkdir()
    shape = frame.scene.ny, frame.scene.nx
    for kind in files.KINDS:
        planes = (
            np.full(shape, kind == "flat", np.float32),
            np.full(shape, 1e-3, np.float32),
            np.full(shape, 5, np.int16),
        )
        files.write_master(files.master_path(folder, frame, kind), CombinedFrame(*planes), kind, [frame])
    monkeypatch.setattr(lake_frames, "from_lake", lambda *_: {("camera", "detector"): [frame]})
    tracemalloc.start()
    try:
        call = ["--lake", str(tmp_path), "--masters", str(folder), "--level2", "--out", str(tmp_path / "out")]
        assert reduce.main(call) == 0
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    print(f"{peak / np.prod(shape):.1f} bytes per pixel")
    assert peak / np.prod(shape) < 50.0


def test_fringes_are_subtracted_with_a_master_of_the_exposures(tmp_path, monkeypatch):
    """Three exposures of other fields give the master. It has the rendered fringes, of which less than 5 % remain."""
    overrides = {"ext.hsc.hsc_z.fringes": (0.05, ""), "ext.hsc.fringe_period": (45.0, "pix")}
    field = {"electrons": (2e4, 1e5), "pitch": 128, "sky": 80.0, "overrides": overrides}
    exposures = []
    for number in range(1, 5):
        (tmp_path / str(number)).mkdir()
        made = ground_frames.made(tmp_path / str(number), "hsc", SIDE, number=number, forced={"fringes": True}, **field)
        exposures.append(made)
    (tmp_path / "none").mkdir()
    none = ground_frames.made(tmp_path / "none", "hsc", SIDE, forced={"fringes": False}, **field)
    first, others = exposures[0], [one.frame for one in exposures[1:]]
    drawn = first.one.maps["sky"] / none.one.maps["sky"] - 1.0
    found = files.read_masters(first.masters, others[0], ("dark", "fringes"))
    master = fringe_masters.combine(others, found, np.zeros((len(others), SIDE, SIDE), np.float32))
    # Broad changes of the sky are not part of the master, and it is smoothed.
    assert np.polyfit(drawn.ravel(), master.mean.ravel(), 1)[0] == pytest.approx(0.95, abs=0.05)
    assert np.corrcoef(drawn.ravel(), master.mean.ravel())[0, 1] > 0.95
    # The command makes it after the flat, if the pointings differ.
    given = {"bias": found.bias, "flat": found.flat}
    monkeypatch.setattr(masters, "_combine_frames", lambda kind, *_: given[kind])
    lamps = [replace(others[0], exposure=replace(others[0].exposure, image_type=kind)) for kind in given]
    for skies, kinds in ((others, ["bias", "flat", "fringes"]), (others[:1] * 4 + others[1:], ["bias", "flat"])):
        combined = {kind: one for kind, one, _ in masters.from_frames([*lamps, *skies], tmp_path)}
        assert list(combined) == kinds
        if "fringes" in combined:
            np.testing.assert_array_equal(combined["fringes"].mean, master.mean)
    files.write_master(files.master_path(first.masters, first.frame, "fringes"), master, "fringes", others)
    left = []
    for more in (["--without", "bias", "dark", "fringes", "pixel_area"], []):
        image, other = (
            files.read_image(reduced(one, tmp_path / f"{len(more)}{name}", *more))
            for name, one in (("with", first), ("none", none))
        )
        good = (image.reduced.weight > 0.0) & (other.reduced.weight > 0.0) & (first.one.noise_free < 1.0)
        more_light = (image.reduced.image - other.reduced.image)[good] / np.median(other.reduced.image[good])
        left.append(float(np.polyfit(drawn[good], more_light, 1)[0]))
        assert (image.card("CALFRING"), other.card("CALFRING")) == (not more, False)
    assert left == pytest.approx([1.0, 0.0], abs=0.05)


def test_a_frame_with_fringes_requires_their_master(tmp_path, capsys):
    own = ground_frames.made(tmp_path, "hsc", 256, (2e4, 1e5), 128, forced={"fringes": True})
    reduced(own, tmp_path / "out", wanted=2)
    said = capsys.readouterr().err
    assert "_fringes.fits: there is no such master" in said
    assert "with three or more pointings" in said
    assert "--without fringes" in said


def test_the_sky_has_the_pixel_area_of_the_middle_of_the_camera(tmp_path):
    """The area of a pixel is that of astropy, in the farthest corner of DECam; stars keep their counts."""
    ground = ground_frames.made(tmp_path, "decam", 256, (2e4, 1e5), 128, forced={"pixel_area": True, "fringes": False})
    boresight = replace(ground.one.detector, x=0.0, y=0.0)
    areas = []
    for system in (ground.wcs, astrometry.wcs(boresight, 53.1, -27.8, 0.0)):
        corners = [SkyCoord(*astrometry.sky_of_pixel(system, *at), unit="deg") for at in square(128.0)]
        sides = [corners[i].separation(corners[i + 1]).arcsec / 20.0 for i in (0, 1)]
        areas.append(sides[0] * sides[1])
    expected = areas[0] / areas[1]
    assert abs(expected - 1.0) > 1e-3
    with_area, without = (
        files.read_image(reduced(ground, tmp_path / name, "--without", "dark", *more))
        for name, more in (("with", ()), ("without", ("pixel_area",)))
    )
    assert (with_area.card("CALAREA"), without.card("CALAREA")) == (True, False)
    # Sections of single amplifiers are those of the raw frame.
    assert any(re.fullmatch("TRIMSEC[A-Z]", key) for key, *_ in ground.frame.cards)
    assert not any(re.fullmatch("[A-Z]+SEC[A-Z]", key) for key, *_ in with_area.cards)
    good = (with_area.reduced.weight > 0.0) & (ground.one.noise_free < 1.0)
    levels = [np.median(image.reduced.image[good]) for image in (without, with_area)]
    assert levels[0] / levels[1] == pytest.approx(expected, abs=2e-4)
    change = without.reduced.image - with_area.reduced.image
    # The change is smooth: it is the same in stars and in the sky around them.
    assert np.ptp(change) < 5e-4 * levels[0]


def square(middle):
    return [(middle - 10.0, middle - 10.0), (middle + 10.0, middle - 10.0), (middle + 10.0, middle + 10.0)]


def test_what_is_left_as_it_is_is_said(jpcam, tmp_path):
    path = reduced(jpcam.ground, tmp_path / "out", "--without", "bias", "dark", "flat", "crosstalk", "nonlinearity")
    found = files.read_image(path)
    assert not any(found.card(key) for key in ("CALBIAS", "CALDARK", "CALFLAT", "CALXTALK", "CALLIN"))
    assert jpcam.image.card("CALFLAT")
    applied = jpcam.ground.frame.applied
    assert (jpcam.image.card("CALXTALK"), jpcam.image.card("CALLIN")) == ("crosstalk" in applied, True)
    assert "nonlinearity" in applied


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--level2", "--rate"], "--rate is not allowed with --level2"),
        (["--level2", "--threshold", "0"], "--threshold = 0.0 is outside"),
        (["--level2", "--least-pixels", "0"], "--least-pixels = 0 is outside"),
        (["--level2", "--aperture", "-1"], "--aperture = -1.0 is outside"),
        (["--cosmic-rays", "0.1"], "--cosmic-rays = 0.1 is outside"),
        (["--threshold", "3"], "without --level2 there is no catalogue"),
        (["--level2", "--masters", "nowhere"], "--masters nowhere: there is no such folder"),
    ],
)
def test_what_makes_no_level2_is_refused_in_a_line(jpcam, tmp_path, capsys, more, words):
    out = tmp_path / "out"
    reduced(jpcam.ground, out, "--without", "bias", "dark", *more, wanted=2)
    said = capsys.readouterr().err
    assert (words in said, said.count("\n")) == (True, 1), said
    assert not out.exists() or not list(out.iterdir())


@pytest.mark.parametrize("change", [{"psf": None}, {"exposure": fields.exposure(channel="VIS")}])
def test_without_a_psf_of_a_ground_camera_nothing_is_written(jpcam, tmp_path, capsys, change):
    ground = replace(jpcam.ground, frame=replace(jpcam.ground.frame, **change))
    reduced(ground, tmp_path / "out", "--level2", wanted=2)
    said = capsys.readouterr().err
    assert ("choose images of ground cameras" in said, said.count("\n")) == (True, 1), said
    assert not (tmp_path / "out").exists()


def test_a_master_of_another_size_is_refused(jpcam, tmp_path, capsys):
    fits.writeto(files.master_path(tmp_path, jpcam.ground.frame, "flat"), np.ones((5, 7), np.float32))
    reduced(jpcam.ground, tmp_path / "out", "--without", "bias", "dark", "--masters", str(tmp_path), wanted=2)
    assert "flat.fits: (5, 7) pixels, the frame has (448, 448)" in capsys.readouterr().err


def test_where_a_flat_of_yours_says_nothing_a_pixel_is_not_used(jpcam):
    found = files.read_masters(jpcam.ground.masters, jpcam.ground.frame, ("dark",))
    blind = ~np.isfinite(fits.getdata(files.master_path(jpcam.ground.masters, jpcam.ground.frame, "flat")))
    assert blind.any()
    assert np.all(found.flags[blind] & calibration.UNSURE)
    assert np.all(jpcam.image.reduced.weight[blind] == 0.0)


@pytest.mark.nightly
@pytest.mark.parametrize("camera", [*ground_frames.BANDS])
def test_every_camera(tmp_path, camera):
    made = of(tmp_path, camera, 1024, electrons=(2e4, 3e5), pitch=96, rays=10.0)
    for check in (check_files, check_flags, check_sky):
        check(made)
    check_stars(made, 40)


LAKE = """
accuracy = "survey"
[universe]
galaxy_limit = 21.0
star_limit = 22.5
box_cells = 192
lensing_nside = 64
[fluxes]
bands = ["{band}"]
[[pointing]]
channel = "EXT"
camera = "{camera}"
band = "{band}"
ra = 53.117
dec = -27.808
centre_on = "{detector}"
detectors = ["{detector}"]
mjd = {mjd}
[[observation]]
channels = ["EXT"]
survey = "{survey}"
image_type = "bias"
exposures = 8
detectors = ["{detector}"]
[[observation]]
channels = ["EXT"]
survey = "{survey}"
image_type = "flat"
exposures = 12
bands = ["{band}"]
detectors = ["{detector}"]
[products]
truth = ["noise_free", "sky", "cosmic_rays"]
"""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("survey", "camera", "band", "detector", "mjd", "size"),
    [
        ("jedis", "jpcam", "jedis_g", "ccd05", 60905.08, 1024),
        # HSC has smaller pixels, and more of its stars are saturated.
        ("whigs", "hsc", "hsc_g", "1_00", 60905.6, 2048),
    ],
)
def test_level_2_of_a_lake_with_its_masters(tmp_path, survey, camera, band, detector, mjd, size):
    """Start from a request with biases and dome flats; the master flat is named by its band."""
    root, listed = layout.resolve_lake(tmp_path / "lake"), detectors._read_layout
    text = LAKE.format(survey=survey, camera=camera, band=band, detector=detector, mjd=mjd)
    wanted = parse(requests.written(tmp_path, text, requests.FIELD.format(0.2), seed=11))
    with pytest.MonkeyPatch.context() as patch:
        small = {"nx": size, "ny": size}
        patch.setattr(detectors, "_read_layout", lambda *of: tuple(replace(d, **small) for d in listed(*of)))
        for job in MODULES:
            for step in job.steps(root, wanted):
                publish.make_version(root, step.plan, step.run_task)
        own, out = str(tmp_path / "masters"), tmp_path / "level2"
        assert masters.main(["--lake", str(root), "--out", own]) == 0
        # The true sky contains the pixel area.
        call = ["--lake", str(root), "--masters", own, "--without", "dark", "pixel_area", "--out", str(out), "--level2"]
        assert reduce.main(call) == 0
    assert sorted(path.name for path in Path(own).iterdir()) == [
        f"{camera}_{detector}_bias.fits", f"{camera}_{band}_{detector}_flat.fits"
    ]  # fmt: skip
    (path,) = out.glob("*.fits")
    found, version = files.read_image(path), read.version(root, "products")
    image = next(row["path"] for row in version.rows().to_pylist() if row["path"].endswith("_sky.fits"))
    sky, light, rays = (
        images.read_images(version.sidecar_path(image.replace("_sky", kind)))[0].data
        for kind in ("_sky", "_noise_free", "_cosmic_rays")
    )
    # Galaxies have faint light in all pixels, so a small fraction of the sky is accepted.
    good = (found.reduced.weight > 0.0) & (light < 0.01 * np.median(sky)) & (rays == 0)
    dark = found.card("DARKRATE") * found.card("EXPTIME")
    left = np.where(good, found.reduced.image * found.card("GAIN") - light - sky - dark, np.nan)
    each = left.reshape(size // BLOCK, BLOCK, size // BLOCK, BLOCK)
    count = np.isfinite(each).sum(axis=(1, 3))
    means = (np.nansum(each, axis=(1, 3)) / np.maximum(count, 1))[count > 0.5 * BLOCK**2] / np.median(sky)
    print(f"{len(means)} blocks: mean {means.mean():.5f}, rms {means.std():.5f}, largest {np.abs(means).max():.5f}")
    assert len(means) > 100
    assert np.mean(np.abs(means) <= 0.003) >= 0.98
    truth = read.version(root, "rendered_truth").rows().to_pylist()
    stars = [row for row in truth if row["expected"] and kind_from_id(row["id"]) == 5 and 17.0 < row["mag"] < 21.0]
    rows = fits.getdata(path.with_suffix(".cat"), "LDAC_OBJECTS")
    distance, which = cKDTree(np.transpose([rows["XWIN_IMAGE"], rows["YWIN_IMAGE"]]) - 1.0).query(
        [(row["x"] + row["psf_x"], row["y"] + row["psf_y"]) for row in stars]
    )
    seen = (distance < 1.0) & (rows["FLAGS"][which] == 0) & (rows["IMAFLAGS_ISO"][which] == 0)
    off = rows["MAG_APER"][which] + found.card("APERCOR") - [row["mag"] for row in stars]
    print(f"{seen.sum()} of {len(stars)} stars: {np.median(off[seen]):.4f} mag")
    assert seen.sum() >= 5
    assert abs(np.median(off[seen])) < 0.02
