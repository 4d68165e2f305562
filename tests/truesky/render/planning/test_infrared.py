"""Planned NISP exposures: flats by lamp and band, ramps set by a block, persistence darks, and errors."""

import copy
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera.lamps import LAMPS
from truesky.render.channels import image_types
from truesky.render.effects.light import calibration_lamp
from truesky.render.plan_exposures import plan
from truesky.render.planning import survey, variants
from truesky.render.planning.planned_exposures import elapsed_time
from truesky.request.exposures import observations
from truesky.request.from_toml import from_table

MISSION = resolve()
BASE = {"name": "x", "seed": 7, "area": {"cone": {"ra": 150.0, "dec": 20.0, "radius": 0.5}}}
FLAT = {"channels": ["NISP-P"], "image_type": "flat"}
POINTING = {"channel": "NISP-P", "band": "euclid_h", "ra": 53.117, "dec": -27.808, "mjd": 60905.0}


def exposures(*blocks, mission=MISSION, **sections):
    wanted = from_table(copy.deepcopy({**BASE, "observation": list(blocks), **sections}))
    return survey.exposures(wanted, mission)


def flats(**more):
    return Counter((e.lamp, e.band) for e, _ in exposures({**FLAT, **more}))


def test_flats_are_in_bands_in_which_a_lamp_is_visible():
    """Each lamp has the same number of flats in each of its bands; 1190 nm is in both Y and J, which overlap there."""
    assert flats(exposures=2) == {
        (1, "euclid_y"): 2, (2, "euclid_j"): 2, (2, "euclid_y"): 2, (3, "euclid_j"): 2, (4, "euclid_h"): 2,
        (5, "euclid_h"): 2,
    }  # fmt: skip
    assert flats(exposures=3, bands=["euclid_h"]) == {(4, "euclid_h"): 3, (5, "euclid_h"): 3}
    assert flats(exposures=1, lamps=[5, 3]) == {(5, "euclid_h"): 1, (3, "euclid_j"): 1}
    for lamp, band in flats(exposures=1):
        assert calibration_lamp.led_efficiency(passbands.load(band), lamp, "nisp", MISSION) > 0.05


def test_invalid_lamps_are_refused():
    with pytest.raises(BadInput, match=r"^observation\[0\]\.lamps: 5 \(1880 nm\) is not visible in euclid_y$"):
        flats(exposures=1, bands=["euclid_y"], lamps=[5])
    for lamps, message in (
        ([6], r"\[0\] = 6 is outside \[1, 5\]"),
        ([1, 1], "contains a lamp twice"),
        ([], "is not"),
    ):
        with pytest.raises(BadInput, match=rf"observation\[0\]\.lamps.*{message}"):
            flats(exposures=1, lamps=lamps)
    # A wavelength of the user that VIS does not detect is refused only if the lamp is named.
    infrared_lamp = resolve(overrides={"vis.flat.led_2": (2000.0, "nm")})
    of_vis = {"channels": ["VIS"], "image_type": "flat", "exposures": 1}
    assert [e.lamp for e, _ in exposures(of_vis, mission=infrared_lamp)] == [1, 3, 4, 5, 6]
    with pytest.raises(BadInput, match=r"^observation\[0\]\.lamps: 2 \(2000 nm\) is not visible in euclid_vis$"):
        exposures({**of_vis, "lamps": [1, 2]}, mission=infrared_lamp)
    with pytest.raises(BadInput, match="lamps is not for dark: used by flat"):
        exposures({"channels": ["NISP-P"], "image_type": "dark", "exposures": 1, "lamps": [1]})


def test_number_of_lamps_agrees_with_requests():
    assert {"VIS": LAMPS["vis"][0], "NISP-P": LAMPS["nisp"][0], "NISP-S": LAMPS["nisp"][0]} == observations.LAMPS


