"""truesky examples FOLDER: copies the requests and notebooks that truesky comes with."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from lake_schema import __version__, command, user_files
from lake_schema.errors import BadInput

# Folder -> the ending of what is copied of it.
SUFFIXES = {"requests": ".toml", "notebooks": ".ipynb"}
# What measures truesky against other programs, and so wants a clone.
_CLONE_ONLY = ("02_speed_for_accuracy.ipynb",)


def example_files() -> list[Path]:
    """What there is to be copied."""
    paths = [path for name, suffix in SUFFIXES.items() for path in sorted(_folder(name).glob(f"*{suffix}"))]
    return [path for path in paths if path.name not in _CLONE_ONLY]


def request_file(name: str) -> Path:
    """A request that truesky comes with."""
    return _folder("requests") / f"{name}.toml"


def _folder(name: str) -> Path:
    """Folder of requests or notebooks: in the package if installed from a wheel, else at the top of the clone."""
    package = Path(__file__).resolve().parents[1]
    return next(folder for folder in (package / name, package.parent / name) if folder.is_dir())


def copy_examples(folder: Path) -> list[Path]:
    """Copies all of them; returns what was written.

    Errors : BadInput where one of them is there already, and nothing is copied
    """
    source_by_target = {
        user_files.check_folder(folder) / path.parent.name / path.name: path for path in example_files()
    }
    if existing := [path for path in source_by_target if path.exists()]:
        raise BadInput(f"{user_files.format_path(existing[0])} is there already: name another folder")
    for target, path in source_by_target.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return list(source_by_target)


def main(argv: Sequence[str]) -> int:
    """Exit status: 0 copied, 2 something is there already."""
    parser = argparse.ArgumentParser(prog="truesky examples", description=__doc__, epilog=f"truesky {__version__}")
    parser.add_argument("folder", type=Path, help="made where it is not there")
    options = parser.parse_args(argv)

    def copy_and_list() -> int:
        for path in copy_examples(options.folder):
            print(path)
        return 0

    return command.run("truesky", copy_and_list)
