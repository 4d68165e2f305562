"""A working copy is compared with a commit; the checkout is removed."""

import contextlib
import json
import os
import subprocess

import pytest

from benchmarks import _subjects, compare

ROOT = compare.ROOT


def worktrees():
    listed = ["git", "-C", str(ROOT), "worktree", "list"]
    return subprocess.run(listed, capture_output=True, text=True, check=True).stdout


# The default run has test_ratios_are_new_times_by_old_times.
@pytest.mark.nightly
def test_the_ratios(tmp_path):
    file, before, subjects = tmp_path / "figures.json", worktrees(), list(_subjects.SUBJECTS)
    assert compare.main(["HEAD", "--quick", "--json", str(file), "--subjects", *subjects]) == 0
    assert worktrees() == before
    figures = json.loads(file.read_text())
    for subject in subjects:
        assert figures[f"{subject}_ratio"] == pytest.approx(figures[f"{subject}_s"] / figures[f"{subject}_base_s"])
        assert figures[f"{subject}_ratio_min"] <= figures[f"{subject}_ratio"] <= figures[f"{subject}_ratio_max"]


@pytest.mark.nightly
def test_the_base_is_imported_from_its_commit(tmp_path):
    """A change of the base's package is seen by the process of the base, but not by that of this working copy."""
    with compare.checkout("HEAD") as base:
        (base / "truesky" / "__init__.py").write_text("raise SystemExit(7)")
        with pytest.raises(SystemExit, match="ended with status 7"):
            compare.compare("fluxes", base, 1, True)
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        with _subjects.start("fluxes", True, environment, ROOT) as process:
            assert _subjects.ask(process) > 0.0
            process.communicate()
    assert not base.exists()


def test_ratios_are_new_times_by_old_times(monkeypatch):
    monkeypatch.setattr(_subjects, "alternate", lambda processes, repeats: [[2.0, 4.0, 9.0], [1.0, 1.0, 3.0]])
    monkeypatch.setattr(_subjects, "start", lambda *arguments: contextlib.nullcontext())
    assert compare.compare("fluxes", ROOT, 3, True) == {
        "fluxes_ratio": 3.0, "fluxes_ratio_min": 2.0, "fluxes_ratio_max": 4.0, "fluxes_base_s": 1.0, "fluxes_s": 4.0,
    }  # fmt: skip


def test_an_unknown_commit_is_refused():
    with pytest.raises(SystemExit, match="commit no-such-commit: "):
        compare.main(["no-such-commit"])


def test_a_commit_whose_library_has_another_name_is_refused(tmp_path, monkeypatch):
    """Without its own package truesky, the process of the base would import the installed one, this working copy."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=A", "-c", "user.email=a@b.c"]
    (tmp_path / "truesky").mkdir()
    (tmp_path / "truesky" / "__init__.py").write_text("")
    for command in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "--no-gpg-sign", "-m", "Old"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(compare, "ROOT", tmp_path)
    with pytest.raises(SystemExit, match=r"^benchmarks\.compare: commit HEAD: it has no package truesky\.render \("):
        compare.main(["HEAD"])
    listed = subprocess.run([*git, "worktree", "list"], capture_output=True, text=True, check=True).stdout
    assert len(listed.splitlines()) == 1
