"""Each of many random statements is refused in one line, or reads nothing but tables of the lake."""

import collections
import os
import time
import warnings

import pytest

from lake_schema.errors import BadInput
from tests.truesky.explore import statement_grammar
from tests.truesky.explore.conftest import make_lake
from tests.truesky.explore.statement_oracle import SECRET, Oracle
from tests.waiting import PATIENCE
from truesky.explore import guard
from truesky.explore.explorer import Explorer

STATEMENTS, MANY_STATEMENTS = 120, 10_000
# The state of the session is compared after this number of statements.
BLOCK = 40
# Longest CPU time (s) in which a statement is checked, by the guard and by this test.
MOST_SECONDS = 2.0


@pytest.fixture
def oracle(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Oracle(tmp_path, statement_grammar.TABLES)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """An explorer of a lake with few rows, so that products of many tables are small."""
    with Explorer(make_lake(tmp_path_factory.mktemp("small") / "lake", 5), timeout=PATIENCE) as opened:
        yield opened


def check(oracle, explorer, numbers):
    """Return the violations of the rules by numbered statements, and the number of statements with each outcome."""
    parser, violations, outcomes = guard.parser(), [], collections.Counter()
    functions = functions_of(oracle.database)
    for number in numbers:
        text = statement_grammar.write(number, functions, oracle.paths)
        started = time.process_time()
        try:
            guard.check_query(text, explorer.versions, parser)
        except BadInput as error:
            message = str(error)
            outcomes["refused"] += 1
            if not message.startswith("SQL: ") or len(message.splitlines()) != 1 or len(message) > 1200:
                violations.append((number, "the message has not one short line", message))
            if number % 2 == 0 and (outcome := oracle.judge(text)) == ("ran", []):
                violations.append((number, "a harmless query is refused", text, message))
        else:
            outcome, found = oracle.judge(text)
            outcomes[f"accepted: {outcome}"] += 1
            violations += [(number, problem, text) for problem in found]
            if outcome != "stopped":
                violations += [(number, problem, text) for problem in run(explorer, text)]
        if (seconds := time.process_time() - started) > MOST_SECONDS:
            violations.append((number, f"takes {seconds:.1f} s", text))
        if number % BLOCK == BLOCK - 1 or number == numbers[-1]:
            violations += [(number, f"or one of the {BLOCK} before {problem}") for problem in oracle.changes()]
    return violations, outcomes


def functions_of(database):
    """Return the names of all functions of DuckDB, sorted."""
    rows = database.execute("SELECT DISTINCT function_name FROM duckdb_functions() ORDER BY 1").fetchall()
    # These can need any amount of memory, wherever a number is their argument. The process of queries limits it.
    large = {"range", "generate_series", "repeat", "lpad", "rpad", "bar", "list_resize", "array_resize"}
    return [name for (name,) in rows if name not in large]


def run(explorer, text):
    """Run an accepted query as users do, and return the rules that it breaks."""
    try:
        answer = f"{explorer.sql(text)}"
    except BadInput as error:
        answer = str(error)
        if not answer.startswith("SQL: ") or len(answer.splitlines()) != 1:
            return [f"the message has not one line: {answer}"]
    return ["tells a secret"] if SECRET in answer else []


@pytest.mark.parametrize("numbers", [range(STATEMENTS)], ids=["few"])
def test_random_statements_are_refused_or_read_tables_of_the_lake(oracle, small, numbers):
    violations, outcomes = check(oracle, small, numbers)
    assert violations == []
    # Neither everything is refused nor everything accepted.
    assert outcomes["accepted: ran"] > len(numbers) / 10, outcomes
    assert outcomes["refused"] > len(numbers) / 3, outcomes


@pytest.mark.nightly
def test_many_random_statements_are_refused_or_read_tables_of_the_lake(oracle, small):
    violations, outcomes = check(oracle, small, range(MANY_STATEMENTS))
    warnings.warn(f"outcomes of {MANY_STATEMENTS} statements: {dict(outcomes)}", stacklevel=1)
    assert violations == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("SELECT word FROM hidden", "tells a secret"),
        ("SELECT count(*) FROM hidden", "reads hidden"),
        ("WITH x AS (SELECT * FROM galaxies, hidden) SELECT count(*) FROM x", "reads hidden"),
        ("SELECT get_block_size('memory')", "reads PRAGMA_DATABASE_SIZE"),
        ("SELECT word FROM '{file}'", "reads READ_CSV_AUTO"),
        ("SELECT length(content) FROM read_text('{file}')", "reads READ_TEXT"),
        ("SELECT * FROM glob('{folder}/*')", "reads GLOB"),
        ("COPY plain TO '{new}'", "uses files"),
        ("COPY plain TO 'relative.csv'", "uses files"),
        ("ATTACH '{new}'", "uses files"),
        ("IMPORT DATABASE '{folder}'", "writes"),
        ("INSERT INTO plain VALUES (1, 2)", "writes"),
        ("SELECT 1; CREATE TABLE x (a INTEGER)", "writes"),
        ("SELECT nextval('numbers')", "writes"),
        ("SELECT getvariable('canary')", "tells a secret"),
        ("SELECT error(getvariable('canary'))", "tells a secret"),
        ("SELECT json_serialize_plan('SELECT getvariable(''canary'')', optimize := true)", "tells a secret"),
        ("SET threads = 3", "changes the session"),
        ("SELECT 1; SET threads = 3", "changes the session"),
        ("PREPARE p AS SELECT 1", "changes the session"),
    ],
)
def test_oracle_detects_violations(oracle, text, problem):
    """Without the guard, the statements that it must refuse break the rules."""
    for name, path in oracle.paths.items():
        text = text.replace(f"{{{name}}}", path)
    assert problem in [*oracle.judge(text)[1], *oracle.changes()]


@pytest.mark.parametrize("text", ["SELECT word FROM '{file}'", "SELECT count(*) FROM glob('{folder}/*')"])
def test_oracle_notices_reading_by_times_of_access(oracle, text):
    os.utime(oracle.file, (0, oracle.file.stat().st_mtime))
    # A file system that is mounted with noatime gives the oracle nothing to notice; its other checks do not need it.
    oracle.file.read_text()
    if oracle.file.stat().st_atime == 0:
        pytest.skip("this file system is mounted without times of access (noatime)")
    assert "uses files" in oracle.judge(text.format(**oracle.paths))[1]


def test_statements_are_reproducible(oracle):
    functions = functions_of(oracle.database)
    first, second = ([statement_grammar.write(n, functions, oracle.paths) for n in range(100)] for _ in range(2))
    assert first == second
    assert len(set(first)) > 90
