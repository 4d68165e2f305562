"""Preview pictures show the image with its labels, north up."""

import numpy as np
import pytest
from matplotlib.image import imread

from tests.truesky.render.exposure.test_render import render
from truesky.render.products import headers, preview, preview_labels
from truesky.render.products.preview_labels import Label


@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_a_picture_is_drawn(channel, tmp_path):
    one = render(channel, flux=30.0)
    s = one.sources
    names = [
        Label(x, y, "galaxy" if shape >= 0 else "star", 20.0 + i, f"{20 + i:.1f}")
        for i, (x, y, shape) in enumerate(zip(s.column, s.row, s.shape, strict=True))
    ]
    path = tmp_path / "pictures" / "a.png"
    preview.picture(path, one.science, headers.science_cards(one), names)
    pixels = imread(path)
    assert pixels.shape == (960, 1320, 4)
    # The picture is neither black nor white, and the overview has structure.
    assert 0.02 < pixels[..., :3].mean() < 0.6
    assert pixels[100:900, 50:900, :3].std() > 0.05
    preview.picture(tmp_path / "b.png", one.science, headers.science_cards(one), names)
    assert (tmp_path / "b.png").read_bytes() == path.read_bytes()


def test_a_picture_without_sources(tmp_path):
    one = render("VIS", flux=0.0)
    preview.picture(tmp_path / "a.png", one.science, headers.science_cards(one), [])
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_stretch():
    rng = np.random.default_rng(1)
    image = rng.normal(1000.0, 5.0, (200, 200))
    image[:3] = 3000.0
    level, noise = preview._sky_and_noise(image)
    assert level == pytest.approx(1000.0, abs=0.5)
    assert noise == pytest.approx(5.0, rel=0.05)
    shown = preview._stretch(np.array([[level - 99, level, level + 20, level + 1e9]]), level, noise)
    assert shown[0, 0] == 0.0
    assert shown[0, 3] == pytest.approx(1.0)
    assert (np.diff(shown[0]) > 0).all()
    assert np.isfinite(preview._stretch(np.zeros((4, 4)), *preview._sky_and_noise(np.zeros((4, 4))))).all()


def test_shrinking_keeps_the_mean():
    image = np.arange(42 * 31, dtype=np.uint16).reshape(42, 31)
    small = preview._shrink(image, 5)
    assert small.shape == (8, 6)
    assert small.mean() == pytest.approx(image[:40, :30].mean())


def test_labels_do_not_overlap():
    names = [Label(float(x), 0.0, "star", float(x), "") for x in range(10)]
    assert [n.column for n in preview_labels.without_overlaps(names, 2.5, 1.0, 4)] == [0.0, 3.0, 6.0, 9.0]
    # The brightest source keeps its label, whatever its kind, and does not count for the other kind.
    galaxy = Label(0.0, 0.5, "galaxy", 9.0, "")
    assert preview_labels.without_overlaps([galaxy, *names], 2.5, 1.0, 2) == [galaxy, names[3], names[6]]


def test_cosmic_rays_are_replaced_by_neighbouring_pixels():
    image = np.add.outer(np.arange(40.0), np.zeros(30))
    hit = np.zeros(image.shape, bool)
    hit[20, 3:25] = hit[0, 0] = True
    spoiled = np.where(hit, 1e5, image)
    mended = preview.repair_cosmic_rays(spoiled, hit)
    np.testing.assert_array_equal(mended[~hit], image[~hit])
    assert np.abs(mended - image).max() <= 1.0
    everything = preview.repair_cosmic_rays(spoiled, np.ones(image.shape, bool))
    np.testing.assert_array_equal(everything, spoiled)


def test_selection_shows_each_channel_and_band_first():
    kinds = [("VIS", "v")] * 4 + [("EXT", "r"), ("EXT", "g"), ("EXT", "r")]
    rows = [{"channel": channel, "band": band, "number": i} for i, (channel, band) in enumerate(kinds)]

    def numbers(most):
        return [row["number"] for row in preview.select_images(rows, most)]

    assert numbers(3) == [0, 4, 5]
    assert numbers(5) == [0, 1, 4, 5, 6]
    assert numbers(None) == numbers(99) == list(range(7))
