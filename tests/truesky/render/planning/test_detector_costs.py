"""Forecast of a plan: costs of a detector, their sums, and a dry run that writes nothing."""

import json
from pathlib import Path

import pytest

from lake_schema.tables.exposures import CHANNELS
from tests.truesky.render.planning.test_survey import VIS, planned
from truesky.commands import plan
from truesky.render.channels import image_types, registry
from truesky.render.exposure import truth_maps
from truesky.render.forecasting import forecast, speed
from truesky.render.planning import detector_costs
from truesky.request.accuracy import DRAFT, REFERENCE, SURVEY
from truesky.request.schema import READOUTS
from truesky.running import submitted_job

DEMO = Path(__file__).parents[4] / "requests" / "demo.toml"
PIXELS = 4096 * 4132
SKY = registry.CHANNELS["VIS"].effects["science"]


def test_cost_increases_with_pixels_and_sources():
    base = detector_costs.cost_model("VIS", True, SKY)
    assert base.seconds(PIXELS, 1000, 0) < base.seconds(PIXELS, 2000, 0) < base.seconds(2 * PIXELS, 2000, 100)
    tiers = [
        detector_costs.cost_model("VIS", True, SKY, accuracy).seconds(PIXELS, 5000, 0)
        for accuracy in (DRAFT, SURVEY, REFERENCE)
    ]
    assert tiers == sorted(set(tiers))
    fewer = detector_costs.cost_model("VIS", True, SKY[:-5])
    assert base.seconds(PIXELS, 0, 0) - fewer.seconds(PIXELS, 0, 0) == pytest.approx(
        sum(effect.cost for effect in SKY[-5:]) * PIXELS / 1e6
    )
    # A bias frame has no sky and no light.
    bias = detector_costs.cost_model("VIS", False, registry.CHANNELS["VIS"].effects["bias"])
    assert bias.seconds(PIXELS, 5000, 10) == bias.seconds(PIXELS, 0, 0) < 0.7 * base.seconds(PIXELS, 0, 0)


def test_spectra_of_faint_sources_take_no_time():
    costs = detector_costs.cost_model("NISP-S", True, registry.CHANNELS["NISP-S"].effects["science"])
    most = costs.most_sources
    bare, full, deeper = (costs.seconds(PIXELS, galaxies, 0.1 * most) for galaxies in (0.0, 0.9 * most, 9.9 * most))
    assert bare < full == pytest.approx(deeper)
    assert full - bare == pytest.approx(0.9 * most * costs.galaxy_s)
    # Images without spectra show faint sources too.
    direct = detector_costs.cost_model("NISP-P", True, registry.CHANNELS["NISP-P"].effects["science"])
    assert direct.seconds(PIXELS, most, 0) < direct.seconds(PIXELS, 10 * most, 0)


def test_images_in_electrons_have_more_bytes_and_no_overscan():
    """Compare with the files: of 2.3 million pixels read out, 2.1 million belong to the detector."""
    raw, read = 2_100_000, 2_300_000
    effects = registry.CHANNELS["EXT"].effects["science"]
    for whole, times in ((False, 1), (True, 2)):
        sizes = {
            way: detector_costs.cost_model("EXT", True, effects, files=detector_costs.OutputFiles(whole, way)).bytes(
                raw, read
            )
            - detector_costs.cost_model("EXT", True, effects, files=detector_costs.OutputFiles(whole, way)).bytes(0, 0)
            for way in READOUTS
        }
        assert sizes == {"raw": 2 * times * read, "amplifiers": 2 * times * read, "electrons": 4 * times * raw}
    # Converters with more than 16 bits.
    few, wide = (
        detector_costs.cost_model("EXT", True, effects, files=detector_costs.OutputFiles(has_32_bits=wide))
        for wide in (False, True)
    )
    assert wide.bytes(raw, read) - few.bytes(raw, read) == 2 * read


def test_each_truth_map_adds_its_bytes():
    sizes = {}
    for channel, kind, looks in (("VIS", "science", True), ("EXT", "science", True), ("VIS", "bias", False)):
        effects = registry.CHANNELS[channel].effects[kind]
        own = [
            detector_costs.cost_model(channel, looks, effects, SURVEY, maps).bytes(PIXELS, PIXELS)
            for maps in ((), tuple(truth_maps.BYTES_PER_PIXEL))
        ]
        sizes[channel, kind] = round((own[1] - own[0]) / PIXELS, 2)
    # All maps of a camera in space; from the ground, where satellites are seen, too; without any light.
    assert sizes == {("VIS", "science"): 21.0, ("EXT", "science"): 25.0, ("VIS", "bias"): 9.0}


