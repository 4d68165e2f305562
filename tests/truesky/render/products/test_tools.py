"""Images processed by standard tools: positions on the sky, verification, and reduction with the header alone.

Tests of tools that are not installed are skipped by name (Debian: apt install source-extractor scamp swarp). sep and
astropy, which are always available, do the same checks.
"""

import re
import shutil
import subprocess
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
import sep
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.mission.parameter import CAMERAS
from tests.truesky import nightly
from tests.truesky.render import fields, infrared, nominal
from tests.truesky.render.fields import MISSION, small
from truesky.render.camera import astrometry, observatories
from truesky.render.camera.detectors import detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.camera.sections import Section
from truesky.render.channels import registry
from truesky.render.products import fits_files, truth_table
from truesky.request.accuracy import SURVEY

# Each quadrant has four stars.
SIDE, STARS = 512, 16
BANDS = {
    "decam": "des_r", "lsstcam": "lsst_r", "megacam": "cfis_r", "jpcam": "jedis_g", "gpc1": "ps1_i", "hsc": "hsc_z",
}  # fmt: skip
# Effects of a ground camera that change light and noise but do not move charge.
SEEN = ("background", "poisson", "read_noise")
COLUMNS = ("ALPHAWIN_J2000", "DELTAWIN_J2000", "XWIN_IMAGE", "YWIN_IMAGE", "FLUX_AUTO", "FLUXERR_AUTO", "FLAGS")
COLUMNS += ("ERRAWIN_IMAGE", "ERRBWIN_IMAGE", "ERRTHETAWIN_IMAGE", "FLUX_RADIUS", "MAG_AUTO")


def tool(name, where="Debian: apt install source-extractor scamp swarp"):
    """Return the command of a tool; the test is skipped if it is not installed."""
    command = shutil.which(name)
    if command is None:
        pytest.skip(f"{name} is not installed ({where})")
    return command


# Raw headers without pointing error.
SURE = MISSION.with_overrides(
    {f"ext.{camera}.header.{error}": (0.0, "arcsec") for camera in CAMERAS for error in ("offset", "rotation")}
)


@dataclass(frozen=True)
class Field:
    """File with bright stars, its head file, and the positions of the stars on the sky."""

    path: object
    stars: SkyCoord
    one: object


def farthest(camera):
    """Return the detector farthest from the boresight, where the distortion is largest, cut to a small size."""
    name = max(detectors(camera, MISSION), key=lambda d: np.hypot(d.x, d.y)).name
    return small(camera, name, SIDE)


def stars_on(camera, sky, detector=None, pointed=None, mission=SURE, at=None, way="raw"):
    """Return a detector with stars of signal-to-noise ratio 600.

    `sky` is that of a ground camera, e-/s/pix; `pointed` is ra, dec and position angle of the boresight; `at` is ra,
    dec of the stars, None = spread out.
    """
    detector = detector or farthest(camera)
    # Stars at the centres of the amplifiers.
    x, y = (axis + SIDE / 32 for axis in nominal.lattice(SIDE, SIDE / 4))
    if camera == "vis":
        quiet = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE)
        return nominal.rendered(detector, np.full(len(x), 19.0), x, y, forced=quiet)
    ra, dec, angle = pointed or boresight_for(detector, 53.1, -27.8, 12.0)
    where = at or astrometry.sky_of_pixel(astrometry.wcs(detector, ra, dec, angle), x, y)
    band, none, points = BANDS[camera], fields.galaxies([], []), fields.stars(*where)
    # Each star has 400,000 electrons.
    f_nu = 10 ** (-0.4 * (25.93 - 2.5 * np.log10(4e5 / 100.0) - 23.9))
    exposed = {
        "channel": "EXT", "camera": camera, "band": band, "ra": ra, "dec": dec, "position_angle": angle, "seeing": 1.0,
        "sky": sky,
    }  # fmt: skip
    tables = none, fields.fluxes(none, band, 0.0), points, fields.fluxes(points, band, f_nu)
    effects = registry.CHANNELS["EXT"].effects["science"]
    quiet = nominal.off(*(effect.name for effect in effects if effect.optional and effect.name not in SEEN))
    return fields.rendered(exposed, detector, tables, mission, SURVEY, forced=quiet, way=way)


