"""Targets of fuzzing: valid inputs, reader, file ending, and whether the reader may end its process."""

import io
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from astropy.io import fits

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.external import files as external_files
from lake_schema.mission import model, parameter
from lake_schema.mission.configuration import resolve
from lake_schema.store import layout, publish, read
from lake_schema.store.provenance import digest
from tests import requests
from tests.truesky.explore.test_hostile_sql import GOOD
from tests.universe import plain_plan, plain_work
from truesky.catalogue import dust_map
from truesky.catalogue.external import mapping, reading
from truesky.catalogue.stars import bright_stars, from_catalogue
from truesky.cosmology import FIDUCIAL
from truesky.explore import guard
from truesky.fluxes import passbands
from truesky.fluxes.libraries import from_files, stars_from_files
from truesky.render import archive
from truesky.render.camera import astrometry, detectors
from truesky.render.planning import ground_surveys
from truesky.render.psf import from_file
from truesky.render.sources import ephemerides, galaxy_stamps
from truesky.request import area, files
from truesky.request.exposures.observations import Observation
from truesky.request.from_toml import parse

ROOT = Path(__file__).resolve().parents[2]
RNG = np.random.default_rng(7)
AREAS = (
    "polygon = [[53.0, -28.0], [54.0, -28.0], [54.0, -27.0], [53.0, -27.0]]",
    "polygon = [[0, 80], [120, 80], [240, 80]]",
    "cone = { ra = 53.1, dec = -27.8, radius = 0.2 }", "box = { ra = [350.0, 359.0], dec = [-1.0, 1.0] }", "tile = 7",
    "patches = [[10.0, 20.0, 1.0], [200.0, -80.0, 3.0]]", "wide = true",
)  # fmt: skip
OWN_SECTIONS = """
[stars]
tycho2 = ["a.dat"]
catalogue = { file = "b.txt", columns = { ra = "RA", dec = "Dec", mag_h = "H", teff = "T" } }
[ingest.galaxies]
files = ["c.fits"]
format = "flagship2"
columns = { ra = "x", mag = { column = "m", scale = 2.0, offset = -1.0 } }
[ingest.dust]
file = "d.fits"
column = "EBV"
[fluxes.passbands.mine]
file = "m.dat"
format = "passband_ascii"
medium = "air"
[psf]
mine = "{detector}.fits"
[mission.overrides]
"vis.read_noise" = { value = 5.0, unit = "electron" }
[explore]
"effects.bleeding" = [true, false]
"vis.gain" = { values = [3.0, 3.5], unit = "electron / adu" }
[effects]
on = ["adc"]
"""
WAVELENGTH = np.linspace(4000.0, 7000.0, 61)
CURVE = np.exp(-(((WAVELENGTH - 5500.0) / 700.0) ** 2))
VOTABLE = """<?xml version="1.0" encoding="UTF-8"?>
<VOTABLE version="1.1" xmlns="http://www.ivoa.net/xml/VOTable/v1.1"><RESOURCE type="results"><TABLE>
<PARAM name="ID" value="x" datatype="char" arraysize="*"/>
<FIELD name="Wavelength" unit="Angstrom" datatype="double"/><FIELD name="Transmission" datatype="double"/>
<DATA><TABLEDATA>
{rows}</TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>
"""
ECSV = """# %ECSV 1.0
# ---
# datatype:
# - {{name: {0}, unit: nm, datatype: float64, description: of light}}
# - {{name: {1}, datatype: float64}}
# meta: !!omap
# - {{a: [1, 2]}}
# - {{b: x}}
# schema: astropy-2.0
{0} {1}
{rows}"""
MANY = {"id": np.arange(50), "ra": RNG.uniform(0, 360, 50), "dec": RNG.uniform(-90, 90, 50), "z": RNG.uniform(0, 3, 50)}
MANY["m"], MANY["name"] = RNG.uniform(9, 15, 50).astype(np.float32), np.array([f"body {i}" for i in range(50)])
BODIES = {
    "mjd": 60900.0 + RNG.uniform(0, 3, 50), "lon": MANY["ra"], "lat": RNG.uniform(-30, 30, 50),
    "east": RNG.uniform(-50, 50, 50), "north": RNG.uniform(-50, 50, 50), "mag": RNG.uniform(15, 25, 50),
}  # fmt: skip
STARS = {"ra": "ra", "dec": "dec", "mag_h": "m", "distance": "z", "teff": "T"}
HALOS = {
    key: json.dumps(title)
    for key, title in {"ra": "ra", "dec": "dec", "z_true": "z", "log_mass": "m", "origin_id": "id"}.items()
}
TYCHO = [
    "0001 00008 1| |  2.31750494|  2.23184345|  -16.3|   -9.0| 68| 73| 1.7| 1.8|1958.89|1951.94| 4|1.0|1.0|0.9|1.0|"
    "12.146|0.158|12.146|0.223|999| |         |  2.31754222|  2.23186444|1.67|1.54| 88.0|100.8| |-0.2",
    "0001 00013 1| |  1.12558209|  2.26739400|   27.7|   -0.5|  9| 12| 1.2| 1.2|1990.76|1989.25| 8|1.0|0.8|1.0|0.7|"
    "10.488|0.038| 8.670|0.015|999|T|         |  1.12551889|  2.26739556|1.81|1.52|  9.3| 12.7| |-0.2",
]
POINTINGS = """# a survey
channel,camera,band,ra,dec,position_angle,mjd,exposure_time_s,sky,seeing,zero_point,psf,detectors,image_type
EXT,lsstcam,lsst_r,-10.0,20.5,30.0,60905.25,,,,,,,
EXT,lsstcam,lsst_r,-10.0,20.5,30.0,60905.5,30,12.5,0.61,28.1,psf.fits,R22_S11 R22_S12,deep
VIS,vis,euclid_vis,10.0,-20.5,30.0,60906.5,560,,,,,,science
"""


