"""A configuration is written to a lake and read back, and two configurations are compared."""

import hashlib
import json

import pytest

from lake_schema.errors import BadInput, Damaged
from lake_schema.mission import compare, published
from lake_schema.mission.configuration import MissionConfiguration, differences, resolve
from lake_schema.mission.model import Model
from lake_schema.mission.parameter import Parameter
from lake_schema.store import publish, read
from lake_schema.store.plan import Plan, Task
from lake_schema.tables.mission import LADDER, MISSION
from truesky.commands import __main__

CHANGED = resolve(ladder=("SIM", *LADDER[:-1]), overrides={"vis.gain": (3.3, "electron / adu")})


def put(lake, configuration, **facts):
    about = {"mission": configuration.fingerprint, "ladder": list(configuration.ladder), **facts}
    plan = Plan(MISSION, about, (Task("all.parquet", {}),))
    publish.make_version(lake, plan, lambda root, facts: published.to_output(configuration))
    return read.version(lake, "mission")


PLACED = resolve(overrides={"vis.gain.E": (3.3, "electron / adu"), "vis.gain@3-4": (3.2, "electron / adu")})


@pytest.mark.parametrize("configuration", [resolve(), CHANGED, PLACED])
def test_a_configuration_survives_the_round_trip(tmp_path, configuration):
    version = put(tmp_path, configuration)
    back = published.read_back(version)
    assert back == MissionConfiguration(
        configuration.parameters, configuration.ladder, configuration.overridden, configuration.models, back.folder
    )
    assert back.fingerprint == configuration.fingerprint
    assert list(differences(back, configuration)) == []
    assert read.find_faults(version, deep=True) == []
    # The copies in the lake are used if the package's files have changed.
    for m in configuration.models:
        assert (back.folder / m.sha256).is_file()
    # A configuration that was read back can be published again with the same rows.
    assert published.to_table(back).equals(published.to_table(configuration))


def test_records_that_the_package_no_longer_has_come_back_too(tmp_path):
    content = b"a,b\n1,2\n"
    (tmp_path / "old").mkdir()
    sha256 = hashlib.sha256(content).hexdigest()
    (tmp_path / "old" / sha256).write_bytes(content)
    old = MissionConfiguration(
        (Parameter("vis.gone", "CBE", 3.0, "s", source="x"),),
        LADDER,
        (),
        (Model("vis.old", "CBE", "old.csv", sha256, source="x"),),
        tmp_path / "old",
    )
    back = published.read_back(put(tmp_path / "lake", old))
    assert back.value("vis.gone") == 3.0
    assert back.numbers("vis.old") == ((1.0, 2.0),)
    assert back.fingerprint == old.fingerprint


def test_a_configuration_is_cached_while_its_file_is_unchanged(tmp_path):
    """A second reader gets the cached configuration; a changed or missing file is refused by every reader."""
    version = put(tmp_path, resolve())
    assert published.read_back(read.version(tmp_path, "mission")) is published.read_back(version)
    file = version.folder / "dataset" / "all.parquet"
    whole = file.read_bytes()
    file.write_bytes(whole[:-50] + bytes(50))
    with pytest.raises(Damaged, match=r"all\.parquet"):
        published.read_back(version)
    file.write_bytes(whole)
    assert published.read_back(version).fingerprint == resolve().fingerprint
    file.unlink()
    with pytest.raises(Damaged, match="missing"):
        published.read_back(version)


def test_a_configuration_that_differs_from_its_manifest_is_refused(tmp_path):
    with pytest.raises(Damaged, match="is not the configuration 0000"):
        published.read_back(put(tmp_path, resolve(), mission="0" * 64))


# ------------------------------------------------------------------------------------------------ diff


def test_differences_are_named_with_both_values(tmp_path, capsys):
    request = tmp_path / "r.toml"
    request.write_text('[mission]\nladder = ["CBE", "BLT", "DES", "REQ", "SIM"]\n'
                       'overrides = {"vis.read_noise" = {value = 5, unit = "electron"}}\n')  # fmt: skip
    put(tmp_path / "lake", CHANGED)
    assert __main__.main(["mission", "diff", ",".join(LADDER), str(request)]) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line == "vis.read_noise: 4.4 electron (CBE) -> 5.0 electron (SIM)"
    assert __main__.main(["mission", "diff", ",".join(LADDER), ",".join(LADDER)]) == 0
    assert capsys.readouterr().out == ""
    assert __main__.main(["mission", "diff", "CBE,SIM,BLT,DES,REQ", str(tmp_path / "lake")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert "vis.gain: 3.48 electron / adu (CBE) -> 3.3 electron / adu (SIM)" in lines
    key = read.version(tmp_path / "lake", "mission").key
    assert __main__.main(["mission", "diff", f"{tmp_path}/lake@{key}", f"{tmp_path}/lake"]) == 0


def test_names_in_only_one_configuration_are_listed():
    some = MissionConfiguration((Parameter("a.b", "CBE", 1.0, "s", source="x"),))
    assert list(differences(some, MissionConfiguration(()))) == ["a.b: 1.0 s (CBE) -> absent"]
    assert list(differences(MissionConfiguration(()), some)) == ["a.b: absent -> 1.0 s (CBE)"]
    # Source and status of a value have no effect.
    other = MissionConfiguration((Parameter("a.b", "BLT", 1.0, "s", source="y"),))
    assert list(differences(some, other)) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[mission]\nladder = ['NEW']", "ladder"),
        ("[mission]\noverrides = {'vis.gain' = {value = 3, unit = 's'}}", "the unit must be electron / adu or"),
        ("[mission]\noverrides = {'vis.gain' = 3}", "request"),
        ("mission = 3", "request"),
        ("[mission", "request"),
    ],
)
def test_names_of_no_configuration_are_refused(tmp_path, capsys, text, words):
    path = tmp_path / "r.toml"
    path.write_text(text)
    assert __main__.main(["mission", "diff", "CBE,SIM,BLT,DES,REQ", str(path)]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    with pytest.raises(BadInput, match="neither"):
        compare.load_configuration(str(tmp_path / "nothing"))
    with pytest.raises(BadInput, match="neither"):
        compare.load_configuration("CBE,BEST")


def test_a_lake_without_the_table(tmp_path):
    with pytest.raises(BadInput, match="no table mission"):
        compare.load_configuration(str(tmp_path))
    (tmp_path / "mission").mkdir()
    (tmp_path / "mission" / "manifest.json").write_text(json.dumps({}))
    with pytest.raises(BadInput, match="no table mission"):
        compare.load_configuration(str(tmp_path))
