"""Invalid input of a command gives one line that names it and exit status 2, quickly and without output files."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pyarrow as pa
import pytest

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store import publish
from lake_schema.tables.mission import LADDER
from tests import requests
from tests.universe import plain_plan, plain_work
from truesky.catalogue import (
    build_active_nuclei,
    build_gaia,
    build_galaxies,
    build_lensed_images,
    build_stars,
    build_strong_lenses,
    build_transients,
    dust_map,
    request_checks,
)
from truesky.commands import __main__ as truesky
from truesky.commands import check, demo, report, submit
from truesky.commands import run as whole
from truesky.explore import __main__ as explore
from truesky.fluxes import compute_fluxes, inputs
from truesky.light_curve_tables import build_light_curves
from truesky.render import archive, coverage, plan_exposures, render_exposures
from truesky.render.products import keys
from truesky.render.psf import from_file
from truesky.request.files import UserCurves
from truesky.request.from_toml import parse
from truesky.running import submitted_job

JOB = Path(__file__).resolve().parents[2] / "jobs" / "render" / "plan_exposures.py"
# An unbounded read takes minutes; imports on a slow machine take seconds.
MOST_SECONDS = 30.0
JOBS = {
    module.JOB.name: module.JOB
    for module in (
        build_galaxies, build_stars, build_active_nuclei, build_transients, build_strong_lenses, build_lensed_images,
        build_gaia, compute_fluxes, plan_exposures, build_light_curves, render_exposures,
    )
}  # fmt: skip


def run(name, lake, path):
    return submitted_job.main(JOBS[name], ["--lake", lake, "--request", path])


# Commands by their argument: a lake, a request, an output file or folder.
OF_LAKE = {
    **{name: partial(run, name) for name in JOBS},
    "explore": lambda lake, good: explore.main(["SELECT 1", "--lake", lake]),
    "explore, tables": lambda lake, good: explore.main(["--lake", lake]),
    "archive": lambda lake, good: archive.main(["--lake", lake]),
    "archive, failures": lambda lake, good: archive.main(["--lake", lake, "--sql", "SELECT 1"]),
    "coverage": lambda lake, good: coverage.main(["--lake", lake]),
    "export, a file": lambda lake, good: truesky.main(["export", "gaia", "--lake", lake, "--out", f"{good}.csv"]),
    "export": lambda lake, good: truesky.main(["export", "galaxies", "--lake", lake, "--out", f"{good}s"]),
    **{name: (lambda lake, good, name=name: truesky.main([name, lake])) for name in ("verify", "gc", "describe")},
    "mission diff": lambda lake, good: truesky.main(["mission", "diff", ",".join(LADDER), f"{lake}@{0:016}"]),
    "demo": lambda lake, good: demo.main(["--out", lake, "--request", good]),
    "run": lambda lake, good: whole.main([good, "--lake", lake], pytest.fail),
    "report": lambda lake, good: report.main([lake]),
}
OF_REQUEST = {
    **{name: (lambda path, new, name=name: run(name, new, path)) for name in JOBS},
    "request check": lambda path, new: check.main([path]),
    "demo": lambda path, new: demo.main(["--request", path, "--out", new]),
    "run": lambda path, new: whole.main([path, "--lake", new], pytest.fail),
    "mission diff": lambda path, new: truesky.main(["mission", "diff", path, ",".join(LADDER)]),
}
OF_TARGET = {
    "explore": lambda out, lake: explore.main(["SELECT 1", "--lake", lake, "--out", out]),
    "archive": lambda out, lake: archive.main(["--lake", lake, "--again", "images/x.fits", "--out", out]),
    "coverage": lambda out, lake: coverage.main(["--lake", lake, "--out", out]),
    "export, a file": lambda out, lake: truesky.main(["export", "gaia", "--lake", lake, "--out", out]),
    "export": lambda out, lake: truesky.main(["export", "galaxies", "--lake", lake, "--out", out]),
}

# Names that files cannot have, or whose reading would not end.
NAMES = {
    "NUL": "a\0b", "5,000 characters": "x" * 5000, "5,000 folders": "x/" * 5000 + "y", "no such user": "~nosuchuser/x",
    "a line break": "a\nb/c", "not of this encoding": "\ud800x", "empty": "",
}  # fmt: skip


def sparse(path):
    with path.open("wb") as stream:
        stream.truncate(10 << 30)


def loop(path):
    path.symlink_to(path)


# Functions that make unusual files at a path.
THINGS = {
    "a pipe": os.mkfifo, "a device": lambda path: path.symlink_to("/dev/zero"), "a folder": lambda path: path.mkdir(),
    "10 GB": sparse, "a loop": loop, "nothing": lambda path: None,
}  # fmt: skip

LONG, DEEP = "1" * 5000, "a" + ".a" * 4000
TEXTS = {
    "an integer of 5,000 digits": requests.text(seed=LONG),
    "a hexadecimal of 5,000 digits": requests.text(seed="0x" + LONG),
    "a number of 5,000 digits": requests.text(seed="0." + LONG),
    "a key of thousands of parts": f"{DEEP} = 1\n",
    "a megabyte of such a key": "a" + ".a" * 500_000 + " = 1\n",
    "a table of thousands of parts": f"[{DEEP}]\n",
    "thousands of tables in one another": "x = " + "{ a = " * 5000 + "1" + " }" * 5000,
    "thousands of lists in one another": "x = " + "[" * 5000 + "]" * 5000,
    "a date that no calendar has": requests.text(seed="2023-02-30"),
    "no text": b"\xff\xfe\x00x",
    "a line of vertices": requests.text(area="polygon = [[0, 0], [1, 0], [2, 0]]"),
    "a meridian of vertices": requests.text(area="polygon = [[10, 10], [10, 20], [10, 30]]"),
    "half of the sky": requests.text(area="polygon = [[0, 0], [120, 0], [240, 0]]"),
    "half of the sky, nearly": requests.text(area="polygon = [[0, 1e-9], [90, 1e-9], [180, 1e-9], [270, 1e-9]]"),
    "opposite vertices": requests.text(area="polygon = [[0, 0], [180, 0], [90, 45]]"),
    "a star": requests.text(area="polygon = [[1, 0], [-0.8, 0.6], [0.3, -0.95], [0.3, 0.95], [-0.8, -0.6]]"),
    "a speck": requests.text(area="polygon = [[0, 0], [1e-5, 0], [0, 1e-5]]"),
    "no such user": requests.text('[stars]\ncatalogue = { file = "~nosuchuser/x", columns = {} }\n'),
    "an effect of a list": requests.text('effects = { on = [["adc"]] }\n'),
}
# Not what a mission is read from: the comparison does not look at it.
NO_MISSION = [name for name in TEXTS if "of vertices" in name or "sky" in name or name in (
    "opposite vertices", "a star", "a speck", "no such user", "an effect of a list",
)]  # fmt: skip


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    """Prevent the start of jobs, and stop readers that wait for a pipe or the end of a device."""

    def fail(*arguments):
        raise AssertionError("a session was asked for")

    monkeypatch.setattr(submitted_job, "_spark_map", fail)
    monkeypatch.setattr(submit, "submit", fail)
    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(300)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def tree(folder):
    return sorted(str(path) for path in folder.rglob("*"))


def refused(folder, capsys, call, *arguments):
    """Return the single error line of a command."""
    before, started = tree(folder), time.process_time()
    assert call(*arguments) == 2
    assert time.process_time() - started < MOST_SECONDS
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert len(err) < 1200
    assert tree(folder) == before
    return err


@pytest.fixture
def good(tmp_path):
    return str(requests.written(tmp_path))


@pytest.mark.parametrize("call", OF_LAKE.values(), ids=OF_LAKE)
def test_an_invalid_lake_is_refused(tmp_path, capsys, good, call):
    for what in ("NUL", "5,000 characters", "5,000 folders", "no such user", "empty"):
        name = NAMES[what]
        refused(tmp_path, capsys, call, f"{tmp_path}/{name}" if name[:1] not in ("", "~") else name, good)
    for thing in ("a pipe", "a device", "10 GB", "a loop"):
        path = tmp_path / thing.replace(" ", "_")
        THINGS[thing](path)
        assert thing.replace(" ", "_") in refused(tmp_path, capsys, call, str(path), good)


@pytest.mark.parametrize("call", OF_REQUEST.values(), ids=OF_REQUEST)
def test_an_invalid_request_file_is_refused(tmp_path, capsys, call):
    for name in NAMES.values():
        refused(tmp_path, capsys, call, f"{tmp_path}/{name}" if name[:1] != "~" else name, str(tmp_path / "new"))
    for thing, make in THINGS.items():
        path = tmp_path / f"{thing.replace(' ', '_')}.toml"
        make(path)
        if thing != "a folder" or call is not OF_REQUEST["mission diff"]:
            assert path.name in refused(tmp_path, capsys, call, str(path), str(tmp_path / "new"))


@pytest.mark.parametrize(
    ("command", "texts"),
    [
        *(pytest.param(name, TEXTS, id=name) for name in OF_REQUEST if name not in ("demo", "mission diff")),
        # It reads each request in a child process, which starts Java.
        pytest.param("demo", ["a star"], id="demo"),
        pytest.param("demo", TEXTS, id="demo, all", marks=pytest.mark.nightly),
        pytest.param("mission diff", [name for name in TEXTS if name not in NO_MISSION], id="mission diff"),
    ],
)
def test_a_request_with_invalid_content_is_refused(tmp_path, capsys, command, texts):
    call = OF_REQUEST[command]
    for name in texts:
        text = TEXTS[name]
        path = tmp_path / "r.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        assert "r.toml" in refused(tmp_path, capsys, call, str(path), str(tmp_path / "new")), name


@pytest.mark.parametrize("call", OF_TARGET.values(), ids=OF_TARGET)
def test_an_unwritable_output_file_is_refused(tmp_path, capsys, call):
    lake = tmp_path / "lake"
    lake.mkdir()
    publish.make_version(lake, plain_plan(), plain_work)
    for name in ("NUL", "5,000 characters"):
        refused(tmp_path, capsys, call, f"{tmp_path}/{NAMES[name]}.csv", str(lake))
    for thing in ("a pipe", "a device", "a loop"):
        path = tmp_path / f"{thing.replace(' ', '_')}.fits"
        THINGS[thing](path)
        refused(tmp_path, capsys, call, str(path), str(lake))


# ------------------------------------------------------------------------------------------------ own files

HEAD = '[fluxes.passbands.mine]\nmedium = "air"\n'
CATALOGUE = 'format = "flagship2"\n'
POINT = '[[pointing]]\nchannel = "VIS"\nband = "euclid_vis"\nra = 53.1\ndec = -27.8\nmjd = 60905.0\n'
HALOS = 'columns = { ra = "ra", dec = "dec", z_true = "z", log_mass = "m" }\n'
SKY = pa.table({"mjd": [60905.0], "channel": ["VIS"], "image_type": ["science"]})
# A key of the request that names a file, and what reads it.
OWN = {
    "fluxes.passbands": (HEAD + 'format = "passband_ascii"\nfile = {}\n', lambda r: inputs.read_passbands(r.curves)),
    "fluxes.passbands, ECSV": (
        HEAD + 'format = "passband_ecsv"\nfile = {}\n',
        lambda r: inputs.read_passbands(r.curves),
    ),
    "fluxes.passbands, VOTable": (
        HEAD + 'format = "passband_svo"\nfile = {}\n',
        lambda r: inputs.read_passbands(r.curves),
    ),
    "fluxes.templates": ('[fluxes.templates]\nformat = "cosmos"\nfiles = [{}]\n', lambda r: inputs.read(r.curves)),
    "fluxes.templates, FITS": (
        '[fluxes.templates]\nformat = "spectrum_fits"\nfiles = [{}]\n',
        lambda r: inputs.read(r.curves),
    ),
    "fluxes.extinction": ('[fluxes.extinction.3]\nformat = "extinction"\nfile = {}\n', lambda r: inputs.read(r.curves)),
    "fluxes.stars, models": ("[fluxes.stars]\nbasel = {}\n", lambda r: inputs.read(r.curves)),
    "fluxes.stars, infrared": ("[fluxes.stars]\nirtf = [{}]\n", lambda r: inputs.read(r.curves)),
    "ingest.galaxies": ("[ingest.galaxies]\n" + CATALOGUE + "files = [{}]\n", lambda r: build_galaxies.steps(None, r)),
    "ingest.halos": ("[ingest.halos]\n" + HALOS + "files = [{}]\n", lambda r: build_galaxies.steps(None, r)),
    "ingest.dust": ('[ingest.dust]\ncolumn = "EBV"\nfile = {}\n', lambda r: dust_map.map_for_request(1, r.ingest.dust)),
    "stars.tycho2": ("[stars]\ntycho2 = [{}]\n", lambda r: request_checks.star_files(r.stars)),
    "stars.catalogue": (
        '[stars.catalogue]\ncolumns = {{ ra = "ra", dec = "dec", mag_h = "h", teff = "t" }}\nfile = {}\n',
        lambda r: request_checks.star_files(r.stars),
    ),
    "psf": (
        POINT + "[psf]\neuclid_vis = {}\n",
        lambda r: from_file.check(Path(dict(r.psfs)["euclid_vis"]), None, None),
    ),
    "solar_system.bodies": (POINT + "[solar_system]\nbodies = {}\n", lambda r: keys.ephemeris_files(r.bodies, SKY)),
    "structure.stamps": (
        POINT + "[structure]\nstamps = {{ file = {} }}\n",
        lambda r: keys.stamp_files(r.structure.stamps.file),
    ),
    "observation.pointings": ('[[observation]]\nchannels = ["VIS"]\npointings = {}\n', lambda r: None),
}


def quoted(text):
    """Return a text as a TOML string."""
    return '"' + text.replace("\0", "\\u0000").replace("\n", "\\n") + '"'


@pytest.fixture(scope="module")
def warm():
    """Fill the caches that are made once per machine, because they take longer than the limit."""
    inputs.read(UserCurves())


@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize(("key", "read"), OWN.values(), ids=OWN)
def test_an_invalid_file_named_in_a_request_is_refused(tmp_path, key, read):
    names = [name for what, name in NAMES.items() if what not in ("not of this encoding", "empty")]
    for suffix in (".fits", ".csv", ".parquet"):
        for thing, make in THINGS.items():
            names.append(thing.replace(" ", "_") + suffix)
            make(tmp_path / names[-1])
    before = tree(tmp_path)
    for name in names:
        folder_of_catalogues = key.startswith("[ingest.") and name.startswith("a_folder")
        path = requests.written(tmp_path, key.replace("{{", "{").replace("}}", "}").replace("{}", quoted(name)))
        started = time.process_time()
        with pytest.raises(BadInput) as caught:
            read(parse(path))
        assert time.process_time() - started < MOST_SECONDS
        said = str(caught.value)
        assert len(said.splitlines()) == 1
        assert len(said) < 1200
        if name in before and not folder_of_catalogues:
            assert name in said
        path.unlink()
    assert tree(tmp_path) == before


def test_every_kind_of_file_has_a_size_limit(tmp_path, monkeypatch):
    for size, kind in enumerate(user_files.MAX_BYTES):
        monkeypatch.setitem(user_files.MAX_BYTES, kind, size)
    for size, kind in enumerate(user_files.MAX_BYTES):
        path = tmp_path / "x"
        path.write_bytes(b"x" * size)
        assert user_files.check_file(path, kind) == path
        path.write_bytes(b"x" * (size + 1))
        with pytest.raises(BadInput, match=f"is larger than {size} bytes, the limit for a {kind}"):
            user_files.check_file(path, kind)


@pytest.mark.parametrize(("lost", "gateway"), [("??", "25333"), ("\udcc3\udca9", "")])
@pytest.mark.parametrize("name", JOBS)
def test_names_that_lost_their_letters_are_refused(tmp_path, capsys, monkeypatch, good, name, lost, gateway):
    """In a locale of ASCII alone Java hands a question mark on for any other letter, and Python surrogates."""
    monkeypatch.setattr("locale.nl_langinfo", lambda item: "ANSI_X3.4-1968")
    if gateway:
        monkeypatch.setenv("PYSPARK_GATEWAY_PORT", gateway)
    for lake, path in ((f"{tmp_path}/{lost}", good), (f"{tmp_path}/lake", f"{tmp_path}/{lost}.toml")):
        assert "export LC_ALL=C.UTF-8" in refused(tmp_path, capsys, run, name, lake, path)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (b"is it?", b"is it?: no such file"),
        pytest.param(b"caf\xc3\xa9", b"export LC_ALL=C.UTF-8", marks=pytest.mark.nightly),
    ],
)
def test_a_question_mark_is_valid_without_java(tmp_path, name, words):
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0"}
    environment.pop("PYSPARK_GATEWAY_PORT", None)
    asked = [sys.executable, JOB, "--lake", tmp_path / "lake"]
    done = subprocess.run([*asked, "--request", bytes(tmp_path / "x") + name], env=environment, capture_output=True)
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []
