"""Processes import only what they use. Modules are counted, because times depend on the machine."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import requests

ROOT = Path(__file__).resolve().parents[3]
# Libraries whose import takes a tenth of a second or more.
SLOW = {
    "astropy.coordinates", "astropy.io.fits", "astropy.units", "astropy.wcs", "colossus", "duckdb", "dust_extinction",
    "galsim", "h5py", "matplotlib", "numba", "pyspark", "scipy.fft", "scipy.interpolate", "scipy.linalg",
    "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.special", "scipy.stats", "speclite",
}  # fmt: skip
CHANNEL_MODULES = {f"truesky.render.channels.{name}" for name in ("ground", "nisp_p", "nisp_s", "vis")}
JOBS = (
    "truesky.catalogue.build_galaxies",
    "truesky.catalogue.build_stars",
    "truesky.commands.plan",
    "truesky.fluxes.compute_fluxes",
    "truesky.render.plan_exposures",
    "truesky.render.render_exposures",
)


def imported_modules(code, *arguments):
    """Return the names of the modules that a new process has imported after some code."""
    text = f"import atexit, sys; atexit.register(lambda: print('modules:', *sys.modules))\n{code}"
    done = subprocess.run(
        [sys.executable, "-c", text, *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.rpartition("modules:")[2].split())


def command(*arguments):
    """Return the names of the modules that `truesky ARGUMENTS` imports."""
    return imported_modules("from truesky.commands.__main__ import entry; entry()", *arguments)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"]])
def test_help_imports_no_library(arguments):
    assert not command(*arguments) & (SLOW | {"numpy", "pandas", "pyarrow", "scipy"})


@pytest.mark.parametrize(
    "module", [", ".join(JOBS), *(pytest.param(job, marks=pytest.mark.nightly) for job in JOBS)], ids=["all", *JOBS]
)
def test_the_module_of_a_job_imports_no_slow_library(module):
    """Functions import a slow library when they use it. Nightly runs name the module that imports one."""
    modules = imported_modules(f"import {module}")
    assert modules & SLOW == set()
    assert modules & CHANNEL_MODULES == set()


# NISP-S imports most.
@pytest.mark.parametrize(
    "name", ["NISP-S", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("VIS", "NISP-P", "EXT"))]
)
def test_a_channel_imports_no_other_channel(name):
    """NISP-S shares the readout of NISP-P, and both read the detector."""
    modules = imported_modules(f"from truesky.render.channels import registry; registry.CHANNELS[{name!r}]")
    expected = {"VIS": {"vis"}, "NISP-P": {"nisp_p"}, "NISP-S": {"nisp_p", "nisp_s"}, "EXT": {"ground"}}[name]
    assert modules & CHANNEL_MODULES == {f"truesky.render.channels.{channel}" for channel in expected}
    assert modules & SLOW == set()


def test_a_plan_of_vis_imports_only_vis(tmp_path):
    """Only the second run counts: the first one may compute passbands for the cache, and imports more."""
    pointing = 'channel = "VIS"\ncamera = "vis"\nband = "euclid_vis"\nra = 53.117\ndec = -27.808\nmjd = 60905.0'
    path = requests.written(
        tmp_path, area=requests.FIELD.format(0.7), more=f"[[pointing]]\n{pointing}\nposition_angle = 0.0\n"
    )
    modules = [command("check", path, "--plan") for _ in range(2)][1]
    assert "truesky.render.plan_exposures" in modules
    assert modules & (SLOW | {"pandas"}) == set()
    assert modules & CHANNEL_MODULES == {"truesky.render.channels.vis"}


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["demo", "field"])
def test_a_check_imports_no_slow_library(name):
    """Only the second run counts: the first one may compute spectra and isochrones for the cache, and imports more."""
    modules = [command("check", f"requests/{name}.toml") for _ in range(2)][1]
    assert modules & (SLOW | {"pandas"}) == set()
    assert not modules & {"truesky.render.channels.nisp_p", "truesky.render.channels.nisp_s"}


@pytest.mark.nightly
def test_a_detector_of_vis_is_rendered_without_the_modules_of_other_channels():
    code = """
from tests.truesky.render.exposure import test_render
assert test_render.render("VIS").science.max() > 0.0
"""
    modules = imported_modules(code)
    assert modules & CHANNEL_MODULES == {"truesky.render.channels.vis"}
    assert modules & {"matplotlib", "pyspark", "scipy.signal", "scipy.stats", "truesky.catalogue"} == set()


def test_queries_import_no_library_of_images():
    modules = imported_modules("import truesky.explore.__main__, truesky.explore.worker, truesky.explore.session")
    assert modules & (SLOW - {"duckdb"}) == set()
