"""Answers to the page about one source: its rows, its observed spectrum, its images and traces, and cutouts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from numpy.polynomial import polynomial

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.fluxes import band_fluxes, inputs, passbands
from truesky.fluxes.spectra import lines
from truesky.page import pictures
from truesky.page.answers import pack, to_json_value
from truesky.page.lake_session import LakeSession, RequestTables

_TABLES_BY_KIND = {**{kind: ("galaxies", "galaxy_fluxes") for kind in range(5)}, 5: ("stars", "star_fluxes")}
# Approximate number of wavelengths at which a spectrum is shown.
_SPECTRUM_SAMPLES = 2400
_CUTOUT_SIDE = 64
# Rows on each side of a trace in a strip (pixels), and largest number of columns along the trace.
_STRIP_HALF_WIDTH, _MAX_STRIP_LENGTH = 12, 4096
Json = dict[str, Any]


def describe_source(lake: LakeSession, identifier_text: str) -> Json:
    """Describe a source: its kind, its rows with units, and the detectors on which it was drawn or dispersed.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    identifier_text : str
        Identifier of the source as a decimal number.

    Returns
    -------
    dict
        `id`, `kind`, `request`, `tables` (columns of its row by table), `drawn` (rows of `rendered_truth`), `spectra`
        (rows of `rendered_spectra` with lines) and, if it is in a catalogue, `place` (RA and Dec in degrees) and
        `images` (images that contain this position).

    Raises
    ------
    BadInput
        If the identifier is invalid, or the lake has no such source.
    """
    identifier = _parse_identifier(identifier_text)
    kind = int(ids.kind_from_id(np.array([identifier]))[0])
    rows, request_tables = _find_source(lake, identifier, kind)
    result: Json = {
        "id": identifier_text,
        "kind": pictures.KIND_NAMES.get(kind, str(kind)),
        "request": request_tables and request_tables.request,
        "tables": {table: _describe_columns(row) for table, row in rows.items()},
        "drawn": [],
        "spectra": [],
    }
    if request_tables is not None and (row := rows.get(_TABLES_BY_KIND[kind][0])) is not None:
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
    """Rows of a table of a request that meet a condition; empty if the request has no such table."""
    version = request_tables.versions.get(table)
    return [] if version is None else version.rows(where=condition).to_pylist()


def _redshift(request_tables: RequestTables, identifier: int, rows: Mapping[str, pa.Table]) -> float:
    """Redshift of a galaxy in the catalogue of a request, else in `rows`; 0 if it is in neither.

    Requests may have different universes, so `rows`, which may belong to another request, are the second choice.
    """
    version = request_tables.versions.get("galaxies")
    row = rows.get("galaxies") if version is None else _source_rows(version, identifier)
    return float(row["z_obs"][0].as_py()) if row is not None and row.num_rows else 0.0


def _describe_trace(lake: LakeSession, request_tables: RequestTables, row: Json, z: float) -> Json:
    """Describe a row of `rendered_spectra`: the images that contain the trace, and its lines by name."""
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
        raise BadInput(f"{text[:40]!r} is not an identifier of a source")
    return int(text)


def _source_rows(version: read.Version, identifier: int) -> pa.Table:
    """Read the row of a source. Only files around its cell are read, unless it lies far from its halo."""
    cell = identifier >> ids.BLOCK_BITS & ((1 << 2 * ids.GENERATION_ORDER + 4) - 1)
    for order in (ids.GENERATION_ORDER, ids.FILE_ORDER):
        parent_cell = int(sky.parent(cell, ids.GENERATION_ORDER, order))
        # Lensing may have moved the source into a neighbouring cell.
        rows = version.rows_in_cells([parent_cell, *sky.margin_cells(order, parent_cell, order).tolist()], order)
        rows = rows.filter(pc.equal(rows["id"], identifier))
        if rows.num_rows:
            return rows
    return version.rows(where=pc.field("id") == identifier)


def _find_source(lake: LakeSession, identifier: int, kind: int) -> tuple[dict[str, pa.Table], RequestTables | None]:
    """Return the rows of a source by table, from the first request that has the largest number of its tables."""
    best: tuple[dict[str, pa.Table], RequestTables | None] = {}, None
    tables = _TABLES_BY_KIND.get(kind, ())
    for request_tables in lake.request_tables(*tables):
        rows = {
            table: _source_rows(request_tables.versions[table], identifier)
            for table in tables
            if table in request_tables.versions
        }
        rows = {table: row for table, row in rows.items() if row.num_rows}
        if len(rows) > len(best[0]):
            best = rows, request_tables
        if len(rows) == len(tables):
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
    """Return the observed spectrum of a source, its lines, and its fluxes in the passbands of the lake.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    identifier_text : str
        Identifier of the source as a decimal number.

    Returns
    -------
    dict
        `wavelength` (angstrom), `f_lambda` (erg s-1 cm-2 A-1), `lines`, `bands` with fluxes `f_nu` in microjansky,
        and `z` for galaxies. If there is no spectrum, only `said`, a message with the reason.
    """
    try:
        return _spectrum(lake, identifier_text)
    except BadInput as error:
        return {"said": str(error)}


def _spectrum(lake: LakeSession, identifier_text: str) -> Json:
    identifier = _parse_identifier(identifier_text)
    kind = int(ids.kind_from_id(np.array([identifier]))[0])
    if kind not in (0, 1, 4, 5):
        raise BadInput(f"a source of kind {pictures.KIND_NAMES.get(kind, kind)} has no spectrum")
    rows, request_tables = _find_source(lake, identifier, kind)
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
    # Average over each step instead of sampling, so that no line is lost between two samples.
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
    """Passbands of a request with the fluxes of a source in them."""
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
    """Return 64 x 64 pixels around a position on an image, without cosmic rays if possible.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image.
    x, y : float
        Column and row of the position; 0 is the centre of the first pixel.

    Returns
    -------
    bytes
        Pixels as float32 [64, 64], NaN outside the image.

    Raises
    ------
    BadInput
        If there is no such image, or the position is not finite or beyond 1e6 pixels.
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
    """Return the pixels along the trace of a source's spectrum, straightened into a strip.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image.
    identifier_text : str
        Identifier of the source as a decimal number.
    order : int
        Order of the grism.

    Returns
    -------
    bytes
        The length of the header (4 bytes), the header (JSON) and the pixels (float32 [rows, columns]). The header has
        `rows`, `columns`, and `first` and `last`, the wavelengths of the first and last column in angstrom. Rows run
        across the trace, which is in the middle. Each value is the nearest pixel of the image, or NaN outside it.

    Raises
    ------
    BadInput
        If there is no such image, or it has no spectrum of this source in this order.
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


def nearest_source(lake: LakeSession, ra: float, dec: float, radius: float) -> Json:
    """Find the galaxy or star that is nearest to a position.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    ra, dec : float
        Position in degrees.
    radius : float
        Search radius in degrees.

    Returns
    -------
    dict
        `id` and `separation` (degrees); empty if there is no source within the radius.
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
