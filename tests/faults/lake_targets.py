"""Further targets of fuzzing: files of a lake, of the cache and of cameras, and images."""

import io
import json
import shutil
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import duckdb
import numpy as np

from lake_schema.external import hdf5
from lake_schema.external import rows as external_rows
from lake_schema.fits import external, images
from lake_schema.mission import camera_folder, camera_tables, camera_template
from lake_schema.store import layout, manifest, publish, read, request_links, stage
from lake_schema.store.provenance import digest
from tests.faults.fuzz_targets import MANY, as_csv, as_image, written
from tests.truesky.page import conftest
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from truesky.catalogue import injected_rows
from truesky.explore import requested_area, session
from truesky.numerics import cache as array_cache
from truesky.numerics import cache_entries
from truesky.reduction import files as reduction_files
from truesky.render.products import head_files, read_back
from truesky.running import progress

CAMERA = (camera_tables.PARAMETERS, camera_tables.LAYOUT, camera_tables.AMPLIFIERS, camera_tables.BANDS,
          camera_tables.WAVEFRONT)  # fmt: skip
AREA = {
    "box": None,
    "vertices": [],
    "patches": [[10.0, 20.0, 1.0]],
    "ra": 0.0,
    "dec": 0.0,
    "radius": 0.0,
    "wide": False,
}


def swapped(make, find):
    """Return a function that calls a reader with a folder, in which a file has been replaced.

    `make` writes the complete folder once, and `find` returns the file of a folder.
    """

    @cache
    def whole():
        folder = Path(tempfile.mkdtemp(prefix="fuzz-folder-")) / "folder"
        make(folder)
        return folder

    def of(read_folder):
        def read_file(path):
            with tempfile.TemporaryDirectory() as place:
                folder = Path(place) / "folder"
                shutil.copytree(whole(), folder, symlinks=True)
                shutil.copyfile(path, find(folder))
                read_folder(folder)

        return read_file

    return of, lambda: [find(whole()).read_bytes()]


def folder_target(make, find, read_folder, ending=""):
    of, seeds = swapped(make, find)
    return seeds, of(read_folder), ending


# ------------------------------------------------------------------------------------------------ lakes


def lake_of_rows(root):
    publish.make_version(root, toy_plan(), toy_work)


def partition(root):
    return next(root.glob("toy/v-*/toy/dataset/**/*.parquet"))


def of_partition(root):
    """Read a partition that agrees with its manifest, as another program could have written both."""
    path = partition(root)
    folder = next(root.glob("toy/v-*"))
    stored = manifest.load(folder, "toy")
    relative = path.relative_to(folder).as_posix()
    try:
        entry = manifest.file_entry(path, relative)
    except Exception:
        # A writer would not come so far: it computes checksums of the parts of a valid file.
        return
    entries = [{**one, **(entry if one["path"] == relative else {})} for one in stored["files"]]
    facts = {key: value for key, value in stored.items() if key != "files"}
    manifest.write(folder, {**facts, "files": entries})
    version = read.version(root, "toy")
    version.rows()
    read.find_faults(version, deep=True)


def unfinished(root):
    """Write a stage with receipts, as a run leaves it that was stopped."""
    plan = plain_plan()
    folder = layout.stage_folder(root, "plain", plan.key)
    folder.mkdir(parents=True)
    for task in plan.tasks:
        stage.run_task(root, plan.key, plan.table, plan.facts, plain_work, task)


def receipt(root):
    return sorted(root.glob("plain/.receipts-*/*.json"))[0]


def of_receipt(root):
    publish.make_version(root, plain_plan(), plain_work)
    assert read.version(root, "plain").rows()["value"].to_pylist() == [1.0] * 60


def resealed(path):
    """Replace the digest of a JSON file by the right one, so that its content is tested as well."""
    with suppress(ValueError, KeyError, AttributeError, TypeError, RecursionError):
        facts = json.loads(path.read_bytes())
        facts.pop("digest")
        path.write_text(json.dumps({**facts, "digest": digest(facts)}))


def lake_of_a_request(root):
    publish.make_version(root, plain_plan(), plain_work, name="mine")
    request_links.write_area(root, "mine", AREA)


def of_area(root):
    """Define the function in_area as a session does; it may fail only when it is called."""
    resealed(root / "names" / "mine" / "area.json")
    with duckdb.connect() as connection:
        for command in (*session._MACROS, *requested_area.macros(root, ["mine.plain"])):
            connection.execute(command)
    request_links.read_area(root, "mine")


def of_link(path):
    """Read a link whose target is the text."""
    text = path.read_bytes().replace(b"\0", b"")[:4000]
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "toy" / "current"
        link.parent.mkdir()
        if text:
            try:
                link.symlink_to(text.decode("utf-8", "surrogateescape"))
            except OSError:
                return
        layout.linked_key(link, "toy" if text.startswith(b"..") else "")


