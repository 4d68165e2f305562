"""Declaration of the table `depth`: how deep each band observes each small pixel of the sky, and what disturbs it.

A pixel is a HEALPix pixel of order 14 (Nside 16384, 12.9 arcsec wide), nested. Pixels without an exposure in a band
have no row.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table

# HEALPix order of the pixels.
ORDER = 14
# Bits of the column `mask`, with their meanings.
EDGE = 1
BRIGHT_STAR = 2
SPIKE = 4
GHOST = 8
SATURATED = 16
BAD_PIXELS = 32
SATELLITE = 64
MASK_BITS = (
    (EDGE, "edge of a detector's image in the pixel"),
    (BRIGHT_STAR, "halo of a bright star"),
    (SPIKE, "diffraction spike or bleeding trail of a bright star"),
    (GHOST, "ghost of a bright star"),
    (SATURATED, "saturated pixels of a detector"),
    (BAD_PIXELS, "bad pixels of the detector on at least 1 % of the area in every exposure"),
    (SATELLITE, "trail of a satellite"),
)
PLANNED, MEASURED, BOTH = 0, 1, 2
ORIGINS = (
    (PLANNED, "plan: expected values of all exposures"),
    (MEASURED, "frames: sky and noise of all exposures were measured on the images"),
    (BOTH, "both: sky and noise were measured for some exposures, and are expected for the others"),
)

DEPTH = Table(
    "depth",
    1,
    (
        Column(
            "_healpix_29",
            "int64",
            ucd="pos.healpix",
            doc="smallest HEALPix index of order 29, nested, in the pixel: the sort key",
            lo=0,
        ),
        Column("pixel", "int64", ucd="pos.healpix", doc="HEALPix pixel of order 14 (Nside 16384), nested", lo=0),
        Column("band", "string", ucd="instr.bandpass", doc="passband name"),
        Column("camera", "string", ucd="instr", doc="camera, a section of the mission database"),
        Column("exposures", "int16", ucd="meta.number;obs.exposure", doc="exposures that cover any of the pixel", lo=1),
        Column(
            "exposure_time_s",
            "float32",
            "s",
            "time.duration;obs.exposure",
            "total exposure time, mean over the covered part of the pixel",
            0.0,
            mantissa_bits=9,
        ),
        Column(
            "sky",
            "float32",
            "electron pix-1 s-1",
            "instr.skyLevel",
            "rate of the sky per detector pixel, mean weighted by exposure time",
            0.0,
            mantissa_bits=9,
        ),
        Column(
            "seeing",
            "float32",
            "arcsec",
            "instr.obsty.seeing",
            "FWHM of the PSF as delivered, mean weighted by exposure time",
            0.0,
            30.0,
            mantissa_bits=9,
        ),
        Column(
            "psf_area",
            "float32",
            "arcsec2",
            "phys.angArea;instr.det.psf",
            "effective area of the PSF: 1 / integral of its square, mean weighted by exposure time",
            0.0,
            mantissa_bits=9,
        ),
        Column(
            "depth_point",
            "float32",
            "mag",
            "phot.mag;instr.sensitivity",
            "AB magnitude of a point source at 5 sigma in all exposures together, before extinction",
            -10.0,
            50.0,
            mantissa_bits=13,
        ),
        Column(
            "depth_aperture",
            "float32",
            "mag",
            "phot.mag;instr.sensitivity",
            "AB magnitude of 5 sigma of the noise in a circle of 2 arcsec diameter, before extinction",
            -10.0,
            50.0,
            mantissa_bits=13,
        ),
        Column(
            "covered", "float32", "", "phys.angArea;arith.ratio", "fraction of the pixel that exposures cover", 0.0, 1.0
        ),
        Column(
            "a_v",
            "float32",
            "mag",
            "phys.absorption.gal",
            "extinction A_V of the Milky Way",
            0.0,
            1e3,
            mantissa_bits=10,
        ),
        Column(
            "mask",
            "int16",
            ucd="meta.code.qual",
            doc="bits: " + "; ".join(f"{bit} {meaning}" for bit, meaning in MASK_BITS),
            lo=0,
            hi=127,
        ),
        Column("origin", "int8", ucd="meta.code", doc="where the values come from", codes=ORIGINS),
    ),
    "Depth, coverage and masks of the survey, in each band and pixel of order 14.",
    key=("pixel", "band"),
    order=5,
    pixel_order=ORDER,
)
