"""Copy the example requests and notebooks of truesky into a folder: truesky examples FOLDER."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput

# Names of the folders with examples, and the suffix of the files in each that are copied.
SUFFIXES = {"requests": ".toml", "notebooks": ".ipynb"}
# Notebooks that are not copied. They compare truesky with other programs, and require a clone of the repository.
_CLONE_ONLY = ("02_speed_for_accuracy.ipynb",)


def example_files() -> list[Path]:
    """Return the paths of all example requests (.toml) and notebooks (.ipynb) that can be copied."""
    paths = [path for name, suffix in SUFFIXES.items() for path in sorted(_folder(name).glob(f"*{suffix}"))]
    return [path for path in paths if path.name not in _CLONE_ONLY]


def request_file(name: str) -> Path:
    """Return the path of an example request by its name, such as "demo"; it is not checked that the file exists."""
    return _folder("requests") / f"{name}.toml"


def _folder(name: str) -> Path:
    """Return the folder `name` ("requests" or "notebooks") with examples.

    It is inside the installed package, or next to it in a clone of the repository. Raises StopIteration if neither
    exists.
    """
    package = Path(__file__).resolve().parents[1]
    return next(folder for folder in (package / name, package.parent / name) if folder.is_dir())


def copy_examples(folder: Path) -> list[Path]:
    """Copy all examples into a folder.

    Parameters
    ----------
    folder : Path
        Target folder. It is created if it does not exist, with the folders "requests" and "notebooks" in it.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    BadInput
        If one of the files exists already in the target folder. Nothing is copied then.
    """
    source_by_target = {
        user_files.check_folder(folder) / path.parent.name / path.name: path for path in example_files()
    }
    if existing := [path for path in source_by_target if path.exists()]:
        raise BadInput(f"{user_files.format_path(existing[0])} exists already: use another folder")
    for target, path in source_by_target.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return list(source_by_target)


def run_command(options: argparse.Namespace) -> int:
    """Copy the examples to the folder in the parsed arguments, print the paths of the copies, and return 0.

    BadInput is raised if a file already exists.
    """
    for path in copy_examples(options.folder):
        print(path)
    return 0
