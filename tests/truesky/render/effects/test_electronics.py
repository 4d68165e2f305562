"""From charge to numbers: quadrants, amplifiers, crosstalk, the bias, injected charge, temperature."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import exposure
from truesky.randomness.rng import stream
from truesky.render.camera import amplifiers, detectors
from truesky.render.effects.charge import charge_injection, dark_current, poisson
from truesky.render.effects.effect import apply_all
from truesky.render.effects.readout import bias_structure, crosstalk, nonlinearity, quadrants
from truesky.render.effects.scene import Scene, dark_current_scaling
from truesky.render.exposure.rendered_detector import random_identity

SCENE = Scene(resolve(), "vis", 560.53, 0.25, 1e4)
CURVE = (0.05, 2.28e5, 0.01, 2e3)


@given(
    half_y=st.integers(1, 6),
    half_x=st.integers(1, 6),
    pre=st.integers(0, 3),
    over=st.integers(0, 3),
    rows=st.integers(0, 2),
    middle=st.sampled_from([0, 2, 4]),
)
def test_quadrants_are_put_together_again(half_y, half_x, pre, over, rows, middle):
    """All that is read: the rows between the halves are not."""
    frame = np.arange(2.0 * half_x * (2 * half_y + middle)).reshape(2 * half_y + middle, 2 * half_x) + 1
    parts = quadrants.apply(frame, pre, over, rows, middle)
    assert parts.shape == (4, half_y + rows, pre + half_x + over)
    frame[half_y : half_y + middle] = 0.0
    np.testing.assert_array_equal(quadrants.assemble(parts, pre, over, rows, middle), frame)
    assert (parts > 0).sum() == 4 * half_y * half_x
    shape = parts.shape[1:]
    for number in range(4):
        across, up = quadrants.pixel_offset(number, shape, pre, over, rows, middle)
        placed = quadrants.to_detector_axes(parts[number], number)
        row, column = (half_y + middle) * (number < 2), half_x * (number in (1, 2))
        assert placed[row + up, column + across] == frame[row, column]
    for number in range(4):
        turned = quadrants.to_detector_axes(parts[number], number)
        np.testing.assert_array_equal(quadrants.to_detector_axes(turned, number), parts[number])


@pytest.mark.parametrize("middle", [0, 4])
def test_the_place_of_a_pixel_is_that_in_the_quadrants(middle):
    sizes, numbers = (3, 2, 1, middle), np.arange(1, 20 * 12 + 1)
    planes = quadrants.apply(numbers.reshape(20, 12), *sizes)
    rows, columns = np.indices((20, 12)).reshape(2, -1)
    places, shape = quadrants.readout_places((rows, columns), (20, 12), *sizes)
    assert shape == planes.shape
    is_read = np.isin(numbers, planes)
    assert is_read.sum() == (20 - middle) * 12
    np.testing.assert_array_equal(planes[tuple(places[is_read].T)], numbers[is_read])
    assert (places[~is_read] == -1).all()


def test_each_corner_is_read_first():
    frame = np.zeros((4132, 4096))
    frame[-1, 0], frame[-1, -1], frame[0, -1], frame[0, 0] = 1, 2, 3, 4
    parts = quadrants.apply(frame, *quadrants.overscan_sizes(SCENE))
    assert parts.shape == (4, 2086, 2128)
    assert "".join(quadrants.NAMES) == "HGFE"
    assert [quadrants.NAMES[number] for number in quadrants.FILE_ORDER] == list("EFGH")
    assert [parts[i, 0, 51] for i in range(4)] == [1, 2, 3, 4]
    assert parts.sum() == 10


def test_odd_detectors_have_no_quadrants():
    with pytest.raises(BadInput, match="even"):
        quadrants.apply(np.zeros((3, 4)), 1, 1, 1)
    with pytest.raises(OutOfRange, match="prescan"):
        quadrants.apply(np.zeros((2, 4)), -1, 1, 1)
    with pytest.raises(BadInput, match="even"):
        quadrants.apply(np.zeros((4, 4)), 1, 1, 1, 3)


@given(st.floats(0, 1e6), st.floats(0, 0.3), st.floats(0, 0.5))
def test_nonlinearity_and_its_inverse(electrons, high, low):
    curve = (high, 2.28e5, low, 2e3)
    measured = nonlinearity.apply(np.array([electrons]), *curve)
    assert 0 <= measured[0] <= electrons
    again = nonlinearity.linearise(measured, *curve)
    assert again[0] == pytest.approx(electrons, rel=1e-9, abs=1e-6)


def test_nonlinearity_is_one_and_five_per_cent():
    n = np.array([1e-3, 2.28e5])
    lost = 1 - nonlinearity.apply(n, *CURVE) / n
    assert lost[0] == pytest.approx(0.01, rel=1e-3)
    assert lost[1] == pytest.approx(0.05 / 1.05, rel=0.005)
    steps = nonlinearity.apply(np.linspace(0, 1e6, 10_001), *CURVE)
    assert (np.diff(steps) > 0).all()
    np.testing.assert_array_equal(nonlinearity.apply(np.array([-5.0]), *CURVE), [-5.0])
    assert nonlinearity.linearise(np.array([1e9]), *CURVE)[0] == np.inf
    assert nonlinearity.parameters(SCENE) == pytest.approx((0.05, 65535 * 3.48, 0.01, 2000.0))
    for wrong in ((-1.0, *CURVE[1:]), (*CURVE[:2], 1.0, 2e3), (0.05, 0.0, 0.01, 2e3), (*CURVE[:3], 0.0)):
        with pytest.raises(OutOfRange, match=r"non-linearity|saturation"):
            nonlinearity.apply(n, *wrong)


def test_nonlinearity_of_more_pixels_than_a_block():
    """Signals below and above the change of the formula for exp(x) - 1 are in each block, in no order."""
    high, saturation, low, knee = CURVE
    electrons = 10.0 ** np.random.default_rng(1).uniform(-2, 6, (3, 1000)) - 5.0
    light = np.maximum(electrons, 0.0)
    response = light / (1.0 + high * light / saturation)
    expected = np.minimum(electrons, 0.0) + response - low * knee * (1.0 - np.exp(-response / knee))
    np.testing.assert_allclose(nonlinearity.apply(electrons, *CURVE), expected, rtol=1e-12, atol=1e-12)
    per_amplifier = nonlinearity.apply(electrons, high, saturation, np.array([low, 0.0, low]), knee)
    np.testing.assert_array_equal(per_amplifier[::2], nonlinearity.apply(electrons, *CURVE)[::2])
    np.testing.assert_allclose(per_amplifier[1], (np.minimum(electrons, 0.0) + response)[1], rtol=1e-14)


def test_crosstalk_of_more_pixels_than_a_block():
    rng = np.random.default_rng(2)
    frame, table = rng.exponential(1e4, (4, 50, 60)), rng.uniform(-1e-3, 1e-3, (4, 4))
    expected = frame + np.einsum("vs,syx->vyx", table - np.diag(np.diag(table)), frame)
    np.testing.assert_allclose(crosstalk.apply(frame, table), expected, rtol=1e-14)
    np.testing.assert_array_equal(crosstalk.apply(frame, table, out=frame), crosstalk.apply(frame, np.zeros((4, 4))))
    np.testing.assert_allclose(frame, expected, rtol=1e-14)


def test_crosstalk_is_taken_from_what_was():
    frame = np.zeros((4, 3, 5))
    frame[0, 1, 2], frame[3, 0, 0] = 1e5, 2e4
    table = crosstalk.coefficients(SCENE)
    out = crosstalk.apply(frame, table)
    np.testing.assert_allclose(out[:, 1, 2], [1e5, 1e5 * table[1, 0], 1e5 * table[2, 0], 1e5 * table[3, 0]])
    assert out[0, 0, 0] == pytest.approx(2e4 * table[0, 3])
    np.testing.assert_array_equal(table, table.T)
    np.testing.assert_array_equal(np.diag(table), 0)
    with pytest.raises(BadInput, match="crosstalk"):
        crosstalk.apply(frame, np.zeros((3, 3)))
    with pytest.raises(OutOfRange, match="crosstalk"):
        crosstalk.apply(frame, np.full((4, 4), np.nan))


@pytest.mark.parametrize(("camera", "name"), [("hsc", "1_12"), ("decam", "N1")])
def test_measured_crosstalk_is_a_fraction_of_adu(camera, name):
    """As the pipelines of the observatories subtract it, before they multiply by gains, which differ."""
    mission = resolve()
    scene = Scene(mission, f"ext.{camera}", 90.0, 10.0, 1e6, detectors.detector(camera, name, mission))
    measured = amplifiers.measured_crosstalk(scene.detector, scene.layout, mission)
    gain = scene.amplifier_values("gain", "electron / adu")[:, None, None]
    adu = np.random.default_rng(5).exponential(1e4, (len(measured), 3, 5))
    found = crosstalk.apply(adu * gain, crosstalk.coefficients(scene)) / gain
    np.testing.assert_allclose(found, adu + np.einsum("vs,syx->vyx", measured, adu), rtol=1e-12)


def test_structure_of_the_bias():
    pattern = bias_structure.structure(400, 2128, 34.8, -10.0, 40.0, 1.0, np.random.default_rng(1))
    assert pattern.shape == (400, 2128)
    settled = pattern[:, 1000:]
    assert settled.mean(axis=1).std() == pytest.approx(34.8, rel=0.1)
    assert (settled - settled.mean(axis=1, keepdims=True)).std() == pytest.approx(1.0, rel=0.02)
    first = pattern[:, 0] - settled.mean(axis=1)
    assert first.mean() == pytest.approx(-10.0, abs=0.2)
    frame = np.zeros((4, 5, 7))
    out = bias_structure.apply(frame, 3.0, 1.0, 4.0, 1.0, np.random.default_rng(2))
    np.testing.assert_array_equal(out, np.repeat(out[:, :1], 5, axis=1))
    assert bias_structure.EFFECT.fixed
    for wrong in ((-1.0, 0.0, 4.0, 1.0), (1.0, 0.0, 0.0, 1.0), (1.0, 0.0, 4.0, -1.0)):
        with pytest.raises(OutOfRange, match="bias"):
            bias_structure.apply(frame, *wrong, np.random.default_rng(2))


def drift_of(mjd, amplifiers=4000, rms=2.0, time=0.25):
    """Return the offsets of many amplifiers on a date."""
    frame = np.zeros((amplifiers, 1, 1))
    return bias_structure.apply_drift(frame, rms, mjd, time, np.random.default_rng(5))[:, 0, 0]


def test_the_bias_drifts_slowly():
    """The offsets are normal; after the correlation time they have the correlation exp(-1/2), after weeks none."""
    start = drift_of(60905.0)
    assert start.std() == pytest.approx(2.0, rel=0.04)
    assert abs(start.mean()) < 0.12
    assert np.mean(np.abs(start) < 2.0) == pytest.approx(0.683, abs=0.025)
    for days in (1e-4, 0.125, 0.25, 0.5, 20.0):
        found = np.corrcoef(start, drift_of(60905.0 + days))[0, 1]
        assert found == pytest.approx(np.exp(-0.5 * (days / 0.25) ** 2), abs=0.06)
    assert np.abs(drift_of(60905.0 + 1e-4) - start).max() < 0.02
    frame = np.arange(24.0).reshape(2, 3, 4)
    moved = bias_structure.apply_drift(frame, np.array([1.0, 0.0]), 60905.0, 0.25, np.random.default_rng(1)) - frame
    assert np.ptp(moved[0]) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(moved[1], 0.0)
    assert moved[0, 0, 0] != 0.0
    for wrong in ((-1.0, 60905.0, 0.25), (np.nan, 60905.0, 0.25), (1.0, 60905.0, 0.0)):
        with pytest.raises(OutOfRange, match="bias drift"):
            bias_structure.apply_drift(frame, *wrong, np.random.default_rng(1))


def test_the_pixels_of_a_row_share_an_offset():
    found = bias_structure.apply_row_noise(np.zeros((2, 5000, 3)), np.array([0.5, 2.0]), np.random.default_rng(3))
    np.testing.assert_array_equal(found, np.repeat(found[..., :1], 3, axis=2))
    assert found[..., 0].std(axis=1) == pytest.approx([0.5, 2.0], rel=0.04)
    # Neither neighbouring rows nor the same row of the other amplifier have the same offset.
    assert abs(np.corrcoef(found[0, 1:, 0], found[0, :-1, 0])[0, 1]) < 0.06
    assert abs(np.corrcoef(found[0, :, 0], found[1, :, 0])[0, 1]) < 0.06
    np.testing.assert_array_equal(bias_structure.apply_row_noise(found, 0.0, np.random.default_rng(3)), found)
    with pytest.raises(OutOfRange, match="noise of rows"):
        bias_structure.apply_row_noise(found, -1.0, np.random.default_rng(3))


def test_injected_charge_comes_in_blocks():
    level = charge_injection.apply(np.zeros((1200, 50)), 15_000.0, 100, 200, 0.03, np.random.default_rng(1))
    out = charge_injection.apply_noise(level, 100, 200, 60.0, np.random.default_rng(2))
    rows = out.mean(axis=1)
    lit = np.flatnonzero(rows > 0)
    assert [lit[0], lit[99], lit[100]] == [200, 299, 500]
    np.testing.assert_array_equal(rows > 0, rows[::-1] > 0)
    columns = out[lit].mean(axis=0)
    assert columns.mean() == pytest.approx(15_000, rel=0.02)
    assert columns.std() == pytest.approx(450, rel=0.4)
    assert (out[lit] - columns).std() == pytest.approx(60, rel=0.05)
    np.testing.assert_array_equal(out, np.rint(out))
    assert (np.ptp(level[lit], axis=0) == 0).all()
    for wrong in ((-1.0, 1, 1, 0.0), (1.0, 0, 1, 0.0), (1.0, 1, -1, 0.0), (1.0, 1, 1, np.nan)):
        with pytest.raises(OutOfRange, match="inject"):
            charge_injection.apply(np.zeros((4, 4)), *wrong, np.random.default_rng(1))
    for wrong in ((1, 1, -1.0), (0, 1, 0.0), (1, 1, np.nan)):
        with pytest.raises(OutOfRange, match="inject"):
            charge_injection.apply_noise(np.zeros((4, 4)), *wrong, np.random.default_rng(1))


def test_columns_take_the_same_charge_in_every_exposure():
    """Two exposures differ by their noise, two detectors by more."""
    row = {"camera": "vis", "band": "euclid_vis", "ra": 10.0, "dec": 20.0, "position_angle": 0.0}
    found = {}
    for detector in ("1-1", "3-4"):
        for mjd in (60905.0, 60906.0):

            def own(effect, when=mjd, name=detector):
                return stream(*random_identity(effect, exposure(**row, mjd=when), name, 1))

            both = (charge_injection.EFFECT, charge_injection.NOISE)
            found[detector, mjd] = apply_all(np.zeros((900, 200)), both, SCENE, own)[0]
    columns = {key: frame[frame[:, 0] > 0].mean(axis=0) for key, frame in found.items()}
    noise = SCENE.value("injection.noise", "electron")
    change = columns["1-1", 60905.0] - columns["1-1", 60906.0]
    assert 0.0 < change.std() < noise
    assert (columns["1-1", 60905.0] - columns["3-4", 60905.0]).std() > 5 * noise


@pytest.mark.parametrize("electrons", [0.0, 1e-3, 0.31, 1.999, 2.0, 9.0])
def test_few_dark_electrons_are_counted_as_many_are(electrons):
    """Few electrons are drawn for blocks of pixels, with the same counts as for single pixels."""
    counts = dark_current.apply(np.full((37, 41), 5.0), electrons, np.random.default_rng(7))
    np.testing.assert_array_equal(counts - 5.0, poisson.apply(np.full((37, 41), electrons), np.random.default_rng(7)))


def test_dark_current_doubles_in_a_few_kelvin():
    assert dark_current_scaling(153.0, 153.0, 1.12) == 1.0
    assert dark_current_scaling(155.4, 153.0, 1.12) == pytest.approx(2.0, rel=0.03)
    assert dark_current_scaling(150.6, 153.0, 1.12) == pytest.approx(0.5, rel=0.05)
    with pytest.raises(OutOfRange, match="temperature"):
        dark_current_scaling(0.0, 153.0, 1.12)


def test_dark_current_follows_the_detector_s_temperature():
    warm = Scene(resolve(overrides={"vis.detector_temperature": (163.0, "K")}), "vis", 560.53, 0.25, 1e4)
    assert warm.dark_electrons / SCENE.dark_electrons == pytest.approx(dark_current_scaling(163.0, 153.0, 1.12))
    assert SCENE.dark_electrons == pytest.approx(560.53 * SCENE.value("dark_current", "electron / (s pix)"))


def test_hot_pixels_freeze_with_the_dark_current():
    """They are thermal: their electrons scale with temperature as the dark current does."""
    reference, warmer = (
        Scene(resolve(overrides={"vis.detector_temperature": (kelvin, "K")}), "vis", 560.0, 0.25, 0.0)
        for kelvin in (SCENE.mission.value("vis.dark_reference_temperature", "K"), 170.0)
    )
    share, electrons = dark_current.HOT.parameters(reference)
    assert electrons == pytest.approx(SCENE.mission.value("vis.hot_current", "electron / (s pix)") * 560.0)
    more = dark_current.HOT.parameters(warmer)
    assert more[0] == share
    assert more[1] / electrons == pytest.approx(warmer.dark_electrons / reference.dark_electrons)
    assert more[1] > 30 * electrons


def test_hot_pixels_are_few_and_the_detector_s_own():
    out = dark_current.apply_hot(np.zeros((500, 400)), 1e-3, 100.0, np.random.default_rng(1))
    hot = out[out > 0]
    assert len(hot) == pytest.approx(200, abs=50)
    assert hot.mean() == pytest.approx(100, rel=0.25)
    assert dark_current.HOT.fixed
    for wrong in ((2.0, 1.0), (0.1, -1.0), (np.nan, 1.0)):
        with pytest.raises(OutOfRange, match="hot"):
            dark_current.apply_hot(np.zeros((3, 3)), *wrong, np.random.default_rng(1))
