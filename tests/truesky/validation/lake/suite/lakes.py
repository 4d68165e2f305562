"""A lake of synthetic frames: products, truth and stars, published as by the jobs."""

import numpy as np

from lake_schema import sky
from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_TRUTH
from lake_schema.tables.stars import STARS
from tests.truesky.validation.lake import made
from tests.universe import rows_of
from truesky.validation.lake.measure.references import ZERO

BAND = "euclid_vis"


def lake(root, files=2, **wrong):
    """Make a lake with `files` frames of one field; `wrong` are arguments of `made.vis_file` for the last frame."""
    root.mkdir(parents=True, exist_ok=True)
    root = layout.resolve_lake(root)
    rng = np.random.default_rng(8)
    of = made.scene(rng)
    _stars(root, of)
    exposures = _exposures(root, files)
    _products(root, of, files, exposures, rng, wrong)
    truth = [_truth(of, number) for number in range(1, files + 1)]
    _published(root, RENDERED_TRUTH, {"frames": files}, RENDERED_TRUTH.build(_joined(truth)))
    return root


def _published(root, table, facts, rows, part="all.parquet", written=None):
    plan = Plan(table, facts, (Task(part, {}),))
    publish.make_version(root, plan, lambda lake, facts: Output(rows, written or {}))
    return plan.key


def _joined(parts):
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _stars(root, of):
    index = sky.healpix_29(of.ra, of.dec)
    order = np.argsort(index)
    cell = int(sky.parent(index, sky.MAX_ORDER, 3)[0])
    part = layout.cell_file(3, cell)
    like = rows_of(STARS, len(of))
    columns = {name: like[name] for name in like.column_names}
    still = np.zeros(len(of), np.float32)
    columns |= {"id": of.id[order], "ra": of.ra[order], "dec": of.dec[order], "_healpix_29": index[order]}
    columns |= {"pm_ra": still, "pm_dec": still}
    _published(root, STARS, {}, STARS.build(columns), part)
    table = fluxes("star", [BAND])
    light = (10 ** (-0.4 * (of.mag - ZERO))).astype(np.float32)
    own = {name: columns[name] for name in ("id", "ra", "dec", "_healpix_29")}
    own |= {f"f_nu_{BAND}": light[order], "integrated": np.zeros(len(of), bool)}
    _published(root, table, {}, table.build(own), part)


def _exposures(root, files):
    like = rows_of(EXPOSURES, files)
    columns = {name: like[name] for name in like.column_names}
    columns |= {
        "exposure_id": np.arange(1, files + 1), "channel": ["VIS"] * files, "camera": ["vis"] * files,
        "band": [BAND] * files, "image_type": ["science"] * files, "mjd": np.full(files, 60905.0),
    }  # fmt: skip
    return _published(root, EXPOSURES, {}, EXPOSURES.build(columns))


def _products(root, of, files, exposures, rng, wrong):
    light = made.light(of) + made.SKY * made.SECONDS
    written = {}
    for number in range(1, files + 1):
        counted = made.hit(rng, rng.poisson(light).astype(float))
        more = wrong if number == files else {}
        written[f"images/{number}.fits"] = _writer(counted, np.random.default_rng(number), more)
    like = rows_of(PRODUCTS, files)
    columns = {name: like[name] for name in like.column_names}
    columns |= {
        "path": list(written), "content": ["science"] * files, "exposure_id": np.arange(1, files + 1),
        "detector": ["1-1"] * files, "channel": ["VIS"] * files, "band": [BAND] * files,
    }  # fmt: skip
    facts = {"inputs": {"exposures": exposures}, "wrong": sorted(wrong)}
    _published(root, PRODUCTS, facts, PRODUCTS.build(columns), written=written)


def _writer(counted, rng, more):
    def write(path):
        made.vis_file(path, counted, rng, **more)

    return write


def _truth(of, number):
    n = len(of)
    return {
        "exposure_id": np.full(n, number), "detector": np.array(["1-1"] * n), "id": of.id, "x": of.x, "y": of.y,
        "expected": of.expected, "drawn": of.expected, "stamp": np.full(n, 40, np.int32),
        "method": np.zeros(n, np.int8),
        "trail_x": np.zeros(n), "trail_y": np.zeros(n), "psf_x": np.zeros(n), "psf_y": np.zeros(n), "mag": of.mag,
    }  # fmt: skip
