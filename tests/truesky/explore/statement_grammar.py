"""Numbered random SQL statements: queries of the lake's tables, and attempts to reach more than these tables.

A statement contains {file}, {folder} and {new}, which `write` replaces with paths. The statements with even numbers are
queries that the guard should accept. The others contain at least one hostile part.
"""

import random

# Tables of the lake that queries may read, with some of their numeric columns.
TABLES = {"galaxies": ("id", "ra", "dec", "z_obs", "kind"), "plain": ("id", "value")}
BLANKS = (" ", " ", " ", "  ", "\n", "\t", " /* ; ' \" */ ", " --;\n", "/**/ ")
# DuckDB takes these for blanks in some places only.
FOREIGN_BLANKS = ("\u00a0", "\u2003", "\u2028")
NAMES = ("a", "b", "c", '"d"', '"é"', '"select"', '"A b;"', '"x""y"')
LITERALS = (
    "1", "-2", "0.5", "1e3", "NULL", "true", "'x'", "'it''s'", "'{file}'", "''", "'\u2003;--'", "$$;$$", "[1,2]",
    "{'k':1}", "DATE '2030-01-01'", "INTERVAL 1 DAY", "'a'::BLOB", "1::DECIMAL(9,2)", "MAP {'k':1}",
)  # fmt: skip
OPERATORS = ("+", "-", "*", "/", "//", "%", "=", "<>", "<", ">=", "AND", "OR", "||", "IS DISTINCT FROM", "^", "&")
TYPES = (
    "INTEGER",
    "DOUBLE",
    "VARCHAR",
    "BIGINT[]",
    "BLOB",
    "DATE",
    "STRUCT(k INTEGER)",
    "JSON",
    "UUID",
    "BIT",
    "VARIANT",
)
FUNCTIONS = (
    "abs", "sqrt", "round", "coalesce", "greatest", "mag_ab", "len", "upper", "hash", "typeof", "concat", "list_value",
    "to_json", "md5",
)  # fmt: skip
AGGREGATES = ("count", "min", "max", "any_value", "list", "first", "approx_count_distinct", "mode")
JOINS = ("JOIN", "LEFT JOIN", "FULL JOIN", "SEMI JOIN", "ANTI JOIN")
SET_OPERATIONS = ("UNION", "UNION ALL", "UNION BY NAME", "INTERSECT", "EXCEPT", "EXCEPT ALL")
# Entries of FROM that are not tables of the lake.
FOREIGN_SOURCES = (
    "'{file}'", '"{file}"', "'{folder}/*.csv'", "read_text('{file}')", "read_blob(['{file}'])", "read_csv('{file}')",
    "read_csv_auto('{file}',header=false)", "read_json('{file}')", "read_ndjson_objects('{file}')",
    "glob('{folder}/*')",
    "sniff_csv('{file}')", "read_parquet('{file}')", "parquet_metadata('{file}')", "parquet_scan('{file}')",
    "hidden", '"hidden"', "main.hidden", "memory.main.hidden", "memory.galaxies", "Hidden", "sqlite_master",
    "duckdb_settings()", "duckdb_secrets()", "duckdb_variables()", "duckdb_tables()", "information_schema.tables",
    "pg_catalog.pg_class", "pg_class", "query('SELECT*FROM{{hidden}}')", "query_table('hidden')",
    "query_table(['hidden'])",
    "pragma_version()", "json_execute_serialized_sql(json_serialize_sql('FROM hidden'))", "json_each('[1]')",
    "repeat(1,2)", "test_all_types()", "which_secret('s3://x','s3')", "summary((FROM hidden))", "(SUMMARIZE hidden)",
    "(DESCRIBE hidden)", "(SHOW TABLES)", "(PIVOT hidden ON word)", "(UNPIVOT hidden ON word)", "checkpoint()",
    "enable_logging()", "force_checkpoint()", "seq_scan('hidden')", "histogram_values(hidden,word)",
    "python_map_function(1)",
    "icu_calendar_names()", "duckdb_logs", "enable_profiling()", "read_duckdb('{file}')", "pg_timezone_names()",
)  # fmt: skip
# Expressions that read or change the session, wait, or run a text as SQL.
FOREIGN_EXPRESSIONS = (
    "getvariable('canary')", "current_setting('custom_user_agent')", "getenv('HOME')", "nextval('numbers')",
    "currval('numbers')", "setval('numbers',7)", "setseed(0.5)", "write_log('x')", "sleep_ms(1)", "pg_sleep(0.001)",
    "current_query()", "json_serialize_sql('SELECT 1')",
    "json_serialize_plan('SELECT current_setting(''custom_user_agent'')',optimize:=true)",
    "json_deserialize_sql(json_serialize_sql('SELECT 1'))", "system.main.getvariable('canary')",
    "'canary'.getvariable()",
    '"getvariable"(\'canary\')', "GetVariable('canary')", "(SELECT content FROM read_text('{file}'))",
    "(SELECT word FROM hidden)", "(FROM '{file}')", "EXISTS (FROM read_text('{file}'))",
    "ARRAY(SELECT word FROM hidden)",
    "list_transform([1],lambda x:getvariable('canary'))", "[getvariable('canary') for x in [1]]",
    "(WITH hidden AS (SELECT * FROM hidden) SELECT word FROM hidden)", "pg_get_viewdef(1)", "pg_size_pretty(1)",
    "get_block_size('memory')",
)  # fmt: skip
# Other statements; {query} is a query.
STATEMENTS = (
    "INSERT INTO plain {query}", "INSERT INTO plain VALUES (1,2)", "UPDATE plain SET value = 0", "DELETE FROM plain",
    "MERGE INTO plain USING galaxies ON plain.id = galaxies.id WHEN MATCHED THEN DELETE", "TRUNCATE plain",
    "CREATE TABLE x AS {query}", "CREATE OR REPLACE VIEW plain AS {query}", "CREATE TEMP TABLE x (a INTEGER)",
    "CREATE MACRO f() AS 1", "CREATE SCHEMA s", "CREATE SEQUENCE s", "CREATE TYPE t AS ENUM ('a')",
    "CREATE SECRET s (TYPE s3, KEY_ID 'x')", "CREATE INDEX i ON plain (id)", "DROP TABLE plain",
    "DROP VIEW IF EXISTS plain",
    "ALTER TABLE plain RENAME TO x", "COMMENT ON TABLE plain IS 'x'", "COPY plain TO '{new}'",
    "COPY ({query}) TO '{new}'",
    "COPY ({query}) TO '{new}' (FORMAT parquet)", "COPY plain FROM '{file}'", "EXPORT DATABASE '{new}'",
    "IMPORT DATABASE '{folder}'", "ATTACH '{new}'", "ATTACH '{new}' AS x (TYPE sqlite)", "DETACH memory", "USE memory",
    "INSTALL httpfs", "LOAD httpfs", "LOAD '{file}'", "FORCE INSTALL spatial FROM '{folder}'", "SET threads = 1",
    "SET VARIABLE canary = 1", "SET GLOBAL memory_limit = '9GB'", "SET enable_external_access = true",
    "RESET lock_configuration", "RESET VARIABLE canary", "PRAGMA database_list", "PRAGMA enable_profiling",
    "PRAGMA table_info('hidden')", "PRAGMA import_database('{folder}')", "CALL pragma_version()",
    "CALL enable_logging()",
    "CALL force_checkpoint()", "PREPARE p AS {query}", "EXECUTE p", "DEALLOCATE p", "EXPLAIN {query}",
    "EXPLAIN ANALYZE {query}", "DESCRIBE hidden", "SHOW TABLES", "SHOW ALL TABLES", "SUMMARIZE hidden", "BEGIN",
    "COMMIT",
    "ROLLBACK", "CHECKPOINT", "VACUUM", "ANALYZE", "PIVOT plain ON value", "UNPIVOT plain ON value",
    "PIVOT (FROM read_text('{file}')) ON content", "WITH w AS (INSERT INTO plain VALUES (1,2) RETURNING id) FROM w",
)  # fmt: skip


