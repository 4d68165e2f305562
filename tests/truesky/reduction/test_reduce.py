"""Test masters and calibrated images of rendered frames of a lake."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from lake_schema import mission
from lake_schema.fits import images
from lake_schema.store import layout, read
from tests.truesky.reduction import lakes
from tests.truesky.render.test_render_exposures_calibration import small_detectors
from truesky.reduction import calibration, files, masters, reduce, stack

BLOCK = 64
GAINS = {
    "vis.gain.E": {"value": 3.0, "unit": "electron / adu"},
    "vis.gain@3-4.H": {"value": 4.0, "unit": "electron / adu"},
}
# Pixels of the quadrants of a detector of 256 columns.
QUADRANTS = {
    "E": np.s_[:128, :128], "F": np.s_[:128, 128:], "G": np.s_[132:, 128:], "H": np.s_[132:, :128],
}  # fmt: skip
TABLE = Path(mission.__file__).parent / "models" / "amplifier_values_vis.csv"


def table_value(key, quadrant, nominal):
    """Return a number of a quadrant of 3-4: that of the camera, times the quadrant's number over the table's median."""
    with TABLE.open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    (own,) = (float(row[key]) for row in rows if (row["detector"], row["amplifier"]) == ("3-4", quadrant))
    return nominal * own / np.median([float(row[key]) for row in rows])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return build(tmp_path_factory.mktemp("reduced"), 256, bias=5, dark=2, flat=1)


def build(folder, side, **counts):
    """Make a lake without cosmic rays, with different gains of the amplifiers, its masters and calibrated images."""
    root = layout.resolve_lake(folder / "lake")
    lakes.make(root, lakes.request(off=lakes.RAYS_OFF, overrides=GAINS, depth=(17.0, 12.0), **counts), side)
    with small_detectors(side):
        assert masters.main(["--lake", str(root), "--out", str(folder / "masters")]) == 0
        call = ["--lake", str(root), "--masters", str(folder / "masters"), "--out", str(folder / "images")]
        assert reduce.main(call) == 0
    return folder


def residuals(folder):
    """Yield (calibrated - truth, NaN at sources and flags; weight; sky in the truth) of each science frame."""
    products = read.version(layout.resolve_lake(folder / "lake"), "products")
    for row in products.rows().to_pylist():
        path = folder / "images" / f"{row['exposure_id']:06d}_VIS_euclid_vis_3-4.fits"
        if row["content"] == "noise_free" and path.exists():
            found = files.read_image(path).reduced
            light = images.read_images(products.sidecar_path(row["path"]))[0].data
            sky = images.read_images(products.sidecar_path(row["path"].replace("noise_free", "sky")))[0].data
            good = (found.flags == 0) & ~ndimage.binary_dilation(light > 2.0, iterations=5)
            if good.mean() < 0.5:
                # A bright star fills the frame.
                continue
            yield np.where(good, found.image - light - sky, np.nan), found.weight, sky


def blocks(values):
    """Return means of blocks of 64 pixels, NaN if less than 3/4 of a block is sky; omit the rows between the halves."""
    half = (len(values) - 4) // 2
    kept = np.concatenate([values[:half], values[half + 4 :]])
    ny, nx = (n // BLOCK for n in kept.shape)
    each = kept[: ny * BLOCK, : nx * BLOCK].reshape(ny, BLOCK, nx, BLOCK)
    enough = np.isfinite(each).mean(axis=(1, 3)) >= 0.75
    return np.where(enough, np.nansum(each, axis=(1, 3)) / np.isfinite(each).sum(axis=(1, 3)).clip(1), np.nan)


def check(folder, within=1.0):
    """In the mean of the dithers, blocks of 64 pixels agree with the sky within 0.3 %; weight times variance is 1.

    At least the fraction `within` of the blocks must agree.
    """
    found = list(residuals(folder))
    assert len(found) >= 3
    left = np.mean([blocks(residual) / blocks(sky) for residual, _, sky in found], axis=0)
    # Fraction of blocks with sky in every dither.
    assert np.isfinite(left).mean() > 0.7
    left = left[np.isfinite(left)]
    product = [np.nanmean(residual**2 * weight) for residual, weight, _ in found]
    print(f"blocks: mean {left.mean():.5f}, rms {left.std():.5f}, largest {np.abs(left).max():.5f}; {product}")
    assert np.mean(np.abs(left) <= 0.003) >= within
    assert left.std() <= 0.0012
    assert np.mean(product) == pytest.approx(1.0, abs=0.02)


def test_the_sky_comes_back_and_its_weight_is_its_inverse_variance(made):
    check(made)


# Readers require a name: see tests/lake_schema/store/test_request_links.py.
@pytest.mark.nightly
def test_request_is_selected_by_name(tmp_path, capsys):
    """The two requests have different numbers of bias frames, two and three."""
    root, side = layout.resolve_lake(tmp_path / "lake"), 64
    for name, count in (("a", 2), ("b", 3)):
        wanted = lakes.request(off=["all"], truth=(), bias=count, dark=0, flat=0, depth=(16.0, 10.0), dither="none")
        lakes.make(root, replace(wanted, name=name), side, name)
    masters_of, images_of = (["--lake", str(root), "--out", str(tmp_path / name)] for name in ("masters", "images"))
    without = ["--without", "dark", "flat", "--masters", str(tmp_path / "masters")]
    with small_detectors(side):
        for name, count in (("a", 2), ("b", 3)):
            capsys.readouterr()
            assert masters.main([*masters_of, "--name", name]) == 0
            assert f"VIS_3-4_bias.fits: {count} frames" in capsys.readouterr().out
        assert reduce.main([*images_of, *without, "--name", "b"]) == 0
        (image,) = (tmp_path / "images").iterdir()
        call = [str(image), "--out", str(tmp_path / "stack.fits"), "--lake", str(root)]
        assert stack.main([*call, "--name", "a"]) == 0
        capsys.readouterr()
        for main, arguments in ((masters.main, masters_of), (reduce.main, [*images_of, *without]), (stack.main, call)):
            assert main(arguments) == 2
            assert capsys.readouterr().err.endswith("of table products: name one of them\n")
            assert main([*arguments, "--name", "c"]) == 2
            assert capsys.readouterr().err.endswith(f"lake {root} has no request c; it has a, b\n")


@pytest.mark.nightly
def test_a_sixteenth_of_a_detector(tmp_path):
    # Noise leaves 0.09 % in the mean of four dithers: some of many blocks exceed 0.3 %, as do those near bright stars.
    check(build(tmp_path, 1024, bias=20, dark=3, flat=4), within=0.98)


def test_masters_agree_with_the_detector(made):
    bias, dark, flat = (images.read_images(made / "masters" / f"VIS_3-4_{kind}.fits") for kind in files.KINDS)
    pixels = np.ones(bias[1].data.shape, bool)
    pixels[128:132] = False
    # Noise of the mean of 5 frames: read noise and rounding, which differ between amplifiers.
    # Quadrants E and F lie below the rows of charge injection, H and G above. The request sets the gains of E and H.
    gain, noise = np.zeros(pixels.shape), np.zeros(pixels.shape)
    for name, part in QUADRANTS.items():
        gain[part], noise[part] = table_value("gain", name, 3.48), table_value("read_noise", name, 4.4)
    gain[QUADRANTS["E"]], gain[QUADRANTS["H"]] = 3.0, 4.0
    expected = np.sqrt((noise**2 + gain**2 / 12) / bias[3].data.clip(1))
    np.testing.assert_allclose(bias[2].data[pixels], expected[pixels], rtol=1e-5)
    # The pattern is the same in every row of a quadrant.
    off = [half - np.median(half, axis=0) for half in (bias[1].data[:128], bias[1].data[132:])]
    assert np.std(np.concatenate(off).ravel() / expected[pixels]) == pytest.approx(1.0, abs=0.03)
    assert np.median(dark[1].data[pixels]) == pytest.approx(5.6e-4, abs=3e-4)
    response = flat[1].data[pixels]
    # The lamp's light is known, the pixels' response is 1 in the mean and 0.7 % rms.
    assert np.median(response) == pytest.approx(1.0, abs=1.5e-3)
    noise = np.median(flat[2].data[pixels])
    assert 1.4826 * np.median(np.abs(response - 1.0)) == pytest.approx(np.hypot(0.007, noise), rel=0.05)
    header = {keyword: value for keyword, value, _ in flat[0].cards}
    assert (header["IMAGETYP"], header["NCOMBINE"], header["DETECTOR"]) == ("master flat", 6, "3-4")


def test_header_of_a_calibrated_image(made):
    path = sorted((made / "images").iterdir())[0]
    found = files.read_image(path)
    assert (found.card("BUNIT"), found.card("CALFLAT"), found.card("CALILLUM")) == ("electron", True, True)
    assert found.card("FLAG8") == "saturated"
    assert found.reduced.image.dtype == found.reduced.weight.dtype == np.float32
    assert np.all((found.reduced.weight > 0) == (found.reduced.flags == 0))
    assert np.all(found.reduced.flags[128:132] == calibration.NO_DATA)


def test_a_rate_is_the_electrons_over_the_time(made, tmp_path):
    call = ["--lake", str(made / "lake"), "--masters", str(made / "masters"), "--out", str(tmp_path), "--rate"]
    path = sorted((made / "images").iterdir())[0]
    with small_detectors():
        assert reduce.main([*call, "--exposures", str(int(path.name[:6]))]) == 0
    usual, rate = files.read_image(path), files.read_image(tmp_path / path.name)
    assert rate.card("BUNIT") == "electron/s"
    np.testing.assert_allclose(rate.reduced.image * usual.card("EXPTIME"), usual.reduced.image, rtol=1e-6)
    good = usual.reduced.weight > 0
    signal = usual.reduced.image * np.sqrt(usual.reduced.weight)
    np.testing.assert_allclose((rate.reduced.image * np.sqrt(rate.reduced.weight))[good], signal[good], rtol=1e-5)


def test_what_does_not_fit_is_refused_in_a_line(made, tmp_path, capsys):
    out = tmp_path / "out"
    call = ["--lake", str(made / "lake"), "--out", str(out)]

    def refused(*more):
        with small_detectors():
            assert reduce.main([*call, *more]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert not out.exists() or not list(out.iterdir())
        return error

    assert "--masters FOLDER is required" in refused()
    assert "no image of detector '1-1'" in refused("--masters", str(made / "masters"), "--detectors", "1-1")
    assert "no image of exposure 999" in refused("--masters", str(made / "masters"), "--exposures", "999")
    none = tmp_path / "none"
    remedy = f"make it with truesky masters {made / 'lake'} --out {none}\n"
    assert refused("--masters", str(none)).endswith(f"--masters {none}: there is no such folder: {remedy}")
    none.mkdir()
    remedy = f"make it with truesky masters LAKE --out {none}, or omit its correction with --without bias\n"
    assert refused("--masters", str(none)).endswith(f"VIS_3-4_bias.fits: there is no such master: {remedy}")
    assert not out.exists()
    # Refuse a master with the patterns of another seed, and a master of another kind.
    other = tmp_path / "other"
    shutil.copytree(made / "masters", other)
    units = images.read_images(other / "VIS_3-4_dark.fits")
    cards = tuple((k, "12" if k == "SEED" else v, c) for k, v, c in units[0].cards)
    images.write_images(other / "VIS_3-4_dark.fits", [images.Image(None, cards), *units[1:]])
    assert "SEED = 12, the frame has 7" in refused("--masters", str(other))
    cards = tuple((k, "long" if k == "EXPTIME" else v, c) for k, v, c in units[0].cards)
    images.write_images(other / "VIS_3-4_dark.fits", [images.Image(None, cards), *units[1:]])
    assert "VIS_3-4_dark.fits: EXPTIME = long must be a number of seconds" in refused("--masters", str(other))
    shutil.copy(made / "masters" / "VIS_3-4_bias.fits", other / "VIS_3-4_dark.fits")
    assert "is not a master dark" in refused("--masters", str(other))


def test_without_calibration_frames_the_remedy_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(masters.lake_frames, "from_lake", lambda root, names, request: {})
    (tmp_path / "lake").mkdir()
    assert masters.main([str(tmp_path / "lake"), "--out", str(tmp_path / "masters")]) == 2
    remedy = 'add an [[observation]] with image_type = "bias" to the request, for NISP "dark" or "flat"'
    problem = f"lake {tmp_path / 'lake'} has no calibration frames for masters: {remedy}"
    assert capsys.readouterr().err == f"truesky masters: {problem}\n"
    assert not (tmp_path / "masters").exists()


def test_header_of_a_stack(made, tmp_path, capsys):
    """The dithers of such a small detector do not overlap."""
    paths = [str(path) for path in sorted((made / "images").iterdir())]
    out = tmp_path / "stack.fits"
    with small_detectors():
        assert stack.main([*paths[:2], "--out", str(out), "--lake", str(made / "lake")]) == 0
    found = files.read_image(out)
    assert (found.card("IMAGETYP"), found.card("BUNIT"), found.card("NCOMBINE")) == ("stack", "electron/s", 2)
    assert 1.5 < found.card("CORRVAR") < 3.0
    seen = found.reduced.weight > 0
    assert np.all(found.reduced.flags[~seen] & calibration.NO_DATA)
    one = files.read_image(sorted((made / "images").iterdir())[0])
    sky = np.median(one.reduced.image[one.reduced.weight > 0]) / one.card("EXPTIME")
    assert np.median(found.reduced.image[seen]) == pytest.approx(sky, rel=0.02)
    psf = images.read_images(out)[-1]
    assert psf.name == "PSF"
    assert 0.85 < psf.data.sum() / dict((k, v) for k, v, _ in psf.cards)["PSFSAMP"] ** 2 < 1.0
    capsys.readouterr()
    assert stack.main([paths[0], paths[0], "--out", str(out)]) == 2
    assert "is given twice" in capsys.readouterr().err
    master = str(made / "masters" / "VIS_3-4_bias.fits")
    assert stack.main([paths[0], master, "--out", str(out)]) == 2
    assert "is not a calibrated image" in capsys.readouterr().err