def test_time_of_truth_maps_depends_on_effects():
    """CPU seconds of all maps of a detector with few sources, measured on a machine with calibration 0.45."""
    seen = {"VIS": 2.4, "EXT": 1.4}
    every_map = tuple(truth_maps.BYTES_PER_PIXEL)
    # Measured without cosmic rays and ghosts on the ground.
    measured = {"VIS": every_map, "EXT": tuple(name for name in every_map if name not in ("cosmic_rays", "ghosts"))}
    for channel, seconds in seen.items():
        effects = registry.CHANNELS[channel].effects["science"]
        none, every = (
            detector_costs.cost_model(channel, True, effects, SURVEY, maps).seconds(PIXELS, 300, 30)
            for maps in ((), measured[channel])
        )
        assert 0.45 * (every - none) == pytest.approx(seconds, abs=0.2)
    light, hits = (
        detector_costs.cost_model("VIS", True, SKY, SURVEY, (name,)).seconds(PIXELS, 0, 0)
        for name in ("noise_free", "cosmic_rays")
    )
    assert hits > light
    # Stars are drawn a second time for their map.
    again = [detector_costs.cost_model("VIS", True, SKY, SURVEY, maps).star_s for maps in ((), ("stars",))]
    assert again[1] == 2 * again[0]


def test_forecast_depends_on_options_of_the_request(tmp_path):
    pointing = [{**VIS, "detectors": ["3-4"]}]
    off = {"off": ["parallel_cti", "serial_cti"]}
    explore = {"accuracy": ["draft", "reference"], "effects.cosmic_rays": [True, False]}
    (plain,) = planned(tmp_path, pointing=pointing)[1].to_pylist()
    (cheap,) = planned(tmp_path, pointing=pointing, effects=off)[1].to_pylist()
    (draft,) = planned(tmp_path, pointing=pointing, accuracy="draft")[1].to_pylist()
    dear = sum(effect.cost for effect in SKY if effect.name in off["off"])
    assert plain["seconds"] - cheap["seconds"] == pytest.approx(1e-6 * PIXELS * dear, rel=0.01)
    assert plain["seconds"] - cheap["seconds"] > 0.5
    assert draft["seconds"] < plain["seconds"]
    assert len({row["seconds"] for row in planned(tmp_path, pointing=pointing, explore=explore)[1].to_pylist()}) == 4


def test_the_forecast_adds_up(tmp_path):
    block = [{"channels": ["VIS", "NISP-S"], "fields": 1}, {"channels": ["VIS"], "image_type": "bias", "exposures": 3}]
    exposures, tasks = planned(tmp_path, observation=block)
    lines = forecast.summarise(exposures, tasks)
    assert [(line.channel, line.survey, line.image_type) for line in lines] == [
        ("NISP-S", "wide", "science"),
        ("VIS", "calibration", "bias"), ("VIS", "wide", "flat"), ("VIS", "wide", "science"),
        ("NISP-S", "all", ""), ("VIS", "all", ""), ("all", "all", ""),
    ]  # fmt: skip
    assert [line.exposures for line in lines] == [4, 3, 1, 5, 4, 9, 13]
    for of_channel in lines[4:6]:
        own = [line for line in lines[:4] if line.channel == of_channel.channel]
        assert of_channel.detectors == sum(line.detectors for line in own)
        assert of_channel.core_hours == pytest.approx(sum(line.core_hours for line in own))
    assert lines[-1].detectors == len(tasks)
    assert lines[-1].core_hours * 3600 == pytest.approx(sum(tasks["seconds"].to_pylist()))
    assert lines[-1].gigabytes * 1e9 == pytest.approx(sum(tasks["bytes"].to_pylist()))
    *_, said = text = list(forecast.format_table(lines, speed.Speed(0.5, "as a test says")))
    assert len(text) == 9
    assert "as a test says: 0.50" in said
    assert [line.core_hours for line in forecast.summarise(exposures, tasks, 0.5)] == [
        0.5 * line.core_hours for line in lines
    ]


