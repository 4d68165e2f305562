"""Completion of shells: the scripts know all commands and options, and the shells accept them."""

import shutil
import subprocess

import pytest

from truesky.command_line import commands
from truesky.commands import __main__ as truesky


def script(shell, capsys):
    assert truesky.main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_command_and_option_is_completed(shell, capsys):
    text = script(shell, capsys)
    for name in commands.COMMANDS:
        assert name in text
    assert "dry-run" in text
    assert "least-pixels" in text


@pytest.mark.parametrize("shell", [shell for shell in ("bash", "zsh", "fish") if shutil.which(shell)])
def test_a_shell_accepts_its_script(shell, capsys):
    done = subprocess.run([shell, "-n"], input=script(shell, capsys), text=True, capture_output=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_bash_completes_commands_options_and_folders(capsys, tmp_path):
    (tmp_path / "my_lake").mkdir()
    text = script("bash", capsys)

    def completions(*words):
        line = " ".join(words)
        call = f"COMP_WORDS=({' '.join(repr(word) for word in words)}); COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'"
        code = f"{text}\n{call}; _shtab_truesky; printf '%s\\n' \"${{COMPREPLY[@]}}\""
        done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True)
        return set(done.stdout.split())

    assert completions("truesky", "va") == {"validate"}
    assert "--dry-run" in completions("truesky", "run", "--d")
    assert "my_lake" in completions("truesky", "sql", "my")


def test_other_shells_are_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        truesky.main(["completion", "csh"])
    assert "csh" in capsys.readouterr().err
