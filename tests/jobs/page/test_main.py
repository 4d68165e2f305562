"""The command: what it prints, and what it refuses in one line."""

import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from jobs.page.__main__ import main

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--host", "0.0.0.0"], "--token of 16 characters is wanted"),
        (["--host", "0.0.0.0", "--token", "short"], "--token of 16 characters is wanted"),
        (["--port", "70000"], "--port 70000: wanted 0 to 65535"),
        (["--timeout", "-1"], "timeout = -1.0 is outside"),
        (["--name", "nobody"], "has no request nobody"),
    ],
)
def test_refusals(shown, capsys, words, said):
    assert main([str(shown), "--no-open", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("page: ")
    assert said in line


def test_a_folder_that_is_no_lake(tmp_path, capsys):
    assert main([str(tmp_path), "--no-open"]) == 2
    assert "holds no table" in capsys.readouterr().err


def test_a_port_that_is_taken(page, shown, capsys):
    assert main([str(shown), "--no-open", "--port", str(page.gate.port)]) == 1
    assert "in use" in capsys.readouterr().err


def test_it_answers_until_it_is_stopped(shown):
    command = [sys.executable, "-m", "jobs.page", str(shown), "--no-open"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        address = server.stdout.readline().split()[-1]
        tap = server.stdout.readline().split()[-1]
        assert urllib.request.urlopen(f"{tap}/availability", timeout=30).status == 200
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(address.partition("?")[0], timeout=30)
        server.send_signal(signal.SIGINT)
        assert server.wait(30) == 0
        assert server.stderr.read() == ""
