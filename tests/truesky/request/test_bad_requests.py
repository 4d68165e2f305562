"""Malformed request files are refused by the check and by every job in one line that names the key."""

import subprocess
import sys
import time

import pytest

from truesky.catalogue import build_gaia, build_galaxies, build_stars
from truesky.commands import check
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.running import submitted_job

JOBS = [module.JOB for module in (build_galaxies, build_stars, build_gaia, compute_fluxes, plan_exposures)]
JOBS.append(render_exposures.JOB)

# Limit of CPU seconds, far above the time of any check on any machine.
HANGS = 60.0

HEAD = 'name = "x"\nseed = 1\n'
CONE = "[area]\ncone = { ra = 53.1, dec = -27.8, radius = 0.2 }\n"
GOOD = HEAD + CONE
POINT = '[[pointing]]\nchannel = "VIS"\nband = "euclid_vis"\nra = 53.1\ndec = -27.8\nmjd = 60905.0\n'
BLOCK = '[[observation]]\nchannels = ["VIS"]\n'

BAD = {
    "empty": ("", "name is missing"),
    "no toml": ("<request/>", "line 1"),
    "no end of a string": ('name = "x', 'line 1: the quote " is not closed'),
    "the same key twice": ('name = "x"\n' + GOOD, "line 2: name is given twice, first in line 1"),
    "a million nested lists": ("x = " + "[" * 1_000_000, "x.toml: "),
    "ten megabytes": ("# " + "x" * 10_000_000, "larger than"),
    "zero bytes": ("\0" * 100, "line 1"),
    "unknown key": ("sead = 1\n" + GOOD, "sead is not a key"),
    "unknown table": (GOOD + "[render]\n", "render is not a key"),
    "unknown key below": (GOOD + POINT + "angle = 3\n", "pointing[0].angle is not a key"),
    "no seed": ('name = "x"\n' + CONE, "seed is missing"),
    "a seed of text": ('name = "x"\nseed = "1"\n' + CONE, "seed"),
    "a seed of 65 bits": (f'name = "x"\nseed = {2**64}\n' + CONE, "seed"),
    "no area": (HEAD, "area"),
    "two areas": (GOOD + "box = { ra = [0, 1], dec = [0, 1] }\n", "area must have exactly one"),
    "an area larger than the sky": (HEAD + "[area]\ncone = { ra = 0, dec = 0, radius = 181 }\n", "area.cone.radius"),
    "a box round the sky twice": (HEAD + "[area]\nbox = { ra = [0, 720], dec = [0, 1] }\n", "area.box.ra"),
    "a pole too far": (HEAD + "[area]\ncone = { ra = 0, dec = 90.0000001, radius = 1 }\n", "area.cone.dec"),
    "no number": (HEAD + "[area]\ncone = { ra = nan, dec = 0, radius = 1 }\n", "area.cone.ra"),
    "no finite number": (HEAD + "[area]\ncone = { ra = 0, dec = 0, radius = inf }\n", "area.cone.radius"),
    "a line for an area": (HEAD + "[area]\npolygon = [[0, 0], [1, 1]]\n", "area.polygon"),
    "no tile": (HEAD + "[area]\ntile = -1\n", "area.tile"),
    "magnitude 99": (GOOD + "[universe]\ngalaxy_limit = 99\n", "universe.galaxy_limit = 99"),
    "a box of any size": (GOOD + "[universe]\nbox_cells = 100000\n", "universe.box_cells"),
    "a file of no rows": (GOOD + "[stars]\nrows_a_file = 0\n", "stars.rows_a_file"),
    "accuracy of no name": ('accuracy = "best"\n' + GOOD, "accuracy"),
    "accuracy of zero": (
        "accuracy = { flux = 0, shape = 1e-3, position = 1e-3, background = 1e-3 }\n" + GOOD, "accuracy.flux = 0",
    ),
    "accuracy below zero": (
        "accuracy = { flux = 1e-3, shape = -1, position = 1e-3, background = 1e-3 }\n" + GOOD, "accuracy.shape = -1",
    ),
    "accuracy of no number": (
        "accuracy = { flux = 1e-3, shape = 1e-3, position = nan, background = 1e-3 }\n" + GOOD, "accuracy.position",
    ),
    "a status of no name": (GOOD + '[mission]\nladder = ["BEST"]\n', "mission.ladder"),
    "an override of no name": (
        GOOD + '[mission.overrides]\n"vis.gane" = { value = 3, unit = "electron / adu" }\n', "vis.gane",
    ),
    "an override of another unit": (
        GOOD + '[mission.overrides]\n"vis.read_noise" = { value = 3, unit = "mm" }\n', "vis.read_noise",
    ),
    "an override out of range": (
        GOOD + '[mission.overrides]\n"vis.read_noise" = { value = -3, unit = "electron" }\n', "vis.read_noise",
    ),
    "an override of no unit": (GOOD + '[mission.overrides]\n"vis.gain" = { value = 3 }\n', "vis.gain.unit is missing"),
    "a pointing of no channel": (GOOD + POINT.replace('"VIS"', '"RADIO"'), "pointing[0].channel"),
    "a pointing beyond the pole": (GOOD + POINT.replace("-27.8", "-97.8"), "pointing[0].dec"),
    "a camera outside the database": (GOOD + POINT + 'camera = "../vis"\n', "../vis"),
    "a band outside the database": (GOOD + POINT.replace("euclid_vis", "/etc/passwd"), "/etc/passwd"),
    "an exposure before it begins": (GOOD + POINT + "exposure_time_s = -1\n", "pointing[0].exposure_time_s = -1"),
    "a hundred thousand and one pointings": (GOOD + "pointing = [" + "{}," * 100_001 + "]\n", "pointing"),
    "observations of nothing": (GOOD + "[[observation]]\n", "observation[0].channels is missing"),
    "a billion exposures": (
        GOOD + BLOCK + 'image_type = "bias"\nexposures = 1_000_000_000\n', "observation[0].exposures = 1000000000",
    ),
    "a billion fields": (GOOD + BLOCK + "fields = 1_000_000_000\n", "observation[0].fields"),
    "a flat of no lamp": (GOOD + BLOCK + 'image_type = "planetary_nebula"\n', "observation[0].image_type"),
    "pointings from elsewhere": (GOOD + BLOCK + 'pointings = "../../etc/passwd"\n', "observation[0].pointings"),
    "pointings from nowhere": (GOOD + BLOCK + 'pointings = "none.csv"\n', "observation[0].pointings"),
    "truth that nobody knows": (GOOD + '[products]\ntruth = ["everything"]\n', "products.truth"),
    "an effect on and off": (GOOD + '[effects]\non = ["bleeding"]\noff = ["bleeding"]\n', "effects: 'bleeding'"),
    "an effect of no name": (GOOD + '[effects]\non = ["magic"]\n', "effects.on"),
    "ten thousand and one requests": (
        GOOD + f'[explore]\n"vis.gain" = {{ values = {list(range(1, 10_002))}, unit = "electron / adu" }}\n',
        "explore.vis.gain",
    ),
    "an exploration of no value": (GOOD + '[explore]\naccuracy = []\n', "explore.accuracy has no value"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _no_session(monkeypatch):
    def fail(*arguments):
        raise AssertionError("a session was asked for")

    monkeypatch.setattr(submitted_job, "_spark_map", fail)


# Long to read; ten thousand and one requests have a limit that is checked in the same way.
LONG = "a hundred thousand and one pointings"


@pytest.mark.parametrize(
    ("text", "words"),
    [pytest.param(*case, marks=pytest.mark.nightly if name == LONG else (), id=name) for name, case in BAD.items()],
)
def test_a_malformed_request_is_refused_by_the_check_and_by_every_job(tmp_path, capsys, text, words):
    path, lake = tmp_path / "x.toml", tmp_path / "lake"
    path.write_text(text)
    started = time.process_time()
    assert check.main([str(path)]) == 2
    assert time.process_time() - started < HANGS
    said = capsys.readouterr().err
    assert words in said
    # An empty request lacks its name, its seed and its area.
    assert said.count("\n") == (3 if not text else 1)
    for job in JOBS:
        assert submitted_job.main(job, ["--lake", str(lake), "--request", str(path)]) == 2
        assert words in capsys.readouterr().err
    assert not lake.exists()


def test_requests_before_malformation_are_valid(tmp_path, capsys):
    for number, text in enumerate((GOOD, GOOD + POINT, GOOD + BLOCK)):
        (tmp_path / f"{number}.toml").write_text(text)
        # The area of these requests is smaller than the field of view.
        assert check.main([str(tmp_path / f"{number}.toml"), "--plan"]) == 0
    assert capsys.readouterr().out.startswith("x: good: 0 pointings, 0 observations, 1 variants\n")


def test_the_check_from_a_shell_imports_nothing_slow(tmp_path):
    """Modules that take seconds to import are not imported by the check."""
    path = tmp_path / "x.toml"
    path.write_text(BAD["magnitude 99"][0])
    code = "import sys; from truesky.commands.check import main; print(main(sys.argv[1:]), *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    status, *modules = done.stdout.split()
    assert (status, done.stderr.count("\n")) == ("2", 1)
    assert "universe.galaxy_limit = 99" in done.stderr
    assert "truesky.request" in modules
    slow = {
        "astropy",
        "colossus",
        "duckdb",
        "galsim",
        "hats",
        "healpy.pixelfunc",
        "matplotlib",
        "numba",
        "pandas",
        "pyspark",
        "scipy",
    }
    assert not slow & set(modules)
