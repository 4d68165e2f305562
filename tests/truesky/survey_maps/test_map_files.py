"""Files of healsparse, against the table and its covered area."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.tables.survey.depth import ORDER
from truesky.render.camera import pointing
from truesky.survey_maps import euclid_maps, healsparse_files
from truesky.survey_maps.depth_lookup import read_depth_map

from . import planned

healsparse = pytest.importorskip("healsparse")


@pytest.fixture(scope="module")
def version(tmp_path_factory):
    return planned.depth(tmp_path_factory.mktemp("lake"), planned.request(planned.POINTINGS[2:]))


def footprint_area(version):
    """Return the area of the footprint of the LSST detector, deg^2, from its corners in the plan."""
    tasks = read.version(version.folder.parent.parent, "tasks").rows()
    (row,) = (row for row in tasks.to_pylist() if row["detector"] == "R22_S11")
    corners = np.array(row["s_region"].split()[2:], float).reshape(-1, 2)
    east, north, out = (axis.ravel() for axis in pointing.basis(row["ra"], row["dec"]))
    x, y, z = ((sky.unit_vectors(*corners.T) * axis).sum(axis=1) for axis in (east, north, out))
    x, y = np.degrees(x / z), np.degrees(y / z)
    return 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))


def test_the_maps_have_the_values_and_the_area_of_the_table(version, tmp_path):
    paths = healsparse_files.write(version, tmp_path, ["lsst_r"], ["depth_point", "covered", "mask", "exposures"])
    names = [f"lsst_r_{name}.hsp" for name in ("depth_point", "covered", "mask", "exposures")]
    assert [path.name for path in paths] == names
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    depth = read_depth_map(version, "lsst_r", ["depth_point", "covered", "mask", "exposures"])
    for path, name in zip(paths, ("depth_point", "covered", "mask", "exposures"), strict=True):
        sky_map = healsparse.HealSparseMap.read(str(path))
        np.testing.assert_array_equal(sky_map.valid_pixels, depth.pixels)
        np.testing.assert_array_equal(sky_map.get_values_pix(depth.pixels), depth.columns[name])
    fraction = healsparse.HealSparseMap.read(str(paths[1]))
    area = float(fraction.get_values_pix(fraction.valid_pixels).sum()) * sky.cell_area(ORDER)
    assert area == pytest.approx(float(depth.columns["covered"].sum()) * sky.cell_area(ORDER), rel=1e-6)
    # With 16 samples per pixel, each side of the detector is placed with an error of at most an eighth of a pixel.
    assert area == pytest.approx(footprint_area(version), rel=3e-3)
    whole = healsparse.HealSparseMap.read(str(paths[0])).get_valid_area(degrees=True)
    assert whole == pytest.approx(len(depth.pixels) * sky.cell_area(ORDER), rel=1e-3)


def test_euclid_maps_have_pixel_and_weight(version, tmp_path):
    from astropy.io import fits

    path = euclid_maps.write(version, tmp_path / "depth.fits", "lsst_r")
    with fits.open(path, checksum=True) as hdus:
        header, rows = hdus[1].header, hdus[1].data
        assert rows.names == ["PIXEL", "WEIGHT"]
        assert [str(rows.dtype[i]) for i in (0, 1)] == [">i8", ">f4"]
        cards = {key: header[key] for key in ("PIXTYPE", "ORDERING", "NSIDE", "INDXSCHM")}
        assert cards == {"PIXTYPE": "HEALPIX", "ORDERING": "NEST", "NSIDE": 16384, "INDXSCHM": "EXPLICIT"}
        depth = read_depth_map(version, "lsst_r", ["depth_point"])
        np.testing.assert_array_equal(rows["PIXEL"], depth.pixels)
        np.testing.assert_array_equal(rows["WEIGHT"], depth.columns["depth_point"])


def test_what_cannot_be_a_map_is_refused(version, tmp_path):
    with pytest.raises(BadInput, match="column camera of table depth is not one of exposures"):
        healsparse_files.write(version, tmp_path, columns=["camera"])
    with pytest.raises(BadInput, match="column camera of table depth is not one of depth_point"):
        euclid_maps.write(version, tmp_path / "x.fits", "lsst_r", "camera")
    with pytest.raises(BadInput, match="table depth has no band lsst_u: it has euclid_j, lsst_r"):
        euclid_maps.write(version, tmp_path / "x.fits", "lsst_u")
    assert not list(tmp_path.iterdir())
