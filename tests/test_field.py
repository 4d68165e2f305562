"""A whole field, from a request to FITS images, measured as an astronomer would measure it.

The five jobs run under Spark once per session and request. The tests examine the tables and images that they published.
A small field has one detector of 0.4 megapixels; the field of the demo request, which takes minutes, is for the night.
"""

import hashlib
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import sep
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning
from scipy import ndimage
from scipy.spatial import cKDTree

import truesky
from lake_schema import sky
from lake_schema.mission.configuration import resolve
from lake_schema.store import layout, read
from lake_schema.store.provenance import libraries, machine
from tests import requests
from tests.extremes.test_detector_sizes import write_camera
from tests.truesky.render import calibrated
from tests.truesky.render.exposure.test_render import render as small
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import archive, plan_exposures, render_exposures
from truesky.render.camera import detectors
from truesky.render.channels import registry
from truesky.render.effects.light import pixel_area
from truesky.render.effects.readout import charge_transfer, quadrants
from truesky.render.effects.scene import Scene
from truesky.render.products import preview_labels, read_back
from truesky.render.sources import catalogue_rows
from truesky.request.from_toml import parse
from truesky.running import submitted_job

pytestmark = pytest.mark.spark

RA, DEC = 53.117, -27.808
DEMO = Path(__file__).parents[1] / "requests" / "demo.toml"
DEMO_CHANNELS = ("EXT", "VIS")
JOBS = (build_galaxies.JOB, build_stars.JOB, compute_fluxes.JOB, plan_exposures.JOB, render_exposures.JOB)


@dataclass(frozen=True)
class Image:
    """An image and its truth: sky-subtracted electrons, and sources with 0-based positions and expected electrons.

    `bad` marks pixels that were hit by a cosmic ray, that are saturated or close to saturated ones, or that detect no
    light. `delayed` is the change of the charge by traps, which capture electrons and release them in later pixels.
    Most of it is the charge of cosmic rays. `limit` is the largest signal of the converters in electrons.
    """

    header: fits.Header
    electrons: np.ndarray
    noise_free: np.ndarray
    variance: np.ndarray
    bad: np.ndarray
    delayed: np.ndarray | float
    limit: float
    x: np.ndarray
    y: np.ndarray
    expected: np.ndarray
    is_star: np.ndarray
    pixel_scale: float
    aperture: float
    blend: float


SMALL = f"""
[universe]
galaxy_limit = 22.5
star_limit = 21.0
box_cells = 192
lensing_nside = 64
[mission]
cameras = ["mini"]
[[pointing]]
channel = "EXT"
camera = "mini"
band = "des_r"
ra = {RA}
dec = {DEC}
centre_on = "chip"
mjd = 60905.25
[products]
truth = ["noise_free", "cosmic_rays"]
"""


@dataclass(frozen=True)
class Field:
    """A lake with all tables of a request, and the least number of sources on each of its detectors."""

    root: Path
    request: Path
    channels: tuple[str, ...]
    sources: int


def made(root, path, channels, sources):
    """Run the jobs of a request."""
    for job in JOBS:
        submitted_job.run(job, root, parse(path))
    return Field(root, path, channels, sources)


def make_small_field(folder):
    """Make a field with one detector of 640 x 600 pixels, which is read by two amplifiers."""
    write_camera(folder / "mini", 640, 600)
    amplifiers = folder / "mini" / "amplifiers.csv"
    head, one = amplifiers.read_text().splitlines()
    half = one.replace("A,0,0,640,", "A,0,0,320,")
    amplifiers.write_text("\n".join((head, half, half.replace("A,0,0,320,600,0", "B,320,0,320,600,1"), "")))
    path = requests.written(folder, SMALL, requests.FIELD.format(0.03), name="small", seed=20240401)
    return made(layout.resolve_lake(folder / "lake"), path, ("EXT",), 20)


