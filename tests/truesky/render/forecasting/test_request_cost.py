"""The forecast of a whole run: sums over jobs and products, and the table that is printed."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from truesky.numerics import cache
from truesky.render.forecasting import preparation, request_cost
from truesky.render.forecasting.image_costs import ImageCosts
from truesky.render.forecasting.speed import Speed
from truesky.render.plan_exposures import Planner, concatenate
from truesky.request.from_toml import from_table

ROOT = Path(__file__).resolve().parents[4]
MACHINE = Speed(0.45, "as a test says")


def request(**changes):
    table = tomllib.loads((ROOT / "requests" / "demo.toml").read_text())
    table |= changes
    return from_table(table)


@pytest.fixture(scope="module")
def demo():
    whole = request()
    return whole, concatenate(Planner.from_request(None, whole).tables())


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache" / "numba"))


def image_costs(whole, rows):
    images = ImageCosts(whole)
    assert list(images.watch([rows])) == [rows]
    return images


def test_images_add_up(demo):
    whole, (exposures, tasks) = demo
    images = image_costs(whole, (exposures, tasks))
    assert (images.detectors, images.exposures, images.channels) == (2, 2, {"VIS", "EXT"})
    assert images.seconds == pytest.approx(sum(tasks["seconds"].to_pylist()))
    # Tables of drawn sources add less than one per cent.
    assert images.bytes == pytest.approx(sum(tasks["bytes"].to_pylist()), rel=0.01)
    assert images.memory_gb == max(tasks["memory"].to_pylist())
    # Only PSFs of Euclid are kept in the cache; the ground's are in the set, too.
    assert {(psf.channel, psf.detector) for psf in images.psfs()} == {("VIS", "3-4"), ("EXT", "R22_S11")}
    one = image_costs(replace(whole, limit=1), (exposures, tasks))
    assert (one.detectors, one.planned) == (1, 2)
    assert one.seconds < images.seconds


def test_the_sums_are_those_of_jobs_and_products(demo):
    whole, rows = demo
    cost = request_cost.forecast(whole, image_costs(whole, rows), MACHINE)
    assert [job.job for job in cost.jobs] == [
        "start", "build_galaxies", "build_stars", "compute_fluxes", "plan_exposures", "render_exposures", "pictures",
    ]  # fmt: skip
    assert cost.cpu_s == pytest.approx(sum(part.cpu_s for part in (*cost.jobs, *cost.items)))
    assert cost.wall_s == pytest.approx(sum(part.wall_s for part in (*cost.jobs, *cost.items)))
    assert cost.lake_bytes == sum(job.bytes for job in cost.jobs)
    assert cost.cache_bytes == sum(item.bytes for item in cost.items)
    assert cost.total_gb > cost.worker_gb == max(job.memory_gb for job in cost.jobs)
    assert all(job.wall_s <= job.cpu_s + 1.0 for job in cost.jobs)
    assert json.loads(json.dumps(cost.as_json()))["detectors"] == 2


def test_a_request_without_images_has_no_costs_of_images(demo):
    whole, rows = demo
    catalogues = request_cost.forecast(replace(whole, pointings=()), ImageCosts(whole), MACHINE)
    images = request_cost.forecast(whole, image_costs(whole, rows), MACHINE)
    assert [job.job for job in catalogues.jobs] == ["start", "build_galaxies", "build_stars", "compute_fluxes"]
    assert catalogues.detectors == 0
    assert catalogues.rows == images.rows
    assert {item.name for item in catalogues.items} < {item.name for item in images.items}


def test_a_warm_cache_costs_less(demo, monkeypatch):
    whole, rows = demo
    cold = request_cost.forecast(whole, image_costs(whole, rows), MACHINE)
    monkeypatch.setattr(preparation, "has_label", lambda label: True)
    warm = request_cost.forecast(whole, image_costs(whole, rows), MACHINE)
    assert warm.jobs == cold.jobs
    assert warm.cpu_s < cold.cpu_s
    assert warm.cache_bytes < 0.02 * cold.cache_bytes


def test_compressed_images_are_smaller(demo):
    """Maps of decimal numbers are not compressed."""
    whole, rows = demo
    plain, rice = (image_costs(replace(whole, compression=name, truth=()), rows).bytes for name in ("none", "rice"))
    assert 0.3 * plain < rice < 0.5 * plain
    plain, rice = (
        image_costs(replace(whole, compression=name, truth=("noise_free",)), rows).bytes for name in ("none", "rice")
    )
    assert 0.7 * plain < rice < plain


# Factor of the machine (an AMD EPYC) from its calibration, CPU seconds of all tasks and of the preparation of the jobs
# in the logs, and bytes of the lake and the cache: runs of requests/demo.toml with an empty and with a full cache.
MEASURED = {"cold": (0.66, 134.7, 483.8e6, 876.6e6), "warm": (0.8, 48.3, 483.8e6, 0.0)}


@pytest.mark.parametrize("state", MEASURED)
def test_the_demo_costs_what_was_measured(demo, monkeypatch, state):
    """Within 30 % in time and 20 % in bytes; the libraries of spectra are made before the first job."""
    factor, seconds, disc, cached = MEASURED[state]
    whole, rows = demo
    if state == "warm":
        monkeypatch.setattr(preparation, "has_label", lambda label: True)
        (code := cache.machine_code_dir()).mkdir(parents=True)
        for name in ("catalogue.halos", "fluxes.tables", "render.drawing.kernels"):
            (code / name).mkdir()
            (code / name / "a.nbi").touch()
    cost = request_cost.forecast(whole, image_costs(whole, rows), Speed(factor, ""))
    tasks = sum(job.cpu_s for job in cost.jobs if job.job not in ("start", "pictures"))
    once = sum(item.cpu_s for item in cost.items if item.name != "libraries of spectra")
    assert tasks + once == pytest.approx(seconds, rel=0.3)
    assert cost.lake_bytes == pytest.approx(disc, rel=0.2)
    assert cost.cache_bytes == pytest.approx(cached, rel=0.2)


def test_the_table_fits_the_terminal(demo):
    whole, rows = demo
    cost = request_cost.forecast(whole, image_costs(whole, rows), MACHINE)
    head, *lines = request_cost.format_table(cost)
    assert head.split() == ["cost", "of", "this", "request", "rows", "CPU", "wall", "disc"]
    assert all(len(line) <= len(head) == 77 for line in lines[:-2])
    (total,) = (line for line in lines if line.startswith("all"))
    assert "min" in total
    assert "0.00" not in "\n".join(lines)
    assert lines[-1].endswith("as a test says")
    assert "2 images" in request_cost.summary(cost)


def test_times_follow_the_speed_of_the_machine(demo):
    whole, rows = demo
    slow, fast = (request_cost.forecast(whole, image_costs(whole, rows), Speed(factor, "")) for factor in (0.9, 0.45))
    assert slow.cpu_s == pytest.approx(2 * fast.cpu_s)
    assert slow.wall_s == pytest.approx(2 * fast.wall_s)
    assert slow.lake_bytes == fast.lake_bytes
