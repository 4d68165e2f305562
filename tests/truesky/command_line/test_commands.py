"""Help, errors and completion of the commands of `truesky`, and how long they take."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from truesky.command_line import commands, simulation
from truesky.commands import __main__ as truesky

ROOT = Path(__file__).resolve().parents[3]
# Modules that take long to import. Help and messages about wrong arguments must not need them.
HEAVY = ("numpy", "pyarrow", "duckdb", "pandas", "pyspark", "scipy", "numba", "astropy", "matplotlib", "shtab")
WORDS = {
    "mission": ["list"], "push": ["s3://x/y"], "stack": ["--out", "x"], "masters": ["--out", "x"],
    "reduce": ["--out", "x"], "export": ["--out", "x"],
}  # fmt: skip


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_the_help_of_every_command_has_its_usage_and_an_example(name, capsys):
    with pytest.raises(SystemExit, match="0"):
        truesky.main([name, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: truesky {name} [-h]")
    assert f"Example: truesky {name}" in " ".join(text.split())
    assert "python -m" not in text


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_examples_are_accepted(name):
    words = re.findall(r'"[^"]*"|\S+', commands.COMMANDS[name].example.partition(">")[0])
    assert commands.parse(name, [word.strip('"') for word in words]).command == name


def test_the_help_lists_every_command_in_a_group():
    text = commands.help_text()
    assert max(map(len, text.splitlines())) <= 80
    assert {declared.group for declared in commands.COMMANDS.values()} == set(commands.GROUPS)
    for name, declared in commands.COMMANDS.items():
        assert f"\n  {name} {declared.positions}" in text
        assert declared.summary in text


def test_the_lake_is_the_first_argument_or_follows_the_request_or_what_is_exported():
    for name in commands.COMMANDS:
        usage = " ".join(commands.command_parser(name).format_usage().split())
        if "LAKE" in usage and name != "stack":
            assert re.search(r"\] (REQUEST |WHAT )?(LAKE|\[LAKE\])", usage), usage


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (["sql", "FROM x", "--lake", "l"], ("l", "FROM x")),
        (["sql", "--lake=l", "FROM x"], ("l", "FROM x")),
        (["sql", "l", "--", "--lake l"], ("l", "--lake l")),
        (["sql", "--lake", "l"], ("l", None)),
    ],
)
def test_the_lake_may_be_an_option(words, given):
    options = commands.parse(words[0], words[1:])
    assert (options.lake, options.sql) == given


def test_optional_positions_may_follow_options():
    assert commands.parse("describe", ["l", "--name", "demo", "galaxies"]).table == "galaxies"
    assert commands.parse("sql", ["l", "--name", "demo", "FROM x", "--json"]).sql == "FROM x"
    assert commands.parse("mission", ["list", "--json", "vis.*"]).pattern == "vis.*"


def test_request_and_lake_may_be_options_of_a_job():
    for words in (
        ["--lake", "l", "--request", "r"],
        ["r", "--lake", "l", "--bands", "x"],
        ["--bands", "x", "--", "r", "l"],
    ):
        options = commands.parse("fluxes", words)
        assert simulation.job_words(options)[:4] == ["--lake", "l", "--request", "r"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["valdiate", "lake"], 'truesky: valdiate is not a command; did you mean "validate"?'),
        (["run", "r", "l", "--limti", "3"], 'truesky run: there is no option --limti; did you mean "--limit"?'),
        (["run", "r", "l", "--lim=3"], 'truesky run: there is no option --lim; did you mean "--limit"?'),
        (["run", "r"], "truesky run: LAKE is missing; for example: truesky run requests/demo.toml my_lake --dry-run"),
        (
            ["masters"],
            "truesky masters: LAKE and --out are missing; for example: truesky masters my_lake --out masters",
        ),
        (["sql", "l", "--lake"], "truesky sql: there is no option --lake"),
        (["sql", "SELECT 1", "l"], 'truesky sql: the lake comes before the query: write truesky sql l "SELECT 1"'),
        (["sql", "select 1"], 'truesky sql: the lake comes before the query: write truesky sql LAKE "select 1"'),
        (
            ["sql", "--out", "a b.fits", "SELECT 1", "l"],
            "truesky sql: the lake comes before the query: write truesky sql l ",
        ),
        (
            ["sql", "l", "SELECT", "1", "--out", "a b.fits"],
            "truesky sql: the query must be in quotes: write truesky sql l \"SELECT 1\" --out 'a b.fits'",
        ),
        (
            ["run", "new_lake", "good.toml", "--dry-run"],
            "truesky run: the request comes before the lake: write truesky run good.toml new_lake --dry-run",
        ),
        (
            ["run", "--limit", "3", "--lake", "good.toml", "--request", "new_lake"],
            "truesky run: the request comes before the lake: write truesky run good.toml new_lake --limit 3",
        ),
        (["sql", "l", "SELECT", "1"], 'truesky sql: the query must be in quotes: write truesky sql l "SELECT 1"'),
        (["--lokal", "plan"], 'truesky: there is no option --lokal; did you mean "--local"?'),
        (["cache", "--clear"], 'truesky cache: there is no option --clear; did you mean "--prune"?'),
        (["mission", "dif"], "truesky mission: ACTION must be list, diff or camera, got 'dif'; did you mean \"diff\"?"),
        (["mission"], "truesky mission: list, diff or camera is missing; for example: truesky mission list"),
        (
            ["completion", "powershell"],
            "truesky completion: SHELL must be bash, zsh or fish, got 'powershell'; for example:",
        ),
        (
            ["run", "r", "l", "--limit", "all"],
            "truesky run: --limit must be a whole number, for example --limit 3, got 'all'",
        ),
        (["sql", "l", "--memory", "x"], "truesky sql: --memory must be a number, for example --memory 2.5, got 'x'"),
        (["reduce", "l", "--exposures", "1,2"], "truesky reduce: --exposures: write numbers without commas, got '1,2'"),
        (["render", "r", "l", "--limit"], "truesky render: --limit requires a value; see truesky render --help"),
        (["render", "r", "l", "--detectors"], "truesky render: --detectors requires at least one value"),
        (["run", "r", "l", "--dry-run=1"], "truesky run: --dry-run takes no value, got '1'"),
        (
            ["render", "r", "l", "--dry-run"],
            "truesky render: there is no option --dry-run; truesky plan REQUEST LAKE --dry-run prints a forecast;",
        ),
        (
            ["inject", "a.csv", "a.fits", "--psf", "0.8", "b.fits"],
            "truesky inject: the image comes before the rows: write truesky inject a.fits a.csv b.fits --psf 0.8",
        ),
        (
            ["stamps", "a.parquet", "l", "out"],
            "truesky stamps: the lake comes before the places: write truesky stamps l a.parquet out",
        ),
        (["cache", "--prune", "--all", "--limit", "1"], "truesky cache: --limit must not be used with --all"),
        (["list", "l", "galaxies", "stars"], "truesky list: unexpected argument stars"),
        (["list", "l", "galaxies", "a", "b"], "truesky list: unexpected arguments a b"),
        (["gc", "l", "--prune"], 'truesky gc: there is no option --prune; did you mean "--delete"?'),
        (["cache", "--delete"], 'truesky cache: there is no option --delete; did you mean "--prune"?'),
        (
            ["page", "x.toml"],
            "truesky page: LAKE must be the folder of a lake, but x.toml is a request: truesky run x.toml LAKE",
        ),
        (
            ["run", "r.toml", "l", "--detectors", "3-4,R22_S11"],
            "truesky run: --detectors: names are separated by blanks, not by commas: write --detectors 3-4 R22_S11",
        ),
    ],
)
def test_mistakes_are_one_line_with_status_2(words, said, capsys):
    with pytest.raises(SystemExit, match="2"):
        raise SystemExit(truesky.main(words))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(said)


@pytest.mark.parametrize("words", [["a.toml", "{}"], ["{}", "a.toml"]])
def test_a_check_needs_no_lake(words, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        commands.parse("check", [word.format(tmp_path) for word in words])
    remedy = "the command needs only a request: write truesky check a.toml"
    assert capsys.readouterr().err == f"truesky check: {tmp_path} is a folder, but {remedy}\n"


@pytest.mark.parametrize("name", ["run", "build", "fluxes", "plan", "render"])
def test_the_request_comes_before_the_lake(name, tmp_path, capsys):
    for words, message in (
        (["new_lake", "good.toml"], f"the request comes before the lake: write truesky {name} good.toml new_lake"),
        (
            ["a.toml", "b.toml"],
            "LAKE must be the folder of a lake, but b.toml is a request: truesky run b.toml LAKE makes",
        ),
    ):
        with pytest.raises(SystemExit, match="2"):
            truesky.main([name, *words])
        assert capsys.readouterr().err.startswith(f"truesky {name}: {message}")
    (tmp_path / "lake.toml").mkdir()
    assert commands.parse(name, ["r.toml", str(tmp_path / "lake.toml")]).lake.endswith("lake.toml")


def test_help_and_mistakes_import_no_heavy_module():
    code = f"""
