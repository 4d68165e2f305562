"""The render job with supernovae, variable stars, active nuclei and lensed images: products, keys and refusals."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids
from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES
from tests.truesky.render.test_render_exposures import BOTH, REQUEST, keys, make, render, small_detectors
from tests.truesky.render.test_render_exposures import wanted as wanted_sky
from truesky.catalogue import build_active_nuclei, build_galaxies, build_stars, build_transients
from truesky.fluxes import compute_fluxes
from truesky.render import render_exposures
from truesky.render.sources import nuclei

WINDOW = {"start": 60900.0, "end": 60910.0, "boost": 60.0}


@pytest.fixture(scope="module", autouse=True)
def _small():
    with small_detectors():
        yield


def wanted(**changes):
    universe = {**REQUEST["universe"], "variables": True, "quasar_boost": 5.0, "transients": {**WINDOW, **changes}}
    return wanted_sky(universe=universe)


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Return a lake with images of two small detectors."""
    root, request = layout.resolve_lake(tmp_path_factory.mktemp("changing") / "lake"), wanted()
    make(root, request, build_galaxies, build_stars, build_active_nuclei, build_transients, compute_fluxes)
    assert render(root, request) == BOTH
    return root


def test_images_contain_supernovae(lake):
    truth, table = (read.version(lake, name).rows(["id"])["id"].to_numpy() for name in ("rendered_truth", "transients"))
    assert np.isin(truth[ids.is_transient(truth)], table).sum() > 3


def test_a_second_run_reuses_all_images(lake):
    assert sum(render(lake, wanted()).values()) == 0


def test_keys_depend_on_the_new_tables(lake, monkeypatch):
    """Other supernovae or nuclei give other keys, and so do other spectra of the same supernovae."""
    before, checksum = keys(lake, wanted()), read.Version.partition_sha256
    for name in ("transients", "active_nuclei"):
        monkeypatch.setattr(
            read.Version,
            "partition_sha256",
            lambda self, part, table=name: "0" * 64 if self.table == table else checksum(self, part),
        )
        assert all(key != before[part] for part, key in keys(lake, wanted()).items())
    monkeypatch.setattr(read.Version, "partition_sha256", checksum)
    assert keys(lake, wanted()) == before


def test_another_window_is_refused_until_its_supernovae_are_drawn(lake):
    with pytest.raises(BadInput, match="table transients was drawn with another end: run truesky transients first"):
        render_exposures.steps(lake, wanted(end=60920.0))


def test_a_lensed_quasar_elsewhere_changes_no_other_nucleus(lake):
    """The quasar of an image may be far from the detector; its key must not spoil the keys of other nuclei."""
    version = read.version(lake, "active_nuclei")
    rows = version.rows(nuclei.COLUMNS)
    quasars = rows.filter(pa.array(rows["kind"].to_numpy() == nuclei.QUASAR_KIND))
    place = {name: float(rows[name][0].as_py()) for name in ("ra", "dec")}
    task, versions = (
        {**place, "radius": 0.02},
        {name: read.version(lake, name) for name in ("galaxies", "active_nuclei")},
    )
    alone = nuclei.read_nuclei(versions, task, 0.0, (1.0, 1.0))
    away = np.hypot(*(quasars[name].to_numpy() - place[name] for name in ("ra", "dec")))
    source = quasars.slice(int(np.argmax(away)), 1)
    assert away.max() > task["radius"]
    image = {
        "id": ids.transient_id(ids.cell_from_id(source["id"].to_numpy()), np.array([5], np.uint64)), **place,
        "type": None, "source_id": source["id"].to_numpy(), "magnification": 3.0, "delay": 12.0,
    }  # fmt: skip
    types = {name: LENSED_IMAGES.column(name).arrow_type for name in nuclei.IMAGE_COLUMNS}
    columns = [pa.array(np.atleast_1d(image[name]).tolist(), kind) for name, kind in types.items()]

    class OneImage:
        def rows_in_cells(self, *arguments):
            return pa.table(columns, names=list(nuclei.IMAGE_COLUMNS))

    both = nuclei.read_nuclei({**versions, nuclei.LENSED_IMAGES: OneImage()}, task, 0.0, (1.0, 1.0))
    assert len(both.points) == len(alone.points) + 1
    assert both.points.slice(0, len(alone.points)).equals(alone.points)
    assert both.points["light_curve_key"][-1].as_py() == source["light_curve_key"][0].as_py()
    assert np.isfinite(both.points["m_1450"][-1].as_py())
