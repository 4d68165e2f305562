"""Test the detection of sources by tiles."""

import subprocess
import tracemalloc

import numpy as np
import pytest
from astropy.io import fits
from scipy.spatial import cKDTree

from tests.truesky.render.products.test_tools import tool
from truesky.reduction import catalogue
from truesky.reduction.calibration import ReducedImage
from truesky.render.camera import astrometry

SIDE, WIDTH, NOISE = 512, 2.0, 10.0


@pytest.fixture(scope="module")
def image():
    """Return stars of one width on a shifted lattice without blends; some are at the edges of tiles."""
    rng = np.random.default_rng(5)
    at = np.stack(np.meshgrid(np.arange(32, SIDE, 64.0), np.arange(32, SIDE, 64.0)), axis=-1).reshape(-1, 2)
    at += rng.uniform(-12.0, 12.0, at.shape)
    light = 10 ** rng.uniform(3.5, 5.5, len(at))
    pixels = np.arange(SIDE)
    shape = [np.exp(-0.5 * ((pixels - place[:, None]) / WIDTH) ** 2) for place in at.T]
    image = np.einsum("n,ny,nx->yx", light / (2 * np.pi * WIDTH**2), shape[1], shape[0])
    image += 100.0 + NOISE * rng.standard_normal(image.shape)
    weight = np.full(image.shape, NOISE**-2, np.float32)
    return ReducedImage(image.astype(np.float32), weight, np.zeros(image.shape, np.uint8)), at, light


def found(image, monkeypatch, tile, beyond):
    monkeypatch.setattr(catalogue, "_TILE", tile)
    monkeypatch.setattr(catalogue, "_TILE_MARGIN", beyond)
    rows = catalogue.detect_sources(image, 1.0, 6.0, catalogue.Limits(threshold=3.0, pixels=9))
    order = np.lexsort((rows["x"], rows["y"]))
    return {name: column[..., order] for name, column in rows.items()}


def test_tiles_find_the_same_sources_as_the_whole_image(image, monkeypatch):
    whole, tiles = (found(image[0], monkeypatch, tile, beyond) for tile, beyond in ((2048, 256), (100, 40)))
    for name, column in whole.items():
        np.testing.assert_allclose(tiles[name], column, rtol=1e-5, atol=1e-5, err_msg=name)


def test_every_star_is_found_once(image, monkeypatch):
    rows = found(image[0], monkeypatch, 100, 40)
    off = np.hypot(rows["xwin"][:, None] - image[1][:, 0], rows["ywin"][:, None] - image[1][:, 1])
    assert len(rows["x"]) == len(image[1])
    assert off.min(axis=0).max() < 0.2


@pytest.mark.parametrize("part", [0.1, 0.35, 0.6, 0.85])
def test_the_level_of_the_sky_is_right_in_whole_numbers_of_adu(part):
    """The sample are 512 x 512 pixels with the noise of VIS; 0.25 electrons are 3 errors of the mean of 50 squares.

    The significance is 0.3 %. With the mode of unsmoothed pixels the error would be up to 3.7 electrons.
    """
    rng, adu = np.random.default_rng(7), 3.48
    true = 133.0 + part * adu
    raw = rng.poisson(true, (512, 512)) + 4.4 * rng.standard_normal((512, 512))
    pixels = (adu * np.rint(raw / adu)).astype(np.float32)
    pixels[250:260, 250:260] += 1000.0
    weight = np.full(pixels.shape, 1.0 / (true + 4.4**2), np.float32)
    weight[:, 100] = 0.0
    image = ReducedImage(pixels, weight, np.zeros(pixels.shape, np.uint8))
    rows, segments = catalogue.detect_segments(image, 1.0, 10.0, catalogue.Limits(threshold=3.0, pixels=9))
    brightest = np.argmax(rows["flux_auto"])
    assert rows["background"][brightest] == pytest.approx(true, abs=0.25)
    assert (segments == brightest + 1).sum() >= 100


