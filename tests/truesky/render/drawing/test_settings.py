"""Settings of drawing meet the promised accuracy, for galaxies and stars of any magnitude."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import _errors as errors
from benchmarks import _positions as positions
from benchmarks import _scenes as scenes
from benchmarks._scenes import NISP, VIS, scene_psf
from lake_schema.errors import BadInput
from tests.truesky import nightly
from truesky.render.drawing import stamp_sizes, stamps, transfer
from truesky.render.drawing.settings import Settings, settings_for
from truesky.render.psf import euclid, model, seeing
from truesky.request import accuracy
from truesky.request.accuracy import DRAFT, PRESETS, QUICKLOOK, REFERENCE, SURVEY

# The best settings: only light outside a large stamp is left out.
FULL = Settings(edge=1e-7, aliased=1e-9, floor=0.0, min_size_arcsec=25.6, positions=9)
SIDE = 256


def rows(name):
    lines = [line for line in Path(stamps.__file__).with_name(name).read_text().splitlines() if line[:1] != "#"]
    return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(lines)]


def test_more_is_asked_for_more_is_taken():
    tiers = [settings_for(wanted) for wanted in (QUICKLOOK, DRAFT, SURVEY, REFERENCE)]
    for field in ("edge", "aliased", "floor"):
        of = [getattr(tier, field) for tier in tiers]
        assert of == sorted(of, reverse=True)
    for field in ("min_size_arcsec", "positions", "colours"):
        of = [getattr(tier, field) for tier in tiers]
        assert of == sorted(of)
    assert [tier.positions for tier in tiers][-1] == max(euclid.DEGREES)


@pytest.fixture(scope="module")
def sample():
    """Return galaxies and stars of 14.5 to 26 mag of a separate seed, each with its most accurate image."""
    some, full = scenes.stratified_sample(VIS, 58, 1), scene_psf(VIS)
    out = []
    for i in range(len(some)):
        one, own = scenes.centred_source(some, i, SIDE), scenes.psf_of_source(full, some, i)
        out.append((one, own, scenes.draw_sources(one, own, VIS, FULL, SIDE)))
    return out


@pytest.mark.parametrize("preset", PRESETS)
def test_neglected_light_is_within_the_promised_limit(preset, sample):
    """The limit also holds for bright stars, whose spikes exceed the mean PSF at the edge of a stamp."""
    wanted, settings = PRESETS[preset], settings_for(PRESETS[preset])
    for one, own, image in sample:
        found = errors.errors(scenes.draw_sources(one, own, VIS, settings, SIDE), image, VIS, one)
        magnitude, star = float(scenes.magnitudes(one, VIS)[0]), one.shape[0] < 0
        assert found[0] / 1.0857 <= wanted.flux, magnitude
        assert found[1] / 1e3 / VIS.scale <= wanted.position, magnitude
        assert found[3] / 2 <= wanted.shape, magnitude
        assert found[4] <= wanted.background, (magnitude, star)
        assert not star or positions.R2_RATIO * found[2] <= wanted.shape, magnitude


def test_a_quicklook_is_half_of_the_work_of_a_draft():
    """The work is the number of pixels of stamps, and of samples through planes of the PSF."""
    some, found = scenes.sources(VIS, 1), []
    for wanted in (QUICKLOOK, DRAFT):
        settings = settings_for(wanted)
        through = scene_psf(VIS, settings.positions, settings.colours)
        sizes = stamp_sizes.stamp_sizes(some.electrons, some.shape, some.shapes, through, VIS.noise, settings)
        pixels = (sizes.astype(float) ** 2).sum()
        found.append((pixels, pixels * transfer.plane_count(through)))
    (quick, quick_planes), (draft, draft_planes) = found
    assert quick <= 0.6 * draft
    assert quick_planes <= 0.15 * draft_planes


def test_planes_of_fewer_colours_are_means_of_neighbours():
    whole = scene_psf(VIS, 9)
    less = model.reduce_colours(whole, 2)
    assert model.reduce_colours(whole, 8) is whole
    np.testing.assert_allclose(less.planes.images[0], whole.planes.images[:4].mean(axis=0), rtol=1e-5, atol=1e-12)
    photons = np.array([[0.3, 0.1, 0.1, 0.1, 0.2, 0.1, 0.05, 0.05]])
    at = np.array([2000.0])
    weights = transfer.basis_weights(less, photons, at, at)[0]
    assert weights[:2] == pytest.approx([0.6, 0.4])
    assert len(weights) == transfer.plane_count(less) == 2 + len(whole.planes.powers)
    # A source with equal light in all sub-bands has the same PSF.
    flat = np.full((1, 8), 0.125)
    both = [transfer.image_of(one.planes, transfer.basis_weights(one, flat, at, at)[0]) for one in (less, whole)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-4, atol=1e-9)
    with pytest.raises(BadInput, match="8 wavelengths of a PSF are not a multiple of 3"):
        model.reduce_colours(whole, 3)


def test_the_rim_is_the_brightest_pixel_farther_out():
    """The rim also agrees with a star on its largest stamp, except for the colour of the star."""
    full = replace(scene_psf(VIS), edges=None)
    one = scenes.centred_source(scenes.stratified_sample(VIS, 3, 1), 8, SIDE)
    star = scenes.draw_sources(one, full, VIS, FULL, SIDE) / one.electrons[0]
    away = np.maximum(*np.abs(np.indices(star.shape) - SIDE // 2))
    for r in (20, 48, 80):
        assert star[away >= r].max() == pytest.approx(full.rim[r], rel=0.5)
    assert (np.diff(full.rim) <= 0).all()
    assert (full.rim >= full.surface - 1e-12)[20:].all()
    # Spikes are several times brighter than the mean.
    assert full.rim[48] > 4.0 * full.surface[48]
    ground = seeing.moffat_psf(0.7, 3.0, 0.2)
    np.testing.assert_allclose(ground.rim[8:200], ground.surface[8:200], rtol=0.1)


@nightly.parametrize(("scene", "file"), [(VIS, "psf_positions.csv"), (NISP, "psf_positions_nisp.csv")], (0,))
def test_psf_errors_between_positions_are_those_of_the_table(scene, file):
    """Errors are relative to the optics computed at the position of a star."""
    table = {row["positions"]: row for row in rows(file) if row["nearest"] == 0}
    at = positions.make_optics(scene)
    star, planes = positions.draw_star(at, np.random.default_rng(8)), scene_psf(scene, 9).planes
    flux, moved, r2, ellipticity = positions.star_errors(at((0.0, 0.0)) + positions.drift(planes, star), star, scene)
    assert flux <= table[9]["flux_error"]
    assert moved <= table[9]["position_error"]
    assert r2 <= table[9]["r2_error"]
    assert ellipticity <= table[9]["ellipticity_error"]
    assert positions.star_errors(at((0.0, 0.0)), star, scene)[2] > 3 * r2


@pytest.mark.nightly
def test_a_row_counts_the_error_of_its_psf():
    """No row promises smaller errors than stars have with its positions and colours."""
    table = accuracy.rows()
    kinds = [(int(row["positions"]), int(row["colours"])) for row in table]
    found = positions.largest_errors(7, 4, list(dict.fromkeys(kinds)))
    for row, kind in zip(table, kinds, strict=True):
        for name, error in found[kind].items():
            assert error <= 1.3 * max(row[name], row[f"{name}_held"])