@pytest.fixture(scope="session")
def demo(spark, tmp_path_factory):
    """The field of the demo request, with a whole detector of VIS and one of LSSTCam."""
    folder = tmp_path_factory.mktemp("field")
    # Ghosts of bright stars are not in the noise-free image, but in that of the detector.
    path, truth = folder / "demo.toml", '"cosmic_rays"]'
    text = DEMO.read_text(encoding="utf-8")
    assert text.count(truth) == 1
    path.write_text(text.replace(truth, '"cosmic_rays", "ghosts"]'), encoding="utf-8")
    # Compile here, so that the memory of the workers does not include the compiler.
    for channel in ("VIS", "EXT"):
        small(channel, forced={effect.name: True for effect in registry.CHANNELS[channel].effects["science"]})
    return made(layout.resolve_lake(folder / "lake"), path, DEMO_CHANNELS, 1000)


@pytest.fixture(scope="session", params=["small", pytest.param("demo", marks=pytest.mark.nightly)])
def either(request, spark, tmp_path_factory):
    """Return one field after the other."""
    if request.param == "demo":
        return request.getfixturevalue("demo")
    return make_small_field(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="session")
def field(demo):
    """Return the root folder of the lake of the demo request."""
    return demo.root


# Of the small field.
SMALL_DIGESTS = {
    "halos": "b5c47ba858fff8a53213a5c9e389efddd5867433a6e2bfd90a3af5cd693b7444",
    "galaxies": "687fee42ac741ad5cfcf8bc76388447f14732736e01a6320a96a881a82f8fa84",
    "stars": "9a32733575d38388edc939bcd158f2ad9d04cca842e6db791e8f7d71abc3090f",
    "galaxy_fluxes": "abcba2119b2a6e020c12942903d2301591382ffd5c20bebbdf7c95db1b2efb85",
    "star_fluxes": "f9df21235aab21a247f81524452b6c3acd781b152897398c46f32ef0b5f7cd09",
}


def published_digests():
    """Return the sha256 of each table from docs/promises.md."""
    text = (Path(__file__).parents[1] / "docs" / "promises.md").read_text(encoding="utf-8")
    return {table: digest for digest, table in re.findall(r"^([0-9a-f]{64})  (\w+)$", text, re.MULTILINE)}


def test_tables_have_the_published_checksums(either):
    """Compare on documented machines with the pinned packages; on others, last bits may differ."""
    pins = (Path(__file__).parents[1] / "requirements" / "run.txt").read_text(encoding="utf-8")
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+) ", pins, re.MULTILINE))
    # PyPI regards `dust_extinction` and `dust-extinction` as one name; the pins have the second form.
    versions = {name.lower().replace("_", "-"): value for name, value in libraries().items() if name != "python"}
    assert set(versions) <= set(pinned)
    others = [name for name, value in versions.items() if pinned[name] != value]
    if machine() != "x86-64-v3 glibc 2.36" or others:
        pytest.skip(f"computed on {machine()} with other versions than the pinned ones: {others}")
    expected, found = published_digests() if either.channels == DEMO_CHANNELS else SMALL_DIGESTS, {}
    for table in published_digests():
        folder = read.version(either.root, table).folder / table / "dataset"
        content = b"".join(path.read_bytes() for path in sorted(folder.glob("Norder=*/Dir=*/Npix=*.parquet")))
        found[table] = hashlib.sha256(content).hexdigest()
    assert len(found) == 5
    assert found == expected, "where a change of the results is intended, update docs/promises.md and SMALL_DIGESTS"


