"""Forecast the cost of everything that is computed once per machine and kept in the cache, and look what it contains.

Examples are the simulated matter, the lensing maps, flux tables, images of PSFs and machine code.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes.tables import settings as flux_settings
from truesky.numerics import cache_labels
from truesky.numerics.cache import has_label, machine_code_dir
from truesky.render.channels import registry
from truesky.render.drawing.settings import settings_for
from truesky.render.forecasting.catalogue_forecast import WORKERS
from truesky.request.schema import Request

# Bands of the tables that relate the colours of galaxies to their spectra, besides the band of the request's limit.
_COLOUR_BANDS = ("sdss_g01", "sdss_r01")
# Resolution of the flux table of the band in which galaxies have their apparent magnitude (redshift step, coefficients
# in E(B-V) and A(V)). This copies truesky/fluxes/tables/flux_tables.py, which takes long to import; a test compares.
REFERENCE_TABLE = ("sdss_r01", 0.005, 6, 1)
# Number of source planes of the lensing maps to z = 6, and of those beyond. A test compares them with lensing.toml.
LENSING_PLANES, FAR_PLANES = 14, 2
# Name of the light of slitless images in the labels of their PSFs; other images have the name of their passband.
_SPECTRA = "spectra"
# Folder of machine code that exists if the functions of a group have been compiled, and name of the group's cost.
_COMPILED = {
    "catalogues": ("catalogue.halos", "compilation of the catalogues"),
    "fluxes": ("fluxes.tables", "compilation of the fluxes"),
    "images": ("render.drawing.kernels", "compilation of the renderer"),
    "spectra": ("render.dispersing", "compilation of slitless images"),
}


@dataclass(frozen=True, slots=True)
class Item:
    """Products of one kind that are computed once and kept in the cache.

    Attributes
    ----------
    name : str
        Name of the products, such as "lensing maps".
    count, cached : int
        Number of products that the request needs, and number of products that the cache contains already.
    cpu_s, wall_s : float
        CPU and wall time in s to make the missing products.
    bytes : float
        Size of the missing products in the cache.
    memory_gb : float
        Peak memory in GB of the process that makes them; 0 if it is small.
    """

    name: str
    count: int
    cached: int
    cpu_s: float
    wall_s: float
    bytes: float
    memory_gb: float = 0.0


@dataclass(frozen=True, slots=True)
class PsfKey:
    """A PSF that an image needs.

    Attributes
    ----------
    channel, section, detector, band : str
        Names of the channel, the camera, the detector and the passband.
    mission : MissionConfiguration
        Mission parameters with which the exposure is simulated.
    """

    channel: str
    section: str
    detector: str
    band: str
    mission: MissionConfiguration


def items(request: Request, psfs: Collection[PsfKey], channels: Collection[str], factor: float = 1.0) -> list[Item]:
    """Forecast the products that a request needs once.

    Parameters
    ----------
    request : Request
        The request.
    psfs : collection of PsfKey
        PSFs of its images; () without images.
    channels : collection of str
        Names of the channels of its images.
    factor : float, optional
        CPU time of this machine relative to the reference machine.

    Returns
    -------
    list of Item
        One item per kind of product. Products that take less than a tenth of a second are left out.
    """
    products = [*_catalogue_items(request), *_flux_items(request)]
    if channels:
        products += _image_items(request, psfs, channels)
    times = factor / float(costs()["machine_factor"])
    return [
        Item(item.name, item.count, item.cached, times * item.cpu_s, times * item.wall_s, item.bytes, item.memory_gb)
        for item in products
    ]


@cache
def costs() -> dict[str, Any]:
    """Return the measured costs, by product: the contents of preparation_costs.toml."""
    return tomllib.loads((files("truesky.render.forecasting") / "preparation_costs.toml").read_text(encoding="utf-8"))


def _catalogue_items(request: Request) -> Iterator[Item]:
    universe, seed = request.universe, request.seed
    yield _item("spectra", "libraries of spectra", [cache_labels.label_spectra()])
    if request.sources is None and request.ingest.dust is None:
        yield _item("dust_map", "dust map", [cache_labels.label_dust_map(seed)])
    if request.sources is not None or request.ingest.galaxies is not None:
        return
    cells, cosmology = universe.box_cells, universe.cosmology.fingerprint()
    bands = dict.fromkeys((universe.galaxy_band, *_COLOUR_BANDS))
    yield _item("band_ratios", "colours of galaxies", [cache_labels.label_band_ratios(band) for band in bands])
    yield _item("halo_tables", "halo abundance", [cache_labels.label_halo_tables(cosmology)])
    yield _item("halo_bias", "halo bias", [cache_labels.label_halo_bias(cosmology)])
    yield _item("box", f"matter in {cells}^3 cells", [cache_labels.label_box("box", cosmology, seed, cells)], cells**3)
    if universe.alignment:
        yield _item(
            "tides", f"tides in {cells}^3 cells", [cache_labels.label_box("tides", cosmology, seed, cells)], cells**3
        )
    if universe.lensing is None:
        with_far_planes = max(universe.high_redshift_boost, universe.quasar_boost) > 0.0
        nside = universe.lensing_nside
        label = cache_labels.label_lensing(cosmology, seed, cells, nside, with_far_planes)
        pixels = 12 * nside**2 * (LENSING_PLANES + with_far_planes * FAR_PLANES)
        # Spherical harmonics take a time proportional to N_side^3, everything else to the number of pixels.
        slower = 1.0 + nside * float(costs()["lensing"]["nside_share"])
        yield _item("lensing", f"lensing maps, N_side {nside}", [label], pixels, slower)
    yield _compilation_item("catalogues")


def _flux_items(request: Request) -> Iterator[Item]:
    choices = dict(zip(request.bands, flux_settings.choose(request.bands, request.accuracy), strict=True))
    tables = [(band, *_numbers(choice.setting)) for band, choice in choices.items() if choice.setting is not None]
    if tables:
        labels = [cache_labels.label_galaxy_table(*table) for table in [*tables, REFERENCE_TABLE]]
        yield _item("galaxy_table", "flux tables of galaxies", labels)
    if request.bands and flux_settings.stars_tabulated(request.accuracy):
        labels = [cache_labels.label_star_table(band) for band in request.bands]
        yield _item("star_table", "flux tables of stars", labels)
    if request.bands:
        # A user's spectra of stars are read from the lake.
        if request.curves.has_stars:
            yield _item("published", "spectra for fluxes", [cache_labels.label_published()])
        yield _compilation_item("fluxes")


def _numbers(setting: Any) -> tuple[float, int, int]:
    return setting.step, setting.n_ebv, setting.n_av


def _image_items(request: Request, psfs: Collection[PsfKey], channels: Collection[str]) -> Iterator[Item]:
    yield _item("profiles", "galaxy profiles", [cache_labels.label_profiles()])
    positions = settings_for(request.accuracy).positions
    # Only PSFs of Euclid are kept in the cache.
    for name in sorted(name for name in channels if not registry.CHANNELS[name].on_ground):
        is_slitless = registry.CHANNELS[name].dispersion is not None
        labels = {
            cache_labels.label_psf(
                psf.section,
                psf.detector,
                _SPECTRA if is_slitless else psf.band,
                positions,
                psf.mission.parameters,
            )
            for psf in psfs
            if psf.channel == name
        }
        if labels:
            yield _item(f"psf_{name}", f"PSFs of {name}", sorted(labels))
    yield _compilation_item("images")
    if any(registry.CHANNELS[name].dispersion is not None for name in channels):
        yield _compilation_item("spectra")


def _item(kind: str, name: str, labels: Sequence[str], amount: float = 1.0, slower: float = 1.0) -> Item:
    """Return the item of one kind of product.

    `kind` is its table in preparation_costs.toml, whose costs are per product and unit of `amount`. There is one
    label per product in `labels`. `slower` multiplies the CPU time.
    """
    cost = costs()[kind]
    cached = sum(1 for label in labels if has_label(label))
    missing = len(labels) - cached
    cpu = missing * amount * slower * cost["s"]
    used = max(1, min(missing, WORKERS)) if cost.get("in_workers") else 1
    memory = amount * cost.get("memory_bytes", 0.0) / 1e9 if missing else 0.0
    # Products with `wall_s` are made while other jobs run.
    wall = missing * cost["wall_s"] if "wall_s" in cost else cpu / used
    return Item(name, len(labels), cached, cpu, wall, missing * amount * cost["bytes"], memory)


def _compilation_item(group: str) -> Item:
    folder, name = _COMPILED[group]
    cost = costs()[f"compile_{group}"]
    if any((machine_code_dir() / folder).glob("*.nbi")):
        return Item(name, 1, 1, 0.0, 0.0, 0.0)
    return Item(name, 1, 0, cost["s"], cost["wall_s"], cost["bytes"])
