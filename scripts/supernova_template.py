"""Make the table of spectra of type Ia supernovae that is included in the package.

    python -m scripts.supernova_template hsiao.h5

The file hsiao.h5 contains the spectral series of Hsiao et al. 2007 (ApJ 663, 1187), as distributed with the package
bayesn (version 0.4.0, file bayesn/data/hsiao.h5, MIT licence). Only the precision is changed: fluxes keep 12 bits of
their mantissa, so that the table is small.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float32
from truesky.variability.supernova_templates import TYPE_IA_FILE

# Bits of the mantissa of a float32 number that are set to 0; 12 of 23 bits are left, an error of 1.2e-4 at most.
DROPPED_BITS = 11


def round_mantissa(values: Float32) -> Float32:
    """Return float32 numbers above 0, rounded to 12 bits of their mantissa."""
    bits = values.view(np.uint32) + np.uint32(1 << DROPPED_BITS - 1)
    return (bits & ~np.uint32((1 << DROPPED_BITS) - 1)).view(np.float32)


def main(path: Path, out: Path = TYPE_IA_FILE) -> None:
    """Read the spectral series in the HDF5 file `path` and write the table."""
    import h5py

    with h5py.File(path) as file:
        phase, wavelength, flux = (file[f"default/{name}"][:] for name in ("phase", "wave", "flux"))
    scaled = round_mantissa((flux / flux.max()).astype(np.float32))
    np.savez_compressed(out, phase=phase.astype(np.float32), wavelength=wavelength.astype(np.float32), flux=scaled)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
