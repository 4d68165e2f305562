"""truesky examples FOLDER: copies the requests and notebooks that truesky comes with."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from lake_schema import __version__, command, user_files
from lake_schema.errors import BadInput

# Folder -> the ending of what is copied of it.
KINDS = {"requests": ".toml", "notebooks": ".ipynb"}
# What measures truesky against other programs, and so wants a clone.
_OF_A_CLONE = ("02_speed_for_accuracy.ipynb",)


def files() -> list[Path]:
    """What there is to be copied."""
    found = [path for name, ending in KINDS.items() for path in sorted(_folder(name).glob(f"*{ending}"))]
    return [path for path in found if path.name not in _OF_A_CLONE]


def request(name: str) -> Path:
    """A request that truesky comes with."""
    return _folder("requests") / f"{name}.toml"


def _folder(name: str) -> Path:
    """Folder of requests or notebooks: in the package if installed from a wheel, else at the top of the clone."""
    package = Path(__file__).resolve().parents[1]
    return next(folder for folder in (package / name, package.parent / name) if folder.is_dir())


def copy(folder: Path) -> list[Path]:
    """Copies all of them; returns what was written.

    Errors : BadInput where one of them is there already, and nothing is copied
    """
    wanted = {user_files.folder(folder) / path.parent.name / path.name: path for path in files()}
    if there := [path for path in wanted if path.exists()]:
        raise BadInput(f"{user_files.shown(there[0])} is there already: name another folder")
    for target, path in wanted.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return list(wanted)


def main(argv: Sequence[str]) -> int:
    """Exit status: 0 copied, 2 something is there already."""
    parser = argparse.ArgumentParser(prog="truesky examples", description=__doc__, epilog=f"truesky {__version__}")
    parser.add_argument("folder", type=Path, help="made where it is not there")
    options = parser.parse_args(argv)

    def copied() -> int:
        for path in copy(options.folder):
            print(path)
        return 0

    return command.status("truesky", copied)
