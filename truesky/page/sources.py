"""Answers to the web page about one galaxy or star: its table rows, spectrum, images, cutouts and dispersed traces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from numpy.polynomial import polynomial

from lake_schema import ids, sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.fluxes import band_fluxes, inputs, passbands
from truesky.fluxes.spectra import lines
from truesky.page import pictures
from truesky.page.answers import pack, to_json_value
from truesky.page.lake_session import LakeSession, RequestTables
from truesky.render.products.sidecar_files import spectra_file

_TABLES_BY_KIND = {**{kind: ("galaxies", "galaxy_fluxes") for kind in range(5)}, 5: ("stars", "star_fluxes")}
# Tables with supernovae, lensed images and active nuclei, the column with the identifier, and the type of the source.
_CHANGING_TABLES = {
    "transients": ("id", "supernova"), "lensed_images": ("id", "lensed image"),
    "active_nuclei": ("point_id", "active nucleus"),
}  # fmt: skip
# Spectra are averaged to about this number of wavelengths.
_SPECTRUM_SAMPLES = 2400
# Width and height of a cutout, pixels.
_CUTOUT_SIDE = 64
# Number of pixels that a straightened spectrum shows on each side of its trace.
_STRIP_HALF_WIDTH = 12
# Largest number of pixels that a straightened spectrum shows along its trace.
_MAX_STRIP_LENGTH = 4096
# Number of points at which a trace is computed to find those at a position, and largest distance of a trace, pixels.
_TRACE_SAMPLES = 17
_TRACE_REACH = 4.0
Json = dict[str, Any]


def describe_source(lake: LakeSession, identifier_text: str) -> Json:
    """Describe a source: its type, its table rows with units, and the detectors on which it was drawn or dispersed.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    identifier_text : str
        Identifier of the source as a decimal number.

    Returns
    -------
    dict
        `id`, `kind` (type of the source, such as "star"), `request` (name of the request, or None), `tables` (for each
        table a list of the columns of the source's row), `drawn` (rows of the table `rendered_truth`), `spectra` (rows
        of the table `rendered_spectra` with emission lines). If the source is in a catalogue, also `place` (RA and Dec
        in degrees) and `images` (images that contain this position).

    Raises
    ------
    BadInput
        If the text is not an integer from 0 to 2^63 - 1, or the lake has no such source.
    """
    identifier = _parse_identifier(identifier_text)
    kind = int(ids.kind_from_id(np.array([identifier]))[0])
    rows, request_tables = _find_source(lake, identifier)
    (kind_name,) = pictures.kind_names(np.array([identifier]))
    result: Json = {
        "id": identifier_text,
        "kind": next((_CHANGING_TABLES[table][1] for table in rows if table in _CHANGING_TABLES), kind_name),
        "request": request_tables and request_tables.request,
        "tables": {table: _describe_columns(row) for table, row in rows.items()},
        "drawn": [],
        "spectra": [],
    }
    if request_tables is not None and (row := _row_with_position(rows)) is not None:
        ra, dec = (float(row[name][0].as_py()) for name in ("ra", "dec"))
        result["place"] = [ra, dec]
        result["images"] = [
            {"number": number, "x": x, "y": y, "is_north_up": pictures.is_north_up(lake, number)}
            for number, x, y in pictures.images_at(lake, ra, dec)
        ]
    condition = pc.field("id") == identifier
    for observing_tables in lake.observed_requests:
        for truth_row in _matching_rows(observing_tables, "rendered_truth", condition):
            result["drawn"].append(
                {"request": observing_tables.request, **{key: to_json_value(value) for key, value in truth_row.items()}}
            )
        traces = _matching_rows(observing_tables, "rendered_spectra", condition)
        z = (
            _redshift(observing_tables, identifier, rows)
            if traces and "galaxies" in _TABLES_BY_KIND.get(kind, ())
            else 0.0
        )
        result["spectra"] += [_describe_trace(lake, observing_tables, trace, z) for trace in traces]
    if not result["tables"] and not result["drawn"]:
        raise BadInput(f"the lake has no source {identifier_text}")
    return result


def _matching_rows(request_tables: RequestTables, table: str, condition: ds.Expression) -> list[Json]:
    """Return the rows of a request's table that meet a condition, as dictionaries; [] if there is no such table."""
    version = request_tables.versions.get(table)
    return [] if version is None else version.rows(where=condition).to_pylist()


