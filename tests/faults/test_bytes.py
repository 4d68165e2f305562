"""Flip bits of small files of every table: readers refuse the file by name, or return the same numbers.

Small files consist of one or two blocks, and every reader verifies them completely. In large files, readers verify only
the blocks that contain the requested data.
"""

import os
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from lake_schema.errors import Damaged
from lake_schema.fits import images
from lake_schema.store import blocks, layout, manifest, parquet, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables import all_tables
from tests.universe import PLAIN, TOY, plain_plan, plain_work, rows_of, toy_rows
from truesky.catalogue.build_galaxies import collect_quarantine, quarantine_file
from truesky.explore.guard import check_query
from truesky.explore.session import Session
from truesky.render.products.sidecar_files import truth_file
from truesky.render.render_exposures import read_truth

TABLES = all_tables(["vis"])
CELL = layout.cell_file(5, 1607)
ROWS = 2
# Number of flipped bits per file: a sample, or all bits. In larger files, which are mostly footer, one bit per byte.
# Most readers test only every n-th of these (n is prime to 8), because all readers compare the same blocks.
SMALL = 8192
SPREAD, SHARE = 17, 3
BITS = [pytest.param(9, id="some"), pytest.param(None, id="every", marks=pytest.mark.nightly)]
MEMORY = 1_000_000_000


def published(root, table, rows, name="a"):
    """Publish a version of a table with given rows in one file, and the same rows in a sidecar file."""
    part = Task(CELL if table.is_catalogue else "all.parquet", {})
    beside = {"beside/x.parquet": lambda path: parquet.write(path, rows, table)}
    publish.make_version(root, Plan(table, {"name": name}, (part,)), lambda lake, facts: Output(rows, beside))
    return read.version(root, table.name)


def asking(version, text):
    """Return the result of an allowed query in the process of the explorer."""
    query = check_query(text, {version.table: version.key})
    root = version.folder.parents[1]

    def asked():
        session = Session(root, {version.table: version.key}, MEMORY)
        return pa.Table.from_batches(list(session.run(query, {})))

    return asked


def readers(version, table):
    """Return name -> function that reads an open version like `rows`, the jobs, the explorer and cones."""
    names = [column.name for column in table.columns]
    some = [names[0], names[-1]]
    found = {
        "open": lambda: pa.table({"x": read.version(version.folder.parents[1], version.table).schema.names}),
        "rows": lambda: version.rows(),
        "columns": lambda: version.rows(some, where=pc.field(names[0]).is_valid()),
        "explorer": asking(version, f'SELECT "{names[-1]}" FROM {version.table}'),
    }
    if table.pixel_order is not None:
        found["cells"] = lambda: version.rows_in_cells([1607], 5, some)
    elif table.is_catalogue:
        ra, dec = (version.rows()[name].to_numpy()[0] for name in ("ra", "dec"))
        found["cone"] = lambda: version.cone(ra, dec, 0.5, ["id"])
        found["cells"] = lambda: version.rows_in_cells([1607], 5, some)
        if "ra_true" in names:
            found["cone by true positions"] = lambda: version.cone(ra, dec, 180.0, ["id"], on="true")
    return found


