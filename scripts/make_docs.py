"""Write the documentation site: the pages of docs/, the notebooks, and references made from the code.

    python -m scripts.make_docs [--out out/site] [--notebooks]

With --notebooks, the notebooks are run on the lake that `make demo` leaves in out/demo, and pictures of the page over
that lake are taken. Otherwise the notebooks are shown as stored, without figures. Nothing is downloaded.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import matplotlib
import nbformat
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from sphinx.application import Sphinx

from lake_schema.mission.configuration import resolve
from scripts import docs_references, page_pictures, structure_picture

ROOT = Path(__file__).resolve().parents[1]
# Chapters of the site: title and pages. Pages of docs/ that no chapter names are how-to pages.
CHAPTERS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Tutorials", ("notebooks",)),
    ("How to", ("others",)),
    (
        "Reference",
        (
            "request.md",
            "tables.md",
            "mission.md",
            "effects.md",
            "accuracy.md",
            "modelled.md",
            "corrections.md",
            "api.md",
        ),
    ),
    ("Contributing", ("contributing.md",)),
)
_DEMO, _DEMO_LAKE = ROOT / "requests" / "demo.toml", ROOT / "out" / "demo" / "lake"
_FOLDERS = "deploy|jobs|truesky|lake_schema|requests|benchmarks|tests|scripts"
_FILE = re.compile(rf"\[([^\]]*)\]\((?:\.\./)*(?:(?:{_FOLDERS})/|README)[^)]*\)")
_NOTEBOOK = re.compile(r"\]\((?:\.\./)*notebooks/([^)]*)\.ipynb\)")


def notebooks(into: Path, run: bool) -> list[str]:
    """Write the notebooks as pages and return the names of the pages; `run` executes them first."""
    pages = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        if run:
            # Notebooks about a field use the lake of `make demo`; the others make a lake.
            makes_own_lake = path.stem.endswith(("shear", "slitless"))
            demo = {} if makes_own_lake else {"TRUESKY_REQUEST": str(_DEMO), "TRUESKY_LAKE": str(_DEMO_LAKE)}
            client = NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": str(path.parent)}})
            client.execute(env={**os.environ, **demo})
        text, resources = MarkdownExporter().from_notebook_node(notebook)
        folder = into / "tutorials"
        folder.mkdir(exist_ok=True)
        for name, data in resources["outputs"].items():
            (folder / f"{path.stem}_{name}").write_bytes(data)
            text = text.replace(f"]({name})", f"]({path.stem}_{name})")
        (folder / f"{path.stem}.md").write_text(text.replace("](../docs/", "](../"), encoding="utf-8")
        pages.append(f"tutorials/{path.stem}.md")
    return pages


# ------------------------------------------------------------------------------------------------ the site


def pages(into: Path, run: bool) -> None:
    """Write all pages to a folder; `run` executes the notebooks."""
    shutil.copytree(ROOT / "docs", into, dirs_exist_ok=True)
    mission = resolve()
    generated = {
        "request.md": docs_references.request_page(),
        "mission.md": docs_references.mission_page(mission),
        "effects.md": docs_references.effects_page(into, mission),
        "accuracy.md": docs_references.accuracy_page(into),
        "api.md": docs_references.api_page(),
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"),
    }
    for name, text in generated.items():
        (into / name).write_text(text, encoding="utf-8")
    tutorials = notebooks(into, run)
    if run:
        _with_pictures(into)
    named = {page for _, names in CHAPTERS for page in names} | {"index.md"}
    listed = {"notebooks": tutorials, "others": sorted({path.name for path in into.glob("*.md")} - named)}
    for path in into.glob("*.md"):
        text = _NOTEBOOK.sub(r"](tutorials/\1.md)", path.read_text(encoding="utf-8"))
        # Links to files that the site does not contain become names.
        path.write_text(_FILE.sub(r"`\1`", text).replace("](docs/", "]("), encoding="utf-8")
    with (into / "index.md").open("a", encoding="utf-8") as home:
        for title, names in CHAPTERS:
            entries = [page for name in names for page in listed.get(name, [name])]
            home.write("\n".join(["", "```{toctree}", f":caption: {title}", ":hidden:", "", *entries, "```", ""]))


def _with_pictures(into: Path) -> None:
    """Add pictures of spiral galaxies and, if a browser is available, of the page over a lake."""
    structure_picture.write(into / "structure.jpg")
    if why := page_pictures.missing_requirement():
        print(f"docs: no pictures of the page: {why}")
        return
    with (into / "page.md").open("a", encoding="utf-8") as page:
        for name, caption in page_pictures.pictures(into):
            page.write(f"\n![{caption}]({name})\n\n*{caption}.*\n")


def build(source: Path, out: Path) -> int:
    """Build the site from a folder of pages. Return 0 if there are no errors and no warnings."""
    configuration = {
        "project": "truesky",
        "extensions": ["myst_parser", "sphinx.ext.autodoc"],
        "html_theme": "pydata_sphinx_theme",
        "html_theme_options": {"show_prev_next": False, "secondary_sidebar_items": ["page-toc"]},
        "html_copy_source": False,
        "myst_heading_anchors": 3,
        "autodoc_default_options": {"members": True, "member-order": "bysource"},
        "autodoc_typehints": "none",
    }
    site = Sphinx(source, None, out, source / "_built", "html", configuration, status=None, warningiserror=True)
    site.connect("autodoc-process-docstring", _show_verbatim)
    site.build()
    return site.statuscode


def _show_verbatim(*event: Any) -> None:
    """Show a docstring exactly as it is written."""
    lines = event[-1]
    lines[1:] = ["", "::", "", *("    " + line for line in lines[1:]), ""] if any(lines[1:]) else []


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "site")
    parser.add_argument("--notebooks", action="store_true", help="run the notebooks to make their figures")
    options = parser.parse_args()
    matplotlib.use("Agg")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "docs"
        source.mkdir()
        pages(source, options.notebooks)
        if build(source, options.out):
            raise SystemExit("truesky: the site has errors, listed above")
    print(options.out / "index.html")


if __name__ == "__main__":
    main()
