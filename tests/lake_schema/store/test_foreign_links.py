"""A run in a lake of a stranger changes nothing outside the lake, wherever the lake contains symbolic links."""

import contextlib

import pytest

from lake_schema.errors import BadInput, Damaged
from lake_schema.store import garbage, publish
from tests.universe import CELLS, plain_plan, plain_work, toy_plan, toy_work

PLAIN, TOY = plain_plan(), toy_plan(cells=CELLS[:2])
# Places of links to a folder outside the lake, and of links to a file that does not exist there.
FOLDERS = [
    "plain", "plain/.stage-{plain}", "plain/.receipts-{plain}", "plain/v-{plain}", "plain/.stage-{plain}/dataset",
    "names", "names/demo", "toy/.stage-{toy}/toy", "toy/.stage-{toy}/toy/dataset", "toy/.stage-{toy}/toy_margin",
    "toy/.stage-{toy}/toy/dataset/Norder=5", "toy/.receipts-{toy}",
]  # fmt: skip
UNUSED = ["runs", "plain/.gone-0"]
FILES = [
    "plain/.lock", "plain/.lock-{plain}", "plain/current", "names/demo/plain", "plain/.stage-{plain}/manifest.json",
]  # fmt: skip


@pytest.mark.parametrize("place", [*FOLDERS, *UNUSED, *FILES])
def test_links_out_of_a_lake_change_nothing_outside(tmp_path, place):
    outside, root = tmp_path / "outside", tmp_path / "lake"
    (outside / "dataset").mkdir(parents=True)
    for name in ("precious", "dataset/precious"):
        (outside / name).write_text("precious")
    before = {path: path.is_file() and path.read_text() for path in outside.rglob("*")}
    link = root / place.format(plain=PLAIN.key, toy=TOY.key)
    link.parent.mkdir(parents=True)
    link.symlink_to(outside / "new" if place in FILES else outside)
    plan, work = (TOY, toy_work) if place.startswith("toy") else (PLAIN, plain_work)
    # Nothing is written through the unused links while a version is made.
    with contextlib.nullcontext() if place in UNUSED else pytest.raises((BadInput, Damaged), match=r"^[^\n]+$"):
        publish.make_version(root, plan, work, name="demo")
    with contextlib.suppress(BadInput, Damaged):
        garbage.collect(root, delete=True)
    assert {path: path.is_file() and path.read_text() for path in outside.rglob("*")} == before
