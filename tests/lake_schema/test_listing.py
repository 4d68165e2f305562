"""Output of the command `list`."""

import json
import os
import re
import shutil

import pytest

from lake_schema import listing
from lake_schema.store import publish
from tests.lake_schema.store.test_request_links import made_from
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from truesky.commands.__main__ import main


@pytest.fixture
def listed(lake):
    first = publish.make_version(lake, plain_plan(1), plain_work, name="a")
    os.utime(first / "manifest.json", (1.7e9, 1.7e9))
    publish.make_version(lake, plain_plan(2), plain_work, name="b")
    publish.make_version(lake, made_from(plain_plan(1).key), plain_work, name="a")
    for name in "ab":
        publish.make_version(lake, toy_plan(), toy_work, name=name)
    return lake


def test_every_version_is_a_row(listed):
    rows = {(row["table"], row["version"]): row for row in listing.rows(listed)}
    first, second = (rows["plain", plain_plan(seed).key] for seed in (1, 2))
    assert (first["names"], first["current"], first["rows"]) == (["a"], False, 60)
    assert first["published"] == "2023-11-14T22:13:20Z"
    assert (second["names"], second["current"]) == (["b"], True)
    files = [path for path in (listed / "plain" / f"v-{plain_plan(1).key}").rglob("*.parquet")]
    assert first["bytes"] == sum(path.stat().st_size for path in files)
    (derived,) = (row for row in rows.values() if row["table"] == "derived")
    assert derived["made_of"] == {"plain": [plain_plan(1).key]}
    assert rows["toy", toy_plan().key]["names"] == ["a", "b"]


def test_columns_are_aligned(listed, capsys):
    assert main(["list", str(listed)]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    starts = [match.start() for match in re.finditer(r"(?<=  )\S", head) if match.group()]
    assert head.split()[:6] == ["names", "table", "version", "current", "published", "rows"]
    for line in lines:
        for column in ("table", "version", "current", "published", "made of"):
            at = head.index(column)
            assert at in starts
            assert line[at - 2 : at] == "  "
            assert line[at] != " "
        for column in ("rows", "bytes"):
            end = head.index(column) + len(column)
            assert line[end - 1].isdigit()
    assert any(line.endswith(f"plain {plain_plan(1).key[:8]}") for line in lines)


def test_json_is_the_rows(listed, capsys):
    assert main(["list", str(listed), "plain", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [row for row in listing.rows(listed) if row["table"] == "plain"]


def test_a_damaged_version_is_a_row_and_exit_status_1(listed, capsys):
    (listed / "plain" / f"v-{plain_plan(1).key}" / "manifest.json").write_text("{")
    assert main(["list", str(listed)]) == 1
    assert "manifest.json: JSONDecodeError" in capsys.readouterr().out


def test_a_missing_table_is_a_wrong_call(lake, listed, tmp_path):
    assert main(["list", str(tmp_path / "empty")]) == 2
    assert main(["list", str(listed), "halos"]) == 2


def test_verify_looks_at_every_request(listed, capsys):
    assert main(["verify", str(listed)]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["derived", "plain", "plain", "toy"]
    shutil.rmtree(listed / "plain" / f"v-{plain_plan(1).key}")
    assert main(["verify", str(listed), "--name", "b"]) == 0
    assert main(["verify", str(listed)]) == 1
    assert "names/a/plain leads to" in capsys.readouterr().err
    assert main(["verify", str(listed), "--name", "c"]) == 2
