"""Make reference images of charge transfer inefficiency (CTI) with the program arCTIc, for the tests of truesky.

Usage: python benchmarks/cti_reference.py [FILE]

The script requires a separate Python environment: arcticpy 2.6 needs NumPy < 2 and the GNU Scientific Library. Every
transfer is simulated (express = 0), and the traps are empty at the first transfer. The images show galaxies on a sky of
130 electrons, without and with cosmic rays. They have 2086 rows, of which the last 20 are overscan. The changes by CTI
are stored as integers in units of 0.001 electrons.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

FILE = (
    Path(__file__).resolve().parents[1] / "tests" / "truesky" / "render" / "effects" / "readout" / "cti_reference.npz"
)
ROWS, OVERSCAN, COLUMNS, SKY = 2086, 20, 32, 130.0
# Density (traps per pixel) and release time (pixel transfers) of three species of traps at the end of the mission
# (Israel et al. 2015).
DENSITY, RELEASE = (0.02, 0.03, 0.95), (0.8, 3.5, 20.0)
# Full well (electrons), and exponent of the volume of a charge cloud as a function of its charge, from the examples of
# arCTIc for Euclid.
FULL_WELL, POWER = 2e5, 0.58
# Unit of the stored changes, electrons.
UNIT = 0.001


def galaxies(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return an image [ROWS, COLUMNS] of galaxies with Poisson noise in whole electrons, and a table of the galaxies.

    The columns of the table are row, column, electrons and scale length (pixels). The overscan rows are 0.
    """
    pixels = ROWS - OVERSCAN
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    expected = np.full((ROWS, COLUMNS), SKY)
    table = []
    for block in range(2):
        for number, row in enumerate(range(100 + 40 * block, pixels - 40, 80)):
            column = 16 * block + rng.uniform(7, 9)
            row_at, scale, ratio = row + rng.uniform(-1, 1), rng.uniform(1.2, 2.5), rng.uniform(0.4, 1.0)
            electrons, angle = 10 ** (2.8 + 1.8 * ((5 * number + 3 * block) % 12) / 11), np.pi * rng.random()
            u = (x - column) * np.cos(angle) + (y - row_at) * np.sin(angle)
            v = (y - row_at) * np.cos(angle) - (x - column) * np.sin(angle)
            light = np.exp(-np.hypot(u, v / ratio) / scale)
            expected += electrons * light / light.sum()
            table.append((row_at, column, electrons, scale))
    image = rng.poisson(expected).astype(np.int32)
    image[pixels:] = 0
    return image, np.array(table)


def cosmic_rays(rng: np.random.Generator) -> np.ndarray:
    """Return an image [ROWS, COLUMNS] of short cosmic-ray tracks in whole electrons, which cover 2 % of the pixels."""
    pixels = ROWS - OVERSCAN
    hits = np.zeros((ROWS, COLUMNS), np.int32)
    while (hits > 0).mean() < 0.02:
        row, column, angle, length = (
            rng.uniform(0, pixels),
            rng.uniform(0, COLUMNS),
            rng.uniform(0, 7),
            rng.uniform(1, 12),
        )
        for step in np.arange(0.0, length, 0.5):
            r, c = int(row + step * np.sin(angle)), int(column + step * np.cos(angle))
            if 0 <= r < pixels and 0 <= c < COLUMNS:
                hits[r, c] += int(rng.exponential(500.0))
    return hits


def main(file: Path) -> None:
    """Write the reference images to a compressed file of numpy (.npz), or only print a message without arcticpy.

    SystemExit is raised if a change does not fit into 32 bits.
    """
    try:
        import arcticpy
    except ImportError:
        print("cti_reference: skipped, because arcticpy is not installed")
        return
    rng = np.random.default_rng(11)
    image, table = galaxies(rng)
    arrays = {"galaxies": image, "cosmic_rays": cosmic_rays(rng), "table": table}
    traps = [arcticpy.TrapInstantCapture(density, release) for density, release in zip(DENSITY, RELEASE, strict=True)]
    ccd = arcticpy.CCD(full_well_depth=FULL_WELL, well_fill_power=POWER)
    roe = arcticpy.ROE(empty_traps_for_first_transfers=True, overscan_start=ROWS - OVERSCAN)
    for name, frame in (("clean", image), ("hit", image + arrays["cosmic_rays"])):
        out = arcticpy.add_cti(
            frame.astype(float),
            parallel_ccd=ccd,
            parallel_roe=roe,
            parallel_traps=traps,
            parallel_express=0,
            verbosity=0,
        )
        change = np.rint((out - frame) / UNIT)
        if np.abs(change).max() > np.iinfo(np.int32).max:
            raise SystemExit(f"{name}: losses of {np.abs(change).max() * UNIT:.0f} electrons exceed 32-bit integers")
        arrays[name] = change.astype(np.int32)
        print(f"{name}: rms of the change {np.sqrt(((out - frame) ** 2).mean()):.2f} electrons")
    np.savez_compressed(file, **arrays)
    print(f"{file}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
