"""Write the table `depth` as healsparse files: one partial HEALPix map per column, each in its own file.

healsparse is the format of survey maps of LSST and DES.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store import manifest, read
from lake_schema.tables.survey.depth import DEPTH, ORDER
from truesky.survey_maps.depth_lookup import choose_bands, read_blocks

# Columns that are written by default.
COLUMNS = (
    "exposures", "exposure_time_s", "sky", "seeing", "psf_area", "depth_point", "depth_aperture", "covered", "a_v",
    "mask", "origin",
)  # fmt: skip
# Nside of the coverage map, whose pixels divide the file into blocks. They are the cells of the table.
_COVERAGE_NSIDE = 32


def write(
    version: read.Version, folder: Path, bands: Sequence[str] = (), columns: Sequence[str] = COLUMNS
) -> list[Path]:
    """Write maps of the table `depth` into a folder, as files with the names <band>_<column>.hsp.

    Parameters
    ----------
    version : Version
        A version of the table `depth`.
    folder : Path
        Folder of the files, which is created if needed. A file appears under its name when it is complete.
    bands : sequence of str
        Names of passbands; by default all bands of the table.
    columns : sequence of str
        Names of columns, of `COLUMNS`.

    Returns
    -------
    list of Path
        The files, by band and then by column.

    Raises
    ------
    BadInput
        If the table has no such band, a column cannot be a map, or the folder is a file or not writable.
    """
    import healsparse

    if unknown := sorted(set(columns) - set(COLUMNS)):
        raise BadInput(f"column {unknown[0]} of table depth is not one of {', '.join(COLUMNS)}")
    chosen_bands = choose_bands(version, bands)
    user_files.check_folder(folder).mkdir(parents=True, exist_ok=True)
    paths = []
    for band in chosen_bands:
        for name in columns:
            value_type = np.dtype(DEPTH.column(name).arrow_type.to_pandas_dtype())
            sky_map = healsparse.HealSparseMap.make_empty(
                _COVERAGE_NSIDE, 1 << ORDER, value_type, sentinel=-1 if value_type.kind == "i" else None
            )
            for pixels, values in read_blocks(version, band, name):
                sky_map.update_values_pix(pixels, values)
            paths.append(folder / f"{band}_{name}.hsp")
            temporary = manifest.temporary_path(paths[-1])
            try:
                sky_map.write(str(temporary), clobber=True)
                temporary.replace(paths[-1])
            finally:
                temporary.unlink(missing_ok=True)
    return paths