def test_python_reads_images_and_truth(either):
    with truesky.open(either.root) as lake:
        images = lake.images()
        assert sorted(images["channel"]) == list(either.channels)
        assert all((either.root / file).is_file() for file in images["file"])
        first = images.iloc[0]
        stored, electrons = lake.image(first["path"]), lake.image(first["path"], electrons=True)
        assert stored.data.shape == electrons.data.shape
        assert 0 < np.median(electrons.data) < np.median(stored.data)
        # Amplifiers of the cameras of the demo have an extension each; the small one is written as one image.
        assert (len(lake.extensions(first["path"])) > 1) == (either.channels == DEMO_CHANNELS)
        truth = lake.truth(first["exposure_id"], first["detector"])
        # The WCS counts from the pixels that `image` returns. Galaxies do not move, as stars do.
        found = truth.merge(lake.table("galaxies", ["id", "ra", "dec"]), on="id")
        x, y = lake.wcs(first["path"]).all_world2pix(found["ra"], found["dec"], 0)
        assert len(found) > either.sources // 10
        assert np.abs(x - found["x"]).max() < 1e-3
        assert np.abs(y - found["y"]).max() < 1e-3
        with pytest.raises(truesky.BadInput, match="is no image of spectra"):
            lake.models(first["exposure_id"], first["detector"])
        assert len(truth) > either.sources
        assert set(truth["detector"]) == {first["detector"]}
        with pytest.raises(truesky.BadInput, match="nothing was rendered for detector 9-9"):
            lake.truth(1, "9-9")
        near = lake.cone("galaxies", RA, DEC, 0.02, ["id", "ra", "dec"])
        assert len(near) > either.sources // 10
        assert sky.separation(near["ra"].to_numpy(), near["dec"].to_numpy(), RA, DEC).max() <= 0.02


def test_python_runs_a_request_and_reuses_tables(either):
    before = {path.name for path in either.root.glob("*/v-*")}
    with truesky.run(either.request, either.root) as lake:
        assert lake.sql("SELECT count(*) AS n FROM tasks")["n"].tolist() == [len(either.channels)]
    assert {path.name for path in either.root.glob("*/v-*")} == before


def product(field, channel, content):
    products = read.version(field, "products")
    for row in products.rows().to_pylist():
        if row["channel"] == channel and row["content"] == content:
            return products.sidecar_path(row["path"])
    raise AssertionError(f"no {content} product of {channel}")