def flip(path, bit):
    """Flip one bit of a file in place and keep its time; a second call restores the file."""
    with path.open("r+b", buffering=0) as stream:
        (byte,) = os.pread(stream.fileno(), 1, bit // 8)
        os.pwrite(stream.fileno(), bytes([byte ^ 1 << bit % 8]), bit // 8)


def answer(reader):
    """Return (rows, None), or (None, message) if the reader refuses the file."""
    try:
        return reader(), None
    except Damaged as error:
        return None, str(error)


def harmed(path, bits, reader, step=1):
    """Return (bits for which a reader refused the file by name, bits tried); other bits must not change the rows.

    `bits` is the number of random bits to try. If it is None, every `step`-th bit is tried, in large files only one bit
    per byte.
    """
    good, size, refused = reader(), 8 * path.stat().st_size, 0
    every = range(size) if size <= 8 * SMALL else [8 * byte + byte % 8 for byte in range(size // 8)]
    some = np.random.default_rng(1).choice(size, bits or 1, replace=False).tolist()
    chosen = every[::step] if bits is None else some
    for bit in chosen:
        flip(path, bit)
        rows, why = answer(reader)
        flip(path, bit)
        assert path.name in why if why else rows.equals(good), f"bit {bit} of {path}"
        refused += bool(why)
    return refused, len(chosen)


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_a_flipped_bit_of_any_table_is_refused_by_name(lake, table, bits, record_property):
    version = published(lake, table, rows_of(table, ROWS))
    path = version.partition_path(version.partitions[0])
    for name, reader in readers(version, table).items():
        some = bits if bits is None or name == "rows" else bits // SHARE
        refused, tried = harmed(path, some, reader, 1 if name == "rows" else SPREAD)
        assert refused == tried, name
        record_property(f"{table.name} {name}", tried)


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", ["quarantine", "rendered_truth", "gaia"])
def test_a_flipped_bit_in_a_sidecar_file_is_refused_by_name(lake, name, bits, record_property):
    """Check the rows that other tables are made from: sidecar files of a task and rows of a margin."""
    (table,) = (table for table in TABLES if table.name == name)
    version = published(lake, table, rows_of(table, ROWS))
    files = {"beside/x.parquet": lambda: version.read_sidecar("beside/x.parquet")}
    if table.is_catalogue:
        files[f"{name}_margin/dataset/{CELL}"] = lambda: version.read_margin(CELL)
    for relative, reader in files.items():
        refused, tried = harmed(version.folder / relative, bits, reader)
        assert refused == tried
        record_property(f"{name} {relative}", tried)


def rows_beside(root, name, beside, relative, facts):
    """Make a version of a table of two rows, with rows of another table in a sidecar file."""
    (table,) = (table for table in TABLES if table.name == name)
    given = rows_of(table, ROWS)
    part = Task(CELL if table.is_catalogue else "all.parquet", facts)
    files = {relative(given): lambda path: parquet.write(path, rows_of(beside, ROWS), beside)}
    publish.make_version(root, Plan(table, {}, (part,)), lambda lake, known: Output(given, files))
    return read.version(root, name)


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("made", ["rendered_truth", "quarantine"])
def test_a_table_is_not_made_from_rows_with_a_flipped_bit(lake, made, bits):
    """Run the jobs that read the sidecar files of other jobs."""
    (table,) = (table for table in TABLES if table.name == made)
    if made == "quarantine":
        cells = [1607 << 6]
        version = rows_beside(lake, "galaxies", table, lambda rows: quarantine_file(cells), {"generation_cells": cells})
        work, facts = collect_quarantine, {"galaxies": version.key}
    else:

        def first(rows):
            (row, *_) = rows.to_pylist()
            return truth_file(row["exposure_id"], row["detector"])

        version = rows_beside(lake, "products", table, first, {})
        work, facts = read_truth, {"products": version.key, "part": "all.parquet"}
    (relative,) = (entry["path"] for entry in version.manifest["files"] if entry["path"].startswith(("truth", "quara")))
    path = version.folder / relative
    assert work(lake, facts).rows.num_rows == ROWS
    refused, tried = harmed(path, bits, lambda: work(lake, facts).rows)
    assert refused == tried


# ------------------------------------------------------------------------------------------------ larger than a read


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """Return a file of several row groups, in which each column has separate blocks."""
    root = tmp_path_factory.mktemp("large")
    rows = toy_rows(1607, 3 * parquet.ROWS_PER_GROUP)
    # Shuffled identifiers, because the pages of sorted ones would be small.
    ids = np.random.default_rng(4).permutation(1 << 20)[: rows.num_rows]
    return published(root, TOY, rows.set_column(0, rows.schema.field(0), pa.array(ids)))


def spans(version, part):
    """Return (column or "", row group, first byte, last byte + 1) of all sections of the file; the footer is last."""
    path = version.partition_path(part)
    about = pq.read_metadata(path)
    found = []
    for group in range(about.num_row_groups):
        for column in range(about.num_columns):
            chunk = about.row_group(group).column(column)
            start = chunk.dictionary_page_offset if chunk.has_dictionary_page else chunk.data_page_offset
            found.append((chunk.path_in_schema, group, start, start + chunk.total_compressed_size))
    return [*found, ("", 0, found[-1][3], path.stat().st_size)]


@pytest.mark.parametrize("flips", [1, pytest.param(300, marks=pytest.mark.nightly)])
def test_checksums_of_read_blocks_are_verified(large, flips):
    """A flipped bit in the read columns is refused, also outside the checksums of pages; other bits have no effect."""
    part = large.partitions[0]
    index = large.rows(["_healpix_29"])["_healpix_29"].to_numpy()
    ra, dec = (large.rows([name])[name].to_numpy()[parquet.ROWS_PER_GROUP + 1000] for name in ("ra", "dec"))
    where = pc.field("_healpix_29") == int(index[parquet.ROWS_PER_GROUP + 1000])
    every, second = {0, 1, 2}, {1}
    wanted = {
        "flux": (lambda: large.rows(["flux"]), {"flux"}, every),
        "where": (lambda: large.rows(["flux"], where=where), {"flux", "_healpix_29"}, second),
        "cone": (lambda: large.cone(ra, dec, 0.003, ["flux"]), {"flux", "_healpix_29", "ra", "dec"}, second),
        "explorer": (asking(large, "SELECT max(flux), min(flux) FROM toy"), {"flux"}, every),
    }
    path = large.partition_path(part)
    rng = np.random.default_rng(2)
    for reader, columns, groups in wanted.values():
        good = reader()
        assert good.num_rows
        for column, group, start, end in spans(large, part):
            needed = not column or (column in columns and group in groups)
            # These bytes are read together with the footer.
            with_footer = end > path.stat().st_size - (64 << 10)
            # The header of a page is at the beginning of its chunk.
            for bit in [8 * start, 8 * start + 60, *rng.integers(8 * start, 8 * end, flips).tolist()]:
                flip(path, bit)
                rows, why = answer(reader)
                flip(path, bit)
                assert why or not needed, (column, group, bit)
                assert path.name in why if why else rows.equals(good)
                assert needed or with_footer or not why


def test_reading_a_column_reads_only_its_bytes(large, monkeypatch):
    """Reading one column of one row group reads few other bytes."""
    read_bytes = []
    one = blocks.VerifiedFile._read_range

    def counted(self, first, last):
        read_bytes.append(last - first)
        return one(self, first, last)

    monkeypatch.setattr(blocks.VerifiedFile, "_read_range", counted)
    index = large.rows(["_healpix_29"])["_healpix_29"].to_numpy()
    read_bytes.clear()
    large.rows(["flux"], where=pc.field("_healpix_29") == int(index[5]))
    chunk = {(column, group): end - start for column, group, start, end in spans(large, large.partitions[0])}
    asked_for, beside = chunk["flux", 0] + chunk["_healpix_29", 0], chunk["flux", 2] + 2 * (64 << 10)
    assert asked_for <= sum(read_bytes) < asked_for + beside


@pytest.mark.parametrize("what", ["columns", "row groups"])
def test_swapped_pieces_of_equal_length_are_refused(lake, what):
    """The checksum of each piece stays correct at the other position."""
    n = 2 * parquet.ROWS_PER_GROUP
    rows = replace(PLAIN, name="wide", columns=tuple(replace(PLAIN.columns[1], name=c) for c in "ab"), key=("a",))
    rng = np.random.default_rng(3)
    # Noise cannot be compressed, so the pieces have the same length.
    version = published(lake, rows, rows.build({c: rng.random(n) for c in "ab"}))
    path, part = version.partition_path(version.partitions[0]), version.partitions[0]
    a0, b0, a1, *_ = ((start, end) for _, _, start, end in spans(version, part))
    first, second = (a0, b0) if what == "columns" else (a0, a1)
    length = min(first[1] - first[0], second[1] - second[0])
    whole = path.read_bytes()
    data = bytearray(whole)
    data[first[0] : first[0] + length], data[second[0] : second[0] + length] = (
        whole[second[0] : second[0] + length],
        whole[first[0] : first[0] + length],
    )
    path.write_bytes(data)
    for reader in (lambda: version.rows(["a"]), asking(version, "SELECT max(a) FROM wide")):
        with pytest.raises(Damaged, match=path.name):
            reader()
    assert read.find_faults(version, deep=True) == [f"{path} has other contents than the manifest says"]


def test_a_number_of_rows_that_differs_from_the_manifest_is_refused(lake):
    """Rewrite a file and its entry in the manifest, but not the number of rows."""
    folder = publish.make_version(lake, plain_plan(), plain_work)
    version = read.version(lake, "plain")
    path = version.partition_path("1.parquet")
    parquet.write(path, version.rows(partitions=["1.parquet"]).slice(0, 19), PLAIN)
    facts = {key: value for key, value in version.manifest.items() if key != "files"}
    new = manifest.file_entry(path, "dataset/1.parquet")
    files = [{**entry, **(new if entry["path"] == new["path"] else {})} for entry in version.manifest["files"]]
    manifest.write(folder, {**facts, "files": files})
    changed = read.version(lake, "plain")
    for reader in (changed.rows, lambda: changed.rows(["id"], ["1.parquet"]), asking(changed, "FROM plain")):
        with pytest.raises(Damaged, match=r"1\.parquet has 19 rows, the manifest says 20"):
            reader()


def test_a_manifest_without_the_blocks_of_a_table_is_refused(lake):
    folder = publish.make_version(lake, plain_plan(), plain_work)
    about = dict(manifest.load(folder, "plain"))
    files = [{key: value for key, value in entry.items() if key != "blocks"} for entry in about["files"]]
    manifest.write(folder, {**about, "files": files})
    with pytest.raises(Damaged, match=r"manifest\.json is not a valid manifest"):
        read.version(lake, "plain")


# ------------------------------------------------------------------------------------------------ images


def picture(path):
    rng = np.random.default_rng(5)
    images.write_images(path, [images.Image(rng.poisson(300, (80, 50)).astype(np.uint16), (("EXPTIME", 560.5, "s"),))])


def packed(path):
    rng = np.random.default_rng(5)
    images.write_images(path, [images.Image(rng.poisson(300, (80, 50)).astype(np.uint16))], rice=True)


def swapped(whole, rng):
    """Return the bytes of a file with two different ranges of 4-byte words swapped."""
    words = np.frombuffer(whole, ">u4")
    while True:
        n = int(rng.integers(1, 40))
        first, second = np.sort(rng.integers(0, words.size - n, 2)).tolist()
        if first + n <= second and (words[first : first + n] != words[second : second + n]).any():
            changed = words.copy()
            changed[first : first + n], changed[second : second + n] = (
                words[second : second + n],
                words[first : first + n],
            )
            return changed.tobytes()


@pytest.mark.parametrize("writer", [picture, packed])
def test_swapped_pieces_of_an_image_are_refused(lake, writer):
    """The checksums in FITS do not detect swapped pieces; the sha256 in the manifest does."""
    publish.make_version(
        lake, plain_plan(parts=1), lambda root, facts: Output(plain_work(root, facts).rows, {"images/a.fits": writer})
    )
    version = read.version(lake, "plain")
    path = version.sidecar_path("images/a.fits")
    whole, rng = path.read_bytes(), np.random.default_rng(6)
    for _ in range(100):
        path.write_bytes(swapped(whole, rng))
        with pytest.raises(Damaged, match=r"a\.fits has other contents than the manifest says"):
            images.read_images(version.sidecar_path("images/a.fits"))


@pytest.mark.parametrize("trials", [100, pytest.param(20_000, marks=pytest.mark.nightly)])
def test_a_compressed_image_with_swapped_pieces_is_read_or_refused(tmp_path, trials):
    """Outside a lake, the checksums stay correct, so the decompressed values are arbitrary."""
    path = tmp_path / "a.fits"
    packed(path)
    whole, rng, refused = path.read_bytes(), np.random.default_rng(7), 0
    for _ in range(trials):
        path.write_bytes(swapped(whole, rng))
        _, why = answer(lambda: images.read_images(path))
        assert why is None or (path.name in why and "\n" not in why)
        refused += bool(why)
    assert refused > 0.9 * trials