class Grammar:
    """Generator of one statement.

    Parameters
    ----------
    rng : random.Random
        Source of the choices.
    functions : sequence of str
        Names of all functions of DuckDB. A hostile statement can call any of them.
    """

    def __init__(self, rng, functions):
        self.rng, self.functions = rng, functions
        # Number of hostile parts that are still to be placed.
        self.hostile = 0
        self.clauses = []

    def has(self, chance):
        return self.rng.random() < chance

    def source(self, depth):
        """Return an entry of FROM."""
        if self.hostile and self.has(0.4):
            self.hostile -= 1
            return self.rng.choice(FOREIGN_SOURCES)
        choice = self.rng.randrange(10 if depth else 6)
        if choice < 4:
            name = self.rng.choice([*TABLES, *self.clauses])
            name = self.rng.choice((name, f'"{name}"')) if '"' not in name else name
            alias = f" AS {self.rng.choice(NAMES)}" if self.has(0.3) else ""
            return f"{name}{alias}" + (" TABLESAMPLE 3 ROWS" if self.has(0.05) else "")
        if choice == 4:
            return self.rng.choice(("range(3)", "generate_series(1,3)", "unnest([1,2])"))
        if choice == 5:
            return f"(VALUES (1,2)) AS {self.rng.choice(NAMES)}"
        if choice < 8:
            return f"{'LATERAL ' if self.has(0.1) else ''}({self.query(depth - 1)}) AS {self.rng.choice(NAMES)}"
        join = self.rng.choice(JOINS)
        return f"{self.source(depth - 1)} {join} {self.source(0)} ON {self.rng.choice(('true', '1 = 1'))}"

    def expression(self, columns, depth):
        """Return an expression; `columns` are the names that it can use."""
        if self.hostile and self.has(0.3):
            self.hostile -= 1
            return self.foreign_expression(columns)
        if not depth or self.has(0.3):
            return self.rng.choice((*columns, *columns, *LITERALS))
        part = lambda: self.expression(columns, depth - 1)  # noqa: E731
        choice = self.rng.randrange(13)
        if choice < 3:
            return f"({part()} {self.rng.choice(OPERATORS)} {part()})"
        if choice < 5:
            return f"{self.rng.choice(FUNCTIONS)}({part()})"
        return (
            lambda: f"CASE WHEN {part()} IS NULL THEN {part()} ELSE {part()} END",
            lambda: f"TRY_CAST({part()} AS {self.rng.choice(TYPES)})",
            lambda: f"({part()})::VARCHAR",
            lambda: f"(SELECT {self.rng.choice(AGGREGATES)}(a0) FROM ({self.query(depth - 1)}) AS s(a0))",
            lambda: f"EXISTS ({self.query(depth - 1)})",
            lambda: f"list_transform([1,2], lambda x: x + {self.rng.choice(columns or ('1',))})",
            lambda: f"{{'k':{part()}, 'l':[{part()}]}}",
            lambda: f"({part()} BETWEEN {part()} AND {part()})",
        )[choice - 5]()

    def foreign_expression(self, columns):
        """Return a forbidden expression, or a call of any function of DuckDB, which may be harmless."""
        if self.has(0.6):
            return self.rng.choice(FOREIGN_EXPRESSIONS)
        arguments = [self.rng.choice((*columns, *LITERALS)) for _ in range(self.rng.randrange(4))]
        schema = self.rng.choice(("", "", "main.", "system.main.", "pg_catalog."))
        return f'{schema}"{self.rng.choice(self.functions)}"({",".join(arguments)})'

    def query(self, depth):
        """Return a query with at most `depth` levels of subqueries."""
        clauses, text = len(self.clauses), ""
        if depth and self.has(0.25):
            name = self.rng.choice(("w", "v", '"plain"', "galaxies"))
            form = self.rng.choice(("", "", "MATERIALIZED ", "NOT MATERIALIZED "))
            text = f"WITH {name} AS {form}({self.query(depth - 1)}) "
            self.clauses.append(name)
        elif depth and self.has(0.05):
            text = "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r WHERE n < 4) "
            self.clauses.append("r")
        text += self.select(depth)
        del self.clauses[clauses:]
        if depth and self.has(0.15):
            # The same number of columns on both sides.
            text = (
                f"SELECT 1 AS a0 FROM ({text}) {self.rng.choice(SET_OPERATIONS)} SELECT 2 AS a0 FROM {self.source(0)}"
            )
        return text

    def select(self, depth):
        """Return a SELECT without WITH."""
        if self.has(0.1):
            return (
                self.rng.choice(("FROM {0}", "SELECT * FROM {0}", "SELECT * EXCLUDE (id) FROM {0}")).format(
                    self.rng.choice([*TABLES])
                )
                if not self.hostile
                else f"FROM {self.source(depth)}"
            )
        if self.has(0.5):
            table = self.rng.choice([*TABLES])
            sources, columns = table, TABLES[table]
        else:
            sources, columns = self.source(depth), ()
            if self.has(0.1):
                sources += f", {self.source(0)}"
        if self.hostile and self.has(0.2):
            sources += f", {self.source(0)}"
        items = ", ".join(
            f"{self.expression(columns, depth)}{f' AS a{i}' if self.has(0.6) else ''}"
            for i in range(self.rng.choice((1, 1, 2)))
        )
        text = f"SELECT {'DISTINCT ' if self.has(0.1) else ''}{items} FROM {sources}"
        if self.has(0.3):
            text += f" WHERE {self.expression(columns, depth)} IS NOT NULL"
        if self.has(0.1):
            text += " GROUP BY ALL"
        elif self.has(0.05):
            text += f" QUALIFY row_number() OVER (ORDER BY {self.expression(columns, 0)}) < 3"
        if self.has(0.2):
            text += " ORDER BY ALL"
        if self.has(0.2):
            text += f" LIMIT {self.rng.choice(('3', '10%', '(SELECT 2)'))} OFFSET 1"
        return text

    def statement(self):
        """Return a hostile statement."""
        choice = self.rng.randrange(20)
        if choice < 6:
            text = self.rng.choice(STATEMENTS).replace("{query}", self.query(1))
        elif choice < 8:
            parts = [self.rng.choice(STATEMENTS).replace("{query}", self.query(0)), self.query(1)]
            self.rng.shuffle(parts)
            text = self.rng.choice((" ; ", ";", " ;; ", " /* */ ; -- \n ")).join(parts)
        elif choice == 8:
            depth = self.rng.choice((20, 300, 1200))
            text = "SELECT " + "(" * depth + "getvariable('canary')" + ")" * depth
        else:
            self.hostile = self.rng.choice((1, 1, 1, 2))
            text = self.query(self.rng.choice((1, 2, 3)))
            if self.hostile:
                text = f"SELECT * FROM ({text}) AS q , {self.rng.choice(FOREIGN_SOURCES)} AS z"
        if self.has(0.1):
            # Cut the text, or repeat a part of it.
            place = self.rng.randrange(len(text) + 1)
            text = text[:place] + self.rng.choice(
                ("", ";", "'", "\\", "\ufeff", "\u200b", "\ud800", "\0", text[place // 2 :])
            )
        return text


def write(number, functions, paths):
    """Return statement `number`.

    Parameters
    ----------
    number : int
        Number of the statement. Even numbers are queries that should be accepted.
    functions : sequence of str
        Names of all functions of DuckDB.
    paths : dict of str to str
        Paths that replace {file}, {folder} and {new}.

    Returns
    -------
    str
        The text of the statement.
    """
    rng = random.Random(number)
    grammar = Grammar(rng, functions)
    text = grammar.statement() if number % 2 else grammar.query(rng.choice((0, 1, 1, 2, 2, 3)))
    words = text.split(" ")
    if rng.random() < 0.5:
        words = [rng.choice((word, word.lower(), word.upper())) if word.isalpha() else word for word in words]
    if rng.random() < 0.5:
        blanks = (*BLANKS, *FOREIGN_BLANKS) if number % 8 == 1 else BLANKS
        text = words[0] + "".join(rng.choice(blanks) + word for word in words[1:])
    else:
        text = " ".join(words)
    for name, path in paths.items():
        text = text.replace(f"{{{name}}}", path)
    return text
