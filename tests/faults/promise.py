"""Check versions after a failure: a reader finds a complete version or none, and a second run repairs the lake."""

from functools import partial

from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from tests.universe import CELLS, plain_plan, plain_work, toy_plan, toy_work

# kind of table -> plan of a seed, and its work
KINDS = {"plain": (plain_plan, plain_work), "toy": (partial(toy_plan, cells=CELLS[:2]), toy_work)}


def make(root, kind, seed, **options):
    plan, work = KINDS[kind]
    return publish.make_version(root, plan(seed), work, **options)


def key(kind, seed):
    return KINDS[kind][0](seed).key


def current(root, kind, request=None):
    """Return the key of the current version, or None; fail if it is incomplete."""
    try:
        version = read.version(root, kind, request=request)
    except BadInput:
        return None
    assert read.find_faults(version, deep=True) == []
    assert version.rows().num_rows == version.num_rows
    assert version.folder == layout.version_folder(root, kind, version.key)
    if kind == "plain":
        assert set(version.rows()["value"].to_pylist()) == {float(version.manifest["facts"]["seed"])}
    return version.key


def sums(root, kind, version_key=None):
    """Return the sha256 of every file of a version, including the manifest."""
    manifest = read.version(root, kind, version_key).manifest
    return {entry["path"]: entry["sha256"] for entry in manifest["files"]}
