"""One source: its rows, its spectrum as it is observed, where it was drawn and dispersed, and small pictures of it."""

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
from truesky.page.answers import packed, plain
from truesky.page.opened import Lake, Requested

_TABLES = {**{kind: ("galaxies", "galaxy_fluxes") for kind in range(5)}, 5: ("stars", "star_fluxes")}
# A spectrum is shown at so many wavelengths.
_SAMPLES = 2400
_CUTOUT = 64
# Rows on each side of a trace that are shown of it, pixels; places along it at most.
_BESIDE, _LONGEST = 12, 4096
Json = dict[str, Any]


def source(lake: Lake, text: str) -> Json:
    """Its kind, its rows by table with units, and where it was drawn.

    text : identifier, decimal
    """
    identifier = _identifier(text)
    kind = int(ids.kind_of(np.array([identifier]))[0])
    rows, own = _found(lake, identifier, kind)
    found: Json = {
        "id": text, "kind": pictures.KINDS.get(kind, str(kind)), "request": own and own.request,
        "tables": {table: _facts(row) for table, row in rows.items()}, "drawn": [], "spectra": [],
    }  # fmt: skip
    if own is not None and (row := rows.get(_TABLES[kind][0])) is not None:
        ra, dec = (float(row[name][0].as_py()) for name in ("ra", "dec"))
        found["place"] = [ra, dec]
        found["images"] = [
            {"number": number, "x": x, "y": y, "is_north_up": pictures.is_north_up(lake, number)}
            for number, x, y in pictures.covering(lake, ra, dec)
        ]
    wanted = pc.field("id") == identifier
    for observed in lake.observed:
        for drawn in _where(observed, "rendered_truth", wanted):
            found["drawn"].append({"request": observed.request, **{key: plain(value) for key, value in drawn.items()}})
        traces = _where(observed, "rendered_spectra", wanted)
        z = _redshift(observed, identifier, rows) if traces and "galaxies" in _TABLES.get(kind, ()) else 0.0
        found["spectra"] += [_trace(lake, observed, trace, z) for trace in traces]
    if not found["tables"] and not found["drawn"]:
        raise BadInput(f"the lake has no source {text}")
    return found


def _where(own: Requested, table: str, wanted: ds.Expression) -> list[Json]:
    """Those rows of a table of a request that a filter lets through."""
    version = own.versions.get(table)
    return [] if version is None else version.rows(where=wanted).to_pylist()


def _redshift(own: Requested, identifier: int, rows: Mapping[str, pa.Table]) -> float:
    """Of a galaxy as a request has it, whose universe may be another; 0 where none has its row.

    rows : by table, of whichever request has the source
    """
    version = own.versions.get("galaxies")
    row = rows.get("galaxies") if version is None else _rows(version, identifier)
    return float(row["z_obs"][0].as_py()) if row is not None and row.num_rows else 0.0


def _trace(lake: Lake, own: Requested, row: Json, z: float) -> Json:
    """A row of `rendered_spectra`: the images that hold it, and its lines by name.

    own : the tables of the request that has it;  z : redshift of the source
    """
    place = own.request, row["exposure_id"], row["detector"]
    known = pictures.pictures(lake)
    numbers = [k for k, one in enumerate(known) if one.place == place]
    about = known[numbers[0]].row if numbers else {"channel": "", "band": ""}
    columns = [row.pop(f"line_{name}") for name in ("wavelength", "expected", "snr")]
    return {"request": own.request, **{key: plain(value) for key, value in row.items()}} | {
        "channel": about["channel"],
        "band": about["band"],
        "images": {known[k].row["content"]: k for k in numbers},
        "lines": [
            {"name": _line_at(wavelength / (1.0 + z)), "wavelength": wavelength, "expected": light, "snr": plain(snr)}
            for wavelength, light, snr in zip(*columns, strict=True)
        ],
    }


def _line_at(wavelength: float) -> str:
    return min(lines.line_list(), key=lambda line: abs(line.vacuum - wavelength)).name


def _identifier(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 19 and int(text) < 1 << 63):
        raise BadInput(f"{text[:40]!r} is not an identifier of a source")
    return int(text)


