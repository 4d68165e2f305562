"""The page about assumed numbers is up to date, and its effects are those of images."""

from pathlib import Path

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from scripts import assumed_tables, draw_vis_amplifiers, rank_assumed_numbers

PAGE = Path(__file__).resolve().parents[2] / "docs" / "assumed_numbers.md"
MISSION = resolve()


def test_every_assumed_number_has_a_measured_effect():
    """If this fails, run: python -m scripts.rank_assumed_numbers"""
    assumed = [rank_assumed_numbers.identity(p) for p in rank_assumed_numbers.assumed_parameters(MISSION)]
    ranking = rank_assumed_numbers.read_ranking()
    assert [tuple(row[name] for name in rank_assumed_numbers.COLUMNS[:4]) for row in ranking] == assumed


def test_the_page_is_up_to_date():
    """If this fails, run: python -m scripts.assumed_tables > docs/assumed_numbers.md"""
    assert PAGE.read_text(encoding="utf-8") == assumed_tables.text()


def test_changed_numbers_are_allowed():
    changed = {
        p.key: (rank_assumed_numbers.changed_value(p), p.unit) for p in rank_assumed_numbers.assumed_parameters(MISSION)
    }
    found = resolve(overrides=changed)
    assert all(found.value(key) == value != MISSION.value(key) for key, (value, _) in changed.items())


def test_the_quadrants_of_vis_are_those_that_the_script_draws():
    """If this fails, write the output of `python -m scripts.draw_vis_amplifiers` to amplifier_values_vis.csv."""
    table = MISSION.content(MISSION.model("vis.amplifier_values")).decode()
    assert table.splitlines() == list(draw_vis_amplifiers.lines(MISSION))


def check_ranking(key, effect):
    """Compare an effect with that of docs/assumed_numbers.csv."""
    (row,) = (row for row in rank_assumed_numbers.read_ranking() if row["parameter"] == key)
    assert row["image"] == effect.image
    assert effect.noise == pytest.approx(float(row["noise"]), rel=0.1)
    assert effect.level == pytest.approx(float(row["level"]), rel=0.1, abs=1e-3)
    assert effect.flux == pytest.approx(float(row["flux"]), abs=1.0)


def electrons_of_sky(camera, band, mission=MISSION):
    exposure = rank_assumed_numbers._exposure(camera, band, "science", mission)
    return exposure.sky * exposure.exposure_time_s


def test_the_effect_of_the_pixels_response_is_that_of_its_light():
    """A response with 0.25 % more scatter changes each pixel by as much of its light, that of the sky and of stars."""
    key = "ext.decam.prnu"
    effect = rank_assumed_numbers.measure(MISSION.parameter(key))
    check_ranking(key, effect)
    unchanged = rank_assumed_numbers._draw_unchanged("decam", "des_r", "science", rank_assumed_numbers._SIDE)
    light = np.asarray(rank_assumed_numbers._electrons(unchanged), float)
    change = np.clip(0.0025 * light / unchanged.scene.pixel_noise, 0.0, 10.0)
    assert effect.noise == pytest.approx(np.sqrt((change**2).mean()), rel=0.05)
    assert abs(effect.level) < 0.01


def test_the_effect_of_the_sky_is_that_of_its_light():
    """A dark sky that is brighter by 0.2 mag has 20.2 % more electrons; the Moon's light is added."""
    key = "ext.jpcam.jedis_g.sky_brightness"
    effect = rank_assumed_numbers.measure(MISSION.parameter(key))
    check_ranking(key, effect)
    sky = electrons_of_sky("jpcam", "jedis_g")
    brighter = electrons_of_sky("jpcam", "jedis_g", resolve(overrides={key: (effect.changed_to, "mag / arcsec2")}))
    assert 1.1 < brighter / sky <= 10.0**0.08
    noise = np.hypot(np.sqrt(sky), MISSION.value("ext.jpcam.read_noise"))
    assert effect.level == pytest.approx((brighter - sky) / noise, rel=0.02)
    assert effect.noise == pytest.approx(effect.level, rel=0.02)