def _redshift(request_tables: RequestTables, identifier: int, rows: Mapping[str, pa.Table]) -> float:
    """Return the observed redshift of a galaxy, or 0 if it is not in a catalogue.

    It is read from the table `galaxies` of the request. If the request has no such table, it is taken from the rows of
    another request in `rows`, which may be from another simulated universe.
    """
    version = request_tables.versions.get("galaxies")
    row = rows.get("galaxies") if version is None else _source_rows(version, identifier)
    return float(row["z_obs"][0].as_py()) if row is not None and row.num_rows else 0.0


def _describe_trace(lake: LakeSession, request_tables: RequestTables, row: Json, z: float) -> Json:
    """Describe a dispersed spectrum on a detector: its row of the table `rendered_spectra` in a form for the page.

    `images` contains the numbers of the detector's images by content, and `lines` the emission lines with name,
    wavelength (angstrom), expected electrons and signal-to-noise ratio. `z` is the redshift, from which the names of
    the lines are found.
    """
    detector_key = request_tables.request, row["exposure_id"], row["detector"]
    images = pictures.pictures(lake)
    numbers = [k for k, image in enumerate(images) if image.detector_key == detector_key]
    image_row = images[numbers[0]].row if numbers else {"channel": "", "band": ""}
    columns = [row.pop(f"line_{name}") for name in ("wavelength", "expected", "snr")]
    return {"request": request_tables.request, **{key: to_json_value(value) for key, value in row.items()}} | {
        "channel": image_row["channel"],
        "band": image_row["band"],
        "images": {images[k].row["content"]: k for k in numbers},
        "lines": [
            {
                "name": _nearest_line(wavelength / (1.0 + z)),
                "wavelength": wavelength,
                "expected": light,
                "snr": to_json_value(snr),
            }
            for wavelength, light, snr in zip(*columns, strict=True)
        ],
    }


def _nearest_line(wavelength: float) -> str:
    return min(lines.line_list(), key=lambda line: abs(line.vacuum - wavelength)).name


def _parse_identifier(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 19 and int(text) < 1 << 63):
        raise BadInput(f"id = {text[:40]!r} is not an identifier of a source")
    return int(text)


def _row_with_position(rows: Mapping[str, pa.Table]) -> pa.Table | None:
    """Return the row of a catalogue among the rows of a source by table, or None if there are only fluxes."""
    return next((row for table, row in rows.items() if not table.endswith("fluxes")), None)


def _id_columns(identifier: int) -> dict[str, str]:
    """Return the tables that may contain a source, each with the column of its identifier."""
    if ids.is_transient(np.array([identifier]))[0]:
        return {table: column for table, (column, _) in _CHANGING_TABLES.items()}
    kind = int(ids.kind_from_id(np.array([identifier]))[0])
    return dict.fromkeys(_TABLES_BY_KIND.get(kind, ()), "id")


def _source_rows(version: read.Version, identifier: int, id_column: str = "id") -> pa.Table:
    """Return the row of a source in a table, as a table of one row, or of none if the source is not in it.

    The identifier, in the column `id_column`, contains the HEALPix cell of the source, or of its halo. Files of this
    cell and its neighbours are read first, and all files only if the source is not found there.
    """
    cell = identifier >> ids.BLOCK_BITS & ((1 << 2 * ids.GENERATION_ORDER + 4) - 1)
    for order in (ids.GENERATION_ORDER, ids.FILE_ORDER):
        parent_cell = int(sky.parent(cell, ids.GENERATION_ORDER, order))
        # The neighbouring cells are read, too, because lensing may have moved the source into one of them.
        rows = version.rows_in_cells([parent_cell, *sky.margin_cells(order, parent_cell, order).tolist()], order)
        rows = rows.filter(pc.equal(rows[id_column], identifier))
        if rows.num_rows:
            return rows
    return version.rows(where=pc.field(id_column) == identifier)


