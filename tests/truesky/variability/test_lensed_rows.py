"""Rows of the table `lensed_images`: who is paired with whom, where images are, and what the rows do not depend on."""

from dataclasses import fields

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.ids import MEMBER_BITS, kind_from_id
from lake_schema.store import validate
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
from truesky.cosmology import FIDUCIAL
from truesky.variability import lensed_images, lensed_rows
from truesky.variability.lensed_rows import PointSources

FIRST_LENS, FIRST_SOURCE, FIRST_HOST = 4 << 60, 5 << 60, 100


def lenses(n=6, **changed):
    """Return columns of `strong_lenses`: n lenses, each with another galaxy behind it."""
    rng = np.random.default_rng(4)
    columns = {
        "id": FIRST_LENS + np.arange(n), "lens_id": 500 + np.arange(n), "source_id": FIRST_HOST + np.arange(n)[::-1],
        "density_boost": np.full(n, 2.0), "ra": rng.uniform(10.0, 10.1, n), "dec": rng.uniform(60.0, 60.1, n),
        "z_lens": np.full(n, 0.5), "z_source": np.full(n, 1.5), "einstein_radius": rng.uniform(0.5, 2.0, n),
        "axis_ratio": rng.uniform(0.4, 0.9, n), "position_angle": rng.uniform(0.0, 180.0, n),
        "source_east": rng.uniform(-0.3, 0.3, n), "source_north": rng.uniform(-0.3, 0.3, n),
    }  # fmt: skip
    return columns | {name: np.asarray(values) for name, values in changed.items()}


def sources(hosts, east=0.0, north=0.0):
    """Return transients in the given galaxies."""
    n = len(hosts)
    return lensed_rows.transients(pa.table({
        "id": FIRST_SOURCE + np.arange(n), "host_id": np.asarray(hosts, np.int64), "offset_east": np.full(n, east),
        "offset_north": np.full(n, north), "density_boost": np.full(n, 3.0), "type": np.full(n, 1),
        "z_obs": np.full(n, 1.501), "peak_mjd": 61000.0 + np.arange(n), "mag_b": np.full(n, 25.0),
        "stretch": np.full(n, 1.1), "ebv": np.full(n, -0.05), "a_v": np.full(n, 0.1),
    }))  # fmt: skip


def rows_of(lens_columns, point_sources) -> pa.Table:
    return lensed_rows.image_rows(lens_columns, point_sources, FIDUCIAL)


def test_rows_are_what_the_table_declares():
    rows = rows_of(lenses(), sources([100, 101, 102, 103, 104, 105]))
    assert validate.find_violations(rows, LENSED_IMAGES) == []
    assert len(set(rows["id"].to_pylist())) == rows.num_rows
    assert set(kind_from_id(rows["id"].to_numpy()).tolist()) == {5}
    assert (rows["id"].to_numpy() >> MEMBER_BITS - 1 & 1 == 1).all()
    assert (rows["id"].to_numpy() & 3 == rows["image"].to_numpy() - 1).all()
    index = rows["_healpix_29"].to_numpy()
    assert index.tolist() == np.sort(sky.healpix_29(rows["ra"].to_numpy(), rows["dec"].to_numpy())).tolist()
    assert rows["density_boost"].to_pylist() == [6.0] * rows.num_rows


def test_images_are_around_the_lens_of_the_host():
    """A source 0.2" north and 0.1" west of the centre of its host, and its row computed for one system."""
    columns = lenses()
    rows = rows_of(columns, sources([103, 99], -0.1, 0.2)).sort_by("image")
    assert set(rows["source_id"].to_pylist()) == {FIRST_SOURCE}
    assert set(rows["system_id"].to_pylist()) == {FIRST_LENS + 2}
    assert set(rows["lens_id"].to_pylist()) == {502}
    one = {name: values[2:3] for name, values in columns.items()}
    images = lensed_images.find_images(
        lensed_images.Ellipsoids(one["einstein_radius"], one["axis_ratio"], one["position_angle"]),
        one["source_east"] - 0.1,
        one["source_north"] + 0.2,
    )
    north = (rows["dec"].to_numpy() - one["dec"]) * 3600.0
    east = (rows["ra"].to_numpy() - one["ra"]) * 3600.0 * np.cos(np.radians(one["dec"]))
    assert east == pytest.approx(images.east, abs=1e-4)
    assert north == pytest.approx(images.north, abs=1e-4)
    signed = rows["magnification"].to_numpy() * rows["parity"].to_numpy()
    assert signed == pytest.approx(images.magnification, rel=1e-6)
    delay = lensed_images.delays(images.lag, 0.5, 1.5, FIDUCIAL)
    assert rows["delay"].to_numpy() == pytest.approx(delay, rel=1e-12)
    assert rows["peak_mjd"].to_numpy() == pytest.approx(61000.0 + delay, rel=1e-12)
    assert rows["stretch"].to_numpy() == pytest.approx(np.full(rows.num_rows, 1.1), rel=1e-6)
    assert rows["images"].to_pylist() == [len(images.source)] * rows.num_rows
    assert rows["image"].to_pylist() == list(range(1, rows.num_rows + 1))


def test_several_sources_in_a_host_and_several_lenses_of_a_host_are_all_paired():
    columns = lenses(source_id=np.array([101, 100, 101, 100, 102, 101]))
    rows = rows_of(columns, sources([100, 101, 101, 103]))
    found = set(zip(rows["source_id"].to_pylist(), rows["system_id"].to_pylist(), strict=True))
    behind = {0: (1, 3), 1: (0, 2, 5), 2: (0, 2, 5)}
    assert found == {(FIRST_SOURCE + i, FIRST_LENS + j) for i, lens in behind.items() for j in lens}


def test_a_row_depends_on_its_lens_and_source_only():
    columns, point_sources = lenses(), sources([100, 101, 102, 103, 104, 105], 0.02, 0.01)
    whole = rows_of(columns, point_sources)
    shuffled = np.array([5, 0, 3, 1, 2, 4])
    *names, light = (field.name for field in fields(point_sources))
    mixed = PointSources(
        *(getattr(point_sources, name)[shuffled] for name in names),
        {name: values[shuffled] for name, values in getattr(point_sources, light).items()},
    )
    assert rows_of({name: values[shuffled] for name, values in columns.items()}, mixed).equals(whole)
    one = rows_of({name: values[4:5] for name, values in columns.items()}, point_sources)
    assert one.equals(whole.filter(pa.array(whole["system_id"].to_numpy() == FIRST_LENS + 4)))


@pytest.mark.parametrize("count", [0, 6])
def test_no_sources_behind_lenses_give_an_empty_table(count):
    rows = rows_of(lenses(count), sources([1, 2] if count else []))
    assert rows.num_rows == 0
    assert validate.find_violations(rows, LENSED_IMAGES) == []


def test_a_source_in_front_of_its_lens_is_refused():
    with pytest.raises(BadInput, match="behind the lens"):
        rows_of(lenses(z_lens=np.full(6, 2.0)), sources([100]))
