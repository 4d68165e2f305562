"""Records of the mission database are read, and wrong ones are refused."""

import re

import astropy.units as u
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission import parameter
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import Parameter, convert, read, read_all_parameters

HEADER = "key,status,value,unit,version,valid_from,confidence,source\n"


def write(folder, *lines):
    path = folder / "section.csv"
    path.write_text(HEADER + "".join(line + "\n" for line in lines))
    return path


def test_a_record_is_read_with_all_fields(tmp_path):
    (record,) = read(write(tmp_path, 'a.gain,CBE,3.48,electron / adu,2,60000.5,published,"Somebody, 2024"'))
    assert record == Parameter("a.gain", "CBE", 3.48, "electron / adu", 2, 60000.5, "published", "Somebody, 2024")


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("a.gain,NEW,1,,1,,assumed,x", "status"),
        ("a.gain,CBE,nan,,1,,assumed,x", "finite"),
        ("a.gain,CBE,inf,,1,,assumed,x", "finite"),
        ("a.gain,CBE,one,,1,,assumed,x", "line 2"),
        ("a.gain,CBE,1,,1.5,,assumed,x", "line 2"),
        ("a.gain,CBE,1,furlongs per fortnight,1,,assumed,x", "not a unit"),
        ("a.gain,CBE,1,,1,,surely,x", "confidence"),
        ("a.gain,CBE,1,,1,,assumed,", "source"),
        ("a.gain,CBE,1,,1,nan,assumed,x", "finite"),
    ],
)
def test_a_bad_record_is_refused_by_name(tmp_path, line, word):
    with pytest.raises(BadInput, match=word) as refusal:
        read(write(tmp_path, line))
    assert "\n" not in str(refusal.value)


def test_other_columns_are_refused(tmp_path):
    path = tmp_path / "section.csv"
    path.write_text("key,value\na,1\n")
    with pytest.raises(BadInput, match="columns"):
        read(path)


def test_every_record_of_the_package_names_a_publication():
    records = read_all_parameters()
    assert len(records) > 500
    for record in records:
        if record.confidence != "assumed":
            assert re.search(r"[A-Z][a-z]{3}", record.source), record
        assert "/" not in record.source, record
        assert u.Unit(record.unit) is not None


def test_published_statuses_are_all_there():
    """The ladder must have several statuses to choose from."""
    found = {(r.key, r.status): r.value for r in read_all_parameters()}
    assert {s for k, s in found if k == "vis.read_noise"} == {"REQ", "DES", "CBE", "SIM"}
    assert found["vis.gain", "CBE"] == 3.48
    assert found["vis.gain", "REQ"] == 3.1
    # A current best estimate meets the requirement.
    for quantity in ("read_noise", "dark_current"):
        best = found.get((f"vis.{quantity}", "CBE"), found.get((f"vis.{quantity}", "BLT")))
        assert best <= found[f"vis.{quantity}", "REQ"]


def test_no_zero_point_of_euclid_is_stored():
    """It follows from throughput and area, so a second number could disagree. Ground surveys publish theirs."""
    stored = [record.key for record in read_all_parameters() if "zp" in record.key or "zero_point" in record.key]
    assert {key.split(".")[0] for key in stored} == {"ext"}


def test_conversion():
    assert convert(1.0, "mas", "arcsec", "here") == pytest.approx(1e-3)
    with pytest.raises(BadInput, match=r"here: the unit must be "):
        convert(1.0, "s", "m", "here")


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("mag(um/pix)", r"'mag\(um/pix\)' is a logarithmic or structured unit: use a linear unit, or mag$"),
        ("dB(um/pix)", "is a logarithmic or structured unit"),
        ("mag(AB)", "is a logarithmic or structured unit"),
        ("(um, pix)", "is a logarithmic or structured unit"),
        ("1e-320 um/pix", "the unit must be mm / pix or a unit that converts to it, got 1e"),
        ("1e400 um/pix", "the unit must be mm / pix or a unit that converts to it, got 1e"),
    ],
)
def test_a_unit_without_a_finite_factor_is_refused(unit, words):
    with pytest.raises(BadInput, match=f"^here: .*{words}"):
        convert(15.0, unit, "mm / pix", "here")


@pytest.mark.parametrize("unit", ["1 / mm9223372036854775807", "km999999999", "1 / km999"])
def test_a_unit_whose_factor_exceeds_the_range_of_numbers_is_refused(unit):
    with pytest.raises(BadInput, match=r"^here: .*the unit must be 1 / mm4"):
        convert(15.0, unit, "1 / mm4", "here")


def test_the_zodiacal_table_is_the_published_one():
    table = {row[0]: row[1:] for row in resolve().numbers("env.zodi.map")}
    assert len(table) == 19
    # Leinert et al. 1998, Table 17: ecliptic poles, quadrature and anti-solar point.
    assert {row[-1] for row in table.values()} == {77.0}
    assert table[90.0][0] == 259.0
    assert table[180.0][0] == 230.0
    assert all(table[90.0][i] >= table[90.0][i + 1] for i in range(10))


def test_statuses_and_sections_are_those_that_are_known():
    records = read_all_parameters()
    assert {record.status for record in records} <= set(parameter.STATUSES)
    prefixes = {record.key.split(".")[0] for record in records}
    assert prefixes == {"env", "plm", "svm", "vis", "nisp", "ext", "survey"}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"a.b,CBE,1,m,1,,assumed,\xff", "codec"),
        (b"a.b,CBE,1,m,1,,assumed," + b"x" * 2000, "line 2: a text is too long"),
        (b'a.b,CBE,1,m,1,,assumed,"x\ny"', "line 3: a text is too long or spans several lines"),
        (b"a.b,CBE,1,m,1,,assumed,x,y", "line 2: a text is too long"),
        (b"a.b,CBE,1,m,1,,assumed," + b"x" * 200_000, "field larger than"),
    ],
)
def test_an_unreadable_text_is_refused_by_name(tmp_path, line, words):
    path = tmp_path / "vis.csv"
    path.write_bytes(b"key,status,value,unit,version,valid_from,confidence,source\n" + line + b"\n")
    with pytest.raises(BadInput, match=rf"^vis.csv.*{words}"):
        read(path)
