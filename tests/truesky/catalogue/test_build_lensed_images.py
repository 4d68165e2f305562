"""The job that builds `lensed_images`: which lenses and sources it joins, also across the edge of a file."""

from dataclasses import asdict

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import layout, plan, publish, read
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.strong_lenses import STRONG_LENSES
from lake_schema.tables.variability.transients import TRANSIENTS
from tests import requests
from truesky.catalogue import build_lensed_images, cells, lensed_quasars
from truesky.catalogue.transients import lensed_supernovae
from truesky.catalogue.transients.supernovae import Window
from truesky.cosmology import FIDUCIAL
from truesky.request.from_toml import parse
from truesky.variability import spectral_series

# Two files with a common edge, and cells of 3 arcsec in the second one along that edge.
FILES = (100, 101)
EDGE = [c for c in sky.margin_cells(FILE_ORDER, FILES[0], 16).tolist() if c >> 2 * (16 - FILE_ORDER) == FILES[1]]
N, SEED, BOOST = 40, 7, 1e4
START, END = 61000.0, 61400.0


def fill(table, columns):
    """Return sorted rows of a table; columns that are not given have their smallest value, or are null."""
    n = len(columns["ra"])
    columns = {**columns, "_healpix_29": sky.healpix_29(columns["ra"], columns["dec"])}
    for column in table.columns:
        if column.name not in columns and not column.nullable:
            smallest = [] if column.type.startswith("list") else column.lo or 0
            columns[column.name] = pa.array([smallest] * n, column.arrow_type)
    return cells.sort_rows(table.build(columns))


@pytest.fixture(scope="module")
def tables():
    """Return galaxies at the edge that form stars, quasars in their generation cells, and lenses at the edge."""
    rng = np.random.default_rng(6)
    ra, dec = sky.cell_centres(16, np.resize(EDGE, N))
    host = sky.cell_at(ra, dec, GENERATION_ORDER)
    quasar_ra, quasar_dec = sky.cell_centres(20, (host << 24) + rng.integers(0, 1 << 24, N))
    all_ra, all_dec, kind = np.append(ra, quasar_ra), np.append(dec, quasar_dec), np.repeat([0, 2], N)
    galaxies = {
        "id": ids.source_id(kind, np.append(host, host), np.arange(2 * N)), "kind": kind, "ra": all_ra, "dec": all_dec,
        "ra_true": all_ra, "dec_true": all_dec, "z_true": np.where(kind == 2, 2.0, 0.5),
        "z_obs": np.where(kind == 2, 2.0, 0.5), "log_stellar_mass": np.ma.array(np.full(2 * N, 10.5), mask=kind == 2),
        "log_sfr": np.ma.array(np.full(2 * N, 1.0), mask=kind == 2), "abs_mag_r01": np.full(2 * N, -22.5),
        "color_gr_01": np.full(2 * N, 0.9), "disk_half_light_radius": np.full(2 * N, 0.3),
        "disk_axis_ratio": np.full(2 * N, 0.7), "position_angle": rng.uniform(0.0, 180.0, 2 * N),
        "kappa": np.zeros(2 * N), "gamma1": np.zeros(2 * N), "gamma2": np.zeros(2 * N),
        "density_boost": np.ones(2 * N),
    }  # fmt: skip
    lenses = {
        "id": ids.source_id(4, host, np.arange(N)), "kind": np.full(N, 4), "lens_id": galaxies["id"][:N],
        "source_id": galaxies["id"][:N], "density_boost": np.full(N, BOOST), "ra": ra, "dec": dec,
        "z_lens": np.full(N, 0.3), "z_source": np.full(N, 0.5), "einstein_radius": np.full(N, 2.0),
        "axis_ratio": np.full(N, 0.7), "velocity_dispersion": np.full(N, 300.0), "images": np.full(N, 2),
        "position_angle": rng.uniform(0.0, 180.0, N), "source_east": rng.uniform(-0.4, 0.4, N),
        "source_north": rng.uniform(-0.4, 0.4, N), "stamp_side": np.ones(N, np.int16),
    }  # fmt: skip
    return {"galaxies": fill(GALAXIES, galaxies), "strong_lenses": fill(STRONG_LENSES, lenses)}