def test_noise_is_rarely_detected():
    """The sample is an image of noise with 262,144 pixels; with the threshold of SourceExtractor there are none.

    The significance is beyond 5 sigma: with the matched filter of sep there are 234.
    """
    noise = np.random.default_rng(8).standard_normal((SIDE, SIDE)).astype(np.float32)
    image = ReducedImage(100.0 + NOISE * noise, np.full(noise.shape, NOISE**-2), np.zeros(noise.shape, np.uint8))
    assert len(catalogue.detect_segments(image, 1.0, 6.0, catalogue.Limits())[0]["x"]) < 10


def test_light_of_a_neighbour_does_not_count():
    """A source beside one that is ten times as bright has its own flux, in the aperture of MAG_AUTO and in a circle."""
    y, x = np.mgrid[:SIDE, :SIDE]
    pixels = 100.0 + np.random.default_rng(9).standard_normal((SIDE, SIDE))
    for column, light in ((250.0, 1e4), (268.0, 1e5)):
        pixels += light * np.exp(-0.5 * ((x - column) ** 2 + (y - 256.0) ** 2) / 9.0) / (18.0 * np.pi)
    image = ReducedImage(pixels.astype(np.float32), np.ones((SIDE, SIDE)), np.zeros((SIDE, SIDE), np.uint8))
    rows = catalogue.detect_segments(image, 1.0, 12.0, catalogue.Limits())[0]
    faint = np.argmin(np.hypot(rows["x"] - 250.0, rows["y"] - 256.0))
    for name in ("flux_auto", "flux_aper"):
        assert rows[name][faint] == pytest.approx(1e4, rel=0.15)


def test_errors_of_windowed_positions_are_their_scatter():
    """The sample are 64 stars in 12 images with different noise; the mean squared offset has an error of 4 %."""
    rng, side, found = np.random.default_rng(6), 512, []
    at = np.stack(np.meshgrid(np.arange(32, side, 64.0), np.arange(32, side, 64.0)), axis=-1).reshape(-1, 2)
    at += rng.uniform(-5.0, 5.0, at.shape)
    pixels = np.arange(side)
    x, y = (np.exp(-0.5 * ((pixels - place[:, None]) / WIDTH) ** 2) for place in at.T)
    light = np.einsum("n,ny,nx->yx", np.full(len(at), 2e4) / (2 * np.pi * WIDTH**2), y, x)
    for _ in range(12):
        noisy = rng.poisson(light) + 100.0 + NOISE * rng.standard_normal(light.shape)
        image = ReducedImage(
            noisy.astype(np.float32), np.full(light.shape, NOISE**-2, np.float32), np.zeros(light.shape, np.uint8)
        )
        rows = catalogue.detect_sources(image, 1.0, 6.0, catalogue.Limits(threshold=3.0, pixels=9))
        distance, which = cKDTree(at).query(np.transpose([rows["xwin"], rows["ywin"]]))
        near = distance < 1.0
        off = [rows[name][near] - at[which[near], axis] for axis, name in enumerate(("xwin", "ywin"))]
        found.append(np.stack([off[0] ** 2, off[1] ** 2]) / rows["window_errors"][:2, near])
    assert np.concatenate(found, axis=1).mean() == pytest.approx(1.0, abs=0.12)


