"""Values of a detector or an amplifier: the most specific one is used, and impossible places are refused by name."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission import detector_overrides, listing
from lake_schema.mission.checks import faults
from lake_schema.mission.configuration import resolve
from lake_schema.mission.detector_overrides import DetectorPlace
from lake_schema.mission.model import read_models
from lake_schema.mission.parameter import CAMERAS, read_all_parameters
from truesky.commands import __main__

GAIN = "electron / adu"
MISSION = resolve()
CAMERA_SECTIONS = ("vis", "nisp", *(f"ext.{camera}" for camera in CAMERAS))


def test_names_of_places_are_no_names_of_parameters():
    keys = {record.key for record in (*read_all_parameters(), *read_models())}
    assert not {key for key in keys if "@" in key or key.rpartition(".")[0] in keys}
    for section in CAMERA_SECTIONS:
        found = detector_overrides.detectors(section, MISSION)
        assert len(set(found)) == len(found) > 10
        assert not [name for name in found if "." in name or "@" in name]
    for section, count in (("vis", 4), ("nisp", 0), ("ext.decam", 2), ("ext.lsstcam", 16), ("ext.gpc1", 64)):
        assert len(detector_overrides.amplifiers(section, MISSION)) == count


@pytest.mark.parametrize("pattern", [pattern for pattern, _ in detector_overrides._read_scopes()])
def test_each_pattern_is_of_some_parameter(pattern):
    assert [record.key for record in read_all_parameters() if pattern.fullmatch(record.key)]


@given(
    given=st.dictionaries(st.sampled_from(["", "@3-4", ".E", ".G", "@3-4.E", "@1-1.F"]), st.floats(1.0, 9.0)),
    detector=st.sampled_from(["", "3-4", "1-1", "6-6"]),
)
def test_the_most_specific_value_is_used(given, detector):
    mission = resolve(overrides={f"vis.gain{where}": (value, GAIN) for where, value in given.items()})
    wanted = tuple(
        next(
            (given[where] for where in (f"@{detector}.{name}", f"@{detector}", f".{name}", "") if where in given),
            3.48,
        )
        for name in "HGFE"
    )
    found = mission.amplifier_values("vis.gain", GAIN, detector)
    assert (found * 4 if len(found) == 1 else found) == wanted
    # The value of a detector does not depend on the values of its amplifiers.
    assert mission.value("vis.gain", place=DetectorPlace(detector)) == given.get(f"@{detector}", given.get("", 3.48))
    assert mission.value("vis.gain", "electron / adu") == given.get("", 3.48)
    assert (mission.fingerprint == MISSION.fingerprint) == (not given)
    assert list(faults(mission)) == []


def test_each_camera_has_its_detectors():
    mission = resolve(
        overrides={
            "nisp.dark_current@DET23": (0.05, "electron / (s pix)"),
            "ext.decam.gain@N1": (4.0, GAIN),
            "vis.dark_current@3-4": (7.2, "electron / (h pix)"),
        }
    )
    assert mission.value("nisp.dark_current", place=DetectorPlace("DET23")) == 0.05
    assert mission.value("nisp.dark_current", place=DetectorPlace("DET22")) == 0.02
    assert mission.value("ext.decam.gain", place=DetectorPlace("N1")) == 4.0
    assert mission.value("vis.dark_current", "electron / (s pix)", DetectorPlace("3-4", "E")) == pytest.approx(
        0.002, abs=0
    )
    later = mission.with_overrides({"nisp.dark_current@DET22": (0.03, "electron / (s pix)")})
    assert later.value("nisp.dark_current", place=DetectorPlace("DET22")) == 0.03
    assert later.value("nisp.dark_current", place=DetectorPlace("DET23")) == 0.05


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("vis.gain.X", "vis has no amplifier 'X', only H, G, F, E"),
        ("vis.gain@3-4.Q", "vis has no amplifier 'Q', only H, G, F, E"),
        ("vis.gain@7-1", "vis has no detector '7-1', only 36 from 1-1 to 6-6"),
        ("vis.gain@", "name of the detector is missing"),
        ("vis.gain@.E", "name of the detector is missing"),
        ("vis.gain.", "name of the amplifier is missing"),
        ("vis.gain@3-4.", "name of the amplifier is missing"),
        ("vis.gains.E", "no such parameter"),
        ("vis.amplifiers.E", "no such parameter"),
        ("vis.cti.age.E", r"may differ between detectors \(vis.cti.age@NAME\), not between their amplifiers"),
        ("vis.exposure_time@3-4", "vis.exposure_time must have one value for the whole camera"),
        ("nisp.gain@DET55", "nisp has no detector 'DET55', only DET11, .*, DET44"),
        ("nisp.gain.E", "not between their amplifiers"),
        ("ext.decam.gain@3-4", "ext.decam has no detector '3-4', only 62"),
    ],
)
def test_a_missing_place_is_refused_by_name(name, words):
    key = detector_overrides.split_name(name, MISSION)[0]
    unit = MISSION.parameter(key).unit if key in [record.key for record in read_all_parameters()] else ""
    with pytest.raises(BadInput, match=words) as error:
        resolve(overrides={name: (3.0, unit)})
    assert str(error.value).startswith(f"mission override {name}: ")
    assert len(str(error.value)) < 300


def test_units_and_bounds_are_the_parameters():
    with pytest.raises(BadInput, match=r"vis\.gain\.E: the unit must be electron / adu"):
        resolve(overrides={"vis.gain.E": (3.0, "s")})
    with pytest.raises(OutOfRange, match=r"vis\.gain@3-4\.E"):
        resolve(overrides={"vis.gain@3-4.E": (-3.0, GAIN)})


# ------------------------------------------------------------------------------------------------ list


def test_the_list_has_every_name_with_its_bounds():
    mission = resolve(overrides={"vis.gain@3-4.E": (3.3, GAIN)})
    entries = {entry.name: entry for entry in listing.list_entries(mission)}
    assert set(entries) == {p.key for p in mission.parameters} | {m.key for m in mission.models}
    for name in ("vis.gain", "vis.gain@3-4.E"):
        assert entries[name].bounds == (1e-3, 1e3)
        assert entries[name].by == "amplifier"
    assert entries["vis.gain@3-4.E"].status == "SIM"
    assert (entries["vis.dark_current"].by, entries["vis.exposure_time"].by) == ("detector", "")
    # Bounds are converted to the unit of the parameter.
    lo, hi = entries["svm.launch"].bounds or (0.0, 1e9)
    assert lo <= mission.value("svm.launch") <= hi
    for entry in entries.values():
        assert entry.bounds is None or entry.bounds[0] <= entry.value <= entry.bounds[1]


def test_the_list_is_aligned_and_filtered(capsys, tmp_path):
    assert __main__.main(["mission", "list", "VIS.gain"]) == 0
    head, line = capsys.readouterr().out.splitlines()
    assert line.startswith("vis.gain  3.48   electron / adu  0.001 .. 1000  amplifier      CBE     GalSim-Euclid-Like")
    assert head.index("status") == line.index("CBE")
    request = tmp_path / "r.toml"
    request.write_text('[mission]\noverrides = {"vis.gain.E" = {value = 3.3, unit = "electron / adu"}}\n')
    assert __main__.main(["mission", "list", "*.gain*", "--of", str(request), "--json"]) == 0
    found = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert found["vis.gain.E"]["value"] == 3.3
    assert "nisp.gain_spread" in found
    assert __main__.main(["mission", "list", "nothing"]) == 2
    assert capsys.readouterr().err == (
        "truesky mission: no name of the mission database matches 'nothing'; "
        'patterns such as "vis.*noise*" select several\n'
    )


def test_one_configuration_is_compared_with_the_default(capsys, tmp_path):
    request = tmp_path / "r.toml"
    request.write_text('[mission]\noverrides = {"vis.gain.E" = {value = 3.3, unit = "electron / adu"}}\n')
    assert __main__.main(["mission", "diff", str(request)]) == 1
    assert capsys.readouterr().out == "vis.gain.E: 3.3 electron / adu (SIM) -> absent\n"
    assert __main__.main(["mission", "diff", "CBE,BLT,DES,REQ,SIM"]) == 0
