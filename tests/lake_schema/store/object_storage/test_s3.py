"""Addresses of lakes on object storage, and errors if there is no lake."""

import time
from types import SimpleNamespace

import pyarrow as pa
import pytest

from lake_schema import user_files
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import layout, publish, read
from lake_schema.store.object_storage import s3
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from truesky.commands import __main__


@pytest.mark.parametrize(
    "text",
    ["s3://sky", "s3://sky/a/b", "s3://sky/a?endpoint_override=http://127.0.0.1:9000", "s3://sky/a?region=eu-west-1"],
)
def test_an_address_is_written_as_it_is_read(text):
    assert str(s3.parse_address(text)) == text
    assert str(layout.open_lake(text)) == text
    assert layout.open_lake(layout.open_lake(text)) == layout.open_lake(text)


def test_an_endpoint_comes_from_the_call_the_address_or_the_environment(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://environment")
    named = "s3://sky/a?endpoint_override=http://address"
    assert s3.parse_address("s3://sky/a").service == "http://environment"
    assert s3.parse_address(named).service == "http://address"
    assert s3.parse_address(named, "http://option").service == "http://option"
    assert s3.parse_address("s3://sky/a").key("galaxies", "x") == "a/galaxies/x"
    assert s3.parse_address("s3://sky").key("galaxies", "x") == "galaxies/x"
    with pytest.raises(BadInput, match="it cannot have an endpoint"):
        layout.open_lake("/lake", "http://option")


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("s3://AKIA:hidden@sky/a", None),
        ("s3://sky/a?access_key=AKIA&secret_key=hidden&region=eu-west-1", None),
        ("s3://sky/a?endpoint_override=https://AKIA:hidden@host", None),
        ("s3://sky/a", "https://AKIA:hidden@host"),
        ("s3://AKIA:hidden@sky/a/../b", None),
    ],
)
def test_no_credentials_are_shown(text, endpoint):
    for open_it in (lambda: s3.parse_address(text, endpoint), lambda: layout.resolve_lake(text)):
        with pytest.raises(BadInput) as refused:
            open_it()
        assert "hidden" not in str(refused.value)
        assert "AKIA" not in str(refused.value)
        assert "s3://" in str(refused.value) or "host" in str(refused.value)


def test_published_versions_survive_the_round_trip():
    told = s3.PublishedVersions({"galaxies": "0" * 16}, {"demo": {"galaxies": "1" * 16}})
    assert s3.parse_published(told.to_bytes(), "here") == told
    assert told.links() == {"galaxies/current": "v-" + "0" * 16, "names/demo/galaxies": "../../galaxies/v-" + "1" * 16}


@pytest.mark.parametrize(
    "data",
    [b"", b"[]", b"{}", b'{"tables": {"a": "1"}, "names": {}}', b'{"tables": {"..": "0123456789abcdef"}, "names": {}}'],
)
def test_malformed_lists_of_versions_are_refused(data):
    with pytest.raises(Damaged, match="here does not say"):
        s3.parse_published(data, "here")


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("s3://{}/nothing", "no lake was pushed there"),
        ("s3://no-such-bucket/lake", "the bucket is wrong"),
        ("s3://sky/lake?endpoint_override=http://127.0.0.1:9", "http://127.0.0.1:9 does not answer"),
    ],
)
def test_a_missing_lake_is_reported_in_one_line(bucket, capsys, place, words):
    began = time.monotonic()
    assert __main__.main(["verify", place.format(bucket[1])]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert time.monotonic() - began < 20


def test_commands_work_on_a_pushed_lake(lake, bucket, capsys):
    publish.make_version(lake, toy_plan(cells=((1607, 30),)), toy_work)
    publish.make_version(lake, plain_plan(1), plain_work, name="first")
    place = f"s3://{bucket[1]}"
    assert __main__.main(["push", str(lake), place]) == 0
    capsys.readouterr()
    for word in (["verify", "--deep"], ["describe"]):
        said = []
        for root in (place, str(lake)):
            assert __main__.main([word[0], root, *word[1:]]) == 0
            said.append(capsys.readouterr().out)
        assert said[0] == said[1]
    assert __main__.main(["list", place]) == 0
    assert read.version(lake, "plain").key in capsys.readouterr().out
    service, name = bucket
    key = next(key for key in service.names(name) if key.endswith("/2.parquet"))
    service.client.put_object(Bucket=name, Key=f"{key}.more", Body=b"x")
    service.client.put_object(Bucket=name, Key=key, Body=b"x")
    assert __main__.main(["verify", place]) == 1
    said = capsys.readouterr().out
    assert f"s3://{name}/{key} has 1 bytes" in said
    assert f"s3://{name}/{key}.more is not in the manifest" in said
    assert __main__.main(["gc", place]) == 2
    assert "POSIX" in capsys.readouterr().err


def test_versions_of_two_tables_are_not_confused(monkeypatch):
    """A version that is not published exists in the folder that has its manifest, and in no other one."""
    lake = layout.open_lake("s3://sky/a")
    lake.store.links = {}
    manifest = lake / "stars" / ("v-" + "0" * 16) / "manifest.json"

    def file_info(path):
        return SimpleNamespace(type=SimpleNamespace(name="File" if path == manifest else "NotFound"))

    monkeypatch.setattr(s3.ObjectPath, "_file_info", file_info)
    assert [(lake / table / ("v-" + "0" * 16)).exists() for table in ("galaxies", "stars")] == [False, True]


def test_a_large_object_is_refused_unread(monkeypatch):
    monkeypatch.setitem(user_files.MAX_BYTES, "manifest", 100)
    monkeypatch.setattr(s3.ObjectStore, "open", lambda store, *parts: pa.BufferReader(bytes(101)))
    with pytest.raises(Damaged, match=r"^s3://sky/a/stars/current is larger than 100 bytes$"):
        (layout.open_lake("s3://sky/a") / "stars/current").read_bytes()
