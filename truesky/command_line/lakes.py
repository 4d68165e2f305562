"""Arguments of the commands that show, check and manage a lake."""

from __future__ import annotations

import os
from pathlib import Path

from truesky.command_line.parser import Parser

_ANY_LAKE = "folder of the lake, or s3://BUCKET/PREFIX"
_STORAGE = "URL of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)"


def _add_table_arguments(parser: Parser) -> None:
    parser.add_lake(_ANY_LAKE)
    parser.add_argument("table", nargs="?", metavar="TABLE", help="one table (default: all tables)")
    parser.add_argument("--endpoint-url", metavar="URL", help=_STORAGE)
    parser.add_argument("--json", action="store_true", help="print a JSON list")


def add_list_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky list`."""
    _add_table_arguments(parser)


def add_describe_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky describe`."""
    _add_table_arguments(parser)
    parser.add_argument("--name", help="only versions of this request (default: all requests)")


def add_verify_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky verify`."""
    add_describe_arguments(parser)
    parser.add_argument("--deep", action="store_true", help="read every byte and compare its sha256")


def add_gc_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky gc`."""
    parser.add_lake()
    parser.add_argument("table", nargs="?", metavar="TABLE", help="one table (default: all tables)")
    parser.add_argument("--delete", action="store_true", help="remove the listed folders (default: list only)")


def add_cache_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky cache`."""
    parser.add_argument("--prune", action="store_true", help="remove entries: by default those beyond the limit")
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--limit", type=float, metavar="GB", help="with --prune: size that may remain")
    amount.add_argument("--all", action="store_true", help="with --prune: remove all entries")
    amount.add_argument(
        "--older-than", type=float, metavar="DAYS", help="with --prune: remove entries that were not used for DAYS"
    )
    parser.add_argument(
        "--kind", nargs="+", metavar="KIND", default=[], help="list or remove only entries of these kinds"
    )
    parser.add_argument("--entries", action="store_true", help="list each entry")
    parser.add_argument("--json", action="store_true", help="print JSON")


def add_no_arguments(parser: Parser) -> None:
    """Declare nothing, for a command without arguments."""


def add_push_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky push`."""
    parser.add_lake()
    parser.add_argument("place", metavar="s3://BUCKET/PREFIX", help="address of the lake on object storage")
    parser.add_argument("--endpoint-url", metavar="URL", help=_STORAGE)
    parser.add_argument("--only", nargs="+", default=[], metavar="TABLE", help="tables to push; other tables stay")
    parser.add_argument("--threads", type=int, metavar="N", help="objects that are sent at a time (default: 16)")


def add_sql_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky sql`."""
    parser.add_lake(_ANY_LAKE)
    parser.add_argument("sql", nargs="?", metavar="QUERY", help="a SELECT, in DuckDB's SQL")
    parser.add_argument("--endpoint-url", metavar="URL", help=_STORAGE)
    parser.add_argument("--name", help="request whose tables are queried, if the lake contains several")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="write the rows to this .csv, .parquet, .fits or .vot file"
    )
    parser.add_argument("--json", action="store_true", help="print all rows as a JSON list")
    _add_query_limits(parser)


def _add_query_limits(parser: Parser) -> None:
    parser.add_argument("--memory", type=float, default=4.0, metavar="GB", help="memory limit of a query (default: 4)")
    parser.add_argument(
        "--timeout", type=float, default=300.0, metavar="S", help="time limit of a query in seconds (default: 300)"
    )


def add_report_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky report`."""
    parser.add_lake()
    parser.add_argument("--json", action="store_true", help="print a JSON list, null for unknown values")


def add_page_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky page`."""
    parser.add_lake(_ANY_LAKE)
    parser.add_argument("--endpoint-url", metavar="URL", help=_STORAGE)
    parser.add_argument("--name", help="show only the tables of the request with this name")
    parser.add_argument("--port", type=int, default=0, help="port to listen on (default: a free port)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1, this machine only)"
    )
    parser.add_argument(
        "--called",
        action="append",
        default=[],
        metavar="NAME",
        help="host name or address that other machines use (required with --host 0.0.0.0; can be repeated)",
    )
    parser.add_argument("--token", help="token in the printed address, 16 characters or more (default: a random one)")
    parser.add_argument("--no-open", dest="open", action="store_false", help="do not open a browser")
    _add_query_limits(parser)


def add_validate_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky validate`."""
    parser.add_lake("lake whose products are validated (default: none, a universe is drawn)", is_optional=True)
    parser.add_argument("--json", action="store_true", help="print all figures as a JSON list")
    of_lake = parser.add_argument_group("options with LAKE")
    of_lake.add_argument("--name", help="request whose tables are validated, if the lake contains several")
    of_lake.add_argument("--exposures", nargs="+", type=int, default=[], metavar="ID", help="default: all exposures")
    of_lake.add_argument("--report", type=Path, metavar="FILE", help="also copy the report of the lake to this file")
    of_lake.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores")
    of_universe = parser.add_argument_group("options without LAKE")
    of_universe.add_argument(
        "--quick", action="store_true", help="draw a few small blocks and one box: takes 20 s, too little sky to pass"
    )
    of_universe.add_argument("--results", type=Path, metavar="FILE", help="write the figures to this JSON file")
    of_universe.add_argument("--figures", type=Path, metavar="FOLDER", help="write plots to this folder")