def store(lake, table, rows, facts):
    """Publish a table of a lake, with one file per cell of FILES."""
    place = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, FILE_ORDER)
    tasks = tuple(
        plan.Task(layout.cell_file(FILE_ORDER, file), {"generation_cells": list(range(file << 6, file + 1 << 6))})
        for file in FILES
    )
    return publish.make_version(
        lake,
        plan.Plan(table, facts, tasks),
        lambda lake, task: plan.Output(rows.filter(pa.array(place == task["generation_cells"][0] >> 6))),
    )


def window(templates=None):
    return Window(START, END, ("ia", "core_collapse"), 10.0, templates)


def stored_lake(lake, tables, with_transients=False, key=None):
    """Publish the tables, and an empty table of transients with the window of time in its facts."""
    store(lake, GALAXIES, tables["galaxies"], {"seed": SEED, "cosmology": asdict(FIDUCIAL)})
    facts = {"galaxies": key or read.version(lake, "galaxies").key}
    store(lake, STRONG_LENSES, tables["strong_lenses"], facts)
    if with_transients:
        made = {"start": START, "end": END, "kinds": window().kinds, "boost": window().boost}
        store(lake, TRANSIENTS, TRANSIENTS.empty(), {**facts, **made, **spectral_series.facts(None)})
    section = f"[universe]\ntransients = {{ start = {START}, end = {END}, boost = {window().boost} }}\n"
    sections = f"[strong_lenses]\nboost = {BOOST}\n{section if with_transients else ''}"
    return parse(requests.written(lake, sections, seed=SEED))


def built(lake, request):
    (step,) = build_lensed_images.steps(lake, request)
    publish.make_version(lake, step.plan, step.run_task)
    return read.version(lake, "lensed_images")


def of_all_cells(rows, draw):
    """Return the rows that a function draws in all generation cells that have galaxies."""
    place = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, GENERATION_ORDER)
    return pa.concat_tables([draw(int(cell), rows.filter(pa.array(place == cell))) for cell in np.unique(place)])


def quasars(cell, galaxies):
    return lensed_quasars.draw(cell, galaxies, SEED, BOOST, FIDUCIAL)


def test_images_are_stored_where_they_are_and_not_where_their_lens_is(tmp_path, tables):
    version = built(tmp_path, stored_lake(tmp_path, tables, with_transients=True))
    templates = spectral_series.templates_from_facts(spectral_series.facts(None))

    def draw(cell, galaxies):
        lenses = tables["strong_lenses"]
        exploded = lensed_supernovae.draw(cell, galaxies, lenses, SEED, window(templates), FIDUCIAL)
        return pa.concat_tables([quasars(cell, galaxies), exploded])

    whole = cells.sort_rows(of_all_cells(tables["galaxies"], draw))
    place = sky.parent(whole["_healpix_29"].to_numpy(), sky.MAX_ORDER, FILE_ORDER)
    for file in FILES:
        rows = version.rows(None, [layout.cell_file(FILE_ORDER, file)])
        assert rows["type"].null_count > 0
        assert rows.num_rows - rows["type"].null_count > 10
        assert rows.equals(whole.filter(pa.array(place == file)))


def test_a_lake_without_transients_has_images_of_quasars_only(tmp_path, tables):
    rows = built(tmp_path, stored_lake(tmp_path, tables)).rows()
    assert rows.num_rows > 0
    assert rows.equals(cells.sort_rows(of_all_cells(tables["galaxies"], quasars)))
    assert rows["type"].null_count == rows.num_rows


def test_tables_of_another_version_of_the_galaxies_are_refused(tmp_path, tables):
    request = stored_lake(tmp_path, tables, key="other")
    with pytest.raises(
        BadInput, match="strong_lenses was drawn in another version of galaxies: run truesky lenses first"
    ):
        build_lensed_images.steps(tmp_path, request)