def _rows(version: read.Version, identifier: int) -> pa.Table:
    """The row of a source: of the files only those about its cell are read, unless it lies far from its halo."""
    cell = identifier >> ids.BLOCK_BITS & ((1 << 2 * ids.GENERATION_ORDER + 4) - 1)
    for order in (ids.GENERATION_ORDER, ids.FILE_ORDER):
        own = int(sky.parent(cell, ids.GENERATION_ORDER, order))
        # What is lensed across a cell's edge lies in a neighbour.
        rows = version.in_cells([own, *sky.margin_cells(order, own, order).tolist()], order)
        rows = rows.filter(pc.equal(rows["id"], identifier))
        if rows.num_rows:
            return rows
    return version.rows(where=pc.field("id") == identifier)


def _found(lake: Lake, identifier: int, kind: int) -> tuple[dict[str, pa.Table], Requested | None]:
    """The rows of a source by table, all of one request: of that which has most of them, of several the first.

    kind : of the source
    """
    best: tuple[dict[str, pa.Table], Requested | None] = {}, None
    tables = _TABLES.get(kind, ())
    for own in lake.requested(*tables):
        rows = {table: _rows(own.versions[table], identifier) for table in tables if table in own.versions}
        rows = {table: row for table, row in rows.items() if row.num_rows}
        if len(rows) > len(best[0]):
            best = rows, own
        if len(rows) == len(tables):
            break
    return best


def _facts(rows: pa.Table) -> list[Json]:
    about = [{key.decode(): value.decode() for key, value in (field.metadata or {}).items()} for field in rows.schema]
    return [
        {"name": field.name, "value": plain(rows[field.name][0].as_py()), "unit": facts.get("unit", ""),
         "meaning": facts.get("description", "")}
        for field, facts in zip(rows.schema, about, strict=True)
    ]  # fmt: skip


def spectrum(lake: Lake, text: str) -> Json:
    """f_lambda as it arrives, its lines, and the passbands of the lake with the fluxes through them.

    text    : identifier, decimal
    returns : wavelengths in angstrom, f_lambda in erg s-1 cm-2 A-1, f_nu in microjansky; or `said`, why there is none
    """
    try:
        return _spectrum(lake, text)
    except BadInput as error:
        return {"said": str(error)}