def written(camera, folder, sky=0.05):
    """Write the image with a dark sky, so that raw frames have no step at the overscan."""
    return put(stars_on(camera, sky), folder)


def put(one, folder):
    """Write the files and the head file to a folder."""
    camera = one.exposure.camera
    rows, writers = fits_files.products(one, ())
    path = folder / f"{camera}_science.fits"
    name = rows["path"][0].as_py()
    writers[name](path)
    writers[name.replace(".fits", ".head")](path.with_suffix(".head"))
    truth = truth_table.truth(one)
    there = (np.asarray(truth[axis]) + np.asarray(truth[f"psf_{axis}"]) for axis in "xy")
    return Field(path, SkyCoord(*astrometry.sky_of_pixel(one.wcs, *there), unit="deg"), one)


@pytest.fixture(scope="module", params=nightly.params(["vis", *CAMERAS], (0, 1, 4)))
def field(request, tmp_path_factory):
    return written(request.param, tmp_path_factory.mktemp("tools"))


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return written("vis", tmp_path_factory.mktemp("tools"))


def arrays(path):
    """Return (header, pixels) of each array."""
    with fits.open(path) as units:
        return [(unit.header, np.array(unit.data, float)) for unit in units if unit.data is not None]


def with_one_wcs(path):
    """Return a file in which one WCS and one bias level are valid for all pixels: the file itself, for most cameras.

    Raw frames of HSC have prescan and overscan between their pixels, and the WCS of the pixels without them. The result
    then has the pixels of the amplifiers side by side. Amplifiers of LSSTCam have different bias levels. In both cases
    the overscan level is subtracted.
    """
    ((header, array), *others) = arrays(path)
    if others or "NAMPS" not in header:
        return path
    numbers = range(1, header["NAMPS"] + 1)
    levels = [np.median(array[window(header[f"BSEC{n}"])]) for n in numbers]
    if "DATASEC" in header and np.ptp(levels) < 200.0:
        return path
    places = [window(header[f"{'DSEC' if 'DATASEC' in header else 'CSEC'}{n}"]) for n in numbers]
    shape = tuple(max(place[axis].stop for place in places) for axis in (0, 1))
    out = np.zeros(array.shape if "DATASEC" in header else shape, np.float32)
    for n, place, level in zip(numbers, places, levels, strict=True):
        out[place] = array[window(header[f"DSEC{n}"])] - level
    joined = path.with_name(f"joined_{path.name}")
    if not joined.exists():
        fits.writeto(joined, out, header)
        joined.with_suffix(".head").write_text(path.with_suffix(".head").read_text())
    return joined


def off(field, ra, dec):
    """Return the rms offset in mas along each axis between detections and stars; all stars must be found."""
    found = SkyCoord(ra, dec, unit="deg")
    nearest, distance, _ = field.stars.match_to_catalog_sky(found)
    assert distance.to_value("arcsec").max() < 0.5
    assert len(set(nearest)) == len(field.stars) == STARS
    return float(np.sqrt(np.mean(distance.to_value("mas") ** 2) / 2.0))


def window(text):
    x0, x1, y0, y1 = (int(n) for n in re.fullmatch(r"\[(\d+):(\d+),(\d+):(\d+)\]", text).groups())
    return slice(y0 - 1, y1), slice(x0 - 1, x1)


def measured(pixels):
    """Return x, y of detected sources, from 0, by windowed centroids."""
    pixels = np.ascontiguousarray(pixels - np.median(pixels))
    found = sep.extract(pixels, 30.0 * 1.48 * np.median(np.abs(pixels)), minarea=5)
    radius, _ = sep.flux_radius(pixels, found["x"], found["y"], np.full(len(found), 15.0), 0.5, subpix=5)
    x, y, _ = sep.winpos(pixels, found["x"], found["y"], 2.0 / 2.3548 * radius)
    return x, y


def said(path):
    """Return the headers in the head file of an image."""
    *blocks, _ = path.with_suffix(".head").read_text().split("END\n")
    return [fits.Header.fromstring(block, sep="\n") for block in blocks]


