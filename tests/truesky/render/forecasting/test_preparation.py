"""The forecast of what is computed once: which products a request needs, and which the cache contains."""

import math
import tomllib
from pathlib import Path

import pytest

from lake_schema.mission import configuration
from tests.truesky import nightly
from truesky.catalogue import dust_map
from truesky.catalogue.galaxies import band_ratios, lensing
from truesky.catalogue.matter import density_box
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.tables import build_tables, flux_tables
from truesky.numerics import cache, cache_labels
from truesky.render.camera.detectors import detectors
from truesky.render.forecasting import preparation
from truesky.render.forecasting.preparation import PsfKey
from truesky.render.psf import euclid
from truesky.render.sources import sersic
from truesky.request.from_toml import from_table, parse

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache" / "numba"))


def request(**changes):
    table = tomllib.loads((ROOT / "requests" / "demo.toml").read_text())
    table["universe"] |= changes
    return from_table(table)


def psf_keys(*names):
    mission = configuration.resolve()
    return {PsfKey("VIS", "vis", name, "euclid_vis", mission) for name in names}


def by_name(*arguments):
    return {item.name: item for item in preparation.items(*arguments)}


def test_numbers_that_are_copied_agree():
    setting = flux_tables.REFERENCE_SETTING
    assert (flux_tables.REFERENCE_BAND, setting.step, setting.n_ebv, setting.n_av) == preparation.REFERENCE_TABLE
    chosen = lensing.settings()
    assert (len(chosen.planes), len(chosen.far_planes)) == (preparation.LENSING_PLANES, preparation.FAR_PLANES)


def test_an_empty_cache_contains_nothing(empty_cache):
    items = by_name(request(), psf_keys("3-4", "3-5"), {"VIS"})
    assert all(item.cached == 0 and item.cpu_s > 0.0 and item.bytes > 0.0 for item in items.values())
    assert items["PSFs of VIS"].count == 2
    assert items["PSFs of VIS"].wall_s == pytest.approx(items["PSFs of VIS"].cpu_s / 2)
    assert "compilation of slitless images" not in items
    assert "compilation of the renderer" not in by_name(request(), (), ())


def test_what_a_request_replaces_is_not_made(empty_cache):
    assert "lensing maps, N_side 256" in by_name(request(), (), ())
    constant = by_name(request(lensing="none", alignment=0.0), (), ())
    assert not any(name.startswith(("lensing", "tides")) for name in constant)
    assert any(name.startswith("matter") for name in constant)


def test_lensing_maps_grow_with_their_resolution(empty_cache):
    small, large = (by_name(request(lensing_nside=n), (), ())[f"lensing maps, N_side {n}"] for n in (256, 1024))
    assert large.bytes == pytest.approx(16 * small.bytes) == pytest.approx(4.83e9, rel=0.02)
    assert large.cpu_s > 16 * small.cpu_s


def test_products_that_are_in_the_cache_cost_nothing(empty_cache):
    whole = request()
    before = by_name(whole, psf_keys("3-4", "3-5"), {"VIS"})
    dust_map.load(whole.seed)
    for psf in psf_keys("3-4"):
        label = cache_labels.label_psf("vis", psf.detector, psf.band, 9, psf.mission.parameters)
        cache.cached_arrays("vis_psf", "a", lambda: {"a": passbands.grid()}, label)
    (folder := cache.machine_code_dir() / "render.drawing.kernels").mkdir(parents=True)
    (folder / "a.nbi").touch()
    after = by_name(whole, psf_keys("3-4", "3-5"), {"VIS"})
    for name, item in after.items():
        if name in ("dust map", "compilation of the renderer"):
            assert (item.cached, item.cpu_s, item.wall_s, item.bytes) == (1, 0.0, 0.0, 0.0)
        elif name == "PSFs of VIS":
            assert (item.cached, item.cpu_s) == (1, pytest.approx(before[name].cpu_s / 2))
        else:
            assert item == before[name]


def test_costs_scale_with_the_speed_of_the_machine(empty_cache):
    whole, factor = request(), preparation.costs()["machine_factor"]
    once, twice = (by_name(whole, (), (), k * factor) for k in (1, 2))
    assert all(twice[name].cpu_s == pytest.approx(2 * once[name].cpu_s) for name in once)
    assert once["dust map"].cpu_s == preparation.costs()["dust_map"]["s"]


@pytest.mark.nightly
def test_products_have_the_labels_for_which_forecasts_look(empty_cache):
    """Small products of every kind, in an empty cache."""
    mission, band = configuration.resolve(), passbands.load("euclid_vis")
    box = density_box.load(3, 32, FIDUCIAL)
    density_box.tides(box)
    lensing.load(box, 16)
    sersic.table()
    vis, nisp = (detectors(name, mission)[0] for name in ("vis", "nisp"))
    euclid.vis_psf(vis, band, mission, 1)
    euclid.nisp_psf_at(nisp, passbands.grid()[9000:9001], mission, 1)
    galaxies = templates.galaxy_library()
    setting = build_tables.Setting(0.2, 3, 2)
    build_tables.galaxy_table(band, galaxies, setting, build_tables.library_key(galaxies))
    band_ratios.load(galaxies, "euclid_vis", 0.0, 0.8)
    for label in (
        cache_labels.label_box("box", FIDUCIAL.fingerprint(), 3, 32),
        cache_labels.label_box("tides", FIDUCIAL.fingerprint(), 3, 32),
        cache_labels.label_lensing(FIDUCIAL.fingerprint(), 3, 32, 16, False),
        cache_labels.label_profiles(),
        cache_labels.label_psf("vis", vis.name, "euclid_vis", 1, mission.parameters),
        cache_labels.label_psf("nisp", nisp.name, "spectra", 1, mission.parameters),
        cache_labels.label_galaxy_table("euclid_vis", 0.2, 3, 2),
        cache_labels.label_band_ratios("euclid_vis"),
    ):
        assert cache.has_label(label)


@nightly.parametrize(
    "path", [pytest.param(path, id=path.stem) for path in sorted((ROOT / "requests").glob("*.toml"))], (0, 3, 8)
)
def test_every_shipped_request_has_finite_costs(path):
    assert all(math.isfinite(item.cpu_s) for item in preparation.items(parse(path), (), {"VIS", "NISP-S"}))
