"""The command: its output, and errors in one line."""

import http.client
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from tests.waiting import PATIENCE
from truesky.page.__main__ import main

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--host", "0.0.0.0", "--token", "0123456789abcdef"],
            "--host 0.0.0.0 accepts connections from other machines: give --called NAME, the name or address that they",
        ),
        (["--host", "0.0.0.0", "--called", "here.example"], "so --token is required"),
        (["--called", "here.example"], "so --token is required"),
        (["--host", "0.0.0.0", "--called", "a b"], "'a b' is not a host name"),
        (["--host", "192.0.2.1"], "so --token is required"),
        (["--token", "short"], "--token must have 16 to 256"),
        (["--token", "0123456789abcde"], "--token must have 16 to 256"),
        (["--token", "0123456789abcdef;"], "--token must have 16 to 256"),
        (["--token", ""], "--token must have 16 to 256"),
        (["--port", "70000"], "--port 70000 is outside [0, 65535]"),
        (["--timeout", "-1"], "timeout = -1.0 is outside"),
        (["--name", "nobody"], "has no request nobody"),
    ],
)
def test_refusals(shown, capsys, words, said):
    assert main([str(shown), "--no-open", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("truesky page: ")
    assert said in line


def test_a_folder_that_is_no_lake(tmp_path, capsys):
    assert main([str(tmp_path), "--no-open"]) == 2
    assert "is not a lake" in capsys.readouterr().err


def test_a_port_that_is_taken(page, shown, capsys):
    assert main([str(shown), "--no-open", "--port", str(page.gate.port)]) == 1
    assert "in use" in capsys.readouterr().err


def test_no_lake(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["--no-open"])
    assert "LAKE is missing" in capsys.readouterr().err


def test_other_machines_may_only_use_the_given_name(shown):
    """A server on all interfaces answers under the given name and under names of this machine, and under no other."""
    command = [sys.executable, "-m", "truesky.page", str(shown), "--no-open", "--host", "0.0.0.0"]
    command += ["--called", "Sky.example", "--called", "192.0.2.7", "--token", "a-token-of-the-tests"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = server.stdout.readline().split()[-1]
            site, _, token = address.partition("/?token=")
            assert (site.rpartition(":")[0], token) == ("http://sky.example", "a-token-of-the-tests")
            port = int(site.rpartition(":")[2])
            for name, status in (
                ("sky.example", 303), ("192.0.2.7", 303), ("127.0.0.1", 303), ("0.0.0.0", 403), ("evil.example", 403),
            ):  # fmt: skip
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
                connection.request("GET", f"/?token={token}", headers={"Host": f"{name}:{port}"})
                assert (name, connection.getresponse().status) == (name, status)
                connection.close()
        finally:
            server.send_signal(signal.SIGINT)


def test_it_answers_until_it_is_stopped(shown):
    command = [sys.executable, "-m", "truesky.page", str(shown), "--no-open"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        address = server.stdout.readline().split()[-1]
        tap = server.stdout.readline().split()[-1]
        assert urllib.request.urlopen(f"{tap}/availability", timeout=PATIENCE).status == 200
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(address.partition("?")[0], timeout=PATIENCE)
        server.send_signal(signal.SIGINT)
        assert server.wait(PATIENCE) == 0
        assert server.stderr.read() == ""


def test_the_first_sky_waits_for_nothing_that_draws_images():
    """Libraries that take long to load are not loaded before the server listens."""
    slow = ("astropy", "galsim", "healpy.pixelfunc", "matplotlib", "numba", "scipy")
    text = f"import sys, truesky.page.__main__; print([name for name in {slow} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert done.stdout == "[]\n"
