"""Measure the cost of everything that is computed once and kept in the cache: CPU time, wall time and size.

The results are the numbers of truesky/render/forecasting/preparation_costs.toml, from which the cost of a request with
an empty cache is forecast. All products are made in an empty temporary cache, so that the benchmark takes minutes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from benchmarks import report
from lake_schema.mission import configuration
from truesky.cosmology import FIDUCIAL
from truesky.numerics import cache

# Bands whose passbands, flux tables and PSFs are made.
_BAND, _NISP_BAND = "euclid_vis", "euclid_h"
# Sides of the box of matter (cells) and resolutions of the lensing maps (HEALPix N_side) that are measured.
_BOX_CELLS, _LENSING_NSIDES = (192, 256), (256, 512)
_QUICK_CELLS, _QUICK_NSIDES = (32,), (16,)
_SEED = 1
_NOTES = {"libraries_s": "CPU seconds; names that end with _wall_s are wall seconds, with _mb megabytes in the cache"}


def products(quick: bool) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the name of each product and a function that makes it; earlier products must be made first.

    With `quick`, the products are small, and slow products are left out.
    """
    # Import here, because machine code is kept in the temporary cache only if no compiled module was imported before.
    from truesky.catalogue import dust_map
    from truesky.catalogue.galaxies import band_ratios, lensing
    from truesky.catalogue.halos import matching
    from truesky.catalogue.matter import density_box
    from truesky.fluxes import passbands
    from truesky.fluxes.libraries import templates

    yield "passbands", lambda: [passbands.load(name) for name in passbands.names()]
    yield "galaxy_library", templates.galaxy_library
    yield "stellar_library", templates.stellar_library
    yield "dust_map", lambda: dust_map.load(_SEED)
    for cells in _QUICK_CELLS if quick else _BOX_CELLS:
        yield f"box_{cells}", lambda cells=cells: density_box.load(_SEED, cells, FIDUCIAL)  # type: ignore[misc]
        yield f"tides_{cells}", lambda cells=cells: density_box.tides(density_box.load(_SEED, cells, FIDUCIAL))  # type: ignore[misc]
    box = density_box.load(_SEED, (_QUICK_CELLS if quick else _BOX_CELLS)[0], FIDUCIAL)
    for nside in _QUICK_NSIDES if quick else _LENSING_NSIDES:
        yield f"lensing_{nside}", lambda nside=nside: lensing.load(box, nside, True)  # type: ignore[misc]
    if quick:
        return
    yield "halo_tables", lambda: matching.masses(FIDUCIAL)
    yield "halo_bias", lambda: density_box.biased_field(box.model, _unit_bias())
    yield "band_ratios", lambda: band_ratios.load(templates.galaxy_library(), _BAND, matching.Z_LAST, 0.8)
    yield from _flux_products()
    yield from _image_products()


def _unit_bias() -> Any:
    import numpy as np

    return np.ones(1)


def _flux_products() -> Iterator[tuple[str, Callable[[], Any]]]:
    from truesky.fluxes import band_fluxes, passbands
    from truesky.fluxes.libraries import templates
    from truesky.fluxes.tables import build_tables, flux_tables, settings
    from truesky.request.accuracy import SURVEY

    galaxies, stars = templates.galaxy_library(), templates.stellar_library()
    key, star_key = build_tables.library_key(galaxies), build_tables.library_key(stars)
    reference = passbands.load(flux_tables.REFERENCE_BAND)
    setting = settings.choose([_BAND], SURVEY)[0].setting
    assert setting is not None
    yield (
        "reference_table",
        lambda: build_tables.galaxy_table(reference, galaxies, flux_tables.REFERENCE_SETTING, key),
    )
    for name in (_BAND, _NISP_BAND, "lsst_r"):
        band = passbands.load(name)
        yield f"galaxy_table_{name}", lambda band=band: build_tables.galaxy_table(band, galaxies, setting, key)  # type: ignore[misc]
        yield f"line_table_{name}", lambda band=band: build_tables.line_table(band)  # type: ignore[misc]
        yield f"star_table_{name}", lambda band=band: build_tables.star_table(band, stars, star_key)  # type: ignore[misc]
    yield (
        "flux_kernels",
        lambda: band_fluxes.prepare([passbands.load(_BAND)], [setting], galaxies, stars, SURVEY),
    )


def _image_products() -> Iterator[tuple[str, Callable[[], Any]]]:
    from truesky.fluxes import passbands
    from truesky.render.camera.detectors import detectors
    from truesky.render.psf import euclid
    from truesky.render.sources import sersic

    mission = configuration.resolve()
    vis, nisp = (detectors(name, mission)[7] for name in ("vis", "nisp"))
    yield "sersic", sersic.table
    for positions in (1, 4, 9, 25):
        yield (
            f"vis_psf_{positions}",
            lambda positions=positions: euclid.vis_psf(vis, passbands.load(_BAND), mission, positions),  # type: ignore[misc]
        )
        yield (
            f"nisp_psf_{positions}",
            lambda positions=positions: euclid.nisp_psf(nisp, passbands.load(_NISP_BAND), mission, positions),  # type: ignore[misc]
        )


def measure(quick: bool) -> dict[str, float]:
    """Make all products in an empty cache, and return CPU seconds (`_s`), wall seconds (`_wall_s`) and size (`_mb`)."""
    figures: dict[str, float] = {}
    with cache.use_temporary_dir():
        size = _cache_bytes()
        for name, make in products(quick):
            started, cpu_started = time.perf_counter(), time.process_time()
            make()
            figures[f"{name}_s"] = time.process_time() - cpu_started
            figures[f"{name}_wall_s"] = time.perf_counter() - started
            size, previous = _cache_bytes(), size
            figures[f"{name}_mb"] = (size - previous) / 1e6
            print(name, figures[f"{name}_s"], figures[f"{name}_mb"], file=sys.stderr, flush=True)
    return figures


def _cache_bytes() -> int:
    return sum(path.stat().st_size for path in cache.cache_dir().rglob("*") if path.is_file())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("preparation", __doc__ or "", argv)
    report.print_and_write("preparation", 1, measure(options.quick), _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