def _find_source(lake: LakeSession, identifier: int) -> tuple[dict[str, pa.Table], RequestTables | None]:
    """Return the rows of a source by name of the table, and the request to which they belong.

    The tables are the catalogue and the fluxes, or the table of a changing source. If several requests contain the
    source, the first one with the most of these tables is used. The result is ({}, None) if no request contains it.
    """
    best: tuple[dict[str, pa.Table], RequestTables | None] = {}, None
    tables = _id_columns(identifier)
    # A changing source is in one table only.
    largest_count = 1 if _CHANGING_TABLES.keys() & tables.keys() else len(tables)
    for request_tables in lake.request_tables(*tables):
        rows: dict[str, pa.Table] = {}
        for table, id_column in tables.items():
            if table in request_tables.versions and len(rows) < largest_count:
                row = _source_rows(request_tables.versions[table], identifier, id_column)
                rows |= {table: row} if row.num_rows else {}
        if len(rows) > len(best[0]):
            best = rows, request_tables
        if len(rows) == largest_count:
            break
    return best


def _describe_columns(rows: pa.Table) -> list[Json]:
    column_metadata = [
        {key.decode(): value.decode() for key, value in (field.metadata or {}).items()} for field in rows.schema
    ]
    return [
        {"name": field.name, "value": to_json_value(rows[field.name][0].as_py()), "unit": metadata.get("unit", ""),
         "meaning": metadata.get("description", "")}
        for field, metadata in zip(rows.schema, column_metadata, strict=True)
    ]  # fmt: skip


def spectrum(lake: LakeSession, identifier_text: str) -> Json:
    """Return the model spectrum of a source in the observer's frame, its lines, and its fluxes in passbands.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    identifier_text : str
        Identifier of the source as a decimal number.

    Returns
    -------
    dict
        `wavelength` (angstrom), `f_lambda` (erg s-1 cm-2 A-1), `lines` (name and observed wavelength in angstrom of
        each emission line of a galaxy), `bands` (passbands with the flux `f_nu` in microjansky), and `z` (redshift,
        only for galaxies). If there is no spectrum or the identifier is invalid, only `said`, a text with the reason.
    """
    try:
        return _spectrum(lake, identifier_text)
    except BadInput as error:
        return {"said": str(error)}


