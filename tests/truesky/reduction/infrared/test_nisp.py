"""Compare NISP masters and calibrated images of rendered frames of a lake with the truth."""

import shutil

import numpy as np
import pytest
from scipy import ndimage

from lake_schema.fits import images
from lake_schema.store import layout, publish, read
from tests import requests
from tests.truesky.render.test_render_exposures_calibration import small_detectors
from tests.truesky.render.test_render_exposures_infrared import MODULES
from truesky.randomness.rng import stream
from truesky.reduction import calibration, files, masters, reduce
from truesky.reduction import frames as lake_frames
from truesky.render.effects.charge import dark_map, ramp_nonlinearity
from truesky.render.effects.effect import Effect
from truesky.request.from_toml import parse

SEED, BLOCK = 3, 64
# Number of darks of the small lake.
DARKS = 6
OBSERVATION = """
[[observation]]
channels = ["NISP-P"]
detectors = ["DET22"]
"""
REQUEST = f"""
accuracy = "draft"
{{sources}}
[products]
truth = ["noise_free", "sky", "persistence"]
[effects]
off = ["ramp_cosmic_rays", "drift"]
{OBSERVATION}
ra = 53.117
dec = -27.808
bands = ["euclid_j"]
{OBSERVATION}
image_type = "dark"
bands = ["euclid_j"]
exposures = {{darks}}
{OBSERVATION}
image_type = "flat"
bands = ["euclid_j"]
exposures = {{flats}}
intensities = [0.2, 0.5, 1.0, 2.0]
"""


STARS = """
[sources]
only = "table"
band = "euclid_j"
stars = "stars.csv"
"""


def build(folder, side, darks, flats, sources=STARS):
    """Make a field in four dithers with calibration frames, their masters and calibrated images."""
    root = layout.resolve_lake(folder / "lake")
    text = REQUEST.format(darks=darks, flats=flats, sources=sources)
    (folder / "stars.csv").write_text("ra,dec,mag\n53.117,-27.808,17.0\n53.119,-27.807,20.0\n")
    wanted = parse(requests.written(folder, text, requests.FIELD.format(0.5), seed=SEED))
    with small_detectors(side):
        for module in MODULES:
            for step in module.steps(root, wanted):
                publish.make_version(root, step.plan, step.run_task)
        assert masters.main(["--lake", str(root), "--out", str(folder / "masters")]) == 0
        call = ["--lake", str(root), "--masters", str(folder / "masters"), "--out", str(folder / "images")]
        assert reduce.main(call) == 0
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return build(tmp_path_factory.mktemp("infrared"), 192, DARKS, 3)


def master(made, name):
    return [unit.data for unit in images.read_images(made / "masters" / name)[1:3]]


def residuals(made):
    """Yield (calibrated - truth, NaN at sources and flags; weight; sky in the truth) of each science frame."""
    products = read.version(layout.resolve_lake(made / "lake"), "products")
    for row in products.rows().to_pylist():
        found = list((made / "images").glob(f"{row['exposure_id']:06d}_*.fits"))
        if row["content"] != "noise_free" or not found:
            continue
        image = files.read_image(found[0]).reduced
        light = images.read_images(products.sidecar_path(row["path"]))[0].data
        sky = images.read_images(products.sidecar_path(row["path"].replace("noise_free", "sky")))[0].data
        good = (image.weight > 0.0) & ~ndimage.binary_dilation(light > 2.0, iterations=5)
        if good.mean() > 0.5:
            yield np.where(good, image.image - light - sky, np.nan), image.weight, sky


