"""Charge transfer inefficiency: against arCTIc, and in the limits that can be written down."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import resolve
from truesky.render.effects.readout import charge_transfer, traps
from truesky.render.effects.readout.traps import Sweeps, Traps
from truesky.render.effects.scene import Scene
from truesky.request import accuracy

ISRAEL = Traps((0.02, 0.03, 0.95), (0.8, 3.5, 20.0), 2e5, 0.0, 0.58)
PIXELS, UNIT = 2066, 0.001
SURVEY = charge_transfer.choose_sweeps(accuracy.SURVEY, PIXELS)
EXACT, LEVELS, MANY = Sweeps(64, 2), Sweeps(1, 1, 9), Sweeps(1, 1, 900)


@cache
def reference(name):
    """(input, arCTIc's output, galaxies) of benchmarks/cti_reference.py."""
    with np.load(Path(__file__).with_name("cti_reference.npz")) as file:
        image = file["galaxies"].astype(float) + (file["cosmic_rays"] if name == "hit" else 0)
        return image, image + UNIT * file[name], file["table"]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def every_transfer(line, silicon, pixels, hits=(), levels=10_000):
    """One transfer at a time, each pixel with its own watermarks per species: the definition, slowly.

    hits : pixel -> (packet, charge that it gets there)
    """
    heights = (np.arange(levels) + 0.5) / levels
    line, n = np.array(line, float), len(line)
    trapped = 0.0
    for pixel in range(pixels - 1, -1, -1):
        if pixel in hits:
            packet, charge = hits[pixel]
            line[packet] += charge
        full = np.zeros((len(silicon.density), levels))
        for i in range(pixel, n):
            released = full * -np.expm1(-1.0 / np.array(silicon.release))[:, None]
            full -= released
            line[i] += (np.array(silicon.density) @ released).sum() / levels
            reached = heights < silicon.volume(line[i])
            line[i] -= (np.array(silicon.density) @ (1.0 - full[:, reached])).sum() / levels
            full[:, reached] = 1.0
        trapped += (np.array(silicon.density) @ full).sum() / levels
    return line, trapped


@pytest.mark.parametrize(("preset", "limit"), [("draft", 0.02), ("survey", 0.002), ("reference", 0.002)])
@pytest.mark.parametrize("name", ["clean", "hit"])
def test_agrees_with_arctic(name, preset, limit):
    image, wanted, _ = reference(name)
    sweeps = charge_transfer.choose_sweeps(accuracy.preset(preset), PIXELS)
    found, _ = traps.shift_charge(image, ISRAEL, sweeps, -2, PIXELS)
    assert rms(found - wanted) <= limit * rms(wanted - image)
    turned, _ = traps.shift_charge(image.T, ISRAEL, sweeps, -1, PIXELS)
    np.testing.assert_array_equal(turned.T, found)


def measured(image, table):
    """Flux, row, column, ellipticity of each galaxy, under a Gaussian that stays where the galaxy is."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    out = []
    for row, column, _, scale in table:
        near = slice(max(int(row) - 25, 0), int(row) + 26)
        dy, dx = y[near] - row, x[near] - column
        light = (image[near] - 130.0) * np.exp(-(dx**2 + dy**2) / (2 * (2 * scale) ** 2))
        total = light.sum()
        xx, yy, xy = ((light * a * b).sum() / total for a, b in ((dx, dx), (dy, dy), (dx, dy)))
        at = ((light * dy).sum() / total, (light * dx).sum() / total)
        out.append((total, *at, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)))
    return np.array(out)


@pytest.mark.parametrize("name", ["clean", "hit"])
def test_each_galaxy_is_changed_as_by_arctic(name):
    image, wanted, table = reference(name)
    found, _ = traps.shift_charge(image, ISRAEL, SURVEY, -2, PIXELS)
    before = measured(image, table)
    use = (before[:, 0] > 300) & (np.abs(before[:, 3:]) < 1).all(1)
    assert use.sum() > 25
    theirs, ours = (measured(frame, table)[use] - before[use] for frame in (wanted, found))
    # Flux, position along the transfer, ellipticity: each galaxy's change.
    for k in (0, 1, 3):
        np.testing.assert_allclose(ours[:, k], theirs[:, k], rtol=0.02, atol=0.02 * rms(theirs[:, k]))
    # It is not nothing.
    assert np.median(-theirs[:, 0] / before[use, 0]) > 0.002
    assert np.median(theirs[:, 1]) > 0.005


def test_agrees_with_single_transfers():
    """Forty rows, so strong that the second order shows, against the definition."""
    rng = np.random.default_rng(3)
    line = rng.poisson(200.0, 40).astype(float)
    line[[5, 20]] += 3000
    line[36:] = 0
    silicon = Traps((15.0, 50.0), (1.5, 8.0), 1e5, 20.0, 0.7)
    wanted, trapped = every_transfer(line, silicon, 36)
    change = rms(wanted - line)
    errors = {}
    each = Sweeps(36, 1)
    for sweeps in (Sweeps(1, 1), Sweeps(1, 2), each):
        found, still = traps.shift_charge(line[None], silicon, sweeps, -1, 36)
        errors[sweeps] = rms(found[0] - wanted) / change
        assert found.sum() + still == pytest.approx(line.sum(), rel=1e-13)
    assert errors[each] < 1e-3
    assert errors[Sweeps(1, 2)] < 0.3 * errors[Sweeps(1, 1)]
    assert traps.shift_charge(line[None], silicon, each, -1, 36)[1] == pytest.approx(trapped, rel=1e-3)


def test_smaller_steps_converge():
    image, _, _ = reference("hit")
    best, _ = traps.shift_charge(image, ISRAEL, EXACT, -2, PIXELS)
    errors = [
        rms(traps.shift_charge(image, ISRAEL, s, -2, PIXELS)[0] - best) for s in (Sweeps(1, 1), SURVEY, Sweeps(4, 2))
    ]
    assert errors[0] > 5 * errors[1] > 5 * errors[2]


def test_first_pixel_trail_of_a_lone_packet():
    """A packet on nothing: what it loses, and the trail behind it, by hand."""
    line = np.zeros((1, 60))
    line[0, 30] = 1e4
    silicon = Traps((0.5,), (5.0,), 1e5, 0.0, 0.5)
    found, still = traps.shift_charge(line, silicon, Sweeps(200, 2), -1)
    captured = 0.5 * np.sqrt(0.1)
    assert (found[0, :30] == 0).all()
    assert found[0, 30] == pytest.approx(1e4 - 31 * captured, rel=1e-4)
    # Electrons that a trail catches again stay behind longer.
    assert found[0, 31:].sum() + still == pytest.approx(31 * captured, rel=1e-3)
    assert (np.diff(found[0, 31:50]) < 0).all()


@given(
    seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-3, 30), notch=st.sampled_from([0.0, 50.0]),
    sweeps=st.one_of(st.builds(Sweeps, st.integers(1, 5), st.sampled_from([1, 2])), st.just(LEVELS)),
    level=st.sampled_from([0.0, 0.3, 10.0, 1e4, 1e9]),
)  # fmt: skip
def test_charge_is_conserved(seed, scale, notch, sweeps, level):
    rng = np.random.default_rng(seed)
    frame = np.floor(rng.exponential(level + 1e-9, (3, 17, 23)))
    frame[rng.random(frame.shape) < 0.02] = 2e5
    silicon = replace(ISRAEL, density=tuple(scale * d for d in ISRAEL.density), notch=notch)
    for axis, pixels in ((-1, 20), (-2, 17)):
        out, still = traps.shift_charge(frame, silicon, sweeps, axis, pixels)
        assert out.min() >= -1e-9
        assert still >= 0
        assert out.sum() + still == pytest.approx(frame.sum(), rel=1e-12, abs=1e-12)


def test_volume_from_its_table():
    """Packets of every size lose what their volume says."""
    n = np.geomspace(1e-3, 1e6, 400)
    silicon = Traps((1e-6,), (1e6,), 2e5, 0.0, 0.58)
    found, _ = traps.shift_charge(n[:, None], silicon, Sweeps(1, 1), -1)
    np.testing.assert_allclose((n - found[:, 0]) * 1e6, silicon.volume(n), rtol=2e-4, atol=2e-10 / 1e-6 * 1e-3)


def test_young_detectors_are_followed_less_closely():
    presets = [accuracy.preset(name) for name in ("draft", "survey", "reference")]
    old = [charge_transfer.choose_sweeps(preset, PIXELS) for preset in presets]
    assert old == [Sweeps(1, 1), Sweeps(1, 2), Sweeps(4, 2)]
    young = [charge_transfer.choose_sweeps(preset, 0.03 * PIXELS) for preset in presets]
    assert young == [LEVELS, Sweeps(1, 1), Sweeps(1, 1)]


@pytest.mark.parametrize(
    ("name", "preset", "age"),
    [
        ("clean", accuracy.DRAFT, 0.03), ("hit", accuracy.DRAFT, 0.037), ("clean", accuracy.SURVEY, 0.03),
        ("clean", accuracy.SURVEY, 0.3), ("clean", accuracy.SURVEY, 1.0),
    ],
)  # fmt: skip
def test_what_following_less_closely_does_to_galaxies(name, preset, age):
    """Flux, position and ellipticity of every galaxy, against small steps: within the errors that are allowed."""
    image, _, table = reference(name)
    silicon = replace(ISRAEL, density=tuple(age * d for d in ISRAEL.density))
    chosen = charge_transfer.choose_sweeps(preset, age * PIXELS)
    assert (chosen == LEVELS) == (preset == accuracy.DRAFT)
    found, best = (measured(traps.shift_charge(image, silicon, s, -2, PIXELS)[0], table) for s in (chosen, EXACT))
    bright = table[:, 2] > 2000
    assert np.abs(found / best - 1)[bright, 0].max() < preset.flux
    assert np.abs(found - best)[bright, 1].max() < preset.position
    assert np.abs(found - best)[bright, 3].max() < preset.shape


@pytest.mark.parametrize("name", ["clean", "hit"])
def test_levels_of_traps(name):
    """They tend to the watermarks; few of them have the pixels' change to a quarter, and sources' mean change."""
    image, _, _ = reference(name)
    best, _ = traps.shift_charge(image, ISRAEL, Sweeps(1, 1), -2, PIXELS)
    few, some, many = (traps.shift_charge(image, ISRAEL, s, -2, PIXELS)[0] for s in (LEVELS, Sweeps(1, 1, 48), MANY))
    errors = [rms(found - best) / rms(best - image) for found in (few, some, many)]
    assert errors[0] < 0.25
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.02
    assert few.sum() == pytest.approx(best.sum(), rel=1e-5)


def test_traps_are_left_out_if_they_change_sources_by_less_than_allowed():
    """A draft leaves out few traps, a quicklook more of them, and a survey none."""
    image, _, table = reference("clean")
    for age, preset, needed in (
        (0.02, accuracy.DRAFT, False), (0.02, accuracy.SURVEY, True), (0.3, accuracy.DRAFT, True),
        (0.15, accuracy.QUICKLOOK, False), (0.6, accuracy.QUICKLOOK, True),
    ):  # fmt: skip
        scene = Scene(resolve(overrides={"vis.cti.age": (age, "")}), "vis", 560.0, 0.25, 1e4, accuracy=preset)
        assert charge_transfer.PARALLEL.is_needed(scene) == needed
        found, _ = traps.shift_charge(image, charge_transfer.silicon_traps(scene, "parallel"), SURVEY, -2, PIXELS)
        before, after = measured(image, table), measured(found, table)
        bright = table[:, 2] > 2000
        worst = (
            np.abs(after / before - 1)[bright, 0].max() / preset.flux,
            np.abs(after - before)[bright, 1].max() / preset.position,
            np.abs(after - before)[bright, 3].max() / preset.shape,
        )
        assert (max(worst) > 1.0) == needed
        if not needed:
            assert rms(found - image) < scene.noticeable_electrons


def test_damage_grows_with_age():
    new, old = (Scene(resolve(overrides={"vis.cti.age": (age, "")}), "vis", 560.0, 0.25, 1e4) for age in (0.03, 1.0))
    assert sum(charge_transfer.silicon_traps(new, "parallel").density) == pytest.approx(0.03)
    assert sum(charge_transfer.silicon_traps(old, "parallel").density) == pytest.approx(1.0)
    assert sum(charge_transfer.silicon_traps(old, "serial").density) == pytest.approx(1 / 3)
    for effect in (charge_transfer.PARALLEL, charge_transfer.SERIAL):
        assert effect.margin(old) > effect.margin(new) > 0


@pytest.mark.parametrize(
    "wrong",
    [{"density": (-1.0,) * 3}, {"release": (0.0,) * 3}, {"power": 0.0}, {"notch": 3e5}, {"full_well": np.nan}],
)
def test_impossible_traps_are_refused(wrong):
    with pytest.raises(OutOfRange, match="trap"):
        replace(ISRAEL, **wrong)


def test_other_mistakes_are_refused():
    with pytest.raises(BadInput, match="densities"):
        Traps((1.0, 2.0), (1.0,), 1e5, 0.0, 0.5)
    with pytest.raises(OutOfRange, match="steps"):
        Sweeps(0, 1)
    with pytest.raises(OutOfRange, match="sweeps"):
        Sweeps(1, 3)
    with pytest.raises(OutOfRange, match="levels"):
        Sweeps(1, 1, 3)
    with pytest.raises(BadInput, match="levels"):
        Sweeps(2, 1, 9)
    with pytest.raises(OutOfRange, match="axis"):
        traps.shift_charge(np.zeros((2, 2)), ISRAEL, SURVEY, 0)
    with pytest.raises(OutOfRange, match="pixels"):
        traps.shift_charge(np.zeros((2, 2)), ISRAEL, SURVEY, -1, 3)


def clocked(column, loss, rows):
    """Charge that leaves a column [n] at each of `rows` clocks; each site keeps `loss` for the packet behind."""
    line, read = np.array(column, float), []
    for _ in range(rows):
        moved = (1.0 - loss) * line
        read.append(moved[0])
        line = np.append(moved[1:], 0.0) + loss * line
    return np.array(read)


@pytest.mark.parametrize("loss", [1e-6, 1e-4])
def test_constant_loss_agrees_with_single_transfers(loss):
    """Compare with single transfers, along columns and along rows: errors are of third order in the loss."""
    rng = np.random.default_rng(1)
    columns = np.zeros((2, 60, 3))
    columns[:, :50] = 10.0 ** rng.uniform(1, 5, (2, 50, 3))
    out = charge_transfer.apply_parallel_loss(columns, loss)
    expected = np.array([[clocked(q[:, c], loss, 60) for c in range(3)] for q in columns]).transpose(0, 2, 1)
    np.testing.assert_allclose(out, expected, rtol=0, atol=(60 * loss) ** 3 * 1e5)
    along = charge_transfer.apply_serial_loss(columns.transpose(0, 2, 1), loss)
    np.testing.assert_array_equal(along, out.transpose(0, 2, 1))
    # The packet behind the last pixel contains a fraction of its charge, and the total is conserved.
    assert out[:, 50].sum() == pytest.approx(50 * loss * columns[:, 49].sum(), rel=60 * loss)
    assert out.sum() == pytest.approx(columns.sum(), rel=1e-12)


@pytest.mark.parametrize("loss", [-1e-6, 0.01, np.nan])
def test_impossible_losses_are_refused(loss):
    with pytest.raises(OutOfRange, match="charge lost in a transfer"):
        charge_transfer.apply_parallel_loss(np.ones((1, 4, 4)), loss)
