"""Write the traces and sensitivities of a grism in the format of grismconf: a text file and FITS tables.

grismconf is a Python package that programs for the extraction of slitless spectra use.
"""

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
# Number of coefficients, of 1, x, y, x^2, x y and y^2, that the file contains for each power of t. (x, y) is the
# undispersed position in pixels, and t the parameter along a trace. The coefficients of the squares and of x y are 0,
# but grismconf requires them for polynomials with four powers of t.
_TERMS = 6


def configuration(name: str, traces: Sequence[Trace], shape: tuple[int, int], files: Sequence[str]) -> str:
    """Return the text of a configuration file of the package grismconf, which describes the traces of a grism.

    Parameters
    ----------
    name : str
        Name of the grism and the detector.
    traces : sequence of Trace
        Traces of the orders.
    shape : (int, int)
        Rows and columns of the detector.
    files : sequence of str
        Names of the files with the sensitivity of each order, in the order of `traces`.

    Returns
    -------
    str
        Text of the file. Offsets are in 0-based pixels from the undispersed image; wavelengths are in Angstrom.
    """
    ny, nx = shape
    lines = [f"# {name}, simulated", f"NAXIS {ny} {nx}"]
    for trace, file in zip(traces, files, strict=True):
        label = f"{trace.order:+d}" if trace.order else "0"
        # XRANGE and YRANGE give how far outside the detector an undispersed image may lie, in pixels. The range must
        # include all sources whose dispersed light falls onto the detector.
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
    """Return the sensitivity of a spectral order as a table: wavelengths in Angstrom, sensitivities, and errors of 0.

    The response of `order` must be in electrons per second in a bin of 1 Angstrom, per erg s-1 cm-2 A-1; this is also
    the unit of the sensitivity. Two values of 0 are added at each end of the response, because software for the
    extraction of spectra sets the first and last two values to 0.
    """
    response = np.pad(order.response, 2)
    wavelength = order.first - 2 + np.arange(float(len(response)))
    zero_error = np.zeros(len(response))
    return SENSITIVITY.build({"WAVELENGTH": wavelength, "SENSITIVITY": response, "ERROR": zero_error})


def write(folder: Path, name: str, orders: Sequence[Order], shape: tuple[int, int]) -> Path:
    """Write the sensitivity tables of all orders, and then the configuration file that names them.

    Parameters
    ----------
    folder : Path
        Folder of the files, which must exist.
    name : str
        Prefix of the names of the files, also written in the configuration file.
    orders : sequence of Order
        Orders, with responses as for `sensitivity`.
    shape : (int, int)
        Rows and columns of the detector.

    Returns
    -------
    Path
        The configuration file. Existing files are replaced.
    """
    files = [f"{name}_{order.trace.order:+d}.fits" for order in orders]
    for order, file in zip(orders, files, strict=True):
        table_to_fits(folder / file, sensitivity(order), SENSITIVITY)
    path = folder / f"{name}.conf"
    with user_files.replace_atomically(path) as temporary:
        text = configuration(name, [order.trace for order in orders], shape, files)
        temporary.write_text(text, encoding="utf-8")
    return path
