"""Readout of detectors: content of a file of several arrays, and reading it back."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits as astropy_fits

from lake_schema.errors import BadInput
from tests.truesky import nightly
from tests.truesky.render.exposure.test_render import render
from truesky.render.channels import ground, readout, registry, vis
from truesky.render.products import fits_files, read_back

TRUTH = ("noise_free", "stars", "sky", "cosmic_rays", "ghosts", "saturation")


def ramp(found, scene, detector, system):
    """Return the arrays of a detector that is read up the ramp: slope, flag, quality of the fit, and groups."""
    found = scene.layout.assemble(found)
    slope = np.rint(np.clip(found, 0.0, 65535.0)).astype(np.uint16)
    flag = (slope > np.median(slope)).astype(np.uint8)
    groups = np.stack([np.rint(found * part).astype(np.int32) for part in (0.25, 0.5, 1.0)])
    return readout.Readout(
        (
            readout.Extension("SLOPE", slope, "electron/s", (("NGROUPS", 3, "groups of the ramp"),)),
            readout.Extension("FLAG", flag, ""),
            readout.Extension("CHI2", np.minimum(slope, 255).astype(np.uint8), ""),
            readout.Extension("GROUPS", groups, "adu"),
        ),
        slope,
        cards=(("NFRAMES", 9, "frames of the ramp"),),
    )


MODE = replace(
    readout.FRAME,
    make_readout=ramp,
    read_pixels=lambda read: np.asarray(read[1].data),
    read_electrons=lambda read: np.asarray(read[1].data) * dict(c[:2] for c in read[0].cards)["EXPTIME"],
)


def put(one, folder, truth=(), rice=False):
    """Write the files of a rendered detector, and return content -> file."""
    rows, writers = fits_files.products(one, truth, rice)
    for path, write in writers.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write(folder / path)
    return {row["content"]: folder / row["path"] for row in rows.to_pylist()}


@pytest.mark.parametrize("rice", [False, True])
def test_every_array_has_its_own_type_unit_and_cards(monkeypatch, tmp_path, rice):
    monkeypatch.setattr(registry, "CHANNELS", {"EXT": replace(ground.CHANNEL, readout=MODE)})
    one = render("EXT")
    assert one.readout.unit is None
    path = put(one, tmp_path, rice=rice)["science"]
    with astropy_fits.open(path, checksum=True) as units:
        whole, *arrays = units
        assert "BUNIT" not in whole.header
        assert whole.header["NFRAMES"] == 9
        assert [(u.name, u.data.dtype.name, u.header.get("BUNIT"), u.header.get("NGROUPS")) for u in arrays] == [
            ("SLOPE", "uint16", "electron/s", 3),
            ("FLAG", "uint8", None, None),
            ("CHI2", "uint8", None, None),
            ("GROUPS", "int32", "adu", None),
        ]
        for unit, extension in zip(arrays, one.readout.extensions, strict=True):
            np.testing.assert_array_equal(unit.data, extension.data)
        assert arrays[-1].data.shape == (3, 256, 256)
    np.testing.assert_array_equal(read_back.frame(path).data, one.science)
    np.testing.assert_array_equal(read_back.electrons(path).data, 100.0 * one.science)


@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_common_unit_of_arrays_is_in_each_header_and_in_the_primary_header(channel, tmp_path):
    one = render(channel)
    assert one.readout.unit == "adu"
    with astropy_fits.open(put(one, tmp_path)["science"]) as units:
        assert [unit.header.get("BUNIT") for unit in units] == ["adu"] * len(units)


@nightly.parametrize("channel", ["VIS", "EXT"], (1,))
def test_truth_maps_are_read_as_electrons(channel, tmp_path):
    one = render(channel, truth=TRUTH)
    paths = put(one, tmp_path, TRUTH)
    assert {"noise_free", "sky", "saturation"} <= set(paths)
    for content, path in paths.items():
        if content in ("science", "saturation"):
            continue
        image = read_back.electrons(path)
        assert image.data.dtype == np.float64
        np.testing.assert_array_equal(image.data, one.maps[content])
        np.testing.assert_array_equal(read_back.frame(path).data, one.maps[content])
    with pytest.raises(
        BadInput,
        match=r"_saturation\.fits: the pixels must have a unit .*, but BUNIT is empty$",
    ):
        read_back.electrons(paths["saturation"])


def test_a_file_of_no_channel_is_refused(monkeypatch, tmp_path):
    path = put(render("VIS"), tmp_path)["science"]
    monkeypatch.setattr(registry, "CHANNELS", {"EXT": ground.CHANNEL})
    for read in (read_back.frame, read_back.electrons):
        with pytest.raises(BadInput, match=r"science\.fits: CHANNEL must be one of EXT, got 'VIS'$"):
            read(path)


def test_result_of_an_effect_is_assembled_before_and_after_the_split_into_quadrants():
    one = render("VIS")
    mode = vis.CHANNEL.readout
    np.testing.assert_array_equal(mode.assemble(one.raw, one.scene), one.science)
    np.testing.assert_array_equal(mode.assemble(one.science, one.scene), one.science)
