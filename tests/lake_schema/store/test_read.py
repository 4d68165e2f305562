"""Reading returns the right rows, opens only files that can contain them, and refuses damaged bytes."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from lake_schema import listing, sky
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output
from tests import hats_readers
from tests.universe import CELLS, toy_plan, toy_work


@pytest.fixture
def toy(lake):
    publish.make_version(lake, toy_plan(), toy_work)
    return read.version(lake, "toy")


def test_rows_of_some_cells(toy):
    everything = toy.rows()
    fine = sky.parent(everything["_healpix_29"].to_numpy(), 29, 8)
    for cells in ([fine[0]], np.unique(fine)[::3], [5], []):
        wanted = everything.filter(pa.array(np.isin(fine, cells)))
        assert toy.rows_in_cells(cells, 8).equals(wanted)
        assert toy.rows_in_cells(cells, 8, ["id", "flux"]).equals(wanted.select(["id", "flux"]))


def test_coarse_cells_are_found_too(toy):
    assert toy.rows_in_cells([1607 >> 4], 3).num_rows == sum(n for c, n in CELLS if c >> 4 == 1607 >> 4)


def test_filters_and_columns(toy):
    rows = toy.rows(["id"], where=pc.field("flux") > 0.5)
    assert rows.column_names == ["id"]
    assert rows.num_rows == sum(f > 0.5 for f in toy.rows()["flux"].to_pylist())
    with pytest.raises(BadInput, match=r"table toy has no column speed; it has .*flux"):
        toy.rows(["id", "speed"])
    with pytest.raises(BadInput, match=r"table toy has no column fluxx; did you mean flux\?"):
        toy.rows(["fluxx"])
    with pytest.raises(
        BadInput, match=r"table toy has no column FLUX \(did you mean flux\?\) and ID \(did you mean id\?\)$"
    ):
        toy.rows(["FLUX", "ra", "ID", "FLUX"])
    with pytest.raises(BadInput, match=r"no column FLUX \(did you mean flux\?\) and speed; it has .*flux"):
        toy.rows(["FLUX", "speed"])


def test_units_come_back_with_the_rows(toy):
    assert toy.schema.field("flux").metadata[b"unit"] == b"uJy"


def test_a_missing_table(lake):
    with pytest.raises(BadInput, match="no table galaxies"):
        read.version(lake, "galaxies")
    with pytest.raises(BadInput, match="name"):
        read.version(lake, "../galaxies")


@pytest.mark.parametrize("harm", ["delete", "shorten", "add", "flip"])
def test_damage_is_named(toy, harm):
    path = toy.partition_path(toy.partitions[0])
    if harm == "delete":
        path.unlink()
    if harm == "shorten":
        os.truncate(path, path.stat().st_size - 1)
    if harm == "add":
        path.with_name("Npix=9999.parquet").write_bytes(path.read_bytes())
    if harm == "flip":
        data = bytearray(path.read_bytes())
        data[len(data) // 3] ^= 1
        path.write_bytes(data)
    found = read.find_faults(toy, deep=True)
    assert len(found) == 1
    assert ("Npix=9999" if harm == "add" else path.name) in found[0]
    if harm == "add":
        assert toy.rows().num_rows == toy.num_rows
    else:
        with pytest.raises(Damaged):
            toy.rows()


def image_work(root, facts):
    return Output(toy_work(root, facts).rows, {f"images/{facts['cell']}.fits": lambda path: path.write_bytes(b"image")})


# Functions that read files of a version, by the folder of these files.
READERS = {
    "toy/dataset/Norder=5": lambda version: version.rows(),
    "toy/dataset": lambda version: version.partition_path(version.partitions[0]),
    "toy": lambda version: version.rows_in_cells([1607 >> 4], 3),
    "toy_margin": lambda version: version.read_margin(version.partitions[0]),
    "toy_margin/dataset": lambda version: version.read_sidecar(f"toy_margin/dataset/{version.partitions[0]}"),
    "images": lambda version: version.sidecar_path("images/1607.fits"),
    "./images": lambda version: version.sidecar_folder("images"),
}


@pytest.mark.parametrize("folder", READERS)
def test_a_linked_folder_is_refused(lake, tmp_path, folder):
    """The linked folder has the right files, but may be outside the lake."""
    publish.make_version(lake, toy_plan(), image_work)
    version = read.version(lake, "toy")
    assert read.find_faults(version, deep=True) == []
    READERS[folder](version)
    path = version.folder / folder
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Damaged, match=f"{path} is a symbolic link"):
        READERS[folder](version)
    for deep in (False, True):
        assert any(f"{path} is a symbolic link" in fault for fault in read.find_faults(version, deep))


def test_a_version_that_is_linked_outside_the_lake_is_refused(lake, tmp_path, toy):
    toy.folder.rename(tmp_path / toy.folder.name)
    toy.folder.symlink_to(tmp_path / toy.folder.name)
    with pytest.raises(BadInput, match=f"path {toy.folder} is outside {lake}"):
        read.version(lake, "toy")
    (row,) = listing.rows(lake)
    assert row["error"] == f"path {toy.folder} is outside {lake}"


def test_any_hats_reader_can_open_it(toy):
    folder = layout.current_link(toy.folder.parents[1], "toy")
    assert hats_readers.is_valid(folder)
    catalogue = hats_readers.open_catalog(folder)
    ra, dec = sky.cell_centre(5, 1607)
    found = catalogue.cone_search(ra, dec, 0.8 * 3600).compute()
    everything = toy.rows()
    apart = sky.separation(ra, dec, everything["ra"].to_numpy(), everything["dec"].to_numpy())
    assert sorted(found["id"]) == sorted(everything["id"].to_numpy()[apart < 0.8])


@pytest.mark.nightly
def test_pairs_across_cell_edges_are_matched(lake):
    """Every source has a twin 1" away in another catalogue; with the margin, no pair is lost at an edge."""
    from tests.universe import TOY

    edge = sky.cell_range(5, 1608)[0]

    def work(root, facts):
        cell, shift = facts["cell"], facts["seed"] / 3600
        rng = np.random.default_rng(7)
        # Half of the pairs along the border of cell 1607 have one member on each side.
        rim = np.concatenate([sky.margin_cells(5, 1607, 13), [edge >> 32]])
        index = np.repeat(rim, 4) << 32 | rng.integers(0, 1 << 32, 4 * rim.size)
        import healpy as hp

        ra, dec = hp.pix2ang(1 << 29, index, nest=True, lonlat=True)
        dec = dec + shift
        here = sky.cell_at(ra, dec, 5) == cell
        order = np.argsort(sky.healpix_29(ra[here], dec[here]))
        columns = {"id": np.flatnonzero(here)[order], "ra": ra[here][order], "dec": dec[here][order]}
        columns["_healpix_29"] = sky.healpix_29(columns["ra"], columns["dec"])
        return Output(TOY.build({**columns, "flux": np.ones(here.sum())}))

    around = np.unique(sky.parent(sky.margin_cells(5, 1607, 13), 13, 5)).tolist()
    cells = [(c, 0) for c in sorted({1607, *around})]
    other = lake.parent / "other"
    other.mkdir()
    publish.make_version(lake, toy_plan(0, cells), work)
    publish.make_version(other, toy_plan(1, cells), work)
    left, right = (hats_readers.open_catalog(layout.current_link(root, "toy")) for root in (lake, other))
    pairs = left.crossmatch(right, radius_arcsec=1.5, n_neighbors=1, suffixes=("_a", "_b")).compute()
    same = (pairs["id_a"] == pairs["id_b"]).sum()
    assert same > 0.97 * read.version(lake, "toy").num_rows  # The rest have another neighbour within 1"
    assert len(pairs) == read.version(lake, "toy").num_rows
