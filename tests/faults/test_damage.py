"""Damage published files: no reader returns a number from a changed byte."""

import os
import shutil
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import Damaged
from lake_schema.fits.images import Image, read_images, write_images
from lake_schema.store import layout, manifest, publish, read, request_links, stage
from lake_schema.store.plan import Output
from tests.faults import promise
from tests.faults.lake_targets import AREA
from tests.universe import plain_plan, plain_work, toy_plan, toy_rows, toy_work
from truesky.numerics import cache

FLIPS = [pytest.param(60, id="short"), pytest.param(2000, id="long", marks=pytest.mark.nightly)]


@pytest.fixture
def toy(lake):
    publish.make_version(lake, toy_plan(), toy_work)
    return read.version(lake, "toy")


def image(part, seed=1):
    rng = np.random.default_rng([seed, part])
    return Image(rng.integers(0, 60_000, (80, 50)).astype(np.uint16), (("EXPTIME", 560.5, "s"),))


def image_work(root, facts):
    part, seed = facts["part"], facts["seed"]
    files = {f"images/{part}.fits": lambda path: write_images(path, [image(part, seed)])}
    return Output(plain_work(root, facts).rows, files)


@pytest.fixture
def images(lake):
    publish.make_version(lake, plain_plan(), image_work)
    return read.version(lake, "plain")


def flipped(path, bit):
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


@pytest.mark.parametrize("flips", FLIPS)
def test_a_flipped_bit_of_a_table_is_never_a_wrong_number(toy, flips):
    part = toy.partitions[0]
    path = toy.partition_path(part)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for bit in rng.choice(8 * len(whole), flips, replace=False):
        flipped(path, bit)
        assert read.find_faults(toy, deep=True) == [f"{path} has other contents than the manifest says"]
        with pytest.raises(Damaged, match=path.name):
            toy.rows(partitions=[part])
        path.write_bytes(whole)


@pytest.mark.parametrize("flips", FLIPS)
def test_a_flipped_bit_of_an_image_is_never_a_wrong_number(images, flips):
    path = images.sidecar_path("images/0.fits")
    whole = path.read_bytes()
    (good,) = read_images(path)
    rng = np.random.default_rng(4)
    refused = 0
    for bit in rng.choice(8 * len(whole), flips, replace=False):
        flipped(path, bit)
        assert len(read.find_faults(images, deep=True)) == 1
        with pytest.raises(Damaged, match=r"0\.fits has other contents"):
            images.sidecar_path("images/0.fits")
        try:
            # Outside a lake the blanks after a header's end may change.
            (found,) = read_images(path)
            assert np.array_equal(found.data, good.data), f"bit {bit}"
            assert found.cards == good.cards, f"bit {bit}"
        except Damaged:
            refused += 1
        path.write_bytes(whole)
    assert refused > 0.6 * flips


# ------------------------------------------------------------------------------------------------ every file of a lake

# Files up to this size (bytes) are tested with every flipped bit, larger ones with one flipped bit of every byte.
SMALL = 8192


class CompleteLake:
    """A lake with every kind of file that has a checksum, and a reader for each of them.

    A reader returns what the file says. With a flipped bit it must return the same, or refuse the file: it raises
    Damaged, or returns None for a receipt or an entry of the cache, which are then made again.
    """

    def __init__(self, root):
        self.root, self.readers = root, {}
        publish.make_version(root, toy_plan(cells=((1607, 30), (1608, 20))), toy_work)
        publish.make_version(root, plain_plan(parts=1), image_work, name="mine")
        for name in ("toy", "plain"):
            self._add_version(read.version(root, name))
        self._add_stage(plain_plan(2, 1))
        request_links.write_area(root, "mine", AREA)
        self.readers[root / "names" / "mine" / "area.json"] = lambda: request_links.read_area(root, "mine")
        self._add_cache(root / "cache" / "arrays-0")
        self.good = {path: reader() for path, reader in self.readers.items()}

    def _add_version(self, version):
        for entry in version.manifest["files"]:
            path = version.folder / entry["path"]
            self.readers[path] = lambda entry=entry: manifest.check_contents(version.folder, entry).read_bytes()
        for part in version.partitions:
            self.readers[version.partition_path(part)] = lambda part=part: version.rows(partitions=[part])
        self.readers[version.folder / "manifest.json"] = lambda: dict(manifest.load(version.folder, version.table))

    def _add_stage(self, plan):
        folder = layout.stage_folder(self.root, "plain", plan.key)
        folder.mkdir()
        for task in plan.tasks:
            stage.run_task(self.root, plan.key, plan.table, plan.facts, image_work, task)
            path = stage.receipts_folder(folder) / f"{task.name}.json"
            self.readers[path] = lambda task=task: stage.read_receipt(folder, task.name)

    def _add_cache(self, folder):
        folder.mkdir(parents=True)
        cache._store({"one": np.arange(50.0), "two": np.ones((3, 4), np.int16)}, folder)
        cache.store_checksums(folder, ["one.npy", "two.npy"])
        shutil.copytree(folder, self.root / "copy")

        def entry():
            """Read the entry; the cache removes a damaged one."""
            found = cache._load(folder)
            found = found and {name: array.tolist() for name, array in found.items()}
            if not folder.exists():
                shutil.copytree(self.root / "copy", folder)
            return found

        self.readers |= {path: entry for path in folder.iterdir()}

    def flips(self, few):
        """Yield (path, bit): `few` bits of each file, or all bits that are tested if it is None."""
        rng = np.random.default_rng(8)
        for path in sorted(self.readers):
            size = path.stat().st_size
            bits = range(8 * size) if size <= SMALL else (8 * at + at % 8 for at in range(size))
            yield from ((path, int(bit)) for bit in (bits if few is None else rng.choice(8 * size, few, replace=False)))

    def is_harmless(self, path, bit):
        """Return True if a file with a flipped bit is refused, or says the same as before."""
        whole = path.read_bytes()
        flipped(path, bit)
        try:
            found = self.readers[path]()
        except Damaged:
            found = None
        path.write_bytes(whole)
        return found is None or found == self.good[path]


