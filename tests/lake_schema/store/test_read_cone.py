"""Selections on the sky by observed and by true position, across edges of cells of one or several orders."""

import healpy as hp
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from tests import hats_readers
from tests.universe import TOY, toy_plan, toy_work

LENSED = Table(
    "lensed",
    1,
    (*TOY.columns, *(Column(f"{name}_true", "float64", "deg", doc="true") for name in ("ra", "dec"))),
    "A toy catalogue with lensed positions.",
    order=5,
)
# Common corners of cells 1607, 1610 and their neighbours, a corner at a pole, and one on RA = 0.
CORNERS = [hp.vec2ang(hp.boundaries(32, cell, nest=True)[:, 0], lonlat=True) for cell in (1607, 1023, 5461)]
N, SPREAD, DEFLECTION = 4000, 0.05, 8 / 3600


def sources(corner, seed=1):
    """Return random sources around a corner of cells, each deflected by up to 8 arcsec."""
    rng = np.random.default_rng(seed)
    centre = hp.ang2vec(*corner, lonlat=True).reshape(3)
    true = centre + np.radians(SPREAD) * rng.normal(size=(N, 3))
    seen = true / np.linalg.norm(true, axis=1)[:, None] + np.radians(DEFLECTION) / 2 * rng.uniform(-1, 1, (N, 3))
    (ra, dec), (ra_true, dec_true) = (hp.vec2ang(v, lonlat=True) for v in (seen, true))
    columns = {
        "ra": ra,
        "dec": dec,
        "_healpix_29": sky.healpix_29(ra, dec),
        "ra_true": ra_true,
        "dec_true": dec_true,
    }
    order = np.argsort(columns["_healpix_29"])
    columns = {name: values[order] for name, values in columns.items()}
    return LENSED.build({**columns, "id": np.arange(N), "flux": rng.random(N)})


def published(root, rows, orders=(5,)):
    """Publish rows as a catalogue with one file per cell; with several orders, cells of order 5 get them in turn."""
    index = rows["_healpix_29"].to_numpy()
    parts = []
    for n, cell in enumerate(np.unique(index >> 48).tolist()):
        order = orders[n % len(orders)]
        cells = np.unique(index[index >> 48 == cell] >> (2 * (29 - order))).tolist()
        parts += [Task(layout.cell_file(order, c), {"order": order, "cell": c}) for c in cells]

    def work(lake, facts):
        return Output(rows.filter(index >> (2 * (29 - facts["order"])) == facts["cell"]))

    publish.make_version(root, Plan(LENSED, {"orders": list(orders)}, tuple(parts)), work)
    return read.version(root, "lensed")


@pytest.fixture(scope="module", params=[(5,), (5, 7, 6)], ids=["one order", "mixed orders"])
def catalogues(request, tmp_path_factory):
    made = []
    for corner in CORNERS:
        rows = sources(corner)
        made.append((corner, rows, published(tmp_path_factory.mktemp("lake"), rows, request.param)))
    return made


def test_corners_are_corners(catalogues):
    for _, _, version in catalogues:
        assert len(version.partitions) >= 3


@given(data=st.data(), on=st.sampled_from(["observed", "true"]))
def test_no_source_is_lost_at_an_edge(catalogues, data, on):
    (ra, dec), rows, version = data.draw(st.sampled_from(catalogues))
    ra, dec = float(ra[0]), float(dec[0])
    towards = st.floats(-SPREAD, SPREAD)
    centre = (ra + data.draw(towards)) % 360, np.clip(dec + data.draw(towards), -90, 90)
    radius = data.draw(st.floats(1e-4, 2 * SPREAD))
    there = (rows[name].to_numpy() for name in version.position_columns(on))
    wanted = rows["id"].to_numpy()[sky.separation(*there, *centre) <= radius]
    found = version.cone(*centre, radius, ["id"], on)
    assert found.column_names == ["id"]
    assert sorted(found["id"].to_pylist()) == sorted(wanted.tolist())


def test_lensing_moves_sources_over_the_edge(catalogues):
    """Without the padded radius, sources whose observed cells are not touched would be lost."""
    lost = 0
    for _, rows, version in catalogues:
        assert 0.3 * DEFLECTION < version.max_deflection() <= DEFLECTION
        radius = 5 / 3600
        for row in range(0, N, 160):
            ra, dec = (float(rows[name][row].as_py()) for name in ("ra_true", "dec_true"))
            found = set(version.cone(ra, dec, radius, ["id"], "true")["id"].to_pylist())
            unpadded = version.rows_in_cells(sky.cells_in_cone(ra, dec, radius, 16), 16, ["id"])["id"].to_pylist()
            lost += len(found - set(unpadded))
            assert row in found or rows["id"][row].as_py() in found
    assert lost > 3


def test_all_columns_and_the_whole_sky(catalogues):
    _, _, version = catalogues[0]
    assert version.cone(10.0, 20.0, 180.0).num_rows == N
    assert version.cone(10.0, 20.0, 180.0, on="true").column_names == LENSED.names
    assert version.cone(float(CORNERS[0][0][0]), -float(CORNERS[0][1][0]), 0.001).num_rows == 0