def test_stars_are_at_the_positions_of_the_headers(field):
    """Read the header and the head file with astropy."""
    convention = observatories.for_camera(field.one.exposure.camera).convention
    path = with_one_wcs(field.path)
    of_file = [header for header, _ in arrays(path)]
    for headers, form in ((of_file, convention), (said(field.path), "tpv")):
        assert all(header["CTYPE1"].endswith(form.upper()) for header in headers)
        places = []
        for system, (header, pixels) in zip(headers, arrays(path), strict=True):
            data = window(header["DATASEC"]) if "DATASEC" in header else (slice(0, SIDE), slice(0, SIDE))
            x, y = measured(pixels[data])
            places.append(WCS(system).all_pix2world(x + data[1].start, y + data[0].start, 0))
        assert off(field, *np.concatenate(places, axis=1)) < 5.0


def extracted(path, kind="FITS_1.0", threshold=30):
    """Return a SExtractor catalogue of a file; `threshold` is in units of the noise of the sky."""
    command, folder = tool("source-extractor"), path.parent
    (folder / "columns.param").write_text("\n".join(COLUMNS) + "\n")
    out = path.with_suffix(".cat")
    subprocess.run(
        [command, path.name, "-c", "none", "-PARAMETERS_NAME", "columns.param", "-FILTER", "N",
         "-CATALOG_NAME", out.name, "-CATALOG_TYPE", kind, "-DETECT_THRESH", str(threshold), "-VERBOSE_TYPE",
         "QUIET"],
        cwd=folder, check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    return out


def test_source_extractor_finds_the_stars(field):
    with fits.open(extracted(with_one_wcs(field.path))) as tables:
        rows = [table.data for table in tables[1:]]
        places = [np.concatenate([row[key] for row in rows]) for key in COLUMNS[:2]]
    assert off(field, *places) < 5.0


@pytest.mark.nightly
@pytest.mark.parametrize(("camera", "limit"), [("vis", 0.5), ("nisp", 1.0)])
def test_source_extractor_finds_no_mean_offset(camera, limit, tmp_path):
    """The WCS points to the centroids of stars: offsets along both axes are 0 in the mean over a lattice, mas.

    The positions of 24 x 24 stars within a pixel form a lattice, so that errors of pixels average out. All effects that
    do not move charge are in the images, except cosmic rays and hot pixels. NISP is in band J.
    """
    n, pitch = 24, 40
    at = pitch * (np.arange(n) + 0.5) + (np.arange(n) + 0.5) / n
    x, y = (axis.ravel() for axis in np.meshgrid(at, at))
    detector = small(camera, "3-4" if camera == "vis" else "DET22", n * pitch)
    if camera == "vis":
        quiet = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE)
        one = nominal.rendered(detector, np.full(len(x), 19.5), x, y, forced=quiet)
        field = put(one, tmp_path)
        with fits.open(extracted(field.path, threshold=5)) as tables:
            found = np.concatenate([np.array([table.data[key] for key in COLUMNS[:2]]) for table in tables[1:]], axis=1)
    else:
        quiet = nominal.off("ramp_cosmic_rays", "dark_map", "persistence")
        one = infrared.rendered(np.full(len(x), 18.0), x, y, detector, forced=quiet, band="euclid_j")
        field = put(one, tmp_path)
        (number,) = (i for i, (header, _) in enumerate(arrays(field.path)) if header["EXTNAME"].endswith("SCI"))
        science = tmp_path / "science.fits"
        # Reference pixels at the border would spoil the background there.
        fits.writeto(science, np.ascontiguousarray(arrays(field.path)[number][1][4:-4, 4:-4]))
        header = said(field.path)[number]
        header["CRPIX1"], header["CRPIX2"] = header["CRPIX1"] - 4.0, header["CRPIX2"] - 4.0
        science.with_suffix(".head").write_text(header.tostring("\n", padding=False) + "\nEND\n")
        with fits.open(extracted(science, threshold=5)) as tables:
            found = np.array([tables[1].data[key] for key in COLUMNS[:2]])
    sky = SkyCoord(*found, unit="deg")
    nearest, distance, _ = field.stars.match_to_catalog_sky(sky)
    assert distance.to_value("arcsec").max() < 0.3
    east, north = (axis.to_value("mas").mean() for axis in field.stars.spherical_offsets_to(sky[nearest]))
    print(camera, "mas to the east and north:", east, north)
    assert max(abs(east), abs(north)) < limit


