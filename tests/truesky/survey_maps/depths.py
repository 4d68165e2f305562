"""Synthetic tables `depth`: every pixel of some cells, with given values, published as by the job."""

import numpy as np

from lake_schema import sky
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.survey.depth import DEPTH, ORDER
from truesky.survey_maps.depth_lookup import DepthMap

PIXELS = 1 << 2 * (ORDER - GENERATION_ORDER)


def pixels_of(cells):
    """Depth pixels in order-8 cells, ascending."""
    return (np.sort(np.asarray(cells, np.int64))[:, None] * PIXELS + np.arange(PIXELS)).ravel()


def columns_of(pixels, band="euclid_vis", **values):
    """Columns of the table for pixels of one band; `values` replace constant columns."""
    n = len(pixels)
    columns = {
        "_healpix_29": pixels << 2 * (sky.MAX_ORDER - ORDER), "pixel": pixels, "band": np.full(n, band, object),
        "camera": np.full(n, "vis", object), "exposures": np.full(n, 4, np.int16), "mask": np.zeros(n, np.int16),
        "origin": np.zeros(n, np.int8),
    }  # fmt: skip
    numbers = {
        "exposure_time_s": 2260.0, "sky": 0.3, "seeing": 0.16, "psf_area": 0.1, "depth_point": 26.0,
        "depth_aperture": 25.5, "covered": 1.0, "a_v": 0.1,
    }  # fmt: skip
    columns |= {name: np.full(n, value, np.float32) for name, value in numbers.items()}
    return columns | values


def depth_map(pixels, band="euclid_vis", **values):
    """The depth of one band in memory."""
    columns = columns_of(pixels, band, **values)
    return DepthMap(band, pixels, {name: columns[name] for name in DEPTH.names if name not in ("pixel", "band")})


def publish_depth(lake, *bands):
    """Publish a table with the columns of several bands, each as returned by `columns_of`."""
    lake.mkdir(parents=True, exist_ok=True)
    joined = {name: np.concatenate([band[name] for band in bands]) for name in DEPTH.names}
    order = np.lexsort((joined["band"].astype(str), joined["pixel"]))
    joined = {name: values[order] for name, values in joined.items()}
    cell = sky.parent(joined["pixel"], ORDER, FILE_ORDER)
    tasks = tuple(Task(layout.cell_file(FILE_ORDER, int(one)), {"cell": int(one)}) for one in np.unique(cell))

    def rows(lake, facts):
        return Output(DEPTH.build({name: values[cell == facts["cell"]] for name, values in joined.items()}))

    publish.make_version(lake, Plan(DEPTH, {"test": len(joined["pixel"])}, tasks), rows)
    return read.version(lake, "depth")
