"""Execute the code blocks of docs/walks in order, each page in an empty folder, as a reader of the page would.

The first line of a block in TOML is a comment with the name of its file.
"""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from sybil import Document
from sybil.parsers.markdown import CodeBlockParser

from truesky.commands import __main__

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs" / "walks").glob("*.md"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return an empty folder, which is the current one. Processes whose numbers are in files of it are ended."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for path in tmp_path.glob("*.pid"):
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(path.read_text()), signal.SIGKILL)


def blocks(page, folder):
    """Return pairs (language, example) of the code blocks of a page. Evaluating an example executes the block."""

    def write_request(example):
        name = example.parsed.splitlines()[0].removeprefix("# ")
        (folder / name).write_text(example.parsed)

    def execute_python(example):
        exec(compile(example.parsed, str(page), "exec"), example.namespace)

    def execute_shell(example):
        run_shell(example.parsed, folder)

    evaluators = {"toml": write_request, "sh": execute_shell, "python": execute_python}
    parsers = [CodeBlockParser(language, evaluator) for language, evaluator in evaluators.items()]
    examples = Document.parse(str(page), *parsers)
    return [(example.region.lexemes["arguments"], example) for example in examples]


def run_shell(script, folder):
    """Run a shell script in a folder; `truesky` is the command of this repository."""
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)
    program = programs / "truesky"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m truesky.commands "$@"\n')
    program.chmod(0o755)
    path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
    result = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{script}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def test_there_is_a_walk_for_each_kind_of_user():
    assert [page.stem for page in PAGES] == ["cluster", "ground", "slitless", "sql", "weak_lensing"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_requests_of_a_walk_are_valid_and_its_code_has_no_syntax_errors(page, folder):
    """Blocks before the first run are executed; of shell scripts, only the checks of requests."""
    has_run = False
    for language, example in blocks(page, folder):
        if language == "sh":
            subprocess.run(["bash", "-n", "-c", example.parsed], check=True)
            for check in re.findall(r"^truesky (check .*)$", example.parsed, re.MULTILINE):
                # In this process, because importing the command takes longer than the check.
                assert __main__.main(shlex.split(check)) == 0, check
            has_run = has_run or "truesky run" in example.parsed
        elif language == "python" and has_run:
            compile(example.parsed, str(page), "exec")
        else:
            example.evaluate()
    assert has_run


@pytest.mark.nightly
@pytest.mark.spark
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_all_steps_of_a_walk_work(page, folder):
    for _, example in blocks(page, folder):
        example.evaluate()