def test_source_extractor_reads_the_saturation_and_the_gain(vis):
    """No star is flagged as saturated, and flux errors agree with the number of electrons."""
    with fits.open(extracted(vis.path)) as tables:
        row = np.concatenate([np.array(table.data) for table in tables[1:]])
    bright = row[row["FLUX_AUTO"] > 1e4]
    assert len(bright) == STARS
    assert not (bright["FLAGS"] & 4).any()
    electrons = bright["FLUX_AUTO"] * np.mean(vis.one.scene.amplifier_values("gain", "electron / adu"))
    assert bright["FLUX_AUTO"] / bright["FLUXERR_AUTO"] == pytest.approx(np.sqrt(electrons), rel=0.1)


def test_swarp_resamples_the_stars_to_their_positions(vis):
    command, folder = tool("SWarp"), vis.path.parent / "swarp"
    folder.mkdir()
    subprocess.run(
        [command, str(vis.path), "-c", "none", "-COMBINE", "N", "-WRITE_XML", "N", "-VERBOSE_TYPE", "QUIET",
         "-RESAMPLE_DIR", str(folder)],
        cwd=folder, check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    places = []
    for path in sorted(folder.glob("*.resamp.fits")):
        ((header, pixels),) = arrays(path)
        assert header["CTYPE1"] == "RA---TAN"
        places.append(WCS(header).all_pix2world(*measured(pixels), 0))
    assert off(vis, *np.concatenate(places, axis=1)) < 5.0


def reference(path, stars):
    """Write a catalogue of stars in the format of SCAMP."""
    ones = np.ones(len(stars))
    columns = {
        "X_WORLD": ("1D", "deg", stars.ra.deg), "Y_WORLD": ("1D", "deg", stars.dec.deg),
        "ERRA_WORLD": ("1E", "deg", 1e-7 * ones), "ERRB_WORLD": ("1E", "deg", 1e-7 * ones),
        "ERRTHETA_WORLD": ("1E", "deg", 0.0 * ones), "MAG": ("1E", "mag", 19.0 * ones),
        "MAGERR": ("1E", "mag", 0.01 * ones), "OBSDATE": ("1D", "yr", 2025.6 * ones),
    }  # fmt: skip
    table = [fits.Column(key, form, unit=unit, array=values) for key, (form, unit, values) in columns.items()]
    empty = fits.PrimaryHDU().header.tostring()
    header = fits.Column("Field Header Card", f"{len(empty)}A", array=[empty])
    units = [fits.PrimaryHDU(), fits.BinTableHDU.from_columns([header], name="LDAC_IMHEAD")]
    fits.HDUList([*units, fits.BinTableHDU.from_columns(table, name="LDAC_OBJECTS")]).writeto(path)


def test_scamp_finds_no_offsets(vis):
    """Offsets that SCAMP reports with the head file and without a fit."""
    command, folder = tool("scamp"), vis.path.parent
    catalogue = extracted(vis.path, "FITS_LDAC")
    reference(folder / "reference.cat", vis.stars)
    done = subprocess.run(
        [command, catalogue.name, "-c", "none", "-AHEADER_SUFFIX", ".head", "-HEADER_SUFFIX", ".out",
         "-ASTREF_CATALOG", "FILE", "-ASTREFCAT_NAME", "reference.cat", "-MATCH", "N", "-SOLVE_ASTROM", "N",
         "-SOLVE_PHOTOM", "N", "-CENTROID_KEYS", "XWIN_IMAGE,YWIN_IMAGE",
         "-CENTROIDERR_KEYS", "ERRAWIN_IMAGE,ERRBWIN_IMAGE,ERRTHETAWIN_IMAGE",
         "-DISTORT_KEYS", "XWIN_IMAGE,YWIN_IMAGE", "-CHECKPLOT_TYPE", "NONE", "-CROSSID_RADIUS", "1", "-WRITE_XML", "N",
         "-VERBOSE_TYPE", "NORMAL"],
        cwd=folder, check=True, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    external = (done.stdout + done.stderr).split("(external)")[1]
    across, up, _, many = re.search(r"Group +1: ([\d.e+-]+)\" ([\d.e+-]+)\" +([\d.e+-]+) +(\d+)", external).groups()
    assert int(many) == STARS
    assert 1e3 * max(float(across), float(up)) < 5.0


def test_files_follow_the_fits_standard(field):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(field.path, checksum=True) as units:
            units.verify("exception")
    for header in said(field.path):
        assert all(len(str(card)) == 80 for card in header.cards)


def test_fitsverify_finds_no_problems(field):
    done = subprocess.run(
        [tool("fitsverify", "HEASARC"), "-q", str(field.path)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout
    assert "0 warnings and 0 errors" in done.stdout or "OK" in done.stdout


def reduced(path):
    """Return (section of the detector, image in e-) of each amplifier of a raw file, reduced with ccdproc."""
    ccdproc = pytest.importorskip("ccdproc", reason="ccdproc is not installed (extra test)")
    from astropy import units as u

    for number, (header, _) in enumerate(arrays(path), start=1):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            raw = ccdproc.CCDData.read(path, hdu=number if "INHERIT" in header else 0)
        if "NAMPS" not in header:
            if "BIASSEC" in header:
                # The bias section of LSSTCam covers the rows of pixels only.
                rows = Section.from_text(header["BIASSEC"]).slices[0]
                raw = raw[rows] if rows.stop < len(raw.data) else raw
                level = ccdproc.subtract_overscan(raw, fits_section=header["BIASSEC"], overscan_axis=1, median=True)
            else:
                level = raw.subtract(header["BIAS"] * u.adu, handle_meta="first_found")
            trimmed = ccdproc.trim_image(level, fits_section=header["TRIMSEC"])
            yield header["CCDSEC"], ccdproc.gain_correct(trimmed, header["GAIN"] * u.electron / u.adu)
        # All amplifiers of a ground camera are in one array.
        for n in range(1, header.get("NAMPS", 0) + 1):
            pixels, bias = (ccdproc.trim_image(raw, fits_section=header[f"{key}{n}"]) for key in ("DSEC", "BSEC"))
            level = ccdproc.subtract_overscan(pixels, overscan=bias, overscan_axis=1, median=True)
            yield header[f"CSEC{n}"], ccdproc.gain_correct(level, header[f"GAIN{n}"] * u.electron / u.adu)


@nightly.parametrize("camera", ["vis", "decam", "lsstcam", "hsc", "megacam"], (0, 1, 3))
def test_ccdproc_reduces_a_raw_frame_by_its_header(camera, tmp_path):
    """The result is in electrons on the pixels of the detector, and keeps the WCS (not for HSC)."""
    field = written(camera, tmp_path, sky=5.0)
    found, one = np.zeros(field.one.science.shape), field.one
    for text, image in reduced(field.path):
        assert image.unit == "electron"
        place = window(text)
        found[place] = image.data
        if camera == "hsc":
            # The WCS of the raw header is that of the joined pixels, which ccdproc cannot know.
            continue
        x, y = image.wcs.all_world2pix(*one.wcs.all_pix2world([place[1].start + 7.0], [place[0].start + 3.0], 0), 0)
        assert (x[0], y[0]) == pytest.approx((7.0, 3.0), abs=1e-4)
    sky = (one.scene.sky_rate + one.scene.dark_rate) * one.scene.exposure_time_s
    left = found - np.asarray(one.noise_free, float)
    # The amplifiers of VIS are not linear.
    assert np.median(left) == pytest.approx(sky, rel=0.02)
    noise = np.hypot(np.sqrt(sky), np.mean(one.scene.amplifier_values("read_noise", "electron")))
    assert 1.4826 * np.median(np.abs(left - np.median(left))) == pytest.approx(noise, rel=0.1)
