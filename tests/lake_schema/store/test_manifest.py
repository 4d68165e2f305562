"""Manifests with wrong contents are refused in one line by every reader."""

import json

import pytest

from lake_schema import listing
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
