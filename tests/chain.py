"""Print digests of the arrays of the chain as JSON: python -m tests.chain table|quick|whole FOLDER.

table  the table of galaxy fluxes in one band
quick  also fluxes, distances and positions, the PSF, shapes of galaxies, and a least-squares solution
whole  also the table of star fluxes; a small lake from the plans of the jobs (galaxies, stars, fluxes, two CCDs); and
       every array in the cache

Only the modules of the requested arrays are imported, because a process for a single table mostly imports. With --keep,
the arrays are also written to FOLDER, so that they can be compared number by number.
"""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.fits.images import read_images
from lake_schema.store import layout, publish, read
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import integration, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table
from truesky.fluxes.tables import build_tables, settings
from truesky.numerics import cache, matrices
from truesky.request.accuracy import DRAFT

BANDS = ("euclid_vis", "lsst_r")
REQUEST = {
    "name": "chain",
    "seed": 7,
    "accuracy": "draft",
    "area": {"cone": {"ra": 53.4375, "dec": -27.279613, "radius": 0.05}},
    "universe": {"galaxy_limit": 22.0, "star_limit": 20.0, "box_cells": 192, "lensing_nside": 64},
    "fluxes": {"bands": list(BANDS)},
    "pointing": [
        {"channel": channel, "camera": camera, "band": band, "detectors": [ccd], "ra": 53.4375, "dec": -27.279613,
         "mjd": 60905.0, "exposure_time_s": 60.0}
        for channel, camera, band, ccd in (("EXT", "lsstcam", "lsst_r", "R22_S11"), ("VIS", "vis", "euclid_vis", "3-4"))
    ],
}  # fmt: skip


def random_galaxies(n):
    """Return galaxies as the functions for integration and for tables need them."""
    from benchmarks.fluxes import sample

    return galaxies_from_table(sample(n, 1), templates.galaxy_library())


def table():
    """Return the table of galaxy fluxes and its templates."""
    library, vis = templates.galaxy_library(), passbands.load("euclid_vis")
    setting = min((choice.setting for choice in settings.choose(["euclid_vis"], DRAFT)), key=lambda s: s.size)
    yield "templates", library.flux
    yield "galaxy_table", build_tables.galaxy_table(vis, library, setting, build_tables.library_key(library))


def quick():
    """Return arrays by name that take a few seconds."""
    from tests.truesky.render import fields
    from truesky.render.psf import euclid, ground
    from truesky.render.sources import galaxy_shapes, sersic

    yield from table()
    rng = np.random.default_rng(1)
    library, vis = templates.galaxy_library(), passbands.load("euclid_vis")
    yield "line_table", build_tables.line_table(vis)[1]
    yield "integrated", integration.galaxy_fluxes(random_galaxies(20), [vis], library)
    yield "distances", FIDUCIAL.comoving_separation(0.0, np.linspace(0.0, 6.0, 50))
    yield "galactic", np.stack(sky.galactic(*rng.uniform(-80.0, 80.0, (2, 1000))))
    planes = euclid.vis_psf(fields.small("vis", "3-4"), vis, fields.MISSION, 4).planes
    yield "psf", planes.images
    yield "psf_drift", planes.drift
    ccd = fields.small("lsstcam", "R22_S11")
    yield (
        "ground_psf",
        ground.atmospheric_psf(ground.Air(0.7), ccd, passbands.load("lsst_r"), fields.MISSION, 4).planes.images,
    )
    yield "sersic", sersic.table()
    shapes = galaxy_shapes.shapes(
        fields.galaxies(np.zeros(50), np.zeros(50), inclination=80 * rng.random(50), gamma1=0.02)
    )
    form = galaxy_shapes.forms(shapes, rng.normal(size=(50, 2, 2)))
    yield "forms", np.concatenate([part.ravel() for part in (form.bulge, form.disk, form.thick)])
    yield "least_squares", matrices.least_squares(rng.normal(size=(30, 6)), rng.normal(size=(30, 3)))


def whole(folder):
    """Return digests of each column and image of the lake and of all files in the cache."""
    from truesky.catalogue import build_galaxies, build_stars
    from truesky.fluxes import compute_fluxes
    from truesky.render import plan_exposures, render_exposures
    from truesky.request.from_toml import from_table

    yield from quick()
    stellar, vis = templates.stellar_library(), passbands.load("euclid_vis")
    yield "stellar_templates", stellar.flux
    yield "star_table", build_tables.star_table(vis, stellar, build_tables.library_key(stellar))
    root = layout.resolve_lake(folder / "lake")
    root.mkdir(parents=True)
    wanted = from_table(REQUEST)
    for job in (build_galaxies.JOB, build_stars.JOB, compute_fluxes.JOB, plan_exposures.JOB, render_exposures.JOB):
        for step in job.steps(root, wanted):
            publish.make_version(root, step.plan, step.run_task)
    for name in read.table_names(root):
        version = read.version(root, name)
        if name != "products":
            rows = version.rows()
            yield from ((f"{name}.{column}", values_of(rows[column])) for column in rows.column_names)
        for entry in version.manifest["files"]:
            if name == "products" and entry["path"].endswith(".fits"):
                for number, image in enumerate(read_images(version.folder / entry["path"])):
                    if image.data is not None:
                        yield f"{entry['path']}[{number}]", np.asarray(image.data)
    for path in sorted(cache.cache_dir().rglob("*.npy")):
        # Timings are not results.
        if not path.parent.name.startswith("calibration-"):
            yield path.relative_to(cache.cache_dir()).as_posix(), np.load(path)


def values_of(column):
    """Return the numbers of a column, or the JSON text of strings and lists."""
    if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
        return column.to_numpy()
    return np.frombuffer(json.dumps(column.to_pylist(), default=str).encode(), np.uint8)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("table", "quick", "whole"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    made = {"table": table, "quick": quick, "whole": lambda: whole(options.folder)}[options.what]()
    found = {}
    for number, (name, values) in enumerate(made):
        values = np.ascontiguousarray(values)
        found[name] = hashlib.sha256(values.tobytes()).hexdigest()
        if options.keep:
            options.folder.mkdir(parents=True, exist_ok=True)
            np.save(options.folder / f"{number:04d}.npy", values)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
