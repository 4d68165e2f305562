"""Check names of modules, and references to files."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# spark-submit puts the folder of the submitted file first in sys.path.
FOLDERS = ("lake_schema", "truesky", "benchmarks", "scripts")
MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if path.stem[:2] != "__")
ELSEWHERE = re.compile(r"(?<![\w.~])/(?:home|root|Users|work)/\w|\.\./shared|\bissues? #?\d", re.IGNORECASE)
# A file or folder of the tree, and a module by its file's name alone.
TOP = "benchmarks|deploy|docs|jobs|lake_schema|notebooks|requests|scripts|tests|truesky"
NAMED = re.compile(rf"(?<![\w./])(?:{TOP})/[\w/.-]*\w")
MODULE = re.compile(r"(?<![\w/.-])[a-z_0-9]+\.py\b")
MAX_BYTES = 1_000_000


def files() -> list[Path]:
    """Return all files that git tracks or would add."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\0")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed if name and (ROOT / name).is_file()]


def test_no_module_shadows_the_standard_library():
    assert MODULES
    assert [path for path in MODULES if path.stem in sys.stdlib_module_names] == []


def test_no_file_refers_to_anything_outside_the_repository():
    found = []
    for path in files():
        text = path.read_bytes().decode("utf-8", errors="replace")
        found += [f"{path.relative_to(ROOT)}: {match[0]}" for match in ELSEWHERE.finditer(text)]
    assert found == []


@pytest.mark.parametrize(
    "text", ["see /" + "home/me/x", ".." + "/shared/facts", "fixes issue" + " 12", "Issue" + " #3"]
)
def test_references_outside_the_repository_are_detected(text):
    assert ELSEWHERE.search(text)


@pytest.mark.parametrize("text", ["the home/work balance", "/path/to/python", "issue of 2024", "framework/work"])
def test_other_texts_are_accepted(text):
    assert not ELSEWHERE.search(text)


def test_files_named_in_texts_exist():
    """Files named in code, comments, docstrings and documentation exist."""
    there = {path.relative_to(ROOT) for path in files()}
    there |= {folder for path in there for folder in path.parents}
    modules, found = {path.name for path in there}, []
    for path in files():
        text = path.read_bytes().decode("utf-8", errors="replace")
        found += [f"{path.relative_to(ROOT)}: {name}" for name in NAMED.findall(text) if Path(name) not in there]
        if path in MODULES:
            found += [f"{path.relative_to(ROOT)}: {name}" for name in MODULE.findall(text) if name not in modules]
    assert found == []


def test_no_large_file():
    assert [path for path in files() if path.stat().st_size > MAX_BYTES] == []


LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")


def test_links_of_pages_exist():
    """Targets of relative links in the README, docs/ and the notebooks exist; index.md is tested with the site."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*"), *(ROOT / "notebooks").glob("*")]
    lost = [
        f"{page.relative_to(ROOT)}: {link}"
        for page in pages
        if page.suffix in (".md", ".ipynb") and page.name != "index.md"
        for link in LINK.findall(page.read_text())
        if "\\" not in link and not (page.parent / link).exists()
    ]
    assert lost == []
