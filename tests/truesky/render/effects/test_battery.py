"""Every effect does nothing when off, does not change its arguments, keeps numbers finite, and has its properties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.truesky.render.effects.battery import CASES, CUT, EFFECTS, SHAPES, call, frame_of, shapes_of
from truesky.render import effects
from truesky.render.channels import ground, nisp_p, vis
from truesky.render.effects.light import intra_pixel

MOST = 4 * max(ny * nx for ny, nx in SHAPES)


def electrons(seed, empty, decades):
    """Whole electrons, some none, the rest over some decades."""
    rng = np.random.default_rng(seed)
    return np.floor(10 ** (decades * rng.random(MOST))) * (rng.random(MOST) >= empty)


# Frames are drawn by numpy because hypothesis takes a second to draw one.
ELECTRONS = st.builds(
    electrons, st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5, 0.95]), st.sampled_from([0.5, 2.5, 8.0])
)
named = pytest.mark.parametrize("name", CASES)


def promising(promise):
    return pytest.mark.parametrize("name", [name for name, case in CASES.items() if getattr(case, promise)])


def test_no_effect_is_forgotten():
    """Every file of the package with an `apply`, and every effect of a channel."""
    from importlib import import_module
    from pkgutil import walk_packages

    found = set()
    for module in walk_packages(effects.__path__, "truesky.render.effects."):
        for key, value in vars(import_module(module.name)).items():
            if key.startswith("apply") and key != "apply_all" and value.__module__ == module.name:
                found.add(value)
    # The response inside a pixel acts before there is a frame, and is in the package of PSFs.
    assert found == {case.apply for case in CASES.values()}
    assert intra_pixel.EFFECT.apply.__module__ == "truesky.render.psf.pixel_response"
    assert {e.apply for kind in (vis, nisp_p, ground) for effects in kind.EFFECTS.values() for e in effects} <= found


IN_PLACE = {name: case for name, case in CASES.items() if EFFECTS[case.name.split(":")[0]].in_place}


@pytest.mark.parametrize(
    ("name", "off"),
    [(name, off) for name, case in IN_PLACE.items() for off in (False, True)[: 1 + (case.off is not None)]],
)
def test_effects_in_place_have_the_same_result(name, off):
    case = CASES[name]
    shape = (4, 20, 30) if case.planes else (20, 30)
    frame = np.floor(np.random.default_rng(2).exponential(3e4, shape))
    expected, other = call(case, frame, off), np.empty(shape)
    assert call(case, frame, off, out=other) is other
    changed = frame.copy()
    assert call(case, changed, off, out=changed) is changed
    np.testing.assert_array_equal(other, expected)
    np.testing.assert_array_equal(changed, expected)


def test_effects_of_vis_need_no_new_frame():
    """Exceptions are the quadrants, which have other pixels than the frame, and effects of calibration frames."""
    new = {effect.name for effects in vis.EFFECTS.values() for effect in effects if not effect.in_place}
    assert new == {
        "quadrants", "readout_trail", "calibration_lamp", "charge_injection", "injection_noise",
        "trap_pumping",
    }  # fmt: skip


@named
@given(data=st.data(), electrons=ELECTRONS)
def test_arguments_are_not_written_and_numbers_stay_finite(name, data, electrons):
    case = CASES[name]
    frame = frame_of(case, data.draw(st.sampled_from(shapes_of(name))), electrons)
    before = frame.copy()
    after = call(case, frame)
    np.testing.assert_array_equal(frame, before)
    assert after is not frame
    assert after.dtype == case.dtype
    assert np.isfinite(after).all()
    if name not in CUT and not case.reshapes:
        assert after.shape == frame.shape
    if case.positive:
        assert after.min() >= 0
    if case.whole:
        np.testing.assert_array_equal(after, np.rint(after))


@named
@given(electrons=ELECTRONS)
def test_switched_off_it_is_the_identity(name, electrons):
    case = CASES[name]
    if case.off is None:
        return
    for shape in SHAPES:
        frame = frame_of(case, shape, electrons)
        np.testing.assert_array_equal(call(case, frame, off=True), frame)


@promising("zero")
def test_nothing_comes_of_nothing(name):
    case = CASES[name]
    for shape in shapes_of(name):
        assert (call(case, frame_of(case, shape, np.zeros(MOST))) == 0).all()


@promising("conserves")
@given(electrons=ELECTRONS)
def test_the_sum_stays(name, electrons):
    case = CASES[name]
    for shape in shapes_of(name):
        frame = frame_of(case, shape, electrons)
        assert call(case, frame).sum() == pytest.approx(frame.sum(), rel=1e-12)


@promising("linear")
@given(electrons=ELECTRONS, factor=st.floats(1e-3, 1e3))
def test_linear_where_claimed(name, electrons, factor):
    case = CASES[name]
    for shape in shapes_of(name):
        frame = frame_of(case, shape, electrons)
        base = factor * call(case, frame)
        np.testing.assert_allclose(call(case, factor * frame), base, rtol=1e-12, atol=1e-12 * (1 + np.abs(base).max()))


@named
def test_the_same_numbers_give_the_same_frame(name):
    case = CASES[name]
    frame = frame_of(case, (12, 10), np.random.default_rng(1).integers(0, 3000, MOST))
    np.testing.assert_array_equal(call(case, frame), call(case, frame))


@named
def test_it_does_something(name):
    case = CASES[name]
    frame = frame_of(case, (12, 10), np.random.default_rng(1).integers(0, 400_000, MOST))
    after = call(case, frame)
    assert after.shape != frame.shape or (after != frame).any()
