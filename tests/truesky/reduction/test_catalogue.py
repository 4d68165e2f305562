"""Test the detection of sources by tiles."""

import numpy as np
import pytest

from truesky.reduction import catalogue
from truesky.reduction.calibration import ReducedImage

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
