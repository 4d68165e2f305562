"""Manifests with wrong contents are refused in one line by every reader."""

import json
import os
import subprocess
import sys

import pytest

from lake_schema import listing, user_files
from lake_schema.errors import Damaged
from lake_schema.store import garbage, manifest, publish, read
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
