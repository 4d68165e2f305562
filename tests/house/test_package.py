"""Check the files, version and dependencies of the distribution."""

from __future__ import annotations

import email
import importlib
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import lake_schema
from lake_schema.store import provenance

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = ("lake_schema", "truesky")
# Endings of files in the packages that are not distributed.
NOT_SHIPPED = {".pyc"}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the path of a wheel, built offline from a copy of the repository."""
    copy = tmp_path_factory.mktemp("wheel")
    for name in (*PACKAGES, "requests", "notebooks"):
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE", "README.md"):
        shutil.copy(ROOT / name, copy)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--quiet", "."]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (file,) = copy.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def wheel(built):
    with zipfile.ZipFile(built) as archive:
        yield archive


def test_wheel_contains_all_files_of_the_packages(wheel):
    of_packages = {path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()}
    there = {path.relative_to(ROOT) for path in of_packages if path.suffix not in NOT_SHIPPED}
    examples = {path.relative_to(ROOT) for folder in ("requests", "notebooks") for path in (ROOT / folder).iterdir()}
    expected = {path.as_posix() for path in there} | {f"truesky/{path.as_posix()}" for path in examples}
    # This notebook requires a clone.
    expected = {name for name in expected if not name.endswith("/02_speed_for_accuracy.ipynb")}
    shipped = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert shipped == expected
    assert {"lake_schema/py.typed", "truesky/py.typed", "lake_schema/mission/vis.csv"} <= shipped
    assert {name.split("/")[0] for name in shipped} == {"lake_schema", "truesky"}


def test_metadata(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = email.message_from_bytes(wheel.read(name))
    assert (metadata["Name"], metadata["Version"]) == ("truesky", lake_schema.__version__)
    assert metadata["License-Expression"] == "BSD-3-Clause"
    # An application: package indexes refuse this classifier.
    assert "Private :: Do Not Upload" in metadata.get_all("Classifier")


# Java prints this when it starts with the module that Spark requires.
INCUBATOR = "WARNING: Using incubator modules"
# Environment variables that a user may have set for another Spark.
FOREIGN = {
    "SPARK_HOME": "/nowhere", "SPARK_CONF_DIR": "/nowhere", "SPARK_ENV_LOADED": "1", "PYSPARK_PYTHON": "/bin/false",
    "PYSPARK_DRIVER_PYTHON": "/bin/false", "PYSPARK_DRIVER_PYTHON_OPTS": "notebook",
}  # fmt: skip


@pytest.mark.spark
@pytest.mark.nightly
def test_an_installed_wheel_runs_a_request_from_an_empty_folder(built, tmp_path):
    """The commands of docs/command.md work in a new environment without a clone of the repository."""
    environment, folder = tmp_path / "venv", tmp_path / "empty"
    venv.EnvBuilder(with_pip=False, symlinks=True).create(environment)
    folder.mkdir()
    (packages,) = environment.glob("lib/python*/site-packages")
    (packages / "ready.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    install = [sys.executable, "-m", "pip", "--python", str(environment / "bin" / "python"), "install", "--no-deps"]
    subprocess.run([*install, "--no-index", "--force-reinstall", str(built)], check=True, capture_output=True)
    kept = {name: os.environ[name] for name in ("JAVA_HOME", "PATH", "LANG") if name in os.environ}
    variables = {**kept, **FOREIGN, "HOME": str(tmp_path), "OMP_NUM_THREADS": "1"}

    def truesky(*words):
        command = [str(environment / "bin" / "truesky"), *words]
        done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, timeout=3000)
        # Neither Spark's messages nor Python's, except one line of Java and the progress, one line every 30 s.
        messages = [line for line in done.stderr.splitlines() if not line.startswith(("progress: ", INCUBATOR))]
        assert (done.returncode, messages) == (0, []), done.stdout
        return done.stdout

    assert "requests/demo.toml" in truesky("examples", ".")
    truesky("check", "requests/demo.toml")
    said = truesky("run", "requests/demo.toml", "lake", "--detectors", "R22_S11")
    (picture,) = (folder / "lake" / "pictures").glob("*.png")
    assert said.splitlines()[-1] == str(picture)
    assert "render_exposures" in said
    query = "SELECT count(*) FROM products WHERE content = 'science'"
    assert truesky("sql", "lake", query).split()[-3] == "1"
    truesky("verify", "lake")
    # A wheel's products have the keys of a clone's.
    manifest = json.loads((folder / "lake" / "galaxies" / "current" / "manifest.json").read_text())
    assert manifest["facts"]["code"] == provenance.code_version()
    assert {path.name for path in folder.iterdir()} == {"requests", "notebooks", "lake"}


def test_changes_name_the_version():
    assert f"\n## {lake_schema.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def pinned(name: str) -> list[tuple[Requirement, list[str]]]:
    """Return the packages that a requirements file pins, with hashes, including files that it refers to."""
    text = (ROOT / "requirements" / f"{name}.txt").read_text().replace("\\\n", "")
    found = []
    for line in text.splitlines():
        if other := re.fullmatch(r"--requirement (\w+)\.txt", line):
            found += pinned(other[1])
        elif line and not line.startswith("#"):
            first, *hashes = re.split(r"\s+--hash=", line.strip())
            found.append((Requirement(first), hashes))
    return found


LISTS = ("build", "run", "test", "bench", "camb")


def pins() -> dict[str, str]:
    every = [requirement for name in LISTS for requirement, _ in pinned(name)]
    found = {canonicalize_name(r.name): str(r.specifier).removeprefix("==") for r in every}
    # No two lists disagree.
    assert len({(canonicalize_name(r.name), str(r.specifier)) for r in every}) == len(found)
    return found


@pytest.mark.parametrize("name", [*LISTS, "oldest"])
def test_every_package_has_one_version_and_hashes(name):
    some = pinned(name)
    assert some
    for requirement, hashes in some:
        assert re.fullmatch(r"==[\w.]+", str(requirement.specifier)), requirement
        assert hashes, requirement
        assert [one for one in hashes if not re.fullmatch(r"sha256:[0-9a-f]{64}", one)] == [], requirement


@pytest.mark.parametrize(("extra", "names"), [("", ("build", "run")), ("test", ("build", "run", "test"))])
def test_packages_installed_without_dependencies_are_complete(extra, names):
    """pip does not resolve dependencies here, so a missing package would only be noticed at import."""
    listed = {canonicalize_name(requirement.name) for name in names for requirement, _ in pinned(name)}
    todo, seen = [("truesky", extra)], set()
    while todo:
        package, with_extra = todo.pop()
        if (package, with_extra) in seen:
            continue
        seen.add((package, with_extra))
        for line in importlib.metadata.requires(package) or []:
            wanted = Requirement(line)
            if wanted.marker is None or any(wanted.marker.evaluate({"extra": e}) for e in {"", with_extra}):
                assert wanted.name == "truesky" or canonicalize_name(wanted.name) in listed, (package, line)
                todo += [(wanted.name, e) for e in wanted.extras or {""}]
    assert len(seen) > 30


def test_dependencies_are_pinned_within_their_ranges():
    project = PROJECT["project"]
    wanted = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    wanted += PROJECT["build-system"]["requires"]
    for line in wanted:
        requirement = Requirement(line)
        if requirement.name == "truesky":
            assert requirement.extras <= project["optional-dependencies"].keys(), line
            continue
        assert requirement.specifier.contains(pins()[canonicalize_name(requirement.name)]), line


# Extras that users install for some commands.
EXTRAS = ("maps", "page", "reduction", "s3")


def test_the_oldest_versions_are_the_lower_bounds():
    """The lower bounds can be installed together."""
    project = PROJECT["project"]
    lines = [
        *project["dependencies"],
        *(line for extra in EXTRAS for line in project["optional-dependencies"][extra]),
    ]
    oldest = {canonicalize_name(requirement.name): requirement for requirement, _ in pinned("oldest")}
    for requirement in map(Requirement, lines):
        (bound,) = (Version(one.version).release for one in requirement.specifier if one.operator == ">=")
        (pin,) = (Version(one.version).release for one in oldest[canonicalize_name(requirement.name)].specifier)
        assert pin[: len(bound)] == bound, requirement


# Of numba, pyspark and boto3, which want one version of them each and are nothing without.
PARTS = {"llvmlite", "py4j", "botocore"}


@pytest.mark.parametrize(
    ("folders", "extras"), [(("lake_schema", "truesky"), EXTRAS), (("tests",), ("test", "docs", *EXTRAS))]
)
def test_imported_packages_are_declared(folders, extras):
    """Direct imports are declared even if another package requires them, also in programs stored as text."""
    project = PROJECT["project"]
    lines = [*project["dependencies"], *(line for extra in extras for line in project["optional-dependencies"][extra])]
    named = {canonicalize_name(Requirement(line).name) for line in lines} | PARTS
    whose = importlib.metadata.packages_distributions()
    missing = {}
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for module in re.findall(
            r"^ *(?:import|from) (\w+)[\w.]*(?:$| import | as |,)", path.read_text(), re.MULTILINE
        ):
            sources = {canonicalize_name(name) for name in whose.get(module, ())} - {"truesky"}
            # Another package may bring a folder of the same name as one of ours.
            if sources and not sources & named and not (ROOT / module).is_dir():
                missing[module] = path.relative_to(ROOT).as_posix()
    assert missing == {}


def test_a_package_with_two_versions_is_not_pinned(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    pin_packages = importlib.import_module("pin_packages")
    assert pin_packages.read("a==1 \\\n    --hash=x\nb==2\n") == {"a": ["a==1 \\", "    --hash=x"], "b": ["b==2"]}
    with pytest.raises(SystemExit, match="a has two versions"):
        pin_packages.read("a==1 ; python_version < '3.12'\na==2 ; python_version >= '3.12'\n")


def test_published_times_come_from_one_commit():
    """Times of several commits or machines cannot be compared."""
    results = [json.loads(file.read_text()) for file in (ROOT / "benchmarks" / "results").glob("*.json")]
    assert len(results) > 10
    assert len({(result["commit"], result["machine"]) for result in results}) == 1