@pytest.mark.parametrize("few", [pytest.param(2, id="few"), pytest.param(None, id="all", marks=pytest.mark.nightly)])
def test_a_flipped_bit_of_any_file_is_refused_or_says_nothing(lake, few):
    """The test of all bits prints the number of its cases and the time with `-s`."""
    complete, started = CompleteLake(lake), time.monotonic()
    assert len(complete.readers) > 15
    flips = list(complete.flips(few))
    for path, bit in flips:
        assert complete.is_harmless(path, bit), (path.relative_to(lake), bit)
    print(f"{len(flips):,} cases in {time.monotonic() - started:.0f} s")


@pytest.mark.parametrize("kind", ["rows", "image"])
def test_a_truncated_file_is_refused_before_use(toy, images, kind):
    version = toy if kind == "rows" else images
    path = version.partition_path(version.partitions[0]) if kind == "rows" else version.sidecar_path("images/0.fits")
    whole = path.read_bytes()
    for size in {*range(0, len(whole), 4096), *range(len(whole) - 16, len(whole))}:
        os.truncate(path, size)
        with pytest.raises(Damaged, match="bytes"):
            version.rows() if kind == "rows" else version.sidecar_path("images/0.fits")
        assert path.name in read.find_faults(version)[0]
        path.write_bytes(whole)


@pytest.mark.parametrize("kind", ["rows", "image"])
@pytest.mark.parametrize("harm", ["delete", "add", "rename", "link", "swap parts", "swap versions"])
def test_an_edited_folder_is_named(lake, toy, images, kind, harm):
    version = toy if kind == "rows" else images
    first, second = (
        (version.partition_path(p) for p in version.partitions[:2])
        if kind == "rows"
        else (version.sidecar_path(f"images/{i}.fits") for i in (0, 1))
    )
    other = first.with_name(f"x{first.name}")
    if harm == "delete":
        first.unlink()
    if harm == "add":
        shutil.copy(first, other)
    if harm == "rename":
        first.rename(other)
    if harm == "link":
        first.rename(lake / first.name)
        first.symlink_to(lake / first.name)
    if harm == "swap parts":
        first.rename(other)
        second.rename(first)
        other.rename(second)
    if harm == "swap versions":
        later = (
            publish.make_version(lake, toy_plan(2), toy_work)
            if kind == "rows"
            else publish.make_version(lake, plain_plan(2), image_work)
        )
        shutil.copy(later / first.relative_to(version.folder), first)
    found = read.find_faults(version, deep=True)
    assert found
    assert all(first.name in line or second.name in line for line in found)
    if kind == "rows" and harm != "add":
        with pytest.raises(Damaged):
            version.rows()


def test_a_damaged_version_is_not_published_again(toy, lake):
    publish.make_version(lake, toy_plan(2), toy_work)
    toy.partition_path(toy.partitions[0]).unlink()
    with pytest.raises(Damaged, match="to make it again"):
        publish.make_version(lake, toy_plan(1), toy_work)
    shutil.rmtree(toy.folder)
    publish.make_version(lake, toy_plan(1), toy_work)
    assert read.find_faults(read.version(lake, "toy"), deep=True) == []


@given(st.data())
def test_verify_detects_any_change(tmp_path_factory, data):
    root = tmp_path_factory.mktemp("lake")
    folder = promise.make(root, "plain", data.draw(st.integers(1, 5)))
    assert read.find_faults(read.version(root, "plain"), deep=True) == []
    path = data.draw(st.sampled_from(sorted(p for p in folder.rglob("*") if p.is_file())))
    whole = path.read_bytes()
    change = data.draw(st.sampled_from(["flip", "cut", "append", "delete"]))
    if change == "flip":
        flipped(path, data.draw(st.integers(0, 8 * len(whole) - 1)))
    elif change == "cut":
        os.truncate(path, data.draw(st.integers(0, len(whole) - 1)))
    elif change == "append":
        path.write_bytes(whole + data.draw(st.binary(min_size=1)))
    else:
        path.unlink()
    try:
        found = read.find_faults(read.version(root, "plain"), deep=True)
    except Damaged as error:
        found = [str(error)]
    # White space in a manifest says nothing.
    assert (found and path.name in found[0]) or path.name == "manifest.json"
    if path.name == "manifest.json" and not found:
        assert change in ("flip", "append")


def test_verify_detects_rows_of_another_cell(lake):
    """The rows reveal the change even if a file and its manifest are rewritten."""
    from lake_schema.store import manifest, parquet

    folder = publish.make_version(lake, toy_plan(), toy_work)
    version = read.version(lake, "toy")
    path = version.partition_path(version.partitions[0])
    for rows, words in (
        (toy_rows(1608, 300), "another cell"),
        (toy_rows(1607, 300).take(list(range(299, -1, -1))), "not sorted"),
        (toy_rows(1607, 299), "299 rows"),
    ):
        parquet.write(path, rows, toy_plan().table)
        facts = {k: v for k, v in version.manifest.items() if k != "files"}
        relative = path.relative_to(folder).as_posix()
        files = [
            {**entry, **(manifest.file_entry(path, relative) if entry["path"] == relative else {})}
            for entry in version.manifest["files"]
        ]
        manifest.write(folder, {**facts, "files": files})
        (found,) = read.find_faults(read.version(lake, "toy"), deep=True)
        assert words in found
        assert path.name in found