def test_a_dry_run_prints_the_forecast_and_writes_nothing(tmp_path, capsys):
    lake = tmp_path / "lake"
    assert submitted_job.main(plan.JOB, ["--lake", str(lake), "--request", str(DEMO), "--dry-run"]) == 0
    lines, whole_run = (table.splitlines() for table in capsys.readouterr().out.split("\n\n"))
    jobs = [
        "start",
        "build_galaxies",
        "build_stars",
        "compute_fluxes",
        "plan_exposures",
        "render_exposures",
        "pictures",
    ]
    assert [line.split()[0] for line in whole_run[:8]] == ["cost", *jobs]
    assert lines[0].startswith("channel")
    assert lines[-2].split()[:2] == ["all", "all"]
    assert lines[-1].startswith("CPU times are for this machine, from a calibration")
    assert not lake.exists()


def test_the_forecast_of_a_dry_run_as_json(tmp_path, capsys):
    words = ["--lake", str(tmp_path / "lake"), "--request", str(DEMO)]
    assert submitted_job.main(plan.JOB, [*words, "--dry-run", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [line["channel"] for line in printed["images"]] == ["EXT", "VIS", "EXT", "VIS", "all"]
    assert printed["images"][-1]["detectors"] == printed["cost"]["detectors"] == 2
    assert submitted_job.main(plan.JOB, [*words, "--json"]) == 2
    assert capsys.readouterr().err == "plan_exposures: --json needs --dry-run: it prints the forecast as JSON\n"
    assert not (tmp_path / "lake").exists()


@pytest.mark.parametrize("channel", registry.CHANNELS)
def test_every_channel_has_measured_costs(channel):
    own = registry.CHANNELS[channel]
    of_nisp = ("redraw_s", "release_s", "group_s", "lamp_frame_s")
    assert min(getattr(own.cost, name) for name in own.cost.__slots__ if name not in of_nisp) > 0.0
    assert (own.cost.lamp_frame_s > 0.0) == (own.cost.group_s > 0.0) == bool(own.ramp_name)
    assert (own.cost.redraw_s > own.cost.release_s > 0.0) == (own.persistence_effect is not None)


def test_every_channel_can_be_planned():
    assert sorted(registry.CHANNELS) == sorted(dict(CHANNELS))
    for name in dict(CHANNELS):
        assert set(image_types.SKY_TYPES) <= set(registry.CHANNELS[name].sky_types)
    assert [name for name in dict(CHANNELS) if "flat" in registry.CHANNELS[name].sky_types] == ["VIS"]


def test_a_bright_lamp_costs_time_in_ramps():
    effects = registry.CHANNELS["NISP-S"].effects
    flat, faint = (
        detector_costs.cost_model("NISP-S", False, effects["flat"], ramp_load=detector_costs.RampLoad(15, frames))
        for frames in (394, 0)
    )
    assert flat.pixel_s - faint.pixel_s == pytest.approx(394e-6 * registry.CHANNELS["NISP-S"].cost.lamp_frame_s)


# Image type of NISP-P, keys of the observation, and CPU seconds in one process of a machine with a calibration of 0.83.
NISP_FRAMES = [
    ("dark", {}, 1.9),
    ("dark", {"macc": [8, 16, 11]}, 2.57),
    ("dark", {"macc": [15, 16, 11]}, 4.6),
    ("flat", {"bands": ["euclid_h"], "lamps": [4], "intensities": [0.04]}, 1.98),
    ("flat", {"bands": ["euclid_h"], "lamps": [4], "intensities": [0.3]}, 7.4),
    ("flat", {"bands": ["euclid_h"], "lamps": [4], "intensities": [1.0]}, 7.8),
]


@pytest.mark.parametrize(("kind", "keys", "seconds"), NISP_FRAMES)
def test_the_time_of_nisp_calibration_frames_is_forecast(tmp_path, kind, keys, seconds):
    """The times were measured on frames of a whole detector; the forecast is within the accuracy of 25 %."""
    block = [{"channels": ["NISP-P"], "image_type": kind, "exposures": 1, "detectors": ["DET14"], **keys}]
    (task,) = planned(tmp_path, observation=block)[1].to_pylist()
    assert 0.8 < 0.83 * task["seconds"] / seconds < 1.25
