"""What must hold after any accident: a reader sees a whole version or none, a second run repairs it."""

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
    """Key of the version that a reader sees, None where there is none; fails where it is not whole."""
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
    """sha256 of every file of a version, the manifest included in its digest."""
    manifest = read.version(root, kind, version_key).manifest
    return {entry["path"]: entry["sha256"] for entry in manifest["files"]}
