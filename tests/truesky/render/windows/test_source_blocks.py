"""Sources around windows: all of a circle and bright ones around it, whatever was read before."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from truesky.render.sources import catalogue_rows
from truesky.render.windows.source_blocks import SourceBlocks

RA, DEC, COUNT, BRIGHT = 53.1, -27.8, 6000, 90.0


class Stored:
    """Rows of a table in memory, which are read by cells like those of a stored version."""

    def __init__(self, table, rows):
        self.table, self.rows, self.reads = table, rows, 0

    def rows_in_cells(self, cells, order, columns):
        self.reads += 1
        here = sky.parent(self.rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, order)
        return self.rows.filter(pa.array(np.isin(here, cells))).select(columns)


@pytest.fixture
def tables(monkeypatch):
    """A catalogue and its fluxes, 1 deg wide, as the functions that read catalogues see them."""
    rng = np.random.default_rng(2)
    ra, dec = RA + rng.uniform(-0.6, 0.6, COUNT), DEC + rng.uniform(-0.5, 0.5, COUNT)
    cell = sky.cell_at(ra, dec, sky.MAX_ORDER)
    order = np.argsort(cell)
    rows = pa.table({"id": np.arange(COUNT), "ra": ra[order], "dec": dec[order], "_healpix_29": cell[order]})
    flux = rows.append_column("f_nu_lsst_r", pa.array(rng.uniform(0.0, 100.0, COUNT)))

    def read_bright(catalogue, fluxes, queries):
        pairs = []
        for query in queries:
            lon, lat = (catalogue.rows[name].to_numpy() for name in ("ra", "dec"))
            reach = query.task["radius"] + query.reach_arcsec / 3600.0
            near = sky.separation(lon, lat, query.task["ra"], query.task["dec"]) < reach
            mask = pa.array(near & (fluxes.rows["f_nu_lsst_r"].to_numpy() >= query.min_flux))
            pairs.append((catalogue.rows.filter(mask).select(["id", "ra", "dec"]),
                          fluxes.rows.filter(mask).select(["id", "f_nu_lsst_r"])))  # fmt: skip
        return pairs

    monkeypatch.setattr(catalogue_rows, "max_deflection", lambda catalogue: 0.0)
    monkeypatch.setattr(catalogue_rows, "read_bright", read_bright)
    return Stored("galaxies", rows), Stored("galaxy_fluxes", flux)


def ids_of(pair):
    rows, fluxes = pair
    assert rows["id"].equals(fluxes["id"])
    ids = rows["id"].to_numpy()
    assert len(np.unique(ids)) == len(ids)
    return set(ids.tolist())


def test_all_sources_of_the_circle_and_bright_ones_around_it(tables):
    blocks = SourceBlocks(*tables, ["id", "ra", "dec"])
    rows = tables[0].rows
    flux = tables[1].rows["f_nu_lsst_r"].to_numpy()
    for ra, dec in ((RA, DEC), (RA + 0.01, DEC - 0.02), (RA - 0.2, DEC + 0.1)):
        found = ids_of(blocks.read({"ra": ra, "dec": dec, "radius": 0.02}, "lsst_r", [(360.0, BRIGHT)]))
        distance = sky.separation(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ra, dec)
        wanted = (distance < 0.02) | ((distance < 0.1) & (flux >= BRIGHT))
        assert set(np.flatnonzero(wanted).tolist()) <= found
        # Faint sources come from the cells of the circle only, which are 0.9 arcmin wide.
        faint = np.array(sorted(found))[flux[sorted(found)] < BRIGHT]
        assert (distance[faint] < 0.06).all()


def test_rows_do_not_depend_on_what_was_read_before(tables):
    places = [(RA + 0.01 * k, DEC + 0.005 * k, 0.01) for k in range(4)]
    tasks = [dict(zip(("ra", "dec", "radius"), place, strict=True)) for place in places]
    together = SourceBlocks(*tables, ["id", "ra", "dec"])
    forwards = [together.read(task, "lsst_r", [(100.0, BRIGHT)]) for task in tasks]
    reads = tables[0].reads
    again = [together.read(task, "lsst_r", [(100.0, BRIGHT)]) for task in reversed(tasks)][::-1]
    assert tables[0].reads == reads
    alone = [SourceBlocks(*tables, ["id", "ra", "dec"]).read(task, "lsst_r", [(100.0, BRIGHT)]) for task in tasks]
    for first, second, third in zip(forwards, again, alone, strict=True):
        assert first[0].equals(second[0])
        assert first[0].equals(third[0])
        assert first[1].equals(third[1])


def test_without_a_limit_no_bright_sources_are_read(tables, monkeypatch):
    monkeypatch.setattr(catalogue_rows, "read_bright", lambda catalogue, fluxes, queries: [1 / 0 for _ in queries])
    found = SourceBlocks(*tables, ["id", "ra", "dec"]).read(
        {"ra": RA, "dec": DEC, "radius": 0.01}, "lsst_r", [(100.0, np.inf)]
    )
    assert ids_of(found)


def test_fluxes_of_other_rows_are_refused(tables):
    catalogue, fluxes = tables
    task = {name: catalogue.rows[name][0].as_py() for name in ("ra", "dec")} | {"radius": 0.01}
    fluxes.rows = fluxes.rows.slice(1)
    blocks = SourceBlocks(catalogue, fluxes, ["id"])
    with pytest.raises(BadInput, match="tables galaxies and galaxy_fluxes: the rows differ"):
        blocks.read(task, "lsst_r", [(1.0, np.inf)])