def check(made):
    """In the mean of the dithers, blocks of 64 pixels agree with the sky within 0.3 %; weight times variance is 1."""
    found = list(residuals(made))
    assert len(found) >= 3

    def blocks(values):
        ny, nx = (n // BLOCK for n in values.shape)
        each = values[: ny * BLOCK, : nx * BLOCK].reshape(ny, BLOCK, nx, BLOCK)
        enough = np.isfinite(each).mean(axis=(1, 3)) >= 0.75
        return np.where(enough, np.nanmean(each, axis=(1, 3)), np.nan)

    left = np.nanmean([blocks(residual) / blocks(sky) for residual, _, sky in found], axis=0)
    product = [np.nanmean(residual**2 * weight) for residual, weight, _ in found]
    print(f"blocks: mean {np.nanmean(left):.5f}, rms {np.nanstd(left):.5f}, largest {np.nanmax(np.abs(left)):.5f}")
    print(f"weight times variance {product}")
    assert np.nanmax(np.abs(left)) <= 0.003
    assert np.mean(product) == pytest.approx(1.0, abs=0.02)


def test_the_sky_comes_back_and_its_weight_is_its_inverse_variance(made):
    check(made)


@pytest.mark.nightly
def test_a_quarter_of_a_detector(tmp_path):
    check(build(tmp_path, 1024, 12, 3, requests.shallow(19.0, 19.0) + '[fluxes]\nbands = ["euclid_j"]\n'))


def test_masters_agree_with_the_detector(made):
    root = layout.resolve_lake(made / "lake")
    with small_detectors(192):
        (own,) = lake_frames.from_lake(root).values()
    scene = own[0].scene
    dark, error = master(made, "NISP-P_4-16-4_DET22_dark.fits")
    assert np.median(dark) == pytest.approx(0.02, abs=2e-3)
    # Single frames have 7 e- less the drift, in 87 s.
    assert np.median(error) == pytest.approx(4.9 / np.sqrt(DARKS) / 87.24, rel=0.1)
    flags = calibration.dark_flags(frames_of_master(dark, error))
    assert 0 < (flags == calibration.HOT).sum() < 0.01 * dark.size
    flat, _ = master(made, "NISP-P_euclid_j_DET22_flat.fits")
    assert np.median(flat) == pytest.approx(1.0, abs=2e-3)
    assert 1.4826 * np.median(np.abs(flat - np.median(flat))) == pytest.approx(0.022, abs=0.003)
    # b of each pixel, as it was drawn.
    b, error = master(made, "NISP_DET22_linearity.fits")
    numbers = own_numbers(ramp_nonlinearity.EFFECT)
    drawn = ramp_nonlinearity.apply(np.zeros(b.shape), *ramp_nonlinearity.EFFECT.parameters(scene), rng=numbers)[3]
    assert np.median(b) == pytest.approx(6e-7, rel=0.03)
    pull = (b - drawn) / error
    assert np.std(pull) == pytest.approx(1.0, abs=0.25)
    assert np.corrcoef(b.ravel(), drawn.ravel())[0, 1] > 0.4


def own_numbers(effect: Effect):
    return stream(SEED, "nisp", "DET22", effect.name)


def frames_of_master(mean, error):
    return calibration.CombinedFrame(mean, error, np.ones(mean.shape, np.int16))


def test_the_bad_pixel_map_flags_hot_pixels_also_without_a_dark(made, tmp_path):
    """Hot pixels above 10 times the noise of an image are in the map, and no calibrated image shows them unflagged.

    The dark current of each pixel is drawn as the renderer draws it. A mean of 1e-3 of the pixels are hot (Kubik et al.
    2025 allow 2e-3 bad ones), with an exponential distribution of mean 5 e-/s in 87.2 s: exp(-70 / 436) of them have
    more than 10 x 7 e-, 31 +- 6 of 192 x 192 pixels.
    """
    name = "NISP_DET22_bad_pixels.fits"
    units = images.read_images(made / "masters" / name)
    header = {key: value for key, value, _ in units[0].cards}
    bits = np.asarray(units[1].data)
    assert (header["IMAGETYP"], header["FLAG4"], bits.dtype) == ("master bad_pixels", "hot pixel", np.uint8)
    with small_detectors(192):
        (own,) = lake_frames.from_lake(layout.resolve_lake(made / "lake")).values()
    drawn = dark_map.EFFECT.apply(
        np.zeros(bits.shape), *dark_map.EFFECT.parameters(own[0].scene), rng=own_numbers(dark_map.EFFECT)
    )
    hot = drawn > 10.0 * 7.0
    assert 13 <= hot.sum() <= 55
    assert (bits[hot] & calibration.HOT).all()
    assert (bits > 0).mean() < 0.01
    path = sorted((made / "images").iterdir())[0]
    call = [
        "--lake",
        str(made / "lake"),
        "--exposures",
        str(int(path.name[:6])),
        "--without",
        "dark",
        "flat",
        "linearity",
    ]
    (tmp_path / "map").mkdir()
    shutil.copy(made / "masters" / name, tmp_path / "map")
    with small_detectors(192):
        assert reduce.main([*call, "--masters", str(tmp_path / "map"), "--out", str(tmp_path / "out")]) == 0
    for file in (path, tmp_path / "out" / path.name):
        reduced = files.read_image(file).reduced
        assert (reduced.flags[hot] & calibration.HOT).all()
        assert not reduced.weight[hot].any()


def test_header_of_a_calibrated_image(made):
    found = files.read_image(sorted((made / "images").iterdir())[0])
    assert (found.card("CALDARK"), found.card("CALLINEA"), found.card("CALFLAT")) == (True, True, True)
    assert (found.card("CALPERS"), found.card("BUNIT")) == (True, "electron")
    header = {
        key: value
        for key, value, _ in images.read_images(made / "masters" / "NISP-P_euclid_j_DET22_flat.fits")[0].cards
    }
    assert {header["LAMP1"], header["LAMP2"]} == {2, 3}
    assert header["WEIGHT1"] + header["WEIGHT2"] == pytest.approx(1.0)


def test_persistence_of_a_single_frame_is_predicted_or_kept(made, tmp_path):
    """Persistence is predicted from all frames in the lake; without the correction, the image contains more charge."""
    path = sorted((made / "images").iterdir())[-1]
    call = ["--lake", str(made / "lake"), "--masters", str(made / "masters"), "--exposures", str(int(path.name[:6]))]
    with small_detectors(192):
        assert reduce.main([*call, "--out", str(tmp_path / "alone")]) == 0
        assert reduce.main([*call, "--out", str(tmp_path / "left"), "--without", "persistence"]) == 0
    usual, alone, left = (
        files.read_image(folder / path.name) for folder in (made / "images", tmp_path / "alone", tmp_path / "left")
    )
    np.testing.assert_array_equal(usual.reduced.image, alone.reduced.image)
    assert left.card("CALPERS") is False
    assert 0.05 < np.median(left.reduced.image - usual.reduced.image) < 3.0


def test_message_names_what_is_missing(made, tmp_path, capsys):
    call = ["--lake", str(made / "lake"), "--out", str(tmp_path / "out")]
    with small_detectors(192):
        assert reduce.main(call) == 2
        assert "--masters FOLDER is required, or --without dark linearity flat" in capsys.readouterr().err
        assert reduce.main([*call, "--masters", str(tmp_path)]) == 2
        assert "NISP-P_4-16-4_DET22_dark.fits" in capsys.readouterr().err
