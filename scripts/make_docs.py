"""Write the documentation site: the pages of docs/, the notebooks, and reference pages made from the code.

    python -m scripts.make_docs [--out out/site] [--notebooks]

With --notebooks, the notebooks are run on the lake (folder of tables and images) that `make demo` leaves in out/demo,
and screenshots of the web page of this lake are taken. Otherwise the notebooks are shown as stored, without figures.
Nothing is downloaded.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import tempfile
from pathlib import Path

import matplotlib
import nbformat
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from sphinx.application import Sphinx

from lake_schema.mission.configuration import resolve
from scripts import docs_references, ghost_picture, page_pictures, place_pictures, structure_picture

ROOT = Path(__file__).resolve().parents[1]
# Chapters of the site: title and pages. "walks" means the pages of docs/walks, "notebooks" those of all notebooks, and
# "others" all pages of docs/ that no other chapter names.
CHAPTERS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("First hour", ("walks",)),
    ("Tutorials", ("notebooks",)),
    ("How to", ("others",)),
    (
        "Reference",
        (
            "request.md",
            "tables.md",
            "limits.md",
            "assumed_numbers.md",
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
# Checks of numpydoc that every documented object must pass: summaries (SS), parameters (PR), returned values (RT) and
# sections (GL).
VALIDATION_CHECKS = (
    *("SS01", "SS02", "SS03", "SS05"),
    *("PR01", "PR02", "PR03", "PR04", "PR07", "PR10"),
    *("RT01", "RT03"),
    *("GL06", "GL07"),
)
_DEMO, _DEMO_LAKE = ROOT / "requests" / "demo.toml", ROOT / "out" / "demo" / "lake"
_FOLDERS = "deploy|jobs|truesky|lake_schema|requests|benchmarks|tests|scripts"
_FILE = re.compile(rf"\[([^\]]*)\]\((?:\.\./)*(?:(?:{_FOLDERS})/|README)[^)]*\)")
_NOTEBOOK = re.compile(r"\]\((?:\.\./)*notebooks/([^)]*)\.ipynb\)")


def notebooks(into: Path, run: bool) -> list[str]:
    """Write the notebooks as Markdown pages below the folder `into`, and return the paths of the pages relative to it.

    If `run` is True, the notebooks are executed first.
    """
    pages = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        if run:
            # Most notebooks use the lake of `make demo`. Those about shear, slitless spectra and lenses make a lake.
            makes_own_lake = path.stem.endswith(("shear", "slitless", "without"))
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


def pages(into: Path, run: bool) -> None:
    """Write all pages of the site, as Markdown with figures, to the existing folder `into`.

    If `run` is True, the notebooks are executed and pictures of galaxies and of the web page are added.
    """
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
    other_pages = sorted({path.name for path in into.glob("*.md")} - named)
    walks = sorted(into.glob("walks/*.md"))
    listed = {"walks": [f"walks/{path.name}" for path in walks], "notebooks": tutorials, "others": other_pages}
    for path in (*into.glob("*.md"), *walks):
        folder = "tutorials" if path.parent == into else "../tutorials"
        text = _NOTEBOOK.sub(rf"]({folder}/\1.md)", path.read_text(encoding="utf-8"))
        # Replace links to files of the repository that are not on the site by the text of the link.
        path.write_text(_FILE.sub(r"`\1`", text).replace("](docs/", "]("), encoding="utf-8")
    with (into / "index.md").open("a", encoding="utf-8") as home:
        for title, names in CHAPTERS:
            entries = [page for name in names for page in listed.get(name, [name])]
            home.write("\n".join(["", "```{toctree}", f":caption: {title}", ":hidden:", "", *entries, "```", ""]))


def _with_pictures(into: Path) -> None:
    """Draw pictures of galaxies and places and, if a browser is available, screenshots of the web page of a lake."""
    structure_picture.write(into / "structure.jpg")
    ghost_picture.write(into / "ghosts.jpg")
    place_pictures.write_places(_DEMO_LAKE, into / "places.jpg")
    place_pictures.write_injection(into / "injection.jpg")
    if why := page_pictures.missing_requirement():
        print(f"docs: no pictures of the page: {why}")
        return
    with (into / "page.md").open("a", encoding="utf-8") as page:
        for name, caption in page_pictures.pictures(into):
            page.write(f"\n![{caption}]({name})\n\n*{caption}.*\n")


def build(source: Path, out: Path) -> int:
    """Build the HTML site in `out` with Sphinx from a folder of pages; return 0 if there are no errors or warnings."""
    configuration = {
        "project": "truesky",
        "extensions": ["myst_parser", "sphinx.ext.autodoc", "numpydoc"],
        "default_role": "code",
        "html_theme": "pydata_sphinx_theme",
        "html_theme_options": {"show_prev_next": False, "secondary_sidebar_items": ["page-toc"]},
        "html_copy_source": False,
        "myst_heading_anchors": 3,
        "autodoc_default_options": {"members": True, "member-order": "bysource"},
        "autodoc_typehints": "none",
        # Members are listed by autodoc, in the order of the source.
        "numpydoc_show_class_members": False,
        "numpydoc_validation_checks": set(VALIDATION_CHECKS),
        # Users get these objects from functions. Their attributes are documented, and their constructors are not used.
        "numpydoc_validation_exclude": {r"\.(SkyImage|PsfImage|GivenFrame|InjectedFrame)$"},
    }
    site = Sphinx(source, None, out, source / "_built", "html", configuration, status=None, warningiserror=True)
    site.build()
    return site.statuscode


def main() -> None:
    """Run the command; SystemExit is raised if Sphinx reports an error or a warning."""
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