def written(write):
    """Return the bytes that a function writes to a path."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "x")
        return (Path(folder) / "x").read_bytes()


def as_csv(columns):
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return "\n".join(",".join(map(str, row)) for row in (list(columns), *rows)).encode()


def as_parquet(columns, **options):
    return written(lambda path: pq.write_table(pa.table(columns), path, **options))


def as_fits(columns, cards=(), units=()):
    formats = {"i": "K", "f": "D", "U": "20A"}
    made = [
        fits.Column(
            name,
            "E" if values.dtype == np.float32 else formats[values.dtype.kind],
            array=values,
            unit=dict(units).get(name),
        )
        for name, values in columns.items()
    ]
    unit = fits.BinTableHDU.from_columns(made)
    unit.header.update(dict(cards))
    return written(lambda path: fits.HDUList([fits.PrimaryHDU(), unit]).writeto(path))


def as_image(data, cards=()):
    unit = fits.PrimaryHDU(data)
    unit.header.update(dict(cards))
    return written(unit.writeto)


def packed(data):
    import gzip

    return gzip.compress(data, mtime=0)


def lines(x, y, separator=" "):
    return "".join(f"{a:.6g}{separator}{b:.6g}\n" for a, b in zip(x, y, strict=True))


# ------------------------------------------------------------------------------------------------ readers


def of_area(path):
    found = area.parse(user_files.read_toml(path, "request"))
    found.cells(3)
    found.contains(*np.meshgrid(np.linspace(0, 360, 9), np.linspace(-90, 90, 5)))
    found.bounding_circle()


def curve(form):
    return lambda path: from_files.passband(path, "x", "air", form)


def rows_of(columns):
    return lambda path: [rows for rows in reading.read([path], columns)]


@cache
def detector():
    return detectors.detectors("vis", resolve())[0]


def of_psf(path):
    from_file.read(path, detector(), passbands.load("euclid_vis"), astrometry.wcs(detector(), 150.0, 2.0, 20.0))


def of_pointings(path):
    ground_surveys.read(path, Observation(("EXT", "VIS"), survey="lsst"), resolve())


def of_parquet(path):
    external_files._refuse_large_footer(path)
    external_files.send_batches(path, ["ra", "dec", "id"], ["name"], io.BytesIO())


def of_query(path):
    text = path.read_bytes().decode("utf-8", "surrogateescape")
    guard.check_query(text, ("galaxies", "galaxy_fluxes", "plain", "products"))


def of_path(path):
    text = path.read_bytes().decode("utf-8", "surrogateescape")
    for ask in (
        layout.resolve_lake,
        layout.check_name,
        user_files.expand_path,
        lambda name: files.resolve_path(Path("."), name),
    ):
        try:
            user_files.check_file(Path(ask(text)), "request")
        except BadInput as error:
            if len(str(error).splitlines()) > 1:
                raise


@cache
def lake():
    root = Path(tempfile.mkdtemp(prefix="fuzz-lake-"))
    publish.make_version(root, plain_plan(), plain_work)
    return root


def of_manifest(path):
    """Add a valid seal, so that the content is tested as well."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "lake"
        shutil.copytree(lake(), root, symlinks=True)
        file = next((root / "plain").glob("v-*/manifest.json"))
        data = path.read_bytes()
        try:
            facts = json.loads(data)
            facts.pop("digest")
            data = json.dumps({**facts, "digest": digest(facts)}).encode()
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
            pass
        file.write_bytes(data)
        version = read.version(root, "plain")
        version.rows()
        read.find_faults(version, deep=True)


