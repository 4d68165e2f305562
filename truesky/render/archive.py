"""The archive of a lake's images: what there is, of what, made when, with what, and what could not be made.

    python -m truesky.render.archive --lake LAKE [--name REQUEST] [--at RA DEC] [--sql "select .. from products"]
                                  [--failures | --exposures]
    python -m truesky.render.archive --lake LAKE --again PATH --out FILE.fits [--version KEY]

products    the published products, each with its sha256, seconds and peak memory
exposures   the files of whole exposures, likewise
failures    detectors that a run could not render
covering    those products whose footprint holds a place
again       renders one of them anew, from the tables and the mission that it was made from

A product's bytes depend on what it was made of alone; how long that took is in the logs of the runs.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import feather

from lake_schema import command, sky, user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import code_version, file_sha256
from truesky.explore.process import Process
from truesky.numerics import matrices
from truesky.render.products import run_log

# Bytes and s that a query of the archive may take.
_MEMORY, _TIMEOUT = 1e9, 60.0
_FAILURES = pa.schema(
    [
        pa.field("part", pa.string()),
        pa.field("error", pa.string()),
        pa.field("attempt", pa.int64()),
        pa.field("seconds", pa.float64()),
        pa.field("peak_gb", pa.float64()),
        pa.field("run", pa.string()),
    ]
)


def products(root: Path, request: str | None = None) -> pa.Table:
    """Rows of the table `products` with sha256, bytes, seconds (s) and peak_gb (GB), null where no log says so.

    request : whose products, where a lake has those of several
    """
    version = read.version(root, "products", request=request)
    files = {entry["path"]: entry for entry in version.manifest["files"]}
    log_entries = {line["part"]: line for line in _log_entries(root, request) if "error" not in line}
    rows = []
    for part in version.manifest["parts"]:
        log_entry = log_entries.get(part["name"], {})
        for row in version.rows(partitions=[part["name"]]).to_pylist():
            measured = {key: log_entry.get(key) for key in ("seconds", "peak_gb")}
            rows.append({**row, **{key: files[row["path"]][key] for key in ("sha256", "bytes")}, **measured})
    log_columns = [("sha256", pa.string()), ("bytes", pa.int64()), ("seconds", pa.float64()), ("peak_gb", pa.float64())]
    return pa.Table.from_pylist(rows, pa.schema([*version.schema, *(pa.field(*column) for column in log_columns)]))


def exposures(root: Path, request: str | None = None) -> pa.Table:
    """Rows of the table `exposure_files` with sha256 and bytes.

    request : whose files, where a lake has those of several
    Errors  : BadInput where there are none, or none of the detectors' present images
    """
    version, images = (read.version(root, name, request=request) for name in ("exposure_files", "products"))
    if version.manifest["facts"]["products"] != images.key:
        raise BadInput('table exposure_files is of other images: run render_exposures with files = "exposure"')
    rows, files = version.rows(), {entry["path"]: entry for entry in version.manifest["files"]}
    file_values = [[files[path][key] for path in rows["path"].to_pylist()] for key in ("sha256", "bytes")]
    return rows.append_column("sha256", pa.array(file_values[0], pa.string())).append_column(
        "bytes", pa.array(file_values[1])
    )


def failures(root: Folder, request: str | None = None) -> pa.Table:
    """Detectors whose last attempt failed: error, attempt, seconds, peak_gb (GB), and the run.

    request : whose detectors, None = of all requests
    """
    last = {(line["request"], line["part"]): line for line in _log_entries(root, request)}
    failed = [last[key] for key in sorted(last) if "error" in last[key]]
    return pa.Table.from_pylist([{k: line.get(k) for k in _FAILURES.names} for line in failed], _FAILURES)


def rows_at_place(rows: pa.Table, ra: float, dec: float) -> pa.Table:
    """Those of the products whose footprint (STC-S polygon of four corners) holds a place, its edge included."""
    if not rows.num_rows:
        return rows
    corners = np.array([region.split()[2:] for region in rows["s_region"].to_pylist()], float).reshape(-1, 4, 2)
    edges = sky.unit_vectors(corners[..., 0], corners[..., 1])
    place = sky.unit_vectors(ra, dec)
    # A place is inside where it is on one side of the great circles through all edges, and not at the antipode.
    side = matrices.matmul(np.cross(edges, np.roll(edges, -1, axis=1)), place)
    inside = (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
    return rows.filter(pa.array(inside & (matrices.matmul(edges.sum(axis=1), place) > 0)))


def _log_entries(root: Folder, request: str | None = None) -> Iterator[dict[str, Any]]:
    """What the runs' logs say of parts of `products`, oldest first, each with its run; of a request, or of all."""
    for path in run_log.logs_of_products(root):
        lines = run_log.lines(path)
        request_name = next((str(line["request"]) for line in lines if "request" in line), "")
        if request in (None, request_name):
            yield from ({**line, "run": path.stem, "request": request_name} for line in lines if "part" in line)


