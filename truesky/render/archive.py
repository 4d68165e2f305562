"""List the images of a lake and the failed detectors, and render a published product again.

    python -m truesky.render.archive --lake LAKE [--name REQUEST] [--at RA DEC] [--sql "select .. from products"]
                                  [--failures | --exposures]
    python -m truesky.render.archive --lake LAKE --again PATH --out FILE.fits [--version KEY]

Products are listed with sha256, size, seconds and peak memory. The bytes of a product depend only on its inputs. Time
and memory come from the logs of the runs.
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

# Memory (bytes) and time (s) that a query of the archive may use.
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
    """Return the rows of `products` with sha256, bytes, seconds, and peak_gb (GB). Values without a log entry are null.

    `request` selects the products if the lake has several requests.
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
    """Return the rows of `exposure_files` with sha256 and bytes; `request` selects them if the lake has several.

    Raises BadInput if the table does not exist or was made from an older version of `products`.
    """
    version, images = (read.version(root, name, request=request) for name in ("exposure_files", "products"))
    if version.manifest["facts"]["products"] != images.key:
        raise BadInput('table exposure_files has outdated images: run render_exposures with files = "exposure"')
    rows, files = version.rows(), {entry["path"]: entry for entry in version.manifest["files"]}
    file_values = [[files[path][key] for path in rows["path"].to_pylist()] for key in ("sha256", "bytes")]
    return rows.append_column("sha256", pa.array(file_values[0], pa.string())).append_column(
        "bytes", pa.array(file_values[1])
    )


def failures(root: Folder, request: str | None = None) -> pa.Table:
    """Return the detectors whose last attempt failed: error, attempt, seconds, peak_gb (GB), and name of the run.

    `request` None means the detectors of all requests.
    """
    last = {(line["request"], line["part"]): line for line in _log_entries(root, request)}
    failed = [last[key] for key in sorted(last) if "error" in last[key]]
    return pa.Table.from_pylist([{k: line.get(k) for k in _FAILURES.names} for line in failed], _FAILURES)


def rows_at_place(rows: pa.Table, ra: float, dec: float) -> pa.Table:
    """Return the rows whose footprint contains a position (deg), including its edge.

    Parameters
    ----------
    rows : pyarrow.Table
        Products; `s_region` is an STC-S polygon with four corners.
    ra, dec : float
        ICRS position in degrees.

    Returns
    -------
    pyarrow.Table
        The selected rows.
    """
    if not rows.num_rows:
        return rows
    corners = np.array([region.split()[2:] for region in rows["s_region"].to_pylist()], float).reshape(-1, 4, 2)
    edges = sky.unit_vectors(corners[..., 0], corners[..., 1])
    place = sky.unit_vectors(ra, dec)
    # A position is inside if it lies on the same side of the great circles through all edges, and not at the antipode.
    side = matrices.matmul(np.cross(edges, np.roll(edges, -1, axis=1)), place)
    inside = (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
    return rows.filter(pa.array(inside & (matrices.matmul(edges.sum(axis=1), place) > 0)))


def _log_entries(root: Folder, request: str | None = None) -> Iterator[dict[str, Any]]:
    """Yield the log lines of tasks of `products`, oldest first, with run and request; None means all requests."""
    for path in run_log.logs_of_products(root):
        lines = run_log.lines(path)
        request_name = next((str(line["request"]) for line in lines if "request" in line), "")
        if request in (None, request_name):
            yield from ({**line, "run": path.stem, "request": request_name} for line in lines if "part" in line)


def search(rows: pa.Table, sql: str, memory: float = _MEMORY, timeout: float = _TIMEOUT) -> pa.Table:
    """Query the rows as the table `products`. The query cannot access files.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows of the table `products`.
    sql : str
        A SELECT statement.
    memory : float
        Memory in bytes that the query may use.
    timeout : float
        Time in seconds that the query may take.

    Returns
    -------
    pyarrow.Table
        The result.

    Raises
    ------
    BadInput
        If the query is invalid or exceeds its memory or time.
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
    """Return the rows as JSON. Values without a JSON form, such as dates and decimals, become strings."""
    if len(set(rows.column_names)) != rows.num_columns:
        raise BadInput("--sql: two columns of the result have the same name: rename one with AS")
    try:
        return [json.dumps(row, default=str, allow_nan=False) for row in rows.to_pylist()]
    except (ValueError, OverflowError, TypeError, pa.ArrowException) as error:
        raise BadInput(f"--sql: the result cannot be written as JSON: {' '.join(str(error).split())[:300]}") from None


def render_again(root: Path, product: str, out: Path, key: str | None = None, request: str | None = None) -> str:
    """Render a published product again into a new file.

    Parameters
    ----------
    root : Path
        Root of the lake.
    product : str
        Path of the product in the table.
    out : Path
        File to write.
    key : str, optional
        Key of the version of `products` that contains it; None means the current version.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    str
        A message that describes the difference, or "" if the bytes are identical.

    Raises
    ------
    BadInput
        If there is no such product, or a table that it was made from has been removed.
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
    # Raises an error if the published file has changed.
    version.sidecar_path(product)
    if file_sha256(out) == version.file_sha256(product):
        return ""
    code = "" if facts["code"] == code_version() else ": the versions of the code differ"
    return f"{out} differs from {product}{code}"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the products, one JSON object per line, optionally limited to a position or a query.

    The exit status is 0, 1 if a product rendered again differs or the lake is damaged, or 2 if the arguments are
    invalid.
    """
    parser = argparse.ArgumentParser(
        prog="python -m truesky.render.archive", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--lake", required=True, help="folder of the lake")
    parser.add_argument("--name", help="name of the request, required if the lake has several")
    parser.add_argument("--at", nargs=2, type=float, metavar=("RA", "DEC"), help="only products at this position, deg")
    parser.add_argument("--sql", help="SELECT statement on the table products")
    parser.add_argument("--failures", action="store_true", help="list detectors that failed instead of products")
    parser.add_argument("--exposures", action="store_true", help="list files of whole exposures instead of detectors")
    parser.add_argument("--again", metavar="PATH", help="render this product again from its original inputs")
    parser.add_argument("--out", type=Path, metavar="FILE", help="output file, required with --again")
    parser.add_argument("--version", metavar="KEY", help="key of an older version of the table products")
    options = parser.parse_args(argv)
    if (options.failures or options.exposures) and options.at is not None:
        parser.error("--at cannot be combined with --failures or --exposures")
    if options.failures and options.exposures:
        parser.error("--failures and --exposures cannot be combined")
    if (options.again is None) != (options.out is None):
        parser.error("--again and --out must be given together")
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
