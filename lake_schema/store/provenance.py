"""Describe the code, libraries and machine with which tables and images are made, and hash JSON values and files."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lake_schema import instruction_set
from lake_schema.store.object_storage.s3 import Folder

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("lake_schema", "truesky")
# Folders of examples, which are left out of the fingerprint of the code. An installed package contains them, but in a
# clone of the repository they are elsewhere.
_EXCLUDED_FOLDERS = {"requests", "notebooks"}
_SUFFIXES = {".py", ".csv", ".npz", ".toml"}
# Libraries whose version can change the bytes of tables and images.
_LIBRARIES = (
    "astropy",
    "colossus",
    "dust_extinction",
    "galsim",
    "hats",
    "healpy",
    "numba",
    "numpy",
    "pyarrow",
    "scipy",
    "speclite",
)


def canonical(value: Any) -> bytes:
    """Return a value as JSON with sorted keys and without spaces, so that equal values give equal bytes.

    ValueError is raised for NaN and infinities, TypeError for a value that JSON cannot represent.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode()


def digest(value: Any) -> str:
    """Return the sha256 (64 hexadecimal digits) of the JSON text of a value with sorted keys, see `canonical`."""
    return hashlib.sha256(canonical(value)).hexdigest()


def file_sha256(path: Folder) -> str:
    """Return the sha256 (64 hexadecimal digits) of the contents of a file; raise OSError if it cannot be read."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def code_version(root: Path = _ROOT) -> str:
    """Return a sha256 of all source and data files of lake_schema and truesky, and of the versions of libraries.

    The files are the .py, .csv and .toml files of both packages in the folder `root`. Python counts as a library, and
    only libraries that can change results are included.
    """
    # With Path objects this takes more than twice as long, and each step of a job computes this hash.
    checksums, start = {}, len(os.path.join(root, ""))
    for package in _PACKAGES:
        top = os.path.join(root, package)
        for folder, below, names in os.walk(top):
            left_out = {"__pycache__"} | (_EXCLUDED_FOLDERS if folder == top else set())
            below[:] = [name for name in below if name not in left_out]
            for path in (os.path.join(folder, name) for name in names if os.path.splitext(name)[1] in _SUFFIXES):
                with open(path, "rb") as stream:
                    checksums[path[start:]] = hashlib.sha256(stream.read()).hexdigest()
    return digest({"files": checksums, "libraries": libraries()})


def libraries() -> Mapping[str, str]:
    """Return the versions of Python and of the libraries that can change the bytes of tables and images, by name."""
    return {"python": platform.python_version(), **{name: version(name) for name in _LIBRARIES}}


def machine() -> str:
    """Return the instruction set and C library that this process uses, such as "x86-64-v3 glibc 2.36".

    The records of all files that are made contain this text, because the last bits of results depend on it. It is not
    part of the hash that names a version of a table.
    """
    return instruction_set.kind()


def git_commit(root: Path = _ROOT) -> str:
    """Return the hash of the git commit that is checked out in `root`, or "unknown" if git does not find one."""
    try:
        process = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"],  # noqa: S607  (the user's own git, wherever it is)
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return process.stdout.strip()
