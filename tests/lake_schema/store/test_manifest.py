"""Manifests with wrong contents are refused in one line by every reader."""

import json
import os
import subprocess
import sys
import time

import pytest

from lake_schema import listing, user_files
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import garbage, layout, manifest, publish, read
from lake_schema.store.provenance import digest
from tests.universe import plain_plan, plain_work

# Functions that read a manifest, with the arguments (lake, folder of the version).
READERS = {
    "load": lambda lake, folder: manifest.load(folder, "plain"),
    "version": lambda lake, folder: read.version(lake, "plain"),
    "latest_version": lambda lake, folder: read.latest_version(lake, "plain"),
    "input_version": lambda lake, folder: read.input_version(lake, "plain", "a"),
    "collect": lambda lake, folder: garbage.collect(lake),
    "make_version": lambda lake, folder: publish.make_version(lake, plain_plan(), plain_work),
}


@pytest.fixture
def published(lake):
    return publish.make_version(lake, plain_plan(), plain_work)


def rewrite(folder, change):
    """Change the contents of a manifest and give it a valid digest."""
    path = folder / "manifest.json"
    facts = json.loads(path.read_bytes())
    del facts["digest"]
    change(facts)
    path.write_text(json.dumps({**facts, "digest": digest(facts)}))


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("text", ["[]", '["digest"]', '"digest"', "3", "0.5", "true", "null"])
def test_a_manifest_that_is_not_an_object_is_damaged(lake, published, reader, text):
    (published / "manifest.json").write_text(text)
    with pytest.raises(Damaged, match=r"manifest\.json: must contain a JSON object"):
        READERS[reader](lake, published)
    (row,) = listing.rows(lake)
    assert "must contain a JSON object" in row["error"]


@pytest.mark.parametrize("value", [[], "text", 3, True, None])
def test_facts_of_a_partition_must_be_an_object(published, value):
    rewrite(published, lambda facts: facts["parts"][0].update(facts=value))
    with pytest.raises(Damaged, match="not a valid manifest"):
        manifest.load(published, "plain")


# Program that prints the row of a lake's only version, with limited memory.
LIST = """
import resource, sys
from pathlib import Path
from lake_schema import listing
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
(row,) = listing.rows(Path(sys.argv[1]))
print(row["rows"], row["error"])
"""


@pytest.mark.parametrize(
    ("replace", "words"),
    [
        (os.mkfifo, "is a pipe, but must be a file: a manifest"),
        (lambda path: path.symlink_to("/dev/zero"), "is a symbolic link"),
        (lambda path: path.mkdir(), "is a folder, but must be a file: a manifest"),
    ],
)
def test_a_manifest_that_is_not_a_regular_file_is_damaged(lake, published, replace, words):
    """Another process reads it, because a process that waits for a pipe must be killed."""
    path = published / "manifest.json"
    path.unlink()
    replace(path)
    result = subprocess.run([sys.executable, "-c", LIST, lake], capture_output=True, text=True, timeout=20)
    assert result.stdout.startswith("None "), result.stderr
    assert str(path) in result.stdout
    assert words in result.stdout


def test_a_large_manifest_is_refused_unread(published, monkeypatch):
    monkeypatch.setitem(user_files.MAX_BYTES, "manifest", 100)
    with pytest.raises(Damaged, match=r"manifest\.json: is larger than 100 bytes, the limit for a manifest"):
        manifest.load(published, "plain")


def test_blanks_around_a_manifest_mean_nothing(published):
    path = published / "manifest.json"
    expected = manifest.load(published, "plain")
    path.write_bytes(b" \n" * 1000 + path.read_bytes() + b"\r\t" * 1000)
    assert manifest.load(published, "plain") == expected


def test_a_manifest_with_too_many_values_is_refused_before_it_is_parsed(published, monkeypatch):
    monkeypatch.setattr(manifest, "_MAX_VALUES", 1000)
    (published / "manifest.json").write_text("[" + "{}," * 1000 + "this is not JSON")
    with pytest.raises(Damaged, match=r"manifest\.json: has more than 1000 values, the limit for a manifest"):
        manifest.load(published, "plain")


def test_a_manifest_that_readers_would_refuse_is_not_published(lake, monkeypatch):
    monkeypatch.setattr(manifest, "_MAX_VALUES", 10)
    with pytest.raises(BadInput, match=r"manifest\.json: has more than 10 values, the limit for a manifest"):
        publish.make_version(lake, plain_plan(), plain_work)
    assert layout.current_key(lake, "plain") is None


@pytest.mark.parametrize("read_keys", [listing.rows, garbage.collect])
def test_many_keys_in_a_manifest_take_linear_time(lake, published, read_keys):
    """A look for the folder of each key would take 80 microseconds."""
    keys = [f"{i:016x}" for i in range(100_000)]
    rewrite(published, lambda facts: facts["facts"].update(keys=keys))
    began = time.process_time()
    read_keys(lake)
    assert time.process_time() - began < 3.0


def test_many_files_in_a_manifest_are_all_checked(published):
    def add_files(facts):
        (entry, *_) = facts["files"]
        facts["files"] += [{**entry, "path": f"dataset/x{i}.parquet"} for i in range(10_000)]

    rewrite(published, add_files)
    assert len(manifest.load(published, "plain").by_path) == 10_003
    rewrite(published, lambda facts: facts["files"][-1].update(bytes=1))
    with pytest.raises(Damaged, match="not a valid manifest"):
        manifest.load(published, "plain")


@pytest.mark.parametrize(
    "entry",
    [
        {"path": "/etc/passwd"}, {"path": "dataset/../../x"}, {"blocks": "AAAA"}, {"sha256": "/etc"},
        {"sha256": "../" * 20 + "etc"}, {"sha256": ""}, {"sha256": "A" * 64},
    ],
)  # fmt: skip
def test_a_wrong_entry_of_a_file_is_damaged(published, entry):
    rewrite(published, lambda facts: facts["files"][1].update(entry))
    with pytest.raises(Damaged, match="not a valid manifest"):
        manifest.load(published, "plain")


@pytest.mark.parametrize("path", ["dataset/" + "x" * 300, "x/" * 100_000 + "0.parquet"])
def test_a_path_that_is_too_long_is_damaged(published, path):
    with pytest.raises(Damaged, match="cannot be read: File name too long"):
        manifest.check_size(published, {"path": path, "bytes": 1})
