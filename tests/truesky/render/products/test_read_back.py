"""An image of a lake is read together with its head file, which has the true WCS."""

import numpy as np
import pytest

from lake_schema.errors import Damaged
from lake_schema.store import layout, publish, read
from lake_schema.store.object_storage import push, s3
from lake_schema.store.plan import Output, Plan
from tests.truesky.render.fields import MISSION, small
from tests.truesky.render.products import test_tools as tools
from tests.universe import toy_plan, toy_rows
from truesky.render.products import fits_files, head_files, read_back


@pytest.fixture(scope="module")
def rendered():
    """Return a raw frame of a camera whose headers have a pointing error of several arcseconds."""
    return tools.stars_on("decam", 0.05, small("decam", "N31", tools.SIDE), (53.1, -27.8, 12.0), MISSION)


@pytest.fixture
def lake(rendered, tmp_path):
    """Return the folder of a lake with a version that contains an image, and the path of the image in the version."""
    rows, files = fits_files.products(rendered, ())
    root, plan = layout.resolve_lake(tmp_path / "lake"), toy_plan()
    publish.make_version(
        root, Plan(plan.table, {}, plan.tasks[:1]), lambda _, facts: Output(toy_rows(facts["cell"], 3), files)
    )
    return root, rows["path"][0].as_py()


def position(version, path):
    """Return the sky position (deg) of the first pixel according to the header that is read back."""
    cards = {key: value for key, value, _ in read_back.header(read_back.image_file(version, path))}
    return cards["CRVAL1"], cards["CRVAL2"]


def test_an_image_on_object_storage_has_the_true_wcs(lake, bucket, rendered):
    root, path = lake
    place = s3.parse_address(f"s3://{bucket[1]}/lake", bucket[0].url)
    list(push.push(root, place))
    far = layout.open_lake(str(place))
    here, there = (position(read.version(where, "toy"), path) for where in (root, far))
    assert there == here
    np.testing.assert_allclose(here, rendered.wcs.wcs.crval, atol=1e-9)
    # The header of the image alone has a pointing error.
    alone = read.version(far, "toy").sidecar_path(path)
    cards = {key: value for key, value, _ in read_back.header(alone)}
    assert abs(cards["CRVAL2"] - here[1]) * 3600.0 > 0.1


@pytest.mark.parametrize("is_missing", [False, True])
def test_a_damaged_head_file_is_refused(lake, is_missing):
    root, path = lake
    version = read.version(root, "toy")
    head = version.folder / head_files.head_path(path)
    if is_missing:
        head.unlink()
    else:
        head.write_text(head.read_text().replace("CRVAL1  =  ", "CRVAL1  = 1"))
    with pytest.raises(Damaged, match=r"\.head"):
        read_back.image_file(version, path)
