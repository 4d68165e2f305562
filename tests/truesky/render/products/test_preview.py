"""Preview pictures show the image with its labels, north up."""

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.image import imread

from tests.truesky import nightly
from tests.truesky.render.exposure.test_render import render
from truesky.render.products import headers, preview, preview_labels
from truesky.render.products.preview_labels import Label


@nightly.parametrize("channel", ["VIS", "EXT"], (1,))
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
    ny, nx = one.science.shape
    # The overview is as high as the picture allows, and has no empty space next to it.
    assert pixels.shape == (960, pytest.approx(893 * nx / ny + 376, abs=2), 4)
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


def spectra_of(boxes):
    """Rows of `rendered_spectra`: for each (id, order, columns, rows) a straight trace between two pixels."""
    rows = [
        {"id": source, "order": order, "trace_x": [x0, x1 - x0], "trace_y": [y0, y1 - y0]}
        for source, order, (x0, x1), (y0, y1) in boxes
    ]
    return pa.Table.from_pylist(rows)


def test_labels_of_a_grism_image_follow_first_orders():
    margin = preview_labels.TRACE_MARGIN
    spectra = spectra_of(
        [(7, 1, (100.0, 600.0), (50.0, 54.0)), (7, 0, (10.0, 20.0), (50.0, 50.0)), (9, 2, (0, 9), (0, 9))]
    )
    boxes = preview_labels._first_orders(spectra)
    assert boxes == {7: (100.0 - margin, 600.0 + margin, 50.0 - margin, 54.0 + margin)}
    column, row = preview_labels._middles(np.array([7, 9]), boxes)
    assert (column[0], row[0]) == (350.0, 52.0)
    assert np.isnan([column[1], row[1]]).all()
    catalogue = pa.table({"id": [7, 9], "z_obs": [1.0, 2.0]})
    (label,) = preview_labels._labels_of("galaxy", catalogue, np.array([1.0, 2.0]), (column, row), (500, 700), boxes)
    assert (label.column, label.row, label.box) == (350.0, 52.0, boxes[7])


@nightly.parametrize("is_vertical", [False, True], (1,))
def test_close_ups_of_traces(is_vertical, tmp_path):
    """A close-up shows the whole trace, and not a square at the position of its source."""
    one = render("VIS", flux=0.0)
    image = np.array(one.science, float)
    ny, nx = image.shape
    length = int(0.8 * min(nx, ny))
    box = (5.0, 29.0, 5.0, 5.0 + length) if is_vertical else (5.0, 5.0 + length, 5.0, 29.0)
    label = Label((box[0] + box[1]) / 2, (box[2] + box[3]) / 2, "galaxy", 20.0, "20.0", box)
    outside = Label(nx - 5.0, 50.0, "galaxy", 19.0, "19.0", (nx - 9.0, nx + 400.0, 40.0, 60.0))
    assert preview_labels.close_ups([outside, label], image.shape, 0.1) == [label]
    drawn = []
    for bright in (False, True):
        if bright:
            # Both ends of the trace are far from its middle.
            image[5:29, 5:29] += 1e5
            image[int(box[3]) - 24 : int(box[3]), int(box[1]) - 24 : int(box[1])] += 1e5
        preview.picture(tmp_path / "a.png", image, headers.science_cards(one), [label])
        drawn.append(imread(tmp_path / "a.png")[..., :3].mean(axis=2))
    # The panel of the close-up is at the upper right; both ends of the trace appear at its ends.
    change = (drawn[1] - drawn[0])[70:340, 905:]
    changed = np.flatnonzero(change.mean(axis=0) > 0.01)
    panel = change[:, changed[0] : changed[-1] + 1]
    assert panel.shape[1] > 200
    along = panel.mean(axis=1) if is_vertical else panel.mean(axis=0)
    assert min(along[5], along[-6]) > 0.1 > along[len(along) // 2]
