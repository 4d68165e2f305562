"""Figures of catalogues: labels of axes, error bars, and no figure without data."""

import numpy as np
import pytest

from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row
from truesky.validation.lake.suite import catalogue_figures, report
from truesky.validation.lake.suite.running import LakeResults


def count(mag, value, error=0.03):
    return Row("observed", f"log_i_{mag:g}", Place(), value, error, 3.0, 0.06, "", "a survey")


ROWS = [count(19.25, 3.0), count(19.75, 3.1, np.nan), count(26.0, -np.inf)]
THETA = np.array([0.4, 0.8, 1.6])


@pytest.fixture
def series():
    edges = np.linspace(0.0, 3.0, 31)
    number = np.exp(-((edges[1:] - 0.9) ** 2))
    ones = np.ones(3)
    return {
        "redshifts": np.stack([edges[:-1], edges[1:], number, 0.1 * number]),
        "colours": np.stack([np.array([0.1, 0.3, 0.5]), *(ones * k for k in range(5)), 0.1 * ones]),
        "colour_edges": np.linspace(-0.5, 2.5, 91), "colour_colour": np.eye(90),
        "w_22": np.stack([THETA, [0.1, 0.05, -0.01], 0.01 * ones, [0.1, 0.05, 0.02]]),
        "w_theory_22": np.stack([THETA, [0.1, 0.05, 0.02]]),
        "shear": np.stack([THETA, 1e-4 * ones, 2e-5 * ones, 1e-6 * ones, 1e-5 * ones, np.full(3, np.nan), 1e-6 * ones]),
        "shear_theory": np.stack([THETA, 1e-4 * ones, 2e-5 * ones]),
    }  # fmt: skip


def test_axes_have_labels_and_points_have_errors(series):
    drawn = list(catalogue_figures.draw_all(ROWS, series))
    assert len(drawn) == 5
    for caption, figure in drawn:
        assert caption.startswith("galaxies: ")
        assert all(axis.get_xlabel() or axis.get_label() == "<colorbar>" for axis in figure.axes)
        assert all(axis.get_ylabel() for axis in figure.axes)
    points = [axis for caption, figure in drawn if "colours of the fluxes" not in caption for axis in figure.axes]
    assert all(axis.containers for axis in points)


def test_no_figure_without_data():
    assert list(catalogue_figures.draw_all([], {})) == []
    assert list(catalogue_figures.draw_all(ROWS[2:], {})) == []
    (one,) = catalogue_figures.draw_all(ROWS, {})
    assert "a survey" in one[0]


def test_report_contains_figures(series):
    text = report.page("lake", LakeResults(ROWS, [], [Result(Place(), ROWS, series)]))
    assert text.count("src='data:image/png;base64,") == 5
    assert "non-linear theory" in text


def test_power_is_plotted_relative_to_theory():
    """Points of the redshift bins are beside each other, and each has its error."""
    ell, expected = np.array([100.0, 200.0]), np.array([4e-6, 1e-6])
    one = np.stack([ell, [8e-6, -1e-6], [1e-6, 2e-6], expected])
    series = {name: one for name in ("power_0.4", "power_0.6", "convergence_power_0.4", "convergence_power_0.6")}
    ((caption, figure),) = catalogue_figures.draw_all([], series)
    assert "Errors are those of Gaussian fields" in caption
    for axis in figure.axes:
        assert [text.get_text() for text in axis.get_legend().get_texts()] == ["0.4 < z < 0.6", "0.6 < z < 0.8"]
        points = [container.lines[0].get_xydata() for container in axis.containers]
        assert np.allclose([values[:, 1] for values in points], [2.0, -1.0], atol=1e-9)
        assert np.abs(points[0][:, 0] - points[1][:, 0]).min() > 1.0
        assert max(np.abs(values[:, 0] - ell).max() for values in points) < 4.0
