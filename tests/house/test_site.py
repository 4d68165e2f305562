"""The documentation site is built, without a warning, from what the clone holds."""

import re
import subprocess
import sys
from pathlib import Path

from jobs.render.channels import registry

ROOT = Path(__file__).resolve().parents[2]


def test_the_site(tmp_path):
    """Every page, every effect with its figure; nothing in it is fetched from elsewhere when it is read."""
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
    names = {e.name for channel in registry.CHANNELS.values() for kind in channel.effects.values() for e in kind}
    assert all(f">{name}<" in effects for name in names)
    # Those that need more than a small frame, or another camera, are described alone.
    assert len(re.findall(r'<img alt="What \w+ does', effects)) >= len(names) - 4
    loaded = re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(https?://[^"]*)"', home + effects)
    assert loaded == []
