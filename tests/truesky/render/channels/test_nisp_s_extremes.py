"""NISP-S at the extremes: the brightest star, the largest galaxy, lines at band edges, redshifts, turned grisms."""

import time
import tracemalloc

import numpy as np
import pyarrow as pa
import pytest
from scipy.special import k1

from tests.truesky import nightly
from tests.truesky.render import infrared, spectroscopic
from tests.truesky.render.channels import spectral_lines
from tests.truesky.render.channels.spectral_lines import Lines
from tests.truesky.render.spectroscopic import TIME, strip
from truesky.fluxes import passbands
from truesky.render.products import truth_table
from truesky.render.sources import colours
from truesky.request.accuracy import DRAFT

BAND = passbands.load("nisp_red")


def rows(found):
    return truth_table.spectra(found).to_pylist()


def whole(found):
    """Check that a frame is finite and contains the light that its truth table lists."""
    assert np.isfinite(infrared.electrons(found)).all()
    assert np.isfinite(found.noise_free).all()
    assert found.noise_free.min() > -1e-3 * found.scene.pixel_noise - 1e-4 * found.noise_free.max()
    assert sum(row["drawn"] for row in rows(found)) == pytest.approx(found.noise_free.sum(dtype=float), rel=1e-4)
    assert all(row["drawn"] <= 1.001 * row["expected"] for row in rows(found))


def electrons(mag, detector):
    """Return the electrons in the whole first order of a source of an AB magnitude."""
    row = spectroscopic.exposed(detector)
    return 10 ** (-0.4 * (mag - row["zero_point"])) * TIME


@nightly.parametrize("angle", [0.0, 4.0], (1,))
def test_a_star_of_ab_2_in_order_0(angle):
    detector = strip(nx=512, ny=256)
    found = spectroscopic.rendered(
        [2.0], [1380.0], [128.0 + 1119 * np.tan(np.radians(angle))], detector, angle=angle, truth=("order_0",)
    )
    whole(found)
    (zeroth,) = (row for row in rows(found) if row["order"] == 0)
    assert 0.01 < zeroth["expected"] / electrons(2.0, detector) < 0.03
    # The wings of the PSF beyond the frame are not drawn.
    assert 0.9 < zeroth["drawn"] / zeroth["expected"] <= 1.0
    assert found.maps["order_0"].sum(dtype=float) == pytest.approx(zeroth["drawn"], rel=1e-5)


@pytest.mark.nightly
def test_a_galaxy_of_half_a_minute_with_lines():
    """The galaxy is wider than the largest stamp: time and memory stay bounded, and the light is in place."""
    detector, column = strip(nx=1300, ny=1200), dict.fromkeys(colours.GALAXY_COLUMNS, 0.0)
    column |= {
        "kind": 0, "z_obs": 1.3, "mag_r01": 14.0, "abs_mag_r01": -22.0, "frac_1": 1.0, "sed_1": 8,
        "flux_halpha": 1e-13, "disk_half_light_radius": 30.0,
    }  # fmt: skip
    tracemalloc.start()
    start = time.process_time()
    found = spectroscopic.rendered([12.0], [620.0], [600.0], detector, body=column, accuracy=DRAFT)
    spent = time.process_time() - start
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    whole(found)
    (first,) = (row for row in rows(found) if row["order"] == 1)
    # 0.4 % of the light of a disc is outside five half-light radii.
    assert 0.98 < first["drawn"] / first["expected"] <= 1.0
    # The scale length is 60 pixels. Rows beyond the largest stamp have the expected light.
    y = np.linspace(300.0, 600.0, 400) * 1.6783469900166605 / (30.0 / detector.pixel_scale)
    rows_beyond = float(np.trapezoid(y * k1(y), y)) / np.pi
    high = round(first["y_first"] + first["y_last"]) // 2 + 300
    assert found.noise_free[high:].sum(dtype=float) / first["expected"] == pytest.approx(rows_beyond, rel=0.1)
    assert first["expected"] == pytest.approx(electrons(12.0, detector), rel=1e-3)
    assert spent < 60.0
    assert peak < 1.5e9


@nightly.parametrize("edge", ["first", "last"], (0,))
def test_a_line_leaves_the_passband_by_and_by(edge):
    """The light of a line decreases to zero with the response at the edge of the passband."""
    ends = BAND.wavelength[BAND.response > 1e-3 * BAND.response.max()]
    waves = ends[0] + np.linspace(60.0, -60.0, 4) if edge == "first" else ends[-1] + np.linspace(-60.0, 60.0, 4)
    light, detector = [], strip(nx=700, ny=64)
    for wave in waves:
        one = Lines(np.array([wave]), np.array([1e-15]), np.array([0.3]))
        place = np.array([[300.0], [30.0]])
        shining, dark = (spectral_lines.exposure(one, place, detector, on, accuracy=DRAFT) for on in (True, False))
        whole(shining)
        light.append(float((shining.noise_free - dark.noise_free).sum(dtype=float)))
    most = 1e-15 * electrons_of(ends.mean())
    assert np.abs(light[-1]) < 0.02 * most + 5.0
    assert np.all(np.diff(light) < 0.02 * most + 5.0)


def electrons_of(wavelength):
    """Return the electrons per erg s-1 cm-2 of a line."""
    return TIME * 9926.0 * float(np.interp(wavelength, BAND.wavelength, BAND.response)) * wavelength / 1.986e-8


@pytest.mark.parametrize("z", [0.0, 6.0])
def test_any_redshift(z):
    column = dict.fromkeys(colours.GALAXY_COLUMNS, 0.0)
    column |= {
        "kind": 0, "z_obs": z, "mag_r01": 22.0, "abs_mag_r01": -18.0, "frac_1": 1.0, "sed_1": 8,
        "disk_half_light_radius": 0.3, **{name: 1e-15 for name in column if name.startswith("flux_")},
    }  # fmt: skip
    found = spectroscopic.rendered([20.0], [300.0], [48.0], body=column)
    whole(found)
    (first,) = (row for row in rows(found) if row["order"] == 1)
    assert first["expected"] == pytest.approx(electrons(20.0, strip()), rel=1e-3)
    assert all(9000.0 < wave < 20000.0 for wave in first["line_wavelength"])


def test_a_grism_that_is_turned_by_30_deg():
    """All light of the first order lies along the tilted trace."""
    found = spectroscopic.rendered([17.0], [290.0], [200.0], strip(nx=640, ny=400), angle=30.0)
    whole(found)
    (first,) = (row for row in rows(found) if row["order"] == 1)
    turned = np.degrees(np.arctan2(first["y_last"] - first["y_first"], first["x_last"] - first["x_first"]))
    assert abs(turned) == pytest.approx(30.0, abs=1.5)
    assert first["drawn"] == pytest.approx(first["expected"], rel=0.02)


def test_all_orders_off_the_detector():
    found = spectroscopic.rendered([10.0, 5.0], [9000.0, 300.0], [48.0, 9000.0], truth=("order_1",))
    assert len(found.sources) == 0
    assert rows(found) == []
    assert not found.noise_free.any()
    assert np.isfinite(infrared.electrons(found)).all()
    assert isinstance(truth_table.spectra(found), pa.Table)
