"""The ladder of statuses chooses one value per name, in any order of the records."""

import pickle
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import STATUSES, Parameter, read_all_parameters
from lake_schema.tables.mission import LADDER

RECORDS = (
    Parameter("a.gain", "REQ", 3.1, "electron / adu", source="x"),
    Parameter("a.gain", "CBE", 3.48, "electron / adu", source="x"),
    Parameter("a.gain", "SIM", 3.0, "electron / adu", source="x"),
    Parameter("a.length", "DES", 2.0, "mm", source="x"),
    Parameter("a.length", "SIM", 0.003, "m", source="x"),
)


def test_the_first_status_of_the_ladder_that_has_a_record_wins():
    chosen = resolve(RECORDS)
    assert chosen.value("a.gain") == 3.48
    assert chosen.value("a.length") == 2.0
    assert resolve(RECORDS, ("SIM", "DES")).value("a.length", "mm") == pytest.approx(3.0)
    assert resolve(RECORDS, ("REQ", "SIM")).value("a.gain") == 3.1


def test_as_simulated_is_the_last_resort():
    assert LADDER[-1] == "SIM"
    everything = resolve()
    with_other = {record.key for record in read_all_parameters() if record.status != "SIM"}
    assert with_other
    assert all(p.status != "SIM" for p in everything.parameters if p.key in with_other)


@given(st.randoms(use_true_random=False), st.permutations(STATUSES))
def test_the_order_of_the_records_does_not_matter(random, ladder):
    # A sample of records: all names of a camera, with a few statuses each.
    records = [record for record in read_all_parameters() if record.key.startswith(("vis.", "svm."))]
    expected = resolve(records, ladder)
    random.shuffle(records)
    assert resolve(records, ladder) == expected
    assert resolve(records, ladder).fingerprint == expected.fingerprint


@given(st.permutations(STATUSES))
def test_there_is_exactly_one_value_a_name(ladder):
    chosen = resolve(ladder=ladder)
    keys = [p.key for p in chosen.parameters]
    assert keys == sorted(set(keys)) == sorted({record.key for record in read_all_parameters()})
    assert set(chosen.parameters) <= set(read_all_parameters())


def test_later_and_newer_records_win_when_they_hold():
    old = Parameter("a.gain", "CBE", 3.0, "electron / adu", valid_from=60000.0, source="x")
    new = replace(old, value=3.2, valid_from=61000.0)
    newer = replace(new, value=3.3, version=2)
    records = (newer, old, new)
    assert resolve(records).value("a.gain") == 3.3
    assert resolve(records, mjd=60500.0).value("a.gain") == 3.0
    with pytest.raises(BadInput, match=r"a\.gain"):
        resolve(records, mjd=59000.0)


def test_the_fingerprint_follows_the_values():
    base = resolve()
    assert len(base.fingerprint) == 64
    assert resolve(overrides={"vis.exposure_time": (560.53, "s")}).fingerprint == base.fingerprint
    # An override of the camera's gain makes all quadrants alike, and one of the age stops the ageing.
    for name, unit in (("vis.gain", "electron / adu"), ("vis.cti.age", ""), ("ext.jpcam.gain", "electron / adu")):
        assert resolve(overrides={name: (base.value(name), unit)}).fingerprint != base.fingerprint
    assert resolve(overrides={"vis.gain": (3.5, "electron / adu")}).fingerprint != base.fingerprint
    assert resolve(ladder=("SIM", "CBE", "BLT", "DES", "REQ")).fingerprint != base.fingerprint
    assert pickle.loads(pickle.dumps(base)) == base


def test_configurations_of_different_lakes_are_told_apart_by_their_hashes():
    """With equal hashes, every look-up in a cache would compare all records."""
    base = resolve()
    here, there = (replace(base, folder=Path(name)) for name in ("here", "there"))
    assert len({hash(base), hash(here), hash(there)}) == 3
    assert replace(here) == here
    assert hash(replace(here)) == hash(here)


def test_an_override_is_converted_and_marked():
    chosen = resolve(overrides={"svm.aocs.jitter_x": (0.025, "arcsec")})
    assert chosen.value("svm.aocs.jitter_x", "mas") == pytest.approx(25.0)
    assert chosen.overridden == ("svm.aocs.jitter_x",)
    assert chosen.parameter("svm.aocs.jitter_x").status == "SIM"


@pytest.mark.parametrize(
    ("key", "value", "unit", "error"),
    [
        ("vis.gains", 3.0, "electron / adu", BadInput),
        ("vis.gain", 3.0, "electron", BadInput),
        ("vis.gain", 3.0, "", BadInput),
        ("vis.gain", 0.0, "electron / adu", OutOfRange),
        ("vis.gain", -3.0, "electron / adu", OutOfRange),
        ("vis.gain", float("nan"), "electron / adu", BadInput),
        ("vis.exposure_time", 0.0, "s", OutOfRange),
        ("vis.read_noise", -1.0, "electron", OutOfRange),
        ("vis.fpa.nx", 1e9, "pix", OutOfRange),
    ],
)
def test_a_bad_override_is_refused_by_name(key, value, unit, error):
    with pytest.raises(error, match=key.replace(".", r"\.")):
        resolve(overrides={key: (value, unit)})


def test_duplicates_and_strange_units_are_refused():
    with pytest.raises(BadInput, match=r"a\.gain .*twice"):
        resolve((*RECORDS, replace(RECORDS[1], value=4.0)))
    with pytest.raises(BadInput, match=r"a\.length.*convert"):
        resolve((*RECORDS, Parameter("a.length", "CBE", 1.0, "s", source="x")))


@pytest.mark.parametrize("ladder", [(), ("CBE", "CBE"), ("CBE", "BEST")])
def test_a_bad_ladder_is_refused(ladder):
    with pytest.raises(BadInput, match="ladder"):
        resolve(RECORDS, ladder)


def test_a_ladder_without_a_needed_status_names_the_parameter():
    with pytest.raises(BadInput, match=r"a\.length"):
        resolve(RECORDS, ("CBE",))


def test_an_unknown_name_is_refused():
    with pytest.raises(BadInput, match=r"vis\.psf"):
        resolve().value("vis.psf")
    with pytest.raises(BadInput, match="the unit must be s or"):
        resolve().value("vis.gain", "s")
