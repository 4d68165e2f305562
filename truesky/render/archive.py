"""List the images of a lake and the failed detectors, and render a published product again.

    python -m truesky.render.archive LAKE [--name REQUEST] [--at RA DEC] [--sql "select .. from products"]
                                  [--failures | --exposures]
    python -m truesky.render.archive LAKE --again PATH --out FILE.fits [--version KEY]

A product is an image file of a detector: science image or truth map. Products are listed with SHA-256, size, rendering
time in seconds and peak memory. Their bytes depend only on their inputs, so that a product rendered again must be
identical. Time and memory come from the log files of the runs.
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
from truesky.command_line.parser import Parser
from truesky.explore.process import Process
from truesky.numerics import matrices
from truesky.render.products import run_log

# Default limit of the memory of an SQL query of the list of images, bytes. A query that needs more raises BadInput.
_MEMORY = 1e9
# Default time limit of an SQL query of the list of images, s. A query that takes longer raises BadInput.
_TIMEOUT = 60.0
# Columns of the list of detectors that could not be rendered.
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
    """Return the table `products` (one row per image file) with additional columns sha256, bytes, seconds and peak_gb.

    `seconds` is the rendering time and `peak_gb` the peak memory in GB of the detector; both are null without a log
    entry. `request` is the name of the request, None if the lake has only one.
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
    """Return the table `exposure_files` (files with all detectors of an exposure) with columns sha256 and bytes.

    `request` is the name of the request, None if the lake has only one. Raises BadInput if the table does not exist, or
    was made from an older version of the table `products`.
    """
    version, images = (read.version(root, name, request=request) for name in ("exposure_files", "products"))
    if version.manifest["facts"]["products"] != images.key:
        raise BadInput('table exposure_files has outdated images: run truesky render with files = "exposure"')
    rows, files = version.rows(), {entry["path"]: entry for entry in version.manifest["files"]}
    file_values = [[files[path][key] for path in rows["path"].to_pylist()] for key in ("sha256", "bytes")]
    return rows.append_column("sha256", pa.array(file_values[0], pa.string())).append_column(
        "bytes", pa.array(file_values[1])
    )


def failures(root: Folder, request: str | None = None) -> pa.Table:
    """Return one row for each detector whose last attempt to render it failed.

    The columns are the partition (exposure number and detector), the error message, the number of the attempt, the
    elapsed time of the attempt in seconds, its peak memory `peak_gb` in GB, and the name of the job run. `request` is
    the name of a request; None means all requests of the lake.
    """
    last = {(line["request"], line["part"]): line for line in _log_entries(root, request)}
    failed = [last[key] for key in sorted(last) if "error" in last[key]]
    return pa.Table.from_pylist([{k: line.get(k) for k in _FAILURES.names} for line in failed], _FAILURES)


def rows_at_place(rows: pa.Table, ra: float, dec: float) -> pa.Table:
    """Return the rows of images whose footprint on the sky contains a position, its edge included.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows of the table `products`; column `s_region` has the footprint as an STC-S polygon with four corners.
    ra, dec : float
        ICRS position in degrees.

    Returns
    -------
    pyarrow.Table
        The selected rows in the same order; there may be none.
    """
    if not rows.num_rows:
        return rows
    corners = np.array([region.split()[2:] for region in rows["s_region"].to_pylist()], float).reshape(-1, 4, 2)
    edges = sky.unit_vectors(corners[..., 0], corners[..., 1])
    place = sky.unit_vectors(ra, dec)
    # A position is inside a footprint if it lies on the same side of the great circles through all edges of the
    # footprint. Its antipode passes this test as well; the second condition excludes footprints on the opposite side of
    # the sky.
    side = matrices.matmul(np.cross(edges, np.roll(edges, -1, axis=1)), place)
    inside = (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
    return rows.filter(pa.array(inside & (matrices.matmul(edges.sum(axis=1), place) > 0)))


def _log_entries(root: Folder, request: str | None = None) -> Iterator[dict[str, Any]]:
    """Yield the log lines, one per attempt to render a detector, oldest run first.

    Each line is the dict of the JSON object in the log, with the names of the job run and of the request added.
    `request` None means all requests of the lake.
    """
    for path in run_log.logs_of_products(root):
        lines = run_log.lines(path)
        request_name = next((str(line["request"]) for line in lines if "request" in line), "")
        if request in (None, request_name):
            yield from ({**line, "run": path.stem, "request": request_name} for line in lines if "part" in line)


def search(rows: pa.Table, sql: str, memory: float = _MEMORY, timeout: float = _TIMEOUT) -> pa.Table:
    """Run an SQL query over rows, which it sees as a table named `products`.

    Parameters
    ----------
    rows : pyarrow.Table
        Any rows, such as the result of `products` or of `failures`.
    sql : str
        A SELECT statement. It runs in a separate process and cannot access files.
    memory : float
        Memory in bytes that the query may use.
    timeout : float
        Time in seconds that the query may take.

    Returns
    -------
    pyarrow.Table
        The result of the query.

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
    """Return each row as the text of a JSON object. Values that JSON lacks, such as dates and decimals, become strings.

    Raises BadInput if two columns have the same name, or a number is NaN or infinite.
    """
    if len(set(rows.column_names)) != rows.num_columns:
        raise BadInput("--sql: two columns of the result have the same name: rename one with AS")
    try:
        return [json.dumps(row, default=str, allow_nan=False) for row in rows.to_pylist()]
    except (ValueError, OverflowError, TypeError, pa.ArrowException) as error:
        raise BadInput(f"--sql: the result cannot be written as JSON: {' '.join(str(error).split())[:300]}") from None


def render_again(root: Path, product: str, out: Path, key: str | None = None, request: str | None = None) -> str:
    """Render a stored image file again from its recorded inputs into a new file, and compare the two.

    Parameters
    ----------
    root : Path
        Lake (folder of stored tables and images).
    product : str
        Path of the image file, as in column `path` of the table `products`.
    out : Path
        File to write.
    key : str, optional
        Key (hash) of the version of the table `products` that has the image; None means the current version.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    str
        "" if the bytes are identical, otherwise a message that names the two files and tells whether the code has
        changed.

    Raises
    ------
    BadInput
        If the table has no such path, or if a table from which the image was made has been removed.

    Notes
    -----
    An error is also raised if the stored file has changed on disc.
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
    # Raise an error if the stored file has changed on disc: its recorded checksum, used below, would be wrong.
    version.sidecar_path(product)
    if file_sha256(out) == version.file_sha256(product):
        return ""
    code = "" if facts["code"] == code_version() else ": the versions of the code differ"
    return f"{out} differs from {product}{code}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command: print image files as one JSON object per line, or render one of them again.

    The list may be limited to a position or an SQL query. The exit status is 0; it is 1 if an image rendered again
    differs or the lake is damaged, or 2 if the arguments are invalid.
    """
    parser = Parser(prog="python -m truesky.render.archive", description=(__doc__ or "").splitlines()[0])
    parser.add_lake()
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