def _spectrum(lake: LakeSession, identifier_text: str) -> Json:
    identifier = _parse_identifier(identifier_text)
    kind = int(ids.kind_from_id(np.array([identifier]))[0])
    if ids.is_transient(np.array([identifier]))[0]:
        raise BadInput(
            f"source {identifier} changes and has no constant spectrum: truesky.open(LAKE).light_curve gives its fluxes"
        )
    if kind not in (0, 1, 4, 5):
        raise BadInput(f"a source of kind {pictures.KIND_NAMES.get(kind, kind)} has no spectrum")
    rows, request_tables = _find_source(lake, identifier)
    for name in _TABLES_BY_KIND[kind]:
        if request_tables is None or name not in rows:
            raise BadInput(f"the lake has no source {identifier} in a table {name}")
    assert request_tables is not None
    source_row, flux_row = (rows[name] for name in _TABLES_BY_KIND[kind])
    flux_facts = request_tables.versions[_TABLES_BY_KIND[kind][1]].manifest["facts"]
    if kind == 5:
        library = inputs.stellar_library_from_facts(lake.root, flux_facts)
        flux_density, wavelength = (
            band_fluxes.star_spectra(source_row, library)[0],
            np.asarray(library.wavelength, float),
        )
    else:
        flux_density, wavelength = (
            band_fluxes.galaxy_spectra(source_row, inputs.galaxy_library_from_facts(lake.root, flux_facts))[0],
            passbands.grid(),
        )
    step = max(len(wavelength) // _SPECTRUM_SAMPLES, 1)
    size = len(wavelength) // step * step
    # Average the spectrum over bins of `step` wavelengths. Taking every step-th value could miss a narrow line.
    result: Json = {
        "wavelength": np.round(wavelength[:size].reshape(-1, step).mean(axis=1), 2).tolist(),
        "f_lambda": [float(f"{value:.5g}") for value in flux_density[:size].reshape(-1, step).mean(axis=1)],
        "lines": [], "bands": _band_fluxes(request_tables, flux_row),
    }  # fmt: skip
    if kind != 5:
        z = float(source_row["z_obs"][0].as_py())
        result["z"] = z
        result["lines"] = [
            {"name": line.name, "wavelength": line.vacuum * (1.0 + z)}
            for line in lines.line_list()
            if (source_row[line.column][0].as_py() or 0.0) > 0.0
        ]
    return result


def _band_fluxes(request_tables: RequestTables, row: pa.Table) -> list[Json]:
    """Return the passbands of a request in which the source has a flux.

    Each dictionary has `name`, `wavelength` (pivot wavelength, angstrom), `width` (angstrom) and `f_nu` (flux density
    in microjansky). `row` is the row of the source in the table of fluxes.
    """
    fluxes = {name: row[name][0].as_py() for name in row.column_names if name.startswith("f_nu_")}
    return [
        {
            "name": passband["name"],
            "wavelength": passband["pivot_wavelength"],
            "f_nu": fluxes[f"f_nu_{passband['name']}"],
            "width": passband["pivot_wavelength"] * passband["log_width"],
        }
        for passband in request_tables.rows("passbands", ["name", "pivot_wavelength", "log_width"])
        if f"f_nu_{passband['name']}" in fluxes
    ]


def cutout(lake: LakeSession, number: int, x: float, y: float) -> bytes:
    """Return 64 x 64 pixels around a position on an image; cosmic rays are removed if their truth image exists.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image, see `pictures.pictures`.
    x, y : float
        Column and row of the position; 0 is the centre of the first pixel. The nearest pixel gets the indices [32, 32].

    Returns
    -------
    bytes
        Pixels as float32 [64, 64] in the byte order of the machine, in electrons (flags in an image of saturation); NaN
        outside the image.

    Raises
    ------
    BadInput
        If there is no such image, or the absolute value of `x` or `y` is NaN or not below 1e6.
    """
    image = pictures.picture(lake, number).levels(without_cosmic_rays=True)[0]
    if not (np.isfinite([x, y]).all() and abs(x) < 1e6 and abs(y) < 1e6):
        raise BadInput("x, y must be finite and below 1e6 pixels")
    out = np.full((_CUTOUT_SIDE, _CUTOUT_SIDE), np.nan, np.float32)
    column, row = round(x) - _CUTOUT_SIDE // 2, round(y) - _CUTOUT_SIDE // 2
    first_row, first_column = max(row, 0), max(column, 0)
    pixels = image[first_row : max(row + _CUTOUT_SIDE, 0), first_column : max(column + _CUTOUT_SIDE, 0)]
    out[
        first_row - row : first_row - row + pixels.shape[0],
        first_column - column : first_column - column + pixels.shape[1],
    ] = pixels
    return out.tobytes()


def trace_strip(lake: LakeSession, number: int, identifier_text: str, order: int) -> bytes:
    """Return the pixels along the trace of a source's dispersed spectrum, straightened into a strip.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image, see `pictures.pictures`.
    identifier_text : str
        Identifier of the source as a decimal number.
    order : int
        Spectral order of the grism, for example 1.

    Returns
    -------
    bytes
        The length of the header (4 bytes), the header (JSON) and the pixels (float32 [rows, columns]). The header has
        `rows` and `columns` (shape of the strip), and `first` and `last` (wavelengths of the first and last column in
        angstrom). The trace is the middle row; it has 12 rows on each side. Each value is the nearest pixel of the
        image, or NaN outside it. Cosmic rays are removed if their truth image exists.

    Raises
    ------
    BadInput
        If there is no such image, the identifier is invalid, or the image has no spectrum of this source in this order.
    """
    image = pictures.picture(lake, number)
    trace_key = {"exposure_id": image.row["exposure_id"], "detector": image.row["detector"], "order": order}
    condition = pc.field("id") == _parse_identifier(identifier_text)
    for name, value in trace_key.items():
        condition = condition & (pc.field(name) == value)
    traces = _matching_rows(image.request_tables, "rendered_spectra", condition)
    if not traces:
        raise BadInput(f"image {number} has no order {order} of source {identifier_text}")
    x, y = (np.array(traces[0][f"trace_{axis}"]) for axis in "xy")
    pixels = image.levels(without_cosmic_rays=True)[0]
    t = np.linspace(0.0, 1.0, int(np.clip(np.hypot(x[1:].sum(), y[1:].sum()) + 1.0, 2, _MAX_STRIP_LENGTH)))
    direction = np.stack([polynomial.polyval(t, polynomial.polyder(part)) for part in (x, y)])
    direction /= np.maximum(np.hypot(*direction), 1e-12)
    offset = np.arange(-_STRIP_HALF_WIDTH, _STRIP_HALF_WIDTH + 1)[:, None]
    column = np.rint(polynomial.polyval(t, x) - offset * direction[1]).astype(int)
    row = np.rint(polynomial.polyval(t, y) + offset * direction[0]).astype(int)
    inside = (column >= 0) & (column < pixels.shape[1]) & (row >= 0) & (row < pixels.shape[0])
    out = np.full(column.shape, np.nan, "<f4")
    out[inside] = pixels[row[inside], column[inside]]
    wavelength_range = {"first": traces[0]["wavelength_first"], "last": traces[0]["wavelength_last"]}
    header = {"rows": out.shape[0], "columns": out.shape[1], **wavelength_range}
    return pack(header, out)


def trace_at(lake: LakeSession, number: int, x: float, y: float) -> Json:
    """Find the source whose first order passes through a position on an image behind a grism.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image, see `pictures.pictures`.
    x, y : float
        Column and row of the position; 0 is the centre of the first pixel.

    Returns
    -------
    dict
        `id` (text) of the source with the most expected electrons among those whose traces are at most 4 pixels away.
        Empty if no trace is that near, or the image has no spectra.

    Notes
    -----
    BadInput is raised if there is no image with this number.
    """
    image = pictures.picture(lake, number)
    path = spectra_file(image.row["exposure_id"], image.row["detector"])
    if not image.version.has_file(path):
        return {}
    rows = image.version.read_sidecar(path)
    rows = rows.filter(pc.equal(rows["order"], 1))
    t = np.linspace(0.0, 1.0, _TRACE_SAMPLES)
    best: tuple[float, int] | None = None
    for trace in rows.select(["id", "trace_x", "trace_y", "expected"]).to_pylist():
        column, row = (polynomial.polyval(t, np.array(trace[f"trace_{axis}"])) for axis in "xy")
        if _distance_to_line(column - x, row - y) <= _TRACE_REACH and (best is None or trace["expected"] > best[0]):
            best = trace["expected"], trace["id"]
    return {} if best is None else {"id": str(best[1])}


def _distance_to_line(x: Float, y: Float) -> float:
    """Return the distance from the origin to a line through the points (x, y), each of shape (n,), in their order."""
    dx, dy = np.diff(x), np.diff(y)
    share = np.clip(-(x[:-1] * dx + y[:-1] * dy) / np.maximum(dx**2 + dy**2, 1e-12), 0.0, 1.0)
    return float(np.hypot(x[:-1] + share * dx, y[:-1] + share * dy).min())


def nearest_source(lake: LakeSession, ra: float, dec: float, radius: float) -> Json:
    """Find the galaxy or star that is nearest to a position on the sky, in all requests of the lake.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    ra, dec : float
        Position in degrees.
    radius : float
        Search radius in degrees, 0 to 180.

    Returns
    -------
    dict
        `id` (text) and `separation` (degrees) of the source; empty if there is no source within the radius.

    Notes
    -----
    BadInput is raised if the position or the radius is outside its bounds.
    """
    best: Json = {}
    for table in ("galaxies", "stars"):
        for request_tables in lake.request_tables(table):
            rows = request_tables.versions[table].cone(ra, dec, radius, ["id", "ra", "dec"])
            if not rows.num_rows:
                continue
            lon, lat = (rows[name].to_numpy() for name in ("ra", "dec"))
            distance = sky.separation(lon, lat, ra, dec)
            first = int(np.argmin(distance))
            if not best or distance[first] < best["separation"]:
                best = {"id": str(rows["id"][first].as_py()), "separation": float(distance[first])}
    return best