def of_log(path):
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "runs").mkdir()
        shutil.copy(path, Path(folder) / "runs" / "1-products-1.jsonl")
        archive.failures(Path(folder))


LOG = [
    {"job": "r", "table": "products", "part": f"{i}.parquet", "rows": 1, "seconds": 1.5, "peak_gb": 0.5, "attempt": 1}
    for i in range(4)
]
LOG[1]["error"], LOG[2]["traceback"] = "BadInput: no", "x\n"


def of_stars(path):
    from_catalogue._read(path, STARS)


def of_map(path):
    dust_map.read(files.DustMap(path, "EBV"))


def of_mission(path):
    for record in parameter.read(path):
        parameter.convert(record.value, record.unit, record.unit, record.key)


PIXELS = {"EBV": RNG.uniform(0.0, 0.1, 48).astype(np.float32), "OTHER": RNG.uniform(0, 1, 48)}
HEALPIX = {"PIXTYPE": "HEALPIX", "ORDERING": "RING", "COORDSYS": "G", "NSIDE": 2}
GAUSS = np.exp(-0.5 * (np.linspace(-6, 6, 25)[:, None] ** 2 + np.linspace(-6, 6, 25) ** 2))
PLANES = np.stack([GAUSS / GAUSS.sum()] * 3).astype(np.float32)
SCALE = {
    "CDELT1": 0.05,
    "CDELT2": 0.05,
    "CUNIT1": "arcsec",
    "CUNIT3": "nm",
    "CRVAL3": 400.0,
    "CDELT3": 350.0,
    "PIXEL": False,
    "PSFFRAME": "SKY",
}
PSFEX = {"POLNAXIS": 2, "POLNGRP": 1, "POLDEG1": 1, "POLNAME1": "X_IMAGE", "POLNAME2": "Y_IMAGE", "PSF_SAMP": 0.5}
PSFEX |= {"POLZERO1": 1000.0, "POLZERO2": 1000.0, "POLSCAL1": 900.0, "POLSCAL2": 900.0, "POLGRP1": 1, "POLGRP2": 1}


def psfex():
    data = fits.Column("PSF_MASK", f"{PLANES.size}E", dim="(25,25,3)", array=PLANES[None])
    unit = fits.BinTableHDU.from_columns([data])
    unit.header.update(PSFEX)
    return written(lambda path: fits.HDUList([fits.PrimaryHDU(), unit]).writeto(path))


def basel():
    """Return one model with the number of wavelengths of all these files."""
    grid = np.linspace(100.0, 24_000.0, 1221)
    text = "".join(f"{x:10.1f}" + "\n" * (i % 8 == 7) for i, x in enumerate(grid)) + "\n"
    head = f"{1:6d}{5750:6d}{4.5:6.2f}{-0.5:6.2f}{2.0:6.2f}{0.7:6.2f}\n"
    values = "".join(f"{1e-5:11.4E}" + "\n" * (i % 7 == 6) for i in range(len(grid)))
    return [(text + head + values + "\n").encode()]


def table_targets(name, columns, reader, **more):
    """Return the targets of a reader of tables for each file ending."""
    return {
        f"{name}, CSV": (lambda: [as_csv(columns)], reader, ".csv"),
        f"{name}, FITS": (lambda: [as_fits(columns, **more), packed(as_fits(columns, **more))], reader, ".fits"),
    }


