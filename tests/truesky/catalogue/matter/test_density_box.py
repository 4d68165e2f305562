"""The box of density: its linear power, growth and velocities."""

import numpy as np
import pytest
from scipy import fft

from lake_schema.errors import BadInput
from tests.truesky import nightly
from truesky.catalogue.matter import density_box
from truesky.cosmology import FIDUCIAL


def spectrum(field, cell):
    """P(k) of a cube in bins: (edges, P, k of every mode)."""
    n = field.shape[0]
    power = np.abs(fft.rfftn(field)) ** 2 * (cell**3 / n**3)
    axis, half = 2 * np.pi * np.fft.fftfreq(n, cell), 2 * np.pi * np.fft.rfftfreq(n, cell)
    k = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + half**2)
    weight = np.full(power.shape, 2.0)
    weight[..., 0] = weight[..., -1] = 1.0
    return k, power, weight


def test_sigma_8():
    k = np.geomspace(1e-4, 50.0, 20_000)
    x = 8.0 * k
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    variance = np.trapezoid(density_box.linear_power(FIDUCIAL, k) * window**2 * k**3 / (2 * np.pi**2), np.log(k))
    assert np.sqrt(variance) == pytest.approx(0.83, rel=0.01)


@nightly.parametrize(("low", "high", "within"), [(0.03, 0.06, 0.08), (0.06, 0.12, 0.05), (0.12, 0.2, 0.05)], (0,))
def test_the_box_has_the_linear_power(box, low, high, within):
    delta = density_box.overdensity(box, np.arange(box.n**3), 1.0).reshape((box.n,) * 3)
    k, power, weight = spectrum(delta, box.model.cell)
    inside = (k > low) & (k < high)
    linear = density_box.linear_power(FIDUCIAL, k[inside])
    assert np.sum(weight[inside] * power[inside]) / np.sum(weight[inside] * linear) == pytest.approx(1.0, abs=within)
    assert delta.min() >= -1.0
    assert delta.mean() == pytest.approx(0.0, abs=0.01)


def test_growth():
    """D of flat Lambda-CDM by its defining integral; f as its derivative."""
    z = np.array([0.0, 0.5, 1.0, 2.0, 10.0])
    a = np.linspace(1e-4, 1.0, 200_001)
    rate = np.sqrt(0.319 / a**3 + 0.681)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(a) * ((a * rate)[1:] ** -3 + (a * rate)[:-1] ** -3))])
    expected = np.interp(1 / (1 + z), a, rate * integral)
    assert FIDUCIAL.growth(z) == pytest.approx(expected / expected[0], rel=1e-3)
    step = 1e-4
    slope = -(1 + z) * (np.log(FIDUCIAL.growth(z + step)) - np.log(FIDUCIAL.growth(z))) / step
    assert FIDUCIAL.growth_rate(z, 0.55) == pytest.approx(slope, rel=0.01)


def test_velocities_are_those_of_linear_theory(box):
    """300 km/s in one direction at z = 0, less what is longer than the box; div v = -a H f delta."""
    factor = float(density_box.velocity_factor(box.model, 0.0))
    rms = np.array([factor * np.std(u, dtype=float) for u in box.velocity])
    assert rms == pytest.approx(np.full(3, 300.0), abs=40.0)
    divergence = sum(
        (np.roll(u, -1, axis) - np.roll(u, 1, axis)) / (2 * box.model.cell) for axis, u in enumerate(box.velocity)
    )
    smooth = box.smoothed[-1]
    assert np.corrcoef(divergence.ravel(), smooth.ravel())[0, 1] < -0.3


def test_smoothing_takes_variance(box):
    assert np.sqrt(box.variance) == pytest.approx([1.23, 1.39, 0.93, 0.78, 0.63], abs=0.02)


def test_the_gain_is_one_today_and_larger_before():
    gain = density_box.matter_gain(density_box.box_model(FIDUCIAL), np.array([0.4, 0.7, 1.0]))
    assert gain[-1] == pytest.approx(1.0, abs=1e-4)
    assert 1.25 > gain[0] > gain[1] > 1.0


def test_odd_boxes_are_refused():
    with pytest.raises(BadInput, match="even number"):
        density_box.load(1, 3, FIDUCIAL)


def test_colossus_writes_nothing_at_home(tmp_path):
    """In a fresh process whose home is empty."""
    import os
    import subprocess
    import sys

    code = (
        "import numpy as np; from truesky.catalogue.matter import linear_theory as t;"
        "from truesky.cosmology import FIDUCIAL as c;"
        "t.halo_tables(c, np.linspace(9, 15, 41), np.array([0.0, 1.0])); t.power(c, np.ones(1))"
    )
    environment = {**os.environ, "HOME": str(tmp_path), "TRUESKY_CACHE": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
