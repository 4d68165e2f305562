"""Properties of the traps that an observer derives from frames of injected charge."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import optimize
from scipy.ndimage import binary_dilation

from lake_schema.mission.configuration import resolve
from tests.truesky.render import calibrated, fields
from truesky.render.camera import detectors
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.scene import Scene
from truesky.render.products import headers
from truesky.request.accuracy import SURVEY

# Effects that an observer has corrected.
UNDONE = dict.fromkeys(
    ("nonlinearity", "crosstalk", "detector_crosstalk", "bias_structure", "bias_drift", "row_noise"), False
)


def electrons(kind, shape, seconds, truth=(), forced=None, mjd=60126.0, **overrides):
    """Return the rendered detector, and the electrons [ny, nx] of its frame above the bias."""
    mission = resolve(overrides={f"vis.{key}": value for key, value in overrides.items()})
    ny, nx = shape
    detector = replace(detectors.detector("vis", "3-4", mission), nx=nx, ny=ny, injection_rows=0)
    none = fields.galaxies([], []), fields.stars([], [])
    tables = none[0], fields.fluxes(none[0], "euclid_vis", 0.0), none[1], fields.fluxes(none[1], "euclid_vis", 0.0)
    row = {"image_type": kind, "exposure_time_s": seconds, "mjd": mjd}
    one = fields.rendered(row, detector, tables, mission, SURVEY, forced=UNDONE | (forced or {}), truth=truth)
    return one, calibrated.electrons(one.raw, one.scene, 1, ())


def test_trails_behind_injected_rows_tell_the_traps():
    """The charge released behind the first block gives the density and the release time of the slow species."""
    # An observer removes cosmic rays by clipping several frames.
    clean = {"readout_cosmic_rays": False}
    _, found = electrons("charge_injection", (1200, 512), 0.0, forced=clean, mjd=60905.0, **{"cti.age": (1.0, "")})
    mission = resolve()
    on, off = (int(mission.value(f"vis.injection.{key}")) for key in ("on", "off"))
    first = on + off
    # Mean of both halves, from their registers on. The empty rows before a block contain no released charge.
    mean = 0.5 * (found + found[::-1])[:600].mean(axis=1)
    assert abs(mean[:off].mean()) < 0.5
    trail = mean[first : first + off]
    rows = np.arange(off)

    def given_back(k, total, tau):
        return total * (np.exp(-k / tau) - np.exp(-(k + 1) / tau))

    # The fast species are 5 % of the traps, and release their charge within a few rows.
    (total, tau), _ = optimize.curve_fit(given_back, rows[5:], trail[5:], (50.0, 10.0))
    volume = (mission.value("vis.injection.level") / mission.value("vis.cti.full_well")) ** 0.58
    # Charge in the trails fills some of the traps again, which makes the trails longer.
    assert total == pytest.approx(first * mission.value("vis.cti.density_3") * volume, rel=0.1)
    assert tau == pytest.approx(mission.value("vis.cti.release_3"), rel=0.15)
    every = sum(mission.value(f"vis.cti.density_{s}") for s in (1, 2, 3))
    assert trail.sum() == pytest.approx(first * every * volume, rel=0.1)
    # The first rows of the block have lost the charge of the trail. The loss ends when the traps are full.
    missing = (np.median(mean[first - 50 : first]) - mean[off:first]).clip(0.0)[:40].sum()
    assert missing == pytest.approx(trail.sum(), rel=0.25)


def test_dipoles_of_a_pumped_frame_are_where_the_truth_has_them():
    """In one noisy frame, nearly all significant pixels are dipoles.

    Most dipoles of the slow species are significant.
    """
    one, found = electrons(
        "trap_pumping", (512, 512), 1800.0, ("traps", "dipoles", "cosmic_rays"),
        **{"injection.off": (0.0, "pix"), "pumping.phase_time": (0.06, "s")},
    )  # fmt: skip
    dipoles, traps = one.maps["dipoles"], one.maps["traps"]
    assert dipoles.sum() == 0
    # Each column of a half has a separate level.
    level = np.concatenate([np.median(half, axis=0, keepdims=True).repeat(256, 0) for half in np.split(found, 2)])
    change = 0.5 * np.diff(found - level, axis=0)
    hit = binary_dilation(one.maps["cosmic_rays"] > 0, iterations=2)[:-1]
    noise = 1.4826 * np.median(np.abs(change))
    seen = (np.abs(change) > 5 * noise) & ~hit
    true = 0.5 * np.diff(dipoles.astype(float), axis=0)
    real = np.abs(true) > 250.0
    assert np.sign(change[seen & real]).tolist() == np.sign(true[seen & real]).tolist()
    assert (np.abs(true[seen]) > 100.0).mean() > 0.9
    assert seen[real & ~hit].mean() > 0.9
    # Pixels that lose charge contain a trap.
    assert (traps[dipoles < 0] > 0).all()


# First row of each half after its blocks of injected charge, from the serial register on: 200 rows are empty, 100 lit.
BEHIND = range(300, 2000, 300)
# Dates in MJD, and the damage on them: 0.03 at launch on MJD 60126, and 1 after six years.
DATES = {"2023-11-01": 60249.0, "2026-07-01": 61222.0, "2029-07-01": 62318.0}
DAMAGE = {date: 0.03 + 0.97 * (mjd - 60126.0) / (6.0 * 365.25) for date, mjd in DATES.items()}


@cache
def aged_halves(date, age=None):
    """Return the electrons of the two halves of a frame of injected charge on a date, from their registers on.

    `age` is the damage that the request sets, if any.
    """
    overrides = {} if age is None else {"cti.age": (age, "")}
    clean = {"readout_cosmic_rays": False}
    one, found = electrons("charge_injection", (4132, 512), 0.0, forced=clean, mjd=DATES[date], **overrides)
    (damage,) = (value for key, value, _ in headers.science_cards(one) if key == "CTIAGE")
    assert damage == pytest.approx(DAMAGE[date] if age is None else age, rel=1e-6)
    return np.stack([found[:2066], found[:2065:-1]])


def trail_of(date, age=None):
    """Return the released charge in the first 60 rows behind all blocks together, electrons per column."""
    halves = aged_halves(date, age).mean(axis=(0, 2))
    return sum(halves[first : first + 60].sum() for first in BEHIND)


def test_the_trail_of_a_pixel_is_seen_at_the_end_of_the_mission_only():
    """The pixel behind the last complete block, in units of the noise of a pixel, measured in the empty rows."""
    significance = {}
    for date in DATES:
        halves = aged_halves(date)
        significance[date] = halves[:, BEHIND[-1]].mean() / halves[:, :190].std()
    assert significance["2023-11-01"] < 1.0
    assert significance["2029-07-01"] > 5.0
    # Each trap of the far end is passed once in 1800 transfers, and is full to the power 0.58 of the injected charge.
    released = sum(n * -np.expm1(-1.0 / tau) for n, tau in ((0.02, 0.8), (0.03, 3.5), (0.95, 20.0)))
    expected = 1800 * released * (15_000.0 / 2e5) ** 0.58 * DAMAGE["2029-07-01"]
    assert significance["2029-07-01"] == pytest.approx(expected / 4.4, rel=0.1)


def test_the_trail_grows_in_proportion_to_the_time_since_launch():
    start = trail_of("2023-11-01")
    assert trail_of("2026-07-01") / start == pytest.approx(DAMAGE["2026-07-01"] / DAMAGE["2023-11-01"], rel=0.08)
    assert trail_of("2029-07-01") / start == pytest.approx(DAMAGE["2029-07-01"] / DAMAGE["2023-11-01"], rel=0.08)


def test_a_request_that_sets_the_damage_stops_its_growth():
    assert trail_of("2029-07-01", 0.5) == pytest.approx(trail_of("2023-11-01", 0.5), rel=0.03)
    mission = resolve(overrides={"vis.cti.age@3-4": (0.5, "")})
    other = resolve(overrides={"vis.cti.age": (0.1, ""), "vis.cti.age_growth": (0.2, "1 / yr")})
    for name, setting, wanted in (
        ("3-4", mission, 0.5), ("1-1", mission, DAMAGE["2029-07-01"]),
        ("1-1", other, 0.1 + 0.2 * (DATES["2029-07-01"] - 60126.0) / 365.25),
    ):  # fmt: skip
        scene = Scene(setting, "vis", 0.0, 0.0, 0.0, detectors.detector("vis", name, setting), mjd=DATES["2029-07-01"])
        assert charge_transfer.age(scene) == pytest.approx(wanted, rel=1e-6)
    # Before the launch, the detectors have the damage of the launch.
    assert charge_transfer.age(replace(scene, mission=resolve(), mjd=0.0)) == 0.03
