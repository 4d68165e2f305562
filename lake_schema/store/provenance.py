"""Fingerprints of the code and of the environment that made a product, and hashes of JSON values."""

from __future__ import annotations

import hashlib
import json
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
# Examples, which are in the package in a wheel but not in a clone.
_EXCLUDED_FOLDERS = {"requests", "notebooks"}
_SUFFIXES = {".py", ".csv", ".toml"}
# Libraries whose version can change the bytes of products.
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
    """Return JSON with sorted keys and no spaces: equal values give equal bytes, and NaN and infinities are refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode()


def digest(value: Any) -> str:
    """Return the sha256 (hexadecimal) of the canonical JSON of a value."""
    return hashlib.sha256(canonical(value)).hexdigest()


def file_sha256(path: Folder) -> str:
    """Return the sha256 (hexadecimal) of a file's contents."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def code_version(root: Path = _ROOT) -> str:
    """Return a fingerprint of all source and data files of lake_schema and truesky, and of the libraries' versions."""
    files = sorted(
        path
        for package in _PACKAGES
        for path in (root / package).rglob("*")
        if path.suffix in _SUFFIXES
        and "__pycache__" not in path.parts
        and path.relative_to(root / package).parts[0] not in _EXCLUDED_FOLDERS
    )
    checksums = {path.relative_to(root).as_posix(): file_sha256(path) for path in files}
    return digest({"files": checksums, "libraries": libraries()})


def libraries() -> Mapping[str, str]:
    """Return the versions of Python and of the libraries that affect the bytes of products."""
    return {"python": platform.python_version(), **{name: version(name) for name in _LIBRARIES}}


def machine() -> str:
    """Return the kind of this machine: instruction set and C library, such as "x86-64-v3 glibc 2.36".

    Receipts of tasks and manifests of versions record it. It is not part of the key of a version.
    """
    return instruction_set.kind()


def git_commit(root: Path = _ROOT) -> str:
    """Return the git commit of the checkout, or "unknown" outside one; it is recorded, but never part of a key."""
    try:
        process = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return process.stdout.strip()