def search(rows: pa.Table, sql: str, memory: float = _MEMORY, timeout: float = _TIMEOUT) -> pa.Table:
    """The answer to a query of the rows, which it calls `products`; it reaches no file.

    memory : bytes that the query may take;  timeout : s
    rows   : of table `products`;  sql : one SELECT
    """
    with tempfile.TemporaryDirectory(prefix="truesky-") as folder:
        file = Path(folder) / "products.arrow"
        feather.write_feather(rows, file, compression="uncompressed")
        process = Process(Path(folder), [f"products=@{file}"], memory)
        try:
            return process.ask(sql, {}, timeout)
        except BadInput as error:
            raise BadInput(f"--sql: {error}") from None
        finally:
            process.close()


def _objects(rows: pa.Table) -> list[str]:
    """The rows as JSON; what JSON has no form for, such as a date or a decimal, as text."""
    if len(set(rows.column_names)) != rows.num_columns:
        raise BadInput("--sql: two columns of the result have the same name; give one of them another with AS")
    try:
        return [json.dumps(row, default=str, allow_nan=False) for row in rows.to_pylist()]
    except (ValueError, OverflowError, TypeError, pa.ArrowException) as error:
        raise BadInput(f"--sql: the result has no form in JSON: {' '.join(str(error).split())[:300]}") from None


def render_again(root: Path, product: str, out: Path, key: str | None = None, request: str | None = None) -> str:
    """Render a product into a file of its own; returns what is to be said of it, empty where its bytes are the same.

    product : its path in the table;  key : of the version of `products` that has it, None = that of the request
    root    : folder of the lake;  out : the file;  request : whose products, where a lake has those of several
    Errors  : BadInput where there is no such product, or where a table that it was made from has been removed
    """
    from truesky.render import render_exposures

    version = read.version(root, "products", key, request)
    rows = [row for row in version.rows().to_pylist() if row["path"] == product]
    if not rows:
        raise BadInput(f"table products: version {version.key} has no product {product}")
    detector_facts = {name: rows[0][name] for name in ("exposure_id", "detector")}
    (part,) = (part for part in version.manifest["parts"] if detector_facts.items() <= part["facts"].items())
    facts = version.manifest["facts"]
    render_exposures.render_task(root, {**facts, **part["facts"]}).files[product](out)
    # Refused where it is no longer what was published.
    version.sidecar_path(product)
    if file_sha256(out) == version.file_sha256(product):
        return ""
    code = "" if facts["code"] == code_version() else ": it was made by another version of the code"
    return f"{out} differs from {product}{code}"


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the products, one JSON object a line; those of a place or of a query where one is given.

    Exit status: 0, 1 a product came out otherwise when it was rendered again or the lake is damaged, 2 the call is
    wrong.
    """
    parser = argparse.ArgumentParser(
        prog="python -m truesky.render.archive", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--lake", required=True, help="folder of the lake")
    parser.add_argument("--name", help="of the request whose products are meant, where the lake has several")
    parser.add_argument("--at", nargs=2, type=float, metavar=("RA", "DEC"), help="only what holds this place, deg")
    parser.add_argument("--sql", help="a query of the table products")
    parser.add_argument("--failures", action="store_true", help="what could not be made, in place of the products")
    parser.add_argument("--exposures", action="store_true", help="files of whole exposures, in place of the detectors'")
    parser.add_argument("--again", metavar="PATH", help="render this product again, as it was made")
    parser.add_argument("--out", type=Path, metavar="FILE", help="where to; wanted with --again")
    parser.add_argument("--version", metavar="KEY", help="of an older version of the table products")
    options = parser.parse_args(argv)
    if (options.failures or options.exposures) and options.at is not None:
        parser.error("failures and whole exposures have no place")
    if options.failures and options.exposures:
        parser.error("--failures and --exposures exclude each other")
    if (options.again is None) != (options.out is None):
        parser.error("--again and --out belong together")
    return command.run("archive", lambda: _answer(options))


def _answer(options: argparse.Namespace) -> int:
    root = layout.resolve_lake(options.lake)
    if options.again is not None:
        difference = render_again(
            root, options.again, user_files.check_target(options.out), options.version, options.name
        )
        print(difference or f"{options.out} equals {options.again}")
        return int(bool(difference))
    if options.at is not None:
        sky.check_positions(*([value] for value in options.at))
    request_name = None if options.name is None else request_links.check_request(root, options.name)
    rows = (failures if options.failures else exposures if options.exposures else products)(root, request_name)
    rows = rows if options.at is None else rows_at_place(rows, *options.at)
    rows = rows if options.sql is None else search(rows, options.sql)
    for line in _objects(rows):
        print(line)
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