@pytest.fixture(scope="session", params=["VIS", "EXT"])
def image(request, field):
    channel = request.param
    path = product(field, channel, "science")
    # Header of the pixels, without prescan and overscan.
    header = fits.Header(card for card in read_back.frame(path).cards)
    noise_free = fits.getdata(product(field, channel, "noise_free")).astype(float)
    diffuse = diffuse_electrons(header)
    ghosts = fits.getdata(product(field, channel, "ghosts")).astype(float)
    electrons = calibrated_electrons(path, header) - diffuse - ghosts
    charge, delayed = fits.getdata(product(field, channel, "cosmic_rays")), 0.0
    gain, read_noise, saturated = amplifier_cards(path, "GAIN", "RDNOISE", "SATURATE")
    # Charge that bled lies where the truth has no sources.
    hit = (charge > 0) | ndimage.binary_dilation(read_back.frame(path).data >= saturated.min(), iterations=3)
    if channel == "VIS":
        held = np.minimum(noise_free + charge, 2e5) + diffuse
        delayed = trailed(held, header) - held
        # The rows of charge injection between the halves detect no light.
        rows = int(header["INJROWS"])
        hit[(len(hit) - rows) // 2 : (len(hit) + rows) // 2] = True
    # Amplifiers of a CCD differ by a few per cent of the variance of the readout, which is a tenth of that of the sky.
    variance = noise_free + diffuse + np.mean(read_noise**2) + np.mean(gain**2) / 12
    x, y, expected, is_star = sources(field, header)
    vis = channel == "VIS"
    return Image(
        header, np.where(np.isfinite(electrons), electrons, 0.0), noise_free, variance,
        hit | ~np.isfinite(electrons), delayed, 65000.0 * gain.min(), x, y, expected, is_star,
        pixel_scale=0.1 if vis else 0.2,
        aperture=1.3 if vis else 2.0,
        blend=2.0 if vis else 4.0,
    )  # fmt: skip


def amplifier_cards(path, *names):
    """Return the values of header cards for all amplifiers of a frame."""
    with fits.open(path) as units:
        headers = [unit.header for unit in units]
    return [np.array([header[name] for header in headers if name in header]) for name in names]


def scene_of(header):
    mission = resolve()
    camera = "vis" if header["CHANNEL"] == "VIS" else "lsstcam"
    detector = detectors.detector(camera, header["DETECTOR"], mission)
    return Scene(mission, detector.section, header["EXPTIME"], header["SKYRATE"], 0.0, detector, mjd=header["MJD-OBS"])


def trailed(expected, header):
    """Return expected charge after capture and release by traps, which delay charge but lose none."""
    scene = scene_of(header)
    sizes = quadrants.overscan_sizes(scene)
    charge = quadrants.apply(expected, *sizes)
    for effect in (charge_transfer.PARALLEL, charge_transfer.SERIAL):
        charge = effect.apply(charge, *effect.parameters(scene))
    return quadrants.assemble(charge, *sizes)


def calibrated_electrons(path, header):
    """Return the electrons of a perfectly calibrated image."""
    scene = scene_of(header)
    with fits.open(path) as units:
        if scene.layout is not None:
            raw = scene.layout.split(np.asarray(read_back.frame(path).data))
        else:
            raw = np.stack(
                [
                    quadrants.to_detector_axes(units[f"{header['DETECTOR']}.{name}"].data.astype(np.uint16), i)
                    for i, name in enumerate(quadrants.NAMES)
                ]
            )
    return calibrated.electrons(raw, scene, int(header["SEED"]), applied(header))


def applied(header):
    """Return the names of the effects applied to an image."""
    states = [header[key].split(":") for key in header if key.startswith("EFFECT")]
    return {name for name, state in states if state.split(",")[0].split()[0] == "on"}


def diffuse_electrons(header):
    """Return the electrons of sky, by pixel area, and dark current in every pixel. SKYRATE is the mean of the sky."""
    sky, dark = (header[key] * header["EXPTIME"] for key in ("SKYRATE", "DARKRATE"))
    if "pixel_area" not in applied(header):
        return sky + dark
    scene = scene_of(header)
    by_area = pixel_area.apply(np.full((scene.ny, scene.nx), sky), *pixel_area.parameters(scene))
    return by_area * (sky / by_area.mean()) + dark


def sources(field, header):
    """Return positions and expected electrons of all sources on the detector, from catalogues and flux tables only."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)  # astropy adds DATE-OBS to its own copy
        system = WCS(header)
    found = []
    for catalogue, fluxes in (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes")):
        motion = ["pm_ra", "pm_dec"] if catalogue == "stars" else []
        middle = header["MJD-OBS"] + 0.5 * header["EXPTIME"] / 86400.0
        where = catalogue_rows.apply_proper_motion(read.version(field, catalogue).rows(["ra", "dec", *motion]), middle)
        flux = read.version(field, fluxes).rows([f"f_nu_{header['BAND']}"])
        x, y = system.all_world2pix(where["ra"].to_numpy(), where["dec"].to_numpy(), 0)
        microjansky = flux.column(0).to_numpy().astype(float)
        electrons = microjansky / 3631e6 * 10 ** (0.4 * header["ZEROPNT"]) * header["EXPTIME"]
        nx, ny = (4096, 4136) if header["CHANNEL"] == "VIS" else (4096, 4004)
        inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
        found.append((x[inside], y[inside], electrons[inside], np.full(inside.sum(), catalogue == "stars")))
    return (np.concatenate(column) for column in zip(*found, strict=True))


@pytest.fixture(scope="session")
def photometry(image):
    """Return aperture sums of isolated sources away from the edge: (index, measured, noise-free, predicted noise)."""
    radius = image.aperture / 2 / image.pixel_scale
    points = np.stack([image.x, image.y], 1)
    tree = cKDTree(points)
    alone = np.ones(len(points), bool)
    for i, j in tree.query_pairs(image.blend / image.pixel_scale):
        # A neighbour spoils a source unless it is more than two magnitudes fainter.
        alone[i] &= image.expected[j] < image.expected[i] * 10**-0.8
        alone[j] &= image.expected[i] < image.expected[j] * 10**-0.8
    ny, nx = image.electrons.shape
    edge = 2 * radius
    alone &= (image.x > edge) & (image.x < nx - edge) & (image.y > edge) & (image.y < ny - edge)
    # A cosmic ray in the aperture is not an error of the photometry.
    hits = sep.sum_circle(image.bad.astype(float), image.x, image.y, radius, subpix=0)[0]
    index = np.flatnonzero(alone & (hits == 0))

    def aperture(data):
        # Whole pixels: a part f of a pixel has f times its noise, but a sum of variances would give sqrt(f) times it.
        return sep.sum_circle(np.ascontiguousarray(data), image.x[index], image.y[index], radius, subpix=1)[0]

    noise = np.sqrt(aperture(image.variance))
    return index, aperture(image.electrons), aperture(image.noise_free), noise


@pytest.mark.nightly
def test_forecast_agrees_with_measured_costs(field):
    """Memory and size of every detector agree within 30 %; time depends on the load of the machine."""
    rows, tasks = archive.products(field).to_pylist(), read.version(field, "tasks").rows().to_pylist()
    assert len(tasks) == 2
    for task in tasks:
        own = [row for row in rows if row["detector"] == task["detector"]]
        assert task["bytes"] == pytest.approx(sum(row["bytes"] for row in own), rel=0.05)
        assert task["memory"] == pytest.approx(own[0]["peak_gb"], rel=0.3)


@pytest.mark.nightly
def test_bright_unblended_sources_are_found(image, photometry):
    index, _, truth, noise = photometry
    bright = index[truth > 10 * noise]
    assert len(bright) > 300
    sigma = float(np.sqrt(np.median(image.variance)))
    background = sep.Background(image.electrons, mask=image.bad, bw=128, bh=128).back()
    data = image.electrons - background
    objects = sep.extract(
        data, 1.5, err=sigma, mask=image.bad, minarea=5, deblend_cont=0.001, deblend_nthresh=64
    )  # fmt: skip
    # Windowed positions, like XWIN_IMAGE of SExtractor: the errors of isophotal barycentres are a third larger.
    width = 1.5 * image.header["PSFFWHM"] / 2.355 / image.pixel_scale
    x, y, _ = sep.winpos(data, objects["x"], objects["y"], width)
    distance, which = cKDTree(np.stack([x, y], 1)).query(np.stack([image.x[bright], image.y[bright]], 1))
    found = distance * image.pixel_scale < 0.25 * image.aperture
    assert found.mean() >= 0.9
    # Errors of positions grow with the PSF, and are larger for galaxies, which VIS resolves.
    fwhm = image.header["PSFFWHM"]
    assert np.median(distance[found]) * image.pixel_scale < max(0.02, 0.05 * fwhm)
    assert abs(np.median((x[which] - image.x[bright])[found])) < 0.15
    assert abs(np.median((y[which] - image.y[bright])[found])) < 0.15


@pytest.mark.nightly
def test_photometry_and_its_noise_agree_with_prediction(image, photometry):
    _, measured, truth, noise = photometry
    bright = truth > 10 * noise
    # A saturated source has lost the charge above the limit of the converter.
    peaks = image.noise_free[np.rint(image.y[photometry[0]]).astype(int), np.rint(image.x[photometry[0]]).astype(int)]
    use = bright & (peaks < 0.5 * image.limit)
    dm = -2.5 * np.log10(measured[use] / truth[use])
    assert abs(np.median(dm)) < 0.01
    pull = (measured[use] - truth[use]) / noise[use]
    spread = (np.percentile(pull, 84) - np.percentile(pull, 16)) / 2
    assert 0.9 < spread < 1.3


@pytest.mark.nightly
def test_frame_contains_the_light_of_its_sources(image):
    """The total light agrees, up to the wings that cross the edges of the detector."""
    assert image.noise_free.sum() == pytest.approx(image.expected.sum(), rel=0.02)
    assert image.noise_free.min() > -1e-3 * np.sqrt(np.median(image.variance))


@pytest.mark.nightly
def test_background_agrees_with_prediction(image):
    """The sample is at least a fifth of the pixels; its mean agrees within 5 standard errors (significance 6e-7)."""
    empty = (image.noise_free < 0.05 * np.sqrt(image.variance)) & ~image.bad
    assert empty.mean() > 0.2
    pixels = (image.electrons - image.noise_free - image.delayed)[empty]
    noise = np.sqrt(image.variance[empty].mean())
    assert abs(pixels.mean()) < 5 * noise / np.sqrt(empty.sum())
    assert pixels.std() == pytest.approx(noise, rel=0.005)


@pytest.mark.parametrize("content", ["science", "noise_free"])
def test_files_are_valid_fits(either, content):
    for channel in either.channels:
        path = product(either.root, channel, content)
        with fits.open(path, checksum=True) as hdus:
            hdus.verify("exception")
            for hdu in hdus:
                assert hdu.verify_checksum() == hdu.verify_datasum() == 1
        header = fits.getheader(path)
        for key in ("EXPTIME", "BUNIT", "SEED", "MISSION", "CTYPE1", "CD1_1", "MJD-OBS", "TRUESKY"):
            assert key in header, key


@pytest.mark.nightly
@pytest.mark.parametrize("content", ["science", "noise_free"])
def test_images_of_vis_have_the_size_of_the_detector(field, content):
    with fits.open(product(field, "VIS", content)) as hdus:
        if content == "noise_free":
            assert hdus[0].shape == (4136, 4096)
        else:
            assert [hdu.shape for hdu in hdus[1:]] == [(2086, 2128)] * 4


@pytest.mark.nightly
def test_preview_labels_the_brightest_sources(field, image):
    channel = image.header["CHANNEL"]
    products = read.version(field, "products").rows().to_pylist()
    (row,) = (row for row in products if (row["channel"], row["content"]) == (channel, "science"))
    made_of = read.version(field, "products").manifest["facts"]["inputs"]
    names = preview_labels.labels(field, row, read_back.electrons(product(field, channel, "science")), made_of)
    for kind in ("galaxy", "star"):
        flux = np.sort(image.expected[image.is_star == (kind == "star")])[-16:] / image.header["EXPTIME"]
        brightest = image.header["ZEROPNT"] - 2.5 * np.log10(flux[::-1])
        assert [label.mag for label in names if label.kind == kind][:16] == pytest.approx(list(brightest), abs=1e-3)


def test_other_tools_can_open_the_lake(either):
    import lsdb

    galaxies = read.version(either.root, "galaxies")
    catalogue = lsdb.open_catalog(str(layout.current_link(either.root, "galaxies")))
    found = catalogue.cone_search(RA, DEC, 60.0).compute()
    everything = galaxies.rows(["ra", "dec"])
    near = sky.separation(RA, DEC, everything["ra"].to_numpy(), everything["dec"].to_numpy()) < 60 / 3600
    assert len(found) == near.sum() > either.sources // 10


def test_fluxes_have_the_cells_of_their_catalogues(either):
    for catalogue, fluxes in (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes")):
        left, right = read.version(either.root, catalogue), read.version(either.root, fluxes)
        assert left.partitions == right.partitions
        assert left.rows(["id"]).equals(right.rows(["id"]))


def test_every_table_is_valid(either):
    names = read.table_names(either.root)
    assert {"galaxies", "galaxy_fluxes", "stars", "products", "rendered_truth"} <= set(names)
    for name in names:
        assert read.find_faults(read.version(either.root, name), deep=True) == []


@pytest.mark.nightly
def test_demo_covers_only_cells_of_its_detectors(field):
    tasks = read.version(field, "tasks").rows(["cells"])["cells"].to_pylist()
    touched = sorted({cell for cells in tasks for cell in cells})
    drawn = parse(DEMO).area.cells()
    assert set(touched) <= set(drawn)
    assert len(drawn) * sky.cell_area(8) <= 0.6


@pytest.mark.nightly
def test_galaxy_counts_agree_with_observations(field):
    """102 galaxies per arcmin2 with I_E < 26, as in deep surveys and the Flagship mock, within 15 %."""
    area = len(parse(DEMO).area.cells()) * sky.cell_area(8) * 3600
    galaxies = read.version(field, "galaxies")
    assert galaxies.num_rows / area == pytest.approx(102, rel=0.15)
    flux = read.version(field, "galaxy_fluxes").rows(["f_nu_euclid_vis"]).column(0).to_numpy()
    a_v = galaxies.rows(["a_v"]).column(0).to_numpy()
    unreddened = flux * 10 ** (0.4 * 2.27 / 3.1 * a_v)
    assert (unreddened > 3631e6 * 10 ** (-0.4 * 24.5)).sum() / area == pytest.approx(31, rel=0.15)
