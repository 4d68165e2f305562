"""Write traces and sensitivities of a grism in the format of grismconf: a text file and FITS tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import user_files
from lake_schema.arrays import Float
from lake_schema.columns import Column, Table
from lake_schema.fits.tables import table_to_fits
from truesky.render.camera.traces import Trace
from truesky.render.dispersing.draw import Order

SENSITIVITY = Table(
    "sensitivity",
    1,
    (
        Column("WAVELENGTH", "float64", "Angstrom", "em.wl", "vacuum wavelength"),
        Column(
            "SENSITIVITY", "float64", "electron cm2 erg-1", "instr.sensitivity", "sensitivity in a bin of 1 Angstrom"
        ),
        Column("ERROR", "float64", "electron cm2 erg-1", "stat.error", "error of the sensitivity, always 0"),
    ),
    "Sensitivity of an order of a grism, in electrons/s per erg s-1 cm-2 A-1.",
    key=("WAVELENGTH",),
)
# Number of terms 1, x, y, x^2, x y, y^2. grismconf requires the squares in polynomials of four powers of t.
_TERMS = 6


def configuration(name: str, traces: Sequence[Trace], shape: tuple[int, int], files: Sequence[str]) -> str:
    """Text of a configuration file.

    Parameters
    ----------
    name : str
        Name of the grism and the detector.
    traces : sequence of Trace
        Traces of the orders.
    shape : (int, int)
        Rows and columns of the detector.
    files : sequence of str
        Names of the files with the sensitivity of each order.

    Returns
    -------
    str
        Text of the file. Offsets are in 0-based pixels from the undispersed image; wavelengths are in Angstrom.
    """
    ny, nx = shape
    lines = [f"# {name}, simulated", f"NAXIS {ny} {nx}"]
    for trace, file in zip(traces, files, strict=True):
        label = f"{trace.order:+d}" if trace.order else "0"
        # The light of a source outside the detector may fall on the detector.
        reach = float(np.abs(trace.polynomials(0.0, 0.0)[0]).sum())
        lines += ["", f"BEAM_{label}", f"SENSITIVITY_{label} {file}"]
        lines += [f"XRANGE_{label} {-reach:.1f} {reach:.1f}", f"YRANGE_{label} {-reach:.1f} {reach:.1f}"]
        for axis, rows in (("X", trace.x), ("Y", trace.y)):
            lines += [f"DISP{axis}_{label}_{i} {_terms(row)}" for i, row in enumerate(rows)]
        lines += [f"DISPL_{label}_0 {trace.first!r}", f"DISPL_{label}_1 {trace.last - trace.first!r}"]
    return "\n".join(lines) + "\n"


def _terms(row: Float) -> str:
    return " ".join(repr(float(value)) for value in np.pad(row, (0, _TERMS - len(row))))


def sensitivity(order: Order) -> pa.Table:
    """Sensitivity of an order as rows of SENSITIVITY.

    The response of `order` must be electrons per second in 1 Angstrom, per erg s-1 cm-2 A-1. The first and last two
    values are 0, because extraction software sets them to 0.
    """
    response = np.pad(order.response, 2)
    wavelength = order.first - 2 + np.arange(float(len(response)))
    zero_error = np.zeros(len(response))
    return SENSITIVITY.build({"WAVELENGTH": wavelength, "SENSITIVITY": response, "ERROR": zero_error})


def write(folder: Path, name: str, orders: Sequence[Order], shape: tuple[int, int]) -> Path:
    """Write the tables and then the configuration, each replaced atomically.

    Parameters
    ----------
    folder : Path
        Folder of the files.
    name : str
        Prefix of their names.
    orders : sequence of Order
        Orders, with responses as for `sensitivity`.
    shape : (int, int)
        Rows and columns of the detector.

    Returns
    -------
    Path
        The configuration file.
    """
    files = [f"{name}_{order.trace.order:+d}.fits" for order in orders]
    for order, file in zip(orders, files, strict=True):
        table_to_fits(folder / file, sensitivity(order), SENSITIVITY)
    path = folder / f"{name}.conf"
    with user_files.replace_atomically(path) as temporary:
        text = configuration(name, [order.trace for order in orders], shape, files)
        temporary.write_text(text, encoding="utf-8")
    return path
