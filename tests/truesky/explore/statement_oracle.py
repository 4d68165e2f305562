"""Run SQL without the guard in a DuckDB database that contains secrets, and describe which rules a statement breaks.

Nothing here uses the guard, or the syntax tree that it checks. DuckDB's plan, made without its optimizer, tells which
tables a statement reads. The statement then runs in a transaction that must not write, and with DuckDB's full access to
files. Times of access tell whether it has read a file.
"""

import contextlib
import json
import os
import threading

import duckdb

SECRET = "canary-5f1d"
# Operators of plans without children that read rows which the query itself contains or computes.
HARMLESS = {
    "COLUMN_DATA_SCAN", "CTE_SCAN", "DELIM_SCAN", "DUMMY_SCAN", "EMPTY_RESULT", "GENERATE_SERIES", "RANGE",
    "REC_CTE_SCAN", "UNNEST",
}  # fmt: skip
# Time after which a statement is interrupted (s).
MOST_SECONDS = 2.0
_STATE = """SELECT (SELECT list(s ORDER BY name) FROM duckdb_settings() s), (SELECT list(t) FROM duckdb_tables() t),
    (SELECT list(sql) FROM duckdb_views() WHERE NOT internal), (SELECT list(value) FROM duckdb_variables()),
    (SELECT list(s) FROM duckdb_sequences() s), (SELECT list(database_name) FROM duckdb_databases()),
    (SELECT list(name) FROM duckdb_prepared_statements()), (SELECT list(t) FROM memory.main.plain t),
    (SELECT list(t) FROM memory.main.galaxies t)"""


class Oracle:
    """Database with tables of a lake and with secrets: a table, a variable, a setting and a file.

    Parameters
    ----------
    folder : Path
        Empty folder. Statements should run in it, so that relative names of files are in it, too.
    tables : mapping of str to sequence of str
        Columns of the tables that statements may read.
    """

    def __init__(self, folder, tables):
        self.folder, self.tables = folder, tables
        self.file, self.new = folder / "secrets" / "secret.csv", folder / "new"
        self.file.parent.mkdir()
        self.file.write_text(f"word,number\n{SECRET},1\n")
        # IMPORT DATABASE reads these.
        (self.file.parent / "schema.sql").write_text(f"CREATE TABLE imported AS SELECT '{SECRET}' AS word;")
        (self.file.parent / "load.sql").touch()
        self.files = self._files()
        self.paths = {"file": str(self.file), "folder": str(self.file.parent), "new": str(self.new)}
        self.open()

    def open(self):
        """Open a new database."""
        self.database = duckdb.connect(":memory:", config={"threads": 1, "custom_user_agent": SECRET})
        for name, columns in self.tables.items():
            rows = ", ".join(f"i AS {column}" for column in columns)
            self.database.execute(f"CREATE TABLE {name} AS SELECT {rows} FROM range(5) t(i)")
        for text in (
            "SET memory_limit = '400MB'", "SET temp_directory = ''", "SET autoinstall_known_extensions = false",
            "SET autoload_known_extensions = false", f"SET VARIABLE canary = '{SECRET}'", "CREATE SEQUENCE numbers",
            f"CREATE TABLE hidden AS SELECT '{SECRET}' AS word",
            "CREATE MACRO mag_ab(f_nu) AS 23.9 - 2.5 * log10(CASE WHEN f_nu > 0 THEN f_nu END)",
        ):  # fmt: skip
            self.database.execute(text)
        self.planner = self.database.cursor()
        self.planner.execute("PRAGMA disable_optimizer")
        self.state = self.database.execute(_STATE).fetchall()

    def judge(self, text):
        """Run a statement.

        Returns
        -------
        outcome : str
            "ran", "stopped" after 2 s, or the type of DuckDB's error.
        violations : list of str
            The rules that the statement broke.
        """
        self._forget_access()
        outcome, violations, answers = "ran", [], []
        try:
            with self._limited_time():
                violations += self._foreign_tables(text)
                self.database.execute("BEGIN TRANSACTION READ ONLY")
                answers.append(self.database.execute(text).fetchmany(1000))
        except duckdb.InterruptException:
            outcome = "stopped"
        except (duckdb.Error, ValueError, OverflowError, ImportError) as error:
            # Python has no values for some results, such as dates beyond the year 9999.
            outcome = type(error).__name__
            answers.append(error)
            if "read-only" in str(error):
                violations.append("writes")
        if SECRET in f"{answers}":
            violations.append("tells a secret")
        # The times come first, because a listing is an access, too.
        if self._is_read() or self._files() != self.files:
            violations.append("uses files")
        with contextlib.suppress(duckdb.Error):
            # There is no transaction if the plan failed.
            self.database.execute("ROLLBACK")
        return outcome, violations

    @contextlib.contextmanager
    def _limited_time(self):
        timer = threading.Timer(MOST_SECONDS, self.database.interrupt)
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _foreign_tables(self, text):
        """Return what a statement reads other than the allowed tables, by its plan."""
        found = []
        try:
            plans = [json.loads(row[1]) for row in self.planner.execute(f"EXPLAIN (FORMAT json) {text}").fetchall()]
        except duckdb.ParserException:
            # Some statements have no plan, and run all the same.
            return []
        stack = [node for plan in plans for node in plan]
        while stack:
            node = stack.pop()
            stack += node["children"]
            name = node["extra_info"].get("Table", node["name"]).removeprefix("memory.main.")
            if not node["children"] and name not in HARMLESS and name not in self.tables:
                found.append(f"reads {name}")
        return found

    def changes(self):
        """Return ["changes the session"] and open a new database if the database differs from its first state."""
        found = ["changes the session"]
        try:
            if self.database.execute(_STATE).fetchall() == self.state:
                return []
        except duckdb.FatalException:
            # An internal error of DuckDB closes the database. The process of queries ends then, and a new one starts.
            found = []
        except duckdb.Error:
            pass
        self.open()
        return found

    def _files(self):
        paths = [*self.folder.rglob("*")]
        return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in paths if path.is_file()}

    def _watched(self):
        return (*self.files, self.file.parent)

    def _forget_access(self):
        """Set times of access to 1970, because the system only updates those that are before the last change."""
        for path in self._watched():
            os.utime(path, ns=(0, path.stat().st_mtime_ns))

    def _is_read(self):
        return any(path.stat().st_atime > 0 for path in self._watched())
