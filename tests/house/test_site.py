"""The documentation site is complete; the nightly test builds it without warnings."""

import re
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from truesky.render.channels import registry

ROOT = Path(__file__).resolve().parents[2]
EFFECTS = {e.name for channel in registry.CHANNELS.values() for kind in channel.effects.values() for e in kind}


def test_pages_of_the_site(tmp_path, monkeypatch):
    """Each page is in the table of contents, and each effect has a description and a figure.

    Only the first figure is drawn, because drawing takes long.
    """
    # Sphinx and nbconvert take seconds to load, in each process of tests.
    from scripts import docs_references, make_docs

    draw = docs_references._draw_figure
    monkeypatch.setattr(
        docs_references,
        "_draw_figure",
        lambda path, *of: path.touch() if list(path.parent.iterdir()) else draw(path, *of),
    )
    plt.switch_backend("Agg")
    make_docs.pages(tmp_path, run=False)
    contents = (tmp_path / "index.md").read_text().partition("{toctree}")[2].split()
    pages = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.md")} - {"index.md"}
    assert pages <= set(contents)
    assert {f"tutorials/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")} <= pages
    effects = (tmp_path / "effects.md").read_text()
    assert [name for name in EFFECTS if f" {name}\n" not in effects] == []
    # Effects that require a large frame or another camera have no figure.
    assert all(
        (tmp_path / name).is_file() for name in re.findall(r"!\[Frame before and after \w+\]\(([^)]*)\)", effects)
    )
    assert len(re.findall(r"!\[Frame before and after ", effects)) >= len(EFFECTS) - 4


@pytest.mark.nightly
def test_the_site(tmp_path):
    """The site contains every page, and every effect with its figure. A browser loads nothing from other hosts."""
    command = [sys.executable, "-m", "scripts.make_docs", "--out", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "site"
    home = (site / "index.html").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert (site / f"{page.stem}.html").exists()
        assert f'href="{page.stem}.html"' in home or page.stem == "index"
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        assert (site / "tutorials" / f"{notebook.stem}.html").exists()
    effects = (site / "effects.html").read_text()
    assert all(f">{name}<" in effects for name in EFFECTS)
    # Effects that require a large frame or another camera have no figure.
    assert len(re.findall(r'<img alt="Frame before and after \w+', effects)) >= len(EFFECTS) - 4
    loaded = re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(https?://[^"]*)"', home + effects)
    assert loaded == []
