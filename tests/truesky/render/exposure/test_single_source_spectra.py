"""Single sources of an image of spectra: they add up to it, and they tell what overlaps what."""

from functools import cache

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky.render import fields, infrared, spectroscopic
from tests.truesky.render.spectroscopic import MISSION
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import images
from truesky.render.exposure import single_source_spectra, spectrum_truth
from truesky.render.exposure.records import Rows, Variant
from truesky.render.products import truth_table
from truesky.request.accuracy import DRAFT

STRIP, LAYERS = spectroscopic.strip(ny=160), ("order_1", "order_0", "order_2", "order_m1")
# Columns over which the light of a trace is looked at together.
BIN = 8


@cache
def crowd():
    """Return catalogue rows, columns of the exposure, and its rendering: stars whose orders overlap on a strip.

    The last star is a row next to another.
    """
    rng = np.random.default_rng(8)
    x = np.concatenate(
        [rng.uniform(-280.0, 850.0, 14), rng.uniform(-1100.0, -900.0, 3), rng.uniform(1300.0, 1700.0, 2)]
    )
    y, mags = rng.uniform(10.0, 150.0, len(x)), np.append(rng.uniform(17.0, 19.0, 14), np.full(5, 15.0))
    x, y, mags = np.append(x, x[0]), np.append(y, y[0] + 1.0), np.append(mags, mags[0])
    row = spectroscopic.exposed(STRIP)
    tables = infrared.tables(STRIP, row, mags, x, y)
    return tables, row, fields.rendered(row, STRIP, tables, MISSION, DRAFT, truth=LAYERS)


@cache
def models():
    tables, row, _ = crowd()
    aim = Aim.from_exposure(fields.exposure(**row), STRIP)
    return {
        one.id: one for one in single_source_spectra.draw_sources(aim, Rows(*tables), Variant(MISSION, DRAFT, {}), 1)
    }


def test_sources_alone_add_up_to_the_image_and_to_its_orders():
    _, _, found = crowd()
    some = models().values()
    assert len(found.sources) > 12
    assert set(found.sources.ids.tolist()) <= set(models())
    np.testing.assert_array_equal(sum(one.frame for one in some).astype(np.float32), found.noise_free)
    for order, name in ((1, "order_1"), (0, "order_0"), (2, "order_2"), (-1, "order_m1")):
        np.testing.assert_array_equal(sum(one.orders[order] for one in some).astype(np.float32), found.maps[name])
    assert found.maps["order_1"].sum() > found.maps["order_0"].sum() > 0.0
    assert found.maps["order_2"].sum() > 0.0


def test_sources_share_the_planes_of_the_psf(monkeypatch):
    """Planes for the stamps of one source are used again for the next."""
    tables, row, _ = crowd()
    made, planes = [], images.planes
    monkeypatch.setattr(images, "planes", lambda psf, sampling: made.append(sampling) or planes(psf, sampling))
    aim = Aim.from_exposure(fields.exposure(**row), STRIP)
    found = list(
        single_source_spectra.draw_sources(aim, Rows(*tables), Variant(MISSION, DRAFT, {}), 1, list(models())[:4])
    )
    assert len(found) == 4
    assert len(made) == len(set(made)) > 0


def test_what_a_source_brings_is_what_the_table_says():
    for row in truth_table.spectra(crowd()[2]).to_pylist():
        assert models()[row["id"]].orders[row["order"]].sum() == pytest.approx(row["drawn"], rel=1e-9, abs=1e-6)


def rows_of(image, least):
    """[bins] Row of the light of a trace, NaN where there is too little."""
    light = image.reshape(len(image), -1, BIN).sum(axis=2)
    total = light.sum(axis=0)
    return np.where(total > least * BIN, np.arange(len(image)) @ light / np.maximum(total, 1e-9), np.nan)


def test_what_overlaps_is_what_models_show():
    """Contaminants and overlapped fractions of first orders agree with the drawn light of each order and source."""
    _, _, found = crowd()
    least, wide = spectrum_truth.MIN_CONTAMINATION * found.scene.pixel_noise, found.psf.fwhm / found.psf.pixel_scale
    seen = {
        (number, order): rows_of(image, least)
        for number, one in models().items() for order, image in one.orders.items() if image.any()
    }  # fmt: skip
    firsts = [row for row in truth_table.spectra(found).to_pylist() if row["order"] == 1]
    for row in firsts:
        own, may, must = seen[row["id"], 1], set(), set()
        covered = np.zeros((2, len(own)), bool)
        for (number, _), other in seen.items():
            if number != row["id"]:
                apart = np.abs(own - other)
                # Half a pixel: images are pixels wide, and a bin's light is in its middle on the average alone.
                may |= {number} if (apart < wide + 0.5).any() else set()
                must |= {number} if (apart < wide - 0.5).sum() > 1 else set()
                covered |= apart < wide + np.array([[-0.5], [0.5]])
        assert must <= set(row["contaminants"]) <= may
        least_part, most_part = covered[:, np.isfinite(own)].mean(axis=1)
        assert least_part - 0.05 <= row["overlapped"] <= most_part + 0.05
    assert any(row["contaminants"] == [] for row in firsts)
    assert any(row["overlapped"] == 1.0 for row in firsts)
    assert any(0.1 < row["overlapped"] < 0.9 for row in firsts)


def test_sources_without_light_and_images_without_spectra_are_refused():
    tables, row, _ = crowd()
    variant = Variant(MISSION, DRAFT, {})
    with pytest.raises(BadInput, match="exposure 1, detector DET22: source 7 has no light on the detector"):
        next(
            single_source_spectra.draw_sources(
                Aim.from_exposure(fields.exposure(**row), STRIP), Rows(*tables), variant, 1, [7]
            )
        )
    dark = fields.exposure(**spectroscopic.exposed(STRIP, kind="dark"))
    with pytest.raises(BadInput, match="exposure 1: NISP-S dark is no image of spectra"):
        next(single_source_spectra.draw_sources(Aim.from_exposure(dark, STRIP), Rows(*tables), variant, 1))