def test_wrong_arguments_of_a_cone_are_refused(lake, catalogues):
    _, _, version = catalogues[0]
    for arguments, words in (
        ((100.0, 91.0, 1.0), r"^dec = 91.0 is outside \[-90.0, 90.0\]$"),
        ((-27.8, 153.1, 1.0), r"^dec = 153.1 is outside \[-90.0, 90.0\]: are ra and dec exchanged\?$"),
        ((0.0, 0.0, -1.0), "radius"),
        ((float("nan"), 0.0, 1.0), "ra"),
        ((float("inf"), 0.0, 1.0), "ra"),
        (("a", 0.0, 1.0), "ra = 'a' is not a number"),
        ((0.0, None, 1.0), "dec = None is not a number"),
        ((0.0, 0.0, "1 arcmin"), "radius must be a number of degrees from 0 to 180, got '1 arcmin': write 0.016667"),
        *(((0.0, 0.0, radius), "radius") for radius in (float("nan"), float("inf"), 1e9, "x", 180.1)),
        ((0.0, 0.0, -1e-5, ["id"], "true"), "radius"),
        ((0.0, 0.0, 1.0, ["id"], "seen"), "on = 'seen'"),
        ((0.0, 0.0, 1.0, ["speed"]), "no column speed"),
    ):
        with pytest.raises(BadInput, match=words):
            version.cone(*arguments)


def test_without_lensing_both_positions_are_equal(lake):
    publish.make_version(lake, toy_plan(), toy_work)
    version = read.version(lake, "toy")
    ra, dec = sky.cell_centre(5, 1607)
    found = [version.cone(ra, dec, 0.5, on=on) for on in read.POSITION_KINDS]
    assert 0 < found[0].num_rows < version.num_rows
    assert found[1].equals(found[0])


def test_a_version_without_deflection_is_refused(catalogues):
    _, _, version = catalogues[0]
    facts = {k: v for k, v in version.manifest.items() if k != "deflection_deg"}
    with pytest.raises(BadInput, match="has no largest deflection"):
        read.Version(version.folder, facts, version.schema).cone(0.0, 0.0, 1.0, on="true")


def test_other_readers_open_mixed_orders(catalogues):
    corner, _, version = catalogues[0]
    assert hats_readers.is_valid(version.folder)
    found = (
        hats_readers.open_catalog(version.folder).cone_search(float(corner[0][0]), float(corner[1][0]), 60.0).compute()
    )
    assert sorted(found["id"]) == sorted(
        version.cone(float(corner[0][0]), float(corner[1][0]), 1 / 60, ["id"])["id"].to_pylist()
    )
    assert len(found) > 20


def test_the_margin_of_each_cell_surrounds_it(catalogues):
    for _, rows, version in catalogues:
        fine = rows["_healpix_29"].to_numpy() >> 32
        for part in version.partitions:
            order, cell = layout.cell_of_file(part)
            margin = pq.read_table(version.folder / "lensed_margin" / "dataset" / part, partitioning=None)
            wanted = rows.filter(np.isin(fine, sky.margin_cells(order, cell, 13)))
            assert margin["id"].to_pylist() == wanted["id"].to_pylist()
            assert version.read_margin(part).equals(wanted)
            assert version.read_margin(part, ["id"]).column_names == ["id"]
            assert margin.num_rows > 10


def test_a_cross_match_loses_no_pair_across_cells_of_other_orders(catalogues, tmp_path):
    """Every source has a twin 0.5" to the north, in files with cells of other orders."""
    _, rows, version = catalogues[0]
    columns = {name: rows[name].to_numpy() for name in rows.column_names}
    columns["dec"] = columns["dec"] + 0.5 / 3600
    columns["_healpix_29"] = sky.healpix_29(columns["ra"], columns["dec"])
    order = np.argsort(columns["_healpix_29"])
    twins = published(tmp_path, LENSED.build({name: values[order] for name, values in columns.items()}), (8, 5, 6))
    file_of = {
        int(cell): part
        for one in (version, twins)
        for part in one.partitions
        for cell in one.rows(["_healpix_29"], [part])["_healpix_29"].to_numpy()
    }
    moved = dict(zip(columns["id"].tolist(), columns["_healpix_29"].tolist(), strict=True))
    stayed = dict(zip(rows["id"].to_pylist(), rows["_healpix_29"].to_pylist(), strict=True))
    assert sum(file_of[moved[i]] != file_of[stayed[i]] for i in stayed) > 100
    left, right = (hats_readers.open_catalog(one.folder, columns=["id", "ra", "dec"]) for one in (version, twins))
    pairs = left.crossmatch(right, radius_arcsec=0.6, n_neighbors=4, suffixes=("_a", "_b")).compute()
    assert set(pairs["id_a"][pairs["id_a"] == pairs["id_b"]]) == set(range(N))