def test_a_window_of_the_size_of_the_image_takes_little_memory(monkeypatch):
    """A star that bleeds along all its columns has such a window. Strips of rows have the sums of the whole window."""
    rng, side = np.random.default_rng(3), 400
    maps = (
        rng.uniform(0.0, 9.0, (side, side)).astype(np.float32), np.full((side, side), 2.0, np.float32),
        rng.random((side, side)) < 0.1,
    )  # fmt: skip
    positions, window = (np.array([120.3, 200.0]), np.array([333.3, 17.6])), np.array([90.0, 3.0])
    found = []
    for pixels in (1 << 20, 1 << 14):
        monkeypatch.setattr(catalogue, "_WINDOW_PIXELS", pixels)
        tracemalloc.start()
        found.append(catalogue._window_errors(maps, 2.0, positions, window))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 150 * pixels
    np.testing.assert_allclose(found[1], found[0], rtol=1e-10)
    # The formula for the first star, without strips.
    y, x = np.mgrid[:side, :side]
    dx, dy = x - positions[0][0], y - positions[1][0]
    weight = np.exp(-0.5 * (dx**2 + dy**2) / 90.0**2) * ~maps[2] * (dx**2 + dy**2 <= 360.0**2)
    variance = weight**2 * (4.0 + maps[0].astype(float) / 2.0)
    expected = [4.0 * (variance * term).sum() / (weight * maps[0]).sum() ** 2 for term in (dx**2, dy**2, dx * dy)]
    np.testing.assert_allclose(found[0][:, 0], expected, rtol=1e-6)


def test_errors_of_windowed_positions_are_those_of_source_extractor(image, tmp_path):
    """The program measures the same image; the axes of its error ellipses agree within 5 %."""
    command = tool("source-extractor")
    header = fits.Header(
        {
            "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg", "CRVAL1": 150.0,
            "CRVAL2": 2.0, "CRPIX1": 256.0, "CRPIX2": 256.0, "CD1_1": -5e-5, "CD1_2": 1.5e-5, "CD2_1": 1e-5,
            "CD2_2": 6e-5, "LONPOLE": 180.0, "RADESYS": "ICRS",
        }
    )  # fmt: skip
    fits.writeto(tmp_path / "a.fits", image[0].image, header)
    names = ["XWIN_IMAGE", "YWIN_IMAGE"]
    names += [f"ERR{axis}WIN_{place}" for place in ("IMAGE", "WORLD") for axis in ("A", "B", "THETA")]
    (tmp_path / "names").write_text("\n".join(names))
    (tmp_path / "filter").write_text("CONV NORM\n1 2 1\n2 4 2\n1 2 1\n")
    subprocess.run(
        [command, "a.fits", "-c", "/dev/null", "-PARAMETERS_NAME", "names", "-FILTER_NAME", "filter", "-CATALOG_TYPE",
         "FITS_1.0", "-CATALOG_NAME", "a.cat", "-GAIN", "1.0", "-DETECT_THRESH", "5", "-VERBOSE_TYPE", "QUIET"],
        cwd=tmp_path, check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    theirs = fits.getdata(tmp_path / "a.cat", 1)
    system = astrometry.from_cards(tuple((key, value, "") for key, value in header.items()))
    rows = catalogue.detect_sources(image[0], 1.0, 6.0, catalogue.Limits(threshold=3.0, pixels=9))
    ours = {name: values for name, _, _, values in catalogue.columns(rows, system, 25.0)}
    distance, which = cKDTree(np.transpose([theirs["XWIN_IMAGE"], theirs["YWIN_IMAGE"]])).query(
        np.transpose([ours["XWIN_IMAGE"], ours["YWIN_IMAGE"]])
    )
    near = distance < 0.05
    assert near.sum() > 40
    for name in ("ERRAWIN_IMAGE", "ERRBWIN_IMAGE", "ERRAWIN_WORLD", "ERRBWIN_WORLD"):
        assert np.median(ours[name][near] / theirs[name][which[near]]) == pytest.approx(1.0, abs=0.05)
    long = near & (ours["ERRAWIN_WORLD"] > 1.1 * ours["ERRBWIN_WORLD"])
    assert long.sum() > 20
    turn = ours["ERRTHETAWIN_WORLD"][long] - theirs["ERRTHETAWIN_WORLD"][which[long]]
    assert np.median(np.abs((turn + 90.0) % 180.0 - 90.0)) < 3.0
