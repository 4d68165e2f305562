"""Properties of the traps that an observer derives from frames of injected charge."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize
from scipy.ndimage import binary_dilation

from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields
from truesky.render.camera import detectors
from truesky.request.accuracy import SURVEY

# Effects that an observer has corrected.
UNDONE = dict.fromkeys(("nonlinearity", "crosstalk", "detector_crosstalk", "bias_structure"), False)


def electrons(kind, shape, seconds, truth=(), forced=None, **overrides):
    """Return the rendered detector, and the electrons [ny, nx] of its frame above the bias."""
    mission = resolve(overrides={f"vis.{key}": value for key, value in overrides.items()})
    ny, nx = shape
    detector = replace(detectors.detector("vis", "3-4", mission), nx=nx, ny=ny, injection_rows=0)
    none = fields.galaxies([], []), fields.stars([], [])
    tables = none[0], fields.fluxes(none[0], "euclid_vis", 0.0), none[1], fields.fluxes(none[1], "euclid_vis", 0.0)
    row = {"image_type": kind, "exposure_time_s": seconds}
    one = fields.rendered(row, detector, tables, mission, SURVEY, forced=UNDONE | (forced or {}), truth=truth)
    value = one.scene.value
    return one, (one.science - value("bias", "adu")) * value("gain", "electron / adu")


def test_trails_behind_injected_rows_tell_the_traps():
    """The charge released behind the first block gives the density and the release time of the slow species."""
    # An observer removes cosmic rays by clipping several frames.
    clean = {"readout_cosmic_rays": False}
    _, found = electrons("charge_injection", (1200, 512), 0.0, forced=clean, **{"cti.age": (1.0, "")})
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