def _spectrum(lake: Lake, text: str) -> Json:
    identifier = _identifier(text)
    kind = int(ids.kind_of(np.array([identifier]))[0])
    if kind not in (0, 1, 4, 5):
        raise BadInput(f"no spectrum is made of a {pictures.KINDS.get(kind, kind)}")
    rows, own = _found(lake, identifier, kind)
    for name in _TABLES[kind]:
        if own is None or name not in rows:
            raise BadInput(f"the lake has no source {identifier} in a table {name}")
    assert own is not None
    row, flux = (rows[name] for name in _TABLES[kind])
    made_of = own.versions[_TABLES[kind][1]].manifest["facts"]
    if kind == 5:
        library = inputs.stars_of(lake.root, made_of)
        whole, grid = band_fluxes.star_spectra(row, library)[0], np.asarray(library.wavelength, float)
    else:
        whole, grid = band_fluxes.galaxy_spectra(row, inputs.library_of(lake.root, made_of))[0], passbands.grid()
    step = max(len(grid) // _SAMPLES, 1)
    size = len(grid) // step * step
    # Means, so that no line falls between two samples.
    found: Json = {
        "wavelength": np.round(grid[:size].reshape(-1, step).mean(axis=1), 2).tolist(),
        "f_lambda": [float(f"{value:.5g}") for value in whole[:size].reshape(-1, step).mean(axis=1)],
        "lines": [], "bands": _bands(own, flux),
    }  # fmt: skip
    if kind != 5:
        z = float(row["z_obs"][0].as_py())
        found["z"] = z
        found["lines"] = [
            {"name": line.name, "wavelength": line.vacuum * (1.0 + z)}
            for line in lines.line_list()
            if (row[line.column][0].as_py() or 0.0) > 0.0
        ]
    return found


def _bands(own: Requested, row: pa.Table) -> list[Json]:
    """Passbands, of the request whose fluxes are shown, with the fluxes through them."""
    named = {name: row[name][0].as_py() for name in row.column_names if name.startswith("f_nu_")}
    return [
        {"name": one["name"], "wavelength": one["pivot_wavelength"], "f_nu": named[f"f_nu_{one['name']}"],
         "width": one["pivot_wavelength"] * one["log_width"]}
        for one in own.rows("passbands", ["name", "pivot_wavelength", "log_width"])
        if f"f_nu_{one['name']}" in named
    ]  # fmt: skip


def cutout(lake: Lake, number: int, x: float, y: float) -> bytes:
    """float32 [64, 64] pixels about a place of an image, NaN beyond its edge.

    lake, number : of the image;  x, y : column and row, 0 = centre of the first pixel
    """
    image = pictures.picture(lake, number).levels(mended=True)[0]
    if not (np.isfinite([x, y]).all() and abs(x) < 1e6 and abs(y) < 1e6):
        raise BadInput("x, y: wanted pixels")
    out = np.full((_CUTOUT, _CUTOUT), np.nan, np.float32)
    column, row = round(x) - _CUTOUT // 2, round(y) - _CUTOUT // 2
    top, left = max(row, 0), max(column, 0)
    piece = image[top : max(row + _CUTOUT, 0), left : max(column + _CUTOUT, 0)]
    out[top - row : top - row + piece.shape[0], left - column : left - column + piece.shape[1]] = piece
    return out.tobytes()


def strip(lake: Lake, number: int, text: str, order: int) -> bytes:
    """Pixels along the trace of a source's order: 4 bytes, the length of the head; the head, JSON; float32 [rows, n].

    lake, number : of the image;  text : identifier of the source, decimal;  order : of the grism
    The head has rows and columns, and the wavelengths of the first and the last column, angstrom. Each value is that
    of the pixel nearest to the place, NaN beyond the image; rows go across the trace, its own in the middle.
    """
    one = pictures.picture(lake, number)
    place = {"exposure_id": one.row["exposure_id"], "detector": one.row["detector"], "order": order}
    wanted = pc.field("id") == _identifier(text)
    for name, value in place.items():
        wanted = wanted & (pc.field(name) == value)
    found = _where(one.own, "rendered_spectra", wanted)
    if not found:
        raise BadInput(f"image {number} has no order {order} of source {text}")
    x, y = (np.array(found[0][f"trace_{axis}"]) for axis in "xy")
    image = one.levels(mended=True)[0]
    t = np.linspace(0.0, 1.0, int(np.clip(np.hypot(x[1:].sum(), y[1:].sum()) + 1.0, 2, _LONGEST)))
    along = np.stack([polynomial.polyval(t, polynomial.polyder(part)) for part in (x, y)])
    along /= np.maximum(np.hypot(*along), 1e-12)
    away = np.arange(-_BESIDE, _BESIDE + 1)[:, None]
    column = np.rint(polynomial.polyval(t, x) - away * along[1]).astype(int)
    row = np.rint(polynomial.polyval(t, y) + away * along[0]).astype(int)
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    out = np.full(column.shape, np.nan, "<f4")
    out[inside] = image[row[inside], column[inside]]
    ends = {"first": found[0]["wavelength_first"], "last": found[0]["wavelength_last"]}
    head = {"rows": out.shape[0], "columns": out.shape[1], **ends}
    return packed(head, out)


def nearest(lake: Lake, ra: float, dec: float, radius: float) -> Json:
    """The source of the catalogues that is nearest to a place, of those within a radius.

    lake : whose catalogues;  ra, dec, radius : deg
    """
    best: Json = {}
    for table in ("galaxies", "stars"):
        for own in lake.requested(table):
            rows = own.versions[table].cone(ra, dec, radius, ["id", "ra", "dec"])
            if not rows.num_rows:
                continue
            lon, lat = (rows[name].to_numpy() for name in ("ra", "dec"))
            away = sky.separation(lon, lat, ra, dec)
            first = int(np.argmin(away))
            if not best or away[first] < best["separation"]:
                best = {"id": str(rows["id"][first].as_py()), "separation": float(away[first])}
    return best