def curve_targets():
    rows, blue = lines(WAVELENGTH, CURVE), lines(WAVELENGTH / 10, CURVE)
    table = "".join(f"<TR><TD>{x:.6g}</TD><TD>{y:.6g}</TD></TR>\n" for x, y in zip(WAVELENGTH, CURVE, strict=True))
    light = {"WAVELENGTH": WAVELENGTH, "FLUX": CURVE}
    return {
        "passband, text": (lambda: [f"# mine\n{rows}".encode()], curve("passband_ascii"), ".dat"),
        "passband, ECSV": (
            lambda: [ECSV.format("wavelength", "throughput", rows=blue).encode()], curve("passband_ecsv"), ".ecsv",
        ),
        "passband, VOTable": (lambda: [VOTABLE.format(rows=table).encode()], curve("passband_svo"), ".xml"),
        "spectrum, CSV": (
            lambda: [("wavelength,flux\n" + lines(WAVELENGTH, CURVE, ",")).encode()],
            lambda path: from_files.read(path, "spectrum_csv"), ".csv",
        ),
        "spectrum, FITS": (
            lambda: [as_fits(light, units={"WAVELENGTH": "Angstrom"}), as_fits(light)],
            lambda path: from_files.read(path, "spectrum_fits"), ".fits",
        ),
        "extinction law": (
            lambda: [lines(np.linspace(900.0, 24_000.0, 100), np.linspace(10.0, 0.1, 100)).encode()],
            lambda path: from_files.law(path, "extinction", WAVELENGTH), ".dat",
        ),
        "models of stars": (basel, stars_from_files.read_basel, ".cor"),
    }  # fmt: skip


TARGETS = {
    "request": (
        lambda: [
            *(path.read_bytes() for path in sorted((ROOT / "requests").glob("*.toml"))),
            requests.text(OWN_SECTIONS).replace("b.txt", "~/b.txt").encode(),
        ], parse, ".toml",
    ),
    "area": (lambda: [text.encode() for text in AREAS], of_area, ".toml"),
    **curve_targets(),
    "PSF, cube": (
        lambda: [as_image(PLANES, SCALE), as_image(PLANES[0], SCALE), packed(as_image(PLANES, SCALE))], of_psf, ".fits",
    ),
    "PSF, PSFEx": (lambda: [psfex()], of_psf, ".psf"),
    "library of galaxies": (
        lambda: [as_image(PLANES[:2]), packed(as_image(PLANES[:2]))],
        lambda path: galaxy_stamps.read.__wrapped__(path, ""), ".fits",
    ),
    **table_targets("bodies", {**BODIES, "name": MANY["name"]}, lambda path: ephemerides.read.__wrapped__(path, "")),
    **table_targets("catalogue", MANY, rows_of(mapping.halo_columns(HALOS, FIDUCIAL)), units={"ra": "deg"}),
    "catalogue, Parquet": (
        lambda: [as_parquet(MANY, write_page_checksum=True), as_parquet(MANY, compression="zstd", row_group_size=20)],
        of_parquet, ".parquet", True,
    ),
    "map of dust": (
        lambda: [as_fits(PIXELS, HEALPIX), as_fits(PIXELS, {**HEALPIX, "ORDERING": "NESTED", "COORDSYS": "C"})],
        of_map, ".fits",
    ),
    **table_targets("stars", {**MANY, "T": np.full(50, 5000.0)}, of_stars),
    "Tycho-2": (lambda: ["\n".join(TYCHO * 3).encode()], bright_stars._records, ".dat"),
    "Tycho-2, FITS": (
        lambda: [as_fits({"RAmdeg": MANY["ra"], "DEmdeg": MANY["dec"], "BTmag": MANY["m"], "VTmag": MANY["m"]})],
        bright_stars._records, ".fits",
    ),
    "pointings": (lambda: [POINTINGS.encode()], of_pointings, ".csv"),
    "mission, values": (
        lambda: [(ROOT / "lake_schema" / "mission" / "spacecraft.csv").read_bytes()], of_mission, ".csv",
    ),
    "mission, models": (lambda: [(ROOT / "lake_schema" / "mission" / "models.csv").read_bytes()], model.read, ".csv"),
    "manifest": (lambda: [next(lake().glob("plain/v-*/manifest.json")).read_bytes()], of_manifest, ".json"),
    "run log": (lambda: ["\n".join(map(json.dumps, LOG)).encode()], of_log, ".jsonl"),
    "SQL": (lambda: [text.encode() for text in GOOD], of_query, ".sql"),
    "path": (
        lambda: [b"lake/of mine", b"~/lake", "/tmp/\u00e9/../x.toml".encode(), b"s3://bucket/x", b"name-1"], of_path,
    ),
}  # fmt: skip