def hats(folder):
    lake_of_rows(folder / "lake")
    (collection,) = folder.glob("lake/toy/v-*")
    shutil.move(collection, folder / "hats")


def of_hats(folder):
    external_rows._files_of_folder(folder / "hats")


# ------------------------------------------------------------------------------------------------ cache


def entry(folder):
    array_cache._store({"one": np.arange(50.0), "two": np.ones((3, 4), np.int16)}, written_folder(folder))
    array_cache.store_checksums(folder, ["one.npy", "two.npy"])


def written_folder(folder):
    folder.mkdir(parents=True)
    return folder


def of_entry(folder):
    found = array_cache._load(folder)
    assert found is None or (found["one"] == np.arange(50.0)).all()


def of_array(folder):
    """Read an array whose checksum is right, as another program could have written both."""
    array_cache.store_checksums(folder, ["one.npy", "two.npy"])
    array_cache._load(folder)


# ------------------------------------------------------------------------------------------------ images


def pixels(name=""):
    data = np.arange(600, dtype=np.float32).reshape(20, 30)
    return images.Image(data, tuple(conftest.astrometry.cards(conftest.system())), name)


def stored(path):
    images.write_images(path, [pixels()])


def packed(path):
    images.write_images(path, [pixels()], rice=True)


def calibrated(path):
    units = [images.Image(None, pixels().cards), *(pixels(name) for name in ("SCI", "WHT", "FLG"))]
    images.write_images(path, units)


def of_head(path):
    head_files.first_cards(path.with_suffix(".fits"))


def of_progress(folder):
    state = progress.read_state(folder)
    progress.time_left(state, 1.8e9)


RUN_FILES = {
    progress._RUN: {"jobs": [["build", 3.0]], "workers": 2},
    progress._JOB: {"finished": [2.5], "job_started": 1.7e9},
    progress._TABLES: {"tables_started": 1.7e9, "parts_of_job": 3},
    progress._TABLE: {"name": "products", "unit": "detector", "parts": 3, "parts_before": 1, "receipts": "receipts"},
    "activity-1-1.json": {"text": "map", "started": 1.7e9, "done": 1, "total": 2, "process": 1},
}


def run_folder(folder):
    folder.mkdir(parents=True)
    for name, content in RUN_FILES.items():
        (folder / name).write_text(json.dumps(content))


def slices(path):
    import h5py

    with h5py.File(path, "w") as file:
        for k in range(2):
            group = file.create_group(str(k)).create_group("data")
            for name in ("ra", "dec", "z"):
                group[name] = MANY[name]


TARGETS = {
    **{
        f"camera, {Path(file).stem}": folder_target(
            lambda folder: camera_template.write_like("megacam", folder), lambda folder, file=file: folder / file,
            camera_folder.read, ".csv",
        ) for file in CAMERA
    },
    "catalogue, HDF5": (
        lambda: [written(slices)], lambda path: hdf5.send_batches(path, ["ra", "dec", "z"], (), io.BytesIO()), ".hdf5",
        True,
    ),
    "catalogue, HATS": folder_target(hats, lambda folder: folder / "hats" / "collection.properties", of_hats),
    "sources, CSV": (
        lambda: [as_csv({name: MANY[name] for name in ("id", "ra", "dec", "z")})],
        lambda path: injected_rows._columns_of_file(path, lambda title: True), ".csv",
    ),
    "partition": folder_target(lake_of_rows, partition, of_partition, ".parquet"),
    "receipt": folder_target(unfinished, receipt, of_receipt, ".json"),
    "area of a request": folder_target(
        lake_of_a_request, lambda root: root / "names" / "mine" / "area.json", of_area, ".json",
    ),
    "link": (lambda: [b"v-0123456789abcdef", b"../../toy/v-0123456789abcdef"], of_link),
    "cache, checksums": folder_target(entry, lambda folder: folder / cache_entries.CHECKSUM_FILE, of_entry, ".json"),
    "cache, array": folder_target(entry, lambda folder: folder / "one.npy", of_array, ".npy"),
    **{
        f"progress of a run, {name}": folder_target(
            run_folder, lambda folder, name=name: folder / name, of_progress, ".json"
        )
        for name in RUN_FILES
    },
    "image": (lambda: [written(stored), written(packed)], read_back.frame, ".fits"),
    "calibrated image": (lambda: [written(calibrated)], reduction_files.read_image, ".fits"),
    "frame of a user": (
        lambda: [as_image(pixels().data, {"CRVAL1": 10.0})], lambda path: external.read_frame(path), ".fits",
    ),
    "head file": (lambda: [head_files.text([pixels()]).encode()], of_head, ".head"),
}  # fmt: skip
