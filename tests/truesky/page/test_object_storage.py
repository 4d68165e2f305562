"""The page over a lake on object storage: the same tables, images and tree as over the folder."""

import shutil

import numpy as np

from lake_schema.store import layout, publish
from lake_schema.store.object_storage import push, s3
from tests.universe import plain_plan, plain_work
from truesky.page import pictures, runs
from truesky.page.lake_session import LakeSession


def test_a_page_shows_what_was_pushed(shown, bucket, tmp_path):
    root = tmp_path / "lake"
    shutil.copytree(shown, root, symlinks=True)
    place = s3.parse_address(f"s3://{bucket[1]}/lake")
    list(push.push(root, place))
    far, near = LakeSession(layout.open_lake(str(place))), LakeSession(root)
    try:
        assert far.key == near.key
        assert [one.row for one in pictures.pictures(far)] == [one.row for one in pictures.pictures(near)]
        for number in range(len(pictures.pictures(near))):
            ours, theirs = (pictures.picture(lake, number) for lake in (near, far))
            file = theirs.version.sidecar_path(theirs.row["path"])
            assert file.read_bytes() == ours.version.sidecar_path(ours.row["path"]).read_bytes()
            assert runs.provenance(far, number) == runs.provenance(near, number)
            assert np.array_equal(ours.tile(0, 0, 0), theirs.tile(0, 0, 0))
        assert runs.runs(far)["jobs"] == []
        assert not far.is_changed()
        publish.make_version(root, plain_plan(99), plain_work)
        list(push.push(root, place, only=["plain"]))
        assert far.is_changed()
    finally:
        far.close()
        near.close()
