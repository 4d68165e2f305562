"""Several requests in one lake: name one, or use its name before the table; no query mixes them silently."""

import pytest

from lake_schema.errors import BadInput
from lake_schema.store import publish
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from tests.waiting import PATIENCE
from truesky.explore.__main__ import main
from truesky.explore.explorer import Explorer


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    root = tmp_path_factory.mktemp("two") / "lake"
    root.mkdir()
    for name, seed in (("a", 1), ("my-b", 2)):
        publish.make_version(root, toy_plan(), toy_work, name=name)
        publish.make_version(root, plain_plan(seed), plain_work, name=name)
    return root


@pytest.fixture(scope="module")
def opened(two):
    with Explorer(two, timeout=PATIENCE) as explorer:
        yield explorer


def test_tables_of_both(opened):
    assert sorted(opened.tables().index) == ["a.plain", "my-b.plain", "toy"]
    assert opened.describe("a.plain").index.tolist() == ["id", "value"]


def test_a_query_of_both(opened):
    text = """SELECT a.plain.value AS x, b.value AS y FROM a.plain JOIN "my-b".plain AS b USING (id) JOIN toy ON true
              LIMIT 1"""
    assert opened.sql(text).to_dict("list") == {"x": [1.0], "y": [2.0]}
    assert opened.sql("SELECT flux FROM A.toy", into="astropy")["flux"].unit == "uJy"


@pytest.mark.parametrize("call", [lambda e: e.sql("FROM plain"), lambda e: e.describe("plain")])
def test_ambiguous_table_is_refused(opened, call):
    with pytest.raises(BadInput, match=r"requests a, my-b have different versions of table plain: name one"):
        call(opened)


@pytest.mark.parametrize(
    "text", ["FROM c.plain", "FROM a.galaxies", "FROM x.a.plain", "FROM temp.plain", "FROM main.toy"]
)
def test_other_schemas_are_refused(opened, text):
    with pytest.raises(BadInput, match="is not a table of the lake"):
        opened.sql(text)


def test_name_selects_a_request(two, capsys):
    with Explorer(two, timeout=PATIENCE, request="a") as explorer:
        assert sorted(explorer.tables().index) == ["plain", "toy"]
        assert explorer.sql("SELECT DISTINCT value FROM plain")["value"].tolist() == [1.0]
        with pytest.raises(BadInput, match="is not a table of the lake"):
            explorer.sql('FROM "my-b".plain')
    with pytest.raises(BadInput, match="has no request c; it has a, my-b"):
        Explorer(two, request="c")
    with pytest.raises(
        BadInput, match=r"no request My-B, because names have only small .*; did you mean my-b\? it has a, m"
    ):
        Explorer(two, request="My-B")
    assert main(["SELECT max(value) FROM plain", "--lake", str(two), "--name", "my-b"]) == 0
    assert "2.0" in capsys.readouterr().out
    assert main(["FROM plain", "--lake", str(two)]) == 2
    assert main(["--lake", str(two)]) == 0
