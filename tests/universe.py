"""Make small artificial tables from the declarations, so that new columns are tested."""

import numpy as np

from lake_schema import ids, sky
from lake_schema.columns import Column, Table
from lake_schema.store import layout
from lake_schema.store.plan import Output, Plan, Task

TOY = Table(
    "toy",
    1,
    (
        Column("id", "int64", ucd="meta.id;meta.main", lo=0, doc="identifier"),
        Column("ra", "float64", "deg", "pos.eq.ra;meta.main", "right ascension", 0.0, 360.0),
        Column("dec", "float64", "deg", "pos.eq.dec;meta.main", "declination", -90.0, 90.0),
        Column("_healpix_29", "int64", ucd="pos.healpix", lo=0, doc="position"),
        Column("flux", "float32", "uJy", "phot.flux.density", "flux", 0.0, 1e9),
    ),
    "A toy catalogue.",
    order=5,
)
CELLS = ((1607, 300), (1608, 200), (1610, 50), (8000, 0))


def toy_rows(cell, n, seed=1):
    rng = np.random.default_rng([seed, cell])
    index, ra, dec = sky.random_in_cell(5, cell, n, rng)
    number = np.arange(n) + cell * 10_000
    return TOY.build({"id": number, "ra": ra, "dec": dec, "_healpix_29": index, "flux": rng.random(n)})


def toy_work(root, facts):
    return Output(toy_rows(facts["cell"], facts["rows"], facts["seed"]))


def toy_plan(seed=1, cells=CELLS):
    parts = tuple(Task(layout.cell_file(5, cell), {"cell": cell, "rows": n}) for cell, n in cells)
    return Plan(TOY, {"seed": seed}, parts)


PLAIN = Table(
    "plain", 1, (TOY.columns[0], Column("value", "float64", doc="value")), "A toy table that is not on the sky."
)


def plain_work(root, facts):
    """Return rows whose values depend on the seed, so that mixed versions are detected."""
    first = facts["part"] * 100
    return Output(PLAIN.build({"id": np.arange(first, first + 20), "value": np.full(20, float(facts["seed"]))}))


def plain_plan(seed=1, parts=3):
    return Plan(PLAIN, {"seed": seed}, tuple(Task(f"{i}.parquet", {"part": i}, 20) for i in range(parts)))


def rows_of(table, n, seed=0):
    """Return n valid rows of any declared table, with unique identifiers and consistent positions."""
    rng = np.random.default_rng(seed)
    columns = {column.name: _values(column, n, rng) for column in table.columns}
    if table.pixel_order is not None:
        pixel = (1607 << 2 * (table.pixel_order - table.order)) + np.arange(n)
        columns |= {"_healpix_29": pixel << 2 * (sky.MAX_ORDER - table.pixel_order), "pixel": pixel}
    elif table.is_catalogue:
        index, ra, dec = sky.random_in_cell(5, 1607, n, rng)
        columns |= {"_healpix_29": index, "ra": ra, "dec": dec}
        kind = columns.get("kind", (table.column("id").lo or 0) >> 60)
        columns["id"] = ids.source_id(kind, 1607 << 6, np.arange(n))
    return table.build(columns)


def _values(column, n, rng):
    if column.codes:
        codes = [code for code, _ in column.codes]
        picked = [codes[i] for i in rng.integers(0, len(codes), n)]
        return picked if column.type == "string" else np.array(picked)
    if column.type == "string":
        return [f"{column.name}-{i}" for i in range(n)]
    if column.type == "list<int64>":
        return [rng.integers(0, 100, 3).tolist() for _ in range(n)]
    if column.type.startswith("list"):
        return [rng.random(3).astype(np.float32).tolist() for _ in range(n)]
    if column.type == "bool":
        return rng.random(n) < 0.5
    if column.name in ("id", "exposure_id", "sed", "law"):
        return np.arange(n)
    lo = column.lo if column.lo is not None else -100.0
    hi = column.hi if column.hi is not None else lo + 100.0
    if column.type.startswith("int"):
        return rng.integers(int(lo), int(min(hi, lo + 100)) + 1, n)
    return lo + (hi - lo) * rng.random(n)
