"""Examples of truesky: all are copied, and no file of the user is overwritten."""

import json
from pathlib import Path

from truesky.commands import __main__ as truesky
from truesky.commands import examples

ROOT = Path(__file__).resolve().parents[3]


def test_requests_and_notebooks_are_copied(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    assert truesky.main(["examples", str(out)]) == 0
    written = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert {"requests/demo.toml", "requests/field.toml", "notebooks/03_render_one_field.ipynb"} <= written
    assert {path.name for path in (ROOT / "requests").glob("*.toml")} == {Path(p).name for p in written if "req" in p}
    assert all((out / name).read_bytes() == (ROOT / name).read_bytes() for name in written)
    assert sorted(capsys.readouterr().out.split()) == sorted(str(out / name) for name in written)


def test_notebooks_that_require_a_clone_are_not_copied():
    """Exactly the notebooks that read files outside the package are not copied."""
    notebooks = (ROOT / "notebooks").glob("*.ipynb")
    cells = {path.name: "".join(map(str, json.loads(path.read_text())["cells"])) for path in notebooks}
    wanting = {name for name, text in cells.items() if "../benchmarks/" in text or "../truesky/render/" in text}
    assert {path.name for path in examples.example_files() if path.suffix == ".ipynb"} == set(cells) - wanting


def test_existing_files_are_not_overwritten(tmp_path, capsys):
    (own := tmp_path / "requests" / "demo.toml").parent.mkdir()
    own.write_text("mine")
    assert truesky.main(["examples", str(tmp_path)]) == 2
    assert "demo.toml exists already" in capsys.readouterr().err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [own]
    assert own.read_text() == "mine"