def test_calibrations_without_a_date_follow_one_another():
    """A dark taken during a flat would contain the persistence of the flat."""
    found = exposures(
        {**FLAT, "exposures": 3, "lamps": [1]}, {"channels": ["NISP-P"], "image_type": "dark", "exposures": 2},
        {"channels": ["VIS"], "image_type": "dark", "exposures": 1},
        {"channels": ["NISP-P"], "image_type": "dark", "exposures": 1, "mjd": 60200.0},
        {"channels": ["NISP-P"], "image_type": "self_calibration", "exposures": 1},
    )  # fmt: skip
    launch, hours = MISSION.value("svm.launch", "d"), MISSION.value("nisp.persistence.window", "d")
    flats, darks, (vis,), (dated,), sky = (
        [e for e, _ in found[i:j]] for i, j in ((0, 3), (3, 5), (5, 6), (6, 7), (7, 10))
    )
    assert flats[0].mjd == vis.mjd == launch
    assert dated.mjd == 60200.0
    assert darks[0].mjd >= flats[-1].mjd + flats[-1].exposure_time_s / 86400 + hours
    assert sky[0].mjd >= 60200.0 + hours


def test_undated_blocks_never_expose_nisp_at_the_same_time():
    """In any order, each block begins when the earlier one has ended and its persistence has faded."""
    field = {"channels": ["NISP-P"], "ra": 53.117, "dec": -27.808, "dither": "none"}
    sky = {"channels": ["NISP-P"], "image_type": "self_calibration", "exposures": 2}
    dark = {"channels": ["NISP-P"], "image_type": "dark", "exposures": 2}
    hours = MISSION.value("nisp.persistence.window", "d")
    for blocks in ((field, sky, dark), (dark, field, field, sky)):
        wanted = from_table(copy.deepcopy({**BASE, "observation": list(blocks)}))
        ends = -1.0
        for i in range(len(blocks)):
            before = survey.exposures(replace(wanted, observations=wanted.observations[:i]), MISSION) if i else []
            upto = survey.exposures(replace(wanted, observations=wanted.observations[: i + 1]), MISSION)
            own = [e for e, _ in upto[len(before) :]]
            assert min(e.mjd for e in own) >= ends
            ends = max(e.mjd + e.exposure_time_s / 86400 for e in own) + hours
    # VIS has no persistence.
    dates = [e.mjd for e, _ in exposures({**field, "channels": ["VIS"]}, {**field, "channels": ["VIS"]})]
    assert dates[: len(dates) // 2] == dates[len(dates) // 2 :]


def test_exposures_of_long_ramps_follow_one_another():
    """Ramps whose reading takes longer than their integration; ramps of spectra used in filters."""
    dark = {"channels": ["NISP-P"], "image_type": "dark", "exposures": 3}
    fields = {"channels": ["NISP-P"], "fields": 1, "dither": "none"}
    for block, macc in ((dark, [2, 1000, 0]), (fields, [15, 16, 11])):
        found = [e for e, _ in exposures({**block, "macc": macc})]
        groups, reads, drops = macc
        frames = groups * reads + (groups - 1) * drops
        for before, now in pairwise(found):
            assert now.mjd - before.mjd > frames * MISSION.value("nisp.frame_time", "s") / 86400 - 1e-9


def test_spectra_with_a_ramp_leave_persistence_in_their_block():
    """With the same settings, exposures of a block leave persistence in later ones."""
    fields = {"channels": ["NISP-P", "NISP-S"], "fields": 1, "dither": "none", "macc": [4, 16, 5]}
    found = [e for e, _ in exposures(fields)]
    assert {e.channel for e in found} == {"NISP-P", "NISP-S"}
    assert len({e.settings for e in found}) == 1
    (spectrum,) = (e for e in found if e.channel == "NISP-S")
    assert spectrum.exposure_time_s == pytest.approx(378 * MISSION.value("nisp.frame_time", "s"))


@pytest.mark.parametrize(("macc", "seconds"), [([4, 16, 4], 200.0), ([2, 1, 0], 2.0)])
def test_a_ramp_with_a_different_exposure_time_is_refused(macc, seconds):
    block = {"channels": ["NISP-P"], "image_type": "dark", "exposures": 1, "macc": macc}
    with pytest.raises(BadInput, match=r"observation\[0\]: macc = .* takes .* s, not exposure_time_s"):
        exposures({**block, "exposure_time_s": seconds})
    own = (macc[0] - 1) * (macc[1] + macc[2]) * MISSION.value("nisp.frame_time", "s")
    ((found, _),) = exposures({**block, "exposure_time_s": round(own, 2)})
    assert found.exposure_time_s == pytest.approx(own, abs=0.01)


def test_an_exposure_time_between_two_ramps_is_refused():
    """98.1 s are 67.5 frames in three differences of 16 reads; with 22 or 23 frames each, the time is 2 % off."""
    with pytest.raises(BadInput, match=r"exposure time 98\.1 s: MACC\(4,16,6\) takes 95\.96 s, .* more than 2%"):
        exposures({**FLAT, "exposures": 1, "exposure_time_s": 98.1})


@pytest.mark.parametrize(
    ("key", "value", "unit"),
    [("nisp.frame_time", 0.0, "s"), ("nisp.ipc.side", 0.11, ""), ("nisp.ipc.diagonal", 0.2, "")],
)
def test_invalid_ramp_parameters_are_refused_with_the_request(key, value, unit):
    overrides = {key: {"value": value, "unit": unit}}
    with pytest.raises(BadInput, match=key):
        from_table({**BASE, "pointing": [POINTING], "mission": {"overrides": overrides}})


def test_too_much_capacitance_is_refused_with_the_request():
    overrides = {f"nisp.ipc.{part}": {"value": 0.07, "unit": ""} for part in ("side", "diagonal")}
    with pytest.raises(BadInput, match=r"nisp\.ipc: neighbours receive 0\.56 of a pixel's charge"):
        from_table({**BASE, "pointing": [POINTING], "mission": {"overrides": overrides}})


def test_a_ramp_applies_to_its_block_only():
    """The ramp sets the exposure times of the block, but not of VIS or of other blocks."""
    dark = {"channels": ["NISP-P"], "image_type": "dark", "exposures": 1}
    fields = {"channels": ["VIS", "NISP-P"], "fields": 1, "dither": "none", "short": False, "flat": False}
    found = exposures({**dark, "macc": [15, 16, 11]}, dark, {**fields, "macc": [2, 1, 0]})
    frame = MISSION.value("nisp.frame_time", "s")
    times = [(e.channel, e.exposure_time_s) for e, _ in found]
    assert times[:2] == [("NISP-P", pytest.approx(378 * frame)), ("NISP-P", pytest.approx(60 * frame))]
    assert [time for channel, time in times[2:] if channel == "NISP-P"] == [pytest.approx(frame)] * 3
    for exposure, own in found:
        with_own = variants.variant(exposure.settings, MISSION, None, {}).mission
        assert with_own.fingerprint == own.fingerprint
        assert (exposure.settings is None) == (exposure.channel == "VIS" or exposure is found[1][0])


def test_an_exploration_and_a_block_s_ramp():
    dark = {"channels": ["NISP-P"], "image_type": "dark", "exposures": 1, "macc": [3, 2, 1]}
    explored = {"nisp.gain": {"values": [1.0, 2.0], "unit": "electron / adu"}}
    own = [mission for _, mission in exposures(dark, explore=explored)]
    assert [mission.value("nisp.gain") for mission in own] == [1.0, 2.0]
    assert {mission.value("nisp.macc.photometric.groups") for mission in own} == {3.0}


MACC = r"observation\[0\]\.macc"


@pytest.mark.parametrize(
    ("macc", "message"),
    [
        ([0, 16, 4], rf"{MACC}\[0\] \(groups\) = 0 is outside \[2, 1000\]"),
        ([4, 16, -1], rf"{MACC}\[2\] \(drops\) = -1 is outside"),
        ([4, 16.0, 4], rf"{MACC}\[1\] \(reads\) must be a whole number from 1 to 1000, got 16.0"),
        ([4, True, 4], rf"{MACC}\[1\] \(reads\) must be a whole number from 1 to 1000, got True"),
        ([4, 16], rf"{MACC} = \[4, 16\] is not \[groups, reads, drops\]"),
        ("4,16,4", rf"{MACC} = '4,16,4' is not"),
        ([100, 30, 30], rf"{MACC} = \[100, 30, 30\] has 5970 frames, more than 4000"),
    ],
)
def test_invalid_ramps_are_refused(macc, message):
    with pytest.raises(BadInput, match=message):
        exposures({**FLAT, "exposures": 1, "macc": macc})


def test_a_ramp_requires_nisp():
    with pytest.raises(BadInput, match="macc is not for VIS: used by NISP-P, NISP-S"):
        exposures({"channels": ["VIS"], "image_type": "dark", "exposures": 1, "macc": [4, 16, 4]})


@pytest.mark.parametrize(
    "block",
    [
        {"image_type": "dark", "exposures": 1}, {"image_type": "flat", "exposures": 1},
        {"image_type": "standard_star", "exposures": 1}, {"image_type": "persistence"},
        {"ra": 53.117, "dec": -27.808, "dither": "none"},
    ],
)  # fmt: skip
def test_a_ramp_of_a_block_of_spectra(block):
    """In a block of spectra, the ramp applies to NISP-S, while NISP-P keeps the ramp of the mission."""
    found = exposures({"channels": ["NISP-S"], "macc": [8, 16, 11], **block})
    seconds = 7 * 27 * MISSION.value("nisp.frame_time", "s")
    for exposure, mission in found:
        assert exposure.exposure_time_s == pytest.approx(seconds)
        assert mission.value("nisp.macc.spectroscopic.groups") == 8.0
        assert mission.value("nisp.macc.photometric.groups") == 4.0
        assert image_types.shared_settings(exposure.settings) is None


def test_flats_at_intensities():
    """Each intensity has the same number of frames, one after the other, and sets the level of its lamp."""
    found = exposures({**FLAT, "exposures": 2, "lamps": [3, 5], "intensities": [0.1, 1.0, 2.5]})
    level = MISSION.value("nisp.flat.signal")
    assert [(e.lamp, mission.value("nisp.flat.signal") / level) for e, mission in found] == [
        (lamp, pytest.approx(share)) for lamp in (3, 5) for share in (0.1, 1.0, 2.5) for _ in range(2)
    ]
    assert [e.settings is None for e, _ in found] == ([False] * 2 + [True] * 2 + [False] * 2) * 2
    # Both frames of a pair have their own date, on which their random numbers depend.
    assert all(earlier.mjd < later.mjd for (earlier, _), (later, _) in pairwise(found))
    of_dome = exposures({**FLAT, "channels": ["EXT"], "survey": "des", "exposures": 2, "intensities": [0.5, 1.0]})
    assert Counter((e.lamp, e.band, e.settings is None) for e, _ in of_dome) == {
        (1, f"des_{band}", at_full_level): 2 for band in "griz" for at_full_level in (False, True)
    }
    of_vis = exposures({"channels": ["VIS"], "image_type": "flat", "exposures": 1, "intensities": [0.5]})
    assert of_vis[0][1].value("vis.flat.signal") == 0.5 * MISSION.value("vis.flat.signal")
    # Each variant has its explored value, which the intensity of a lamp multiplies.
    explored = {"nisp.flat.signal": {"values": [1e4, 2e4], "unit": "electron"}}
    two = exposures({**FLAT, "exposures": 1, "lamps": [3], "intensities": [3.0]}, explore=explored)
    assert [mission.value("nisp.flat.signal") for _, mission in two] == [3e4, 6e4]
    assert len({image_types.shared_settings(e.settings) for e, _ in two}) == 2
    for values, message in (([], "not a list"), ([0.0], r"intensities\[0\]"), ([1.0, 1.0], "twice")):
        with pytest.raises(BadInput, match=rf"observation\[0\]\.intensities.*{message}|{message}"):
            exposures({**FLAT, "exposures": 1, "intensities": values})
    with pytest.raises(BadInput, match="intensities is not for dark: used by flat, persistence"):
        exposures({"channels": ["NISP-P"], "image_type": "dark", "exposures": 1, "intensities": [1.0]})


REMEMBERED = {"channels": ["NISP-P"], "image_type": "persistence"}


def test_darks_after_a_bright_exposure():
    """From 100 s to two hours after its end; the next bright exposure and channel wait until persistence has faded."""
    found = [e for e, _ in exposures({**REMEMBERED, "channels": ["NISP-P", "NISP-S"], "exposures": 2, "lamps": [3]})]
    window, at = MISSION.value("nisp.persistence.window", "d"), 0
    for size in (8, 8, 5, 5):
        bright, *darks = found[at : at + size]
        at += size
        ends = bright.mjd + elapsed_time(bright, MISSION) / 86400.0
        after = [round((dark.mjd - ends) * 86400.0) for dark in darks]
        listed = [100, 300, 600, 1200, 2400, 4800, 7000]
        # Ramps of NISP-S take 573 s.
        assert after == (listed if bright.channel == "NISP-P" else [100, 1200, 2400, 4800])
        assert (bright.image_type, bright.lamp) == ("flat", 3)
        assert {(dark.image_type, dark.lamp, dark.channel) for dark in darks} == {("persistence", None, bright.channel)}
        if at < len(found):
            assert found[at].mjd >= darks[-1].mjd + elapsed_time(darks[-1], MISSION) / 86400.0 + window - 1e-9


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"delays_s": [100.0, 150.0]}, r"delays_s: the dark at 150 s begins before the dark at 100 s ends"),
        ({"delays_s": [7200.0]}, "delays_s: 7200 s is too late, nisp.persistence.window allows"),
        ({"bright": "sky", "lamps": [3]}, "lamps must not be set if bright = 'sky'"),
        ({"bright": "moon"}, "bright"),
        ({"image_type": "dark", "exposures": 1, "delays_s": [100.0]}, "delays_s is not for dark: used by persistence"),
        ({"channels": ["VIS"]}, "image_type = 'persistence' is not a type of VIS"),
    ],
)
def test_invalid_persistence_darks_are_refused(more, message):
    with pytest.raises(BadInput, match=message):
        exposures({**REMEMBERED, **more})


