"""Models that are files are named with their sha256, and other files are refused."""

import hashlib
from dataclasses import replace

import pytest

from lake_schema.errors import BadInput, Damaged
from lake_schema.mission import model
from lake_schema.mission.configuration import resolve
from lake_schema.mission.model import Model, parse_numbers, parse_rows, read_content, read_models

ZODI = next(m for m in read_models() if m.key == "env.zodi.map")


def test_every_file_is_the_one_that_is_named():
    assert ZODI in read_models()
    for one in read_models():
        assert hashlib.sha256(read_content(one)).hexdigest() == one.sha256


def test_another_file_is_refused_with_both_sums(tmp_path):
    other = replace(ZODI, sha256="0" * 64)
    with pytest.raises(Damaged, match=f"env.zodi.map.*{ZODI.sha256}.*not 0000"):
        read_content(other)
    with pytest.raises(Damaged, match="is missing"):
        read_content(replace(ZODI, file="nothing.csv"))
    # A file that was published with an old product is found by its checksum, if it is undamaged.
    old = b"an older table"
    digest = hashlib.sha256(old).hexdigest()
    (tmp_path / digest).write_bytes(old)
    assert read_content(replace(ZODI, sha256=digest), tmp_path) == old
    (tmp_path / digest).write_bytes(old[:-1])
    with pytest.raises(Damaged, match="sha256"):
        read_content(replace(ZODI, sha256=digest), tmp_path)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"file": "../vis.csv"}, "neither"),
        ({"file": "/etc/passwd"}, "neither"),
        ({"file": "os:../x"}, "neither"),
        ({"file": "os:/etc/passwd"}, "neither"),
        ({"file": ""}, "neither"),
        ({"sha256": "abc"}, "hexadecimal"),
        ({"sha256": "G" * 64}, "hexadecimal"),
        ({"status": "NEW"}, "status"),
        ({"confidence": "surely"}, "confidence"),
        ({"source": ""}, "source"),
    ],
)
def test_a_bad_record_is_refused_by_name(change, word):
    with pytest.raises(BadInput, match=f"env.zodi.map.*{word}"):
        replace(ZODI, **change)


def test_other_columns_are_refused(tmp_path):
    (tmp_path / "models.csv").write_text("key,file\na,b\n")
    with pytest.raises(BadInput, match="columns"):
        model.read(tmp_path / "models.csv")


def test_tables_of_numbers_and_of_texts():
    data = b"# a comment\na,b\n1,x\n2,\n"
    assert parse_rows(data) == ({"a": "1", "b": "x"}, {"a": "2", "b": ""})
    values = parse_numbers(b"# a comment\na,b\n1,\n2,3\n")
    assert values[1] == (2.0, 3.0)
    assert values[0][0] == 1.0
    assert values[0][1] != values[0][1]


def test_a_ladder_chooses_models_too():
    assert resolve().model("ext.lsstcam.layout").file == "layout_lsstcam.csv"
    simulated = resolve(ladder=("SIM", "CBE", "BLT", "DES", "REQ"))
    assert simulated.model("ext.lsstcam.layout").file == "layout_lsstcam_one_maker.csv"
    assert {row["type"] for row in simulated.rows("ext.lsstcam.layout")} == {"e2v"}
    assert {row["type"] for row in resolve().rows("ext.lsstcam.layout")} == {"e2v", "itl"}
    assert simulated.fingerprint != resolve().fingerprint
    with pytest.raises(BadInput, match="no model x"):
        resolve().numbers("x")


def test_a_name_is_a_value_or_a_model():
    with pytest.raises(BadInput, match=r"vis\.gain is both a value and a model"):
        resolve(models=(Model("vis.gain", "CBE", "x.csv", "0" * 64, source="x"),))
    with pytest.raises(BadInput, match="given twice"):
        resolve(models=(ZODI, ZODI))


def test_the_fingerprint_follows_the_files():
    base = resolve()
    models = [m for m in read_models() if m.key != "env.zodi.map"]
    other = resolve(models=(*models, replace(ZODI, sha256="0" * 64)))
    assert other.fingerprint != base.fingerprint
    assert resolve(models=(*models, replace(ZODI, source="elsewhere"))).fingerprint == base.fingerprint


def test_a_table_is_cached_and_immutable():
    """The effects of one detector use the table of amplifiers some hundred times."""
    data = read_content(next(m for m in read_models() if m.key == "ext.gpc1.amplifiers"))
    assert parse_rows(data) is parse_rows(data)
    with pytest.raises(TypeError):
        parse_rows(data)[0]["gain"] = "2"