import sys
from truesky.commands.__main__ import main
for words in (["--help"], ["valdiate"], *([name, "--help"] for name in {sorted(commands.COMMANDS)}), ["run", "r"]):
    try:
        main(words)
    except SystemExit:
        pass
print(*sorted(sys.modules.keys() & {set(HEAVY)}), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stderr.splitlines()[-1] == ""


def test_limits_in_the_help_are_those_of_queries():
    from truesky.explore import process

    options = commands.parse("sql", ["lake"])
    assert (options.memory * 1e9, options.timeout) == (process.MEMORY, process.TIMEOUT)


def test_defaults_in_the_help_are_those_of_the_reduction_and_of_push():
    from lake_schema.store.object_storage import push
    from truesky.reduction import reduce

    text = " ".join(commands.command_parser("reduce").format_help().split())
    limits = reduce.Limits()
    for value in (limits.threshold, limits.pixels):
        assert f"(default: {value:g})" in text
    assert f"default: {reduce._COSMIC_RAY_SIGMA:g} with --level2" in text
    assert f"(default: {push.THREADS})" in commands.command_parser("push").format_help()


def test_the_default_ladder_is_that_of_the_mission():
    from lake_schema.tables.mission import LADDER

    assert commands.parse("mission", ["list"]).of == ",".join(LADDER)
