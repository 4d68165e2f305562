"""Declaration of the tables of true positions and electrons of the sources in simulated images.

The table `rendered_truth` has one row per source of a detector, and `rendered_spectra` one row per spectral order of a
source. A source outside a detector has no row if only its faint wings reach the detector, beyond the stamp (square
around the source) in which it is drawn. Stars with noticeable diffraction spikes have a row in this case, too.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table

METHODS = (
    (0, "a point, through the PSF at its place"),
    (1, "a profile, convolved with the PSF at its place"),
    (2, "a picture, of a strong lens' arcs or of a galaxy of a library, convolved with the PSF at its place"),
    (3, "a trail of a moving point, in pieces, each through the PSF at its place"),
)


def _trail(axis: str, doc: str) -> Column:
    return Column(f"trail_{axis}", "float64", "pix", f"pos.cartesian.{axis};instr.det", doc, nullable=True)


def _centroid(axis: str, doc: str) -> Column:
    return Column(f"psf_{axis}", "float64", "pix", f"pos.cartesian.{axis};instr.det.psf", doc, nullable=True)


RENDERED_TRUTH = Table(
    "rendered_truth",
    1,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column(
            "id",
            "int64",
            ucd="meta.id;meta.main",
            doc="source, as in the catalogues; kind 6: a moving body; kind 5, member 1: a standard star",
            lo=0,
        ),
        Column("x", "float64", "pix", "pos.cartesian.x;instr.det", "column, 0 = centre of the first pixel"),
        Column("y", "float64", "pix", "pos.cartesian.y;instr.det", "row, 0 = centre of the first pixel"),
        Column(
            "expected",
            "float64",
            "electron",
            "phot.count",
            "expected electrons in the exposure, on and off the detector",
            0.0,
        ),
        Column(
            "drawn", "float64", "electron", "phot.count;instr.det", "electrons drawn on read-out pixels of the stamp"
        ),
        Column(
            "stamp", "int32", "pix", "phys.angSize;instr.det", "side of the stamp; fainter wings are drawn beyond it", 1
        ),
        Column("method", "int8", "", "meta.code", "how it was drawn", codes=METHODS),
        _trail("x", "it moves by, with (x, y) in the middle; of very long trails each row is of the part near"),
        _trail("y", "the same along the rows' axis"),
        _centroid(
            "x",
            "centroid of a point of its colour there, in a Gaussian window of the rms `psf_window`, minus x; mean over "
            "the positions within a pixel; null if light is dispersed",
        ),
        _centroid("y", "the same along the rows' axis"),
        Column(
            "psf_window",
            "float64",
            "arcsec",
            "phys.angSize;instr.det.psf",
            "rms of the Gaussian window of psf_x and psf_y, as PSFWIN of the header",
            0.0,
            nullable=True,
        ),
        Column(
            "mag",
            "float64",
            "mag",
            "phot.mag",
            "AB magnitude of `expected`, with ZEROPNT and EXPTIME of the header",
            nullable=True,
        ),
    ),
    "Sources of the rendered images: true places and electrons.",
    key=("exposure_id", "detector", "id"),
)

_ORDERS = ((-1, "order -1"), (0, "order 0"), (1, "order 1: the spectrum that is measured"), (2, "order 2"))


def _place(axis: str, end: str, text: str) -> Column:
    return Column(f"{axis}_{end}", "float64", "pix", f"pos.cartesian.{axis};instr.det", text)


RENDERED_SPECTRA = Table(
    "rendered_spectra",
    1,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column("id", "int64", ucd="meta.id;meta.main", doc="source, as in rendered_truth", lo=0),
        Column("order", "int8", "", "instr.order", "order of the grism", codes=_ORDERS),
        Column("wavelength_first", "float64", "Angstrom", "em.wl", "vacuum wavelength at t = 0", 0.0),
        Column(
            "wavelength_last",
            "float64",
            "Angstrom",
            "em.wl",
            "vacuum wavelength at t = 1; the wavelength is linear in t",
            0.0,
        ),
        _place("x", "first", "column of t = 0, 0 = centre of the first pixel"),
        _place("y", "first", "row of t = 0"),
        _place("x", "last", "column of t = 1"),
        _place("y", "last", "row of t = 1"),
        Column("trace_x", "list<float64>", "pix", "pos.cartesian.x;instr.det", "columns: coefficients of t^0, t^1, .."),
        Column("trace_y", "list<float64>", "pix", "pos.cartesian.y;instr.det", "rows: coefficients of t^0, t^1, .."),
        Column(
            "expected",
            "float64",
            "electron",
            "phot.count",
            "expected electrons in the exposure, on and off the detector",
            0.0,
        ),
        Column("drawn", "float64", "electron", "phot.count;instr.det", "electrons drawn on the detector by its stamps"),
        Column(
            "overlapped",
            "float64",
            "",
            "phys.size;arith.ratio",
            "fraction of a first order's length on the detector that overlaps with the trace of another source. A "
            "column overlaps if the rows of the traces differ by less than the sum of their half widths, and the other "
            "has at least as many electrons as the noise of a pixel; null for other orders",
            0.0,
            1.0,
            nullable=True,
        ),
        Column("contaminants", "list<int64>", "", "meta.id;src", "sources of these traces, ascending"),
        Column(
            "line_wavelength",
            "list<float64>",
            "Angstrom",
            "em.wl",
            "observed wavelengths of the lines of a first order that fall on the detector",
        ),
        Column(
            "line_expected",
            "list<float64>",
            "electron",
            "phot.count;em.line",
            "expected electrons of each of these lines",
        ),
        Column(
            "line_snr",
            "list<float64>",
            "",
            "stat.snr;em.line",
            "signal-to-noise ratio of each: weighted by the source's image, with the noise of sky and continuum, "
            "without contaminants",
        ),
    ),
    "Spectra of the rendered images: true traces, electrons, lines, and what overlaps.",
    key=("exposure_id", "detector", "id", "order"),
)