def test_a_star_field_as_bright_exposure():
    """Star fields as images, or through the grism."""
    sky = {**REMEMBERED, "bright": "sky", "delays_s": [300.0]}
    photometry = [e for e, _ in exposures({**sky, "exposures": 2, "bands": ["euclid_h"]})]
    assert [e.image_type for e in photometry] == ["self_calibration", "persistence"] * 2
    assert {e.band for e in photometry[::2]} == {"euclid_h"}
    spectra = [e for e, _ in exposures({**sky, "channels": ["NISP-S"]})]
    assert [(e.image_type, e.grism) for e in spectra] == [("science", "RGS000"), ("persistence", None)]


@pytest.mark.parametrize("value", [0.0, 1.0, -4.0, 3.5])
def test_numbers_of_the_missions_ramp_must_be_integers(value):
    """A request that overrides or explores the ramp with other numbers is refused before anything is made."""
    key = "nisp.macc.photometric.groups"
    for sections in (
        {"mission": {"overrides": {key: {"value": value, "unit": ""}}}},
        {"explore": {key: {"values": [value], "unit": ""}}},
    ):
        with pytest.raises(BadInput, match=key):
            from_table({**BASE, "pointing": [POINTING], **sections})


def test_a_ramp_of_too_many_frames_is_refused_with_the_request():
    overrides = {"nisp.macc.photometric.groups": {"value": 400, "unit": ""}}
    with pytest.raises(BadInput, match=r"nisp\.macc\.photometric: MACC\(400,16,4\) has 7996 frames, more than 4000"):
        from_table({**BASE, "pointing": [POINTING], "mission": {"overrides": overrides}})


@pytest.mark.parametrize(("seconds", "message"), [(20.0, "takes 69.79 s without any drops"), (1e5, "more than 1000")])
def test_an_exposure_time_without_a_ramp_is_refused(tmp_path, seconds, message):
    one = from_table({**BASE, "pointing": [{**POINTING, "exposure_time_s": seconds}]})
    with pytest.raises(BadInput, match=rf"pointing\[0\]\.exposure_time_s: exposure time .*{message}"):
        plan(tmp_path, one)
    with pytest.raises(BadInput, match=rf"observation\[0\]: exposure time .*{message}"):
        exposures({**FLAT, "exposures": 1, "exposure_time_s": seconds})


def test_darks_are_in_bands_that_the_block_names():
    """Fluxes are computed only in these bands."""
    dark = {"channels": ["NISP-P"], "image_type": "dark", "exposures": 2}
    assert [e.band for e, _ in exposures(dark)] == ["euclid_y", "euclid_y"]
    assert [e.band for e, _ in exposures({**dark, "bands": ["euclid_h"]})] == ["euclid_h", "euclid_h"]
    assert {e.band for e, _ in exposures({**REMEMBERED, "bands": ["euclid_j"], "delays_s": [100.0]})} == {"euclid_j"}
