"""Files of healsparse, against the table and its covered area."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.tables.survey.depth import ORDER
from truesky.render.camera import pointing
from truesky.survey_maps import euclid_maps, healsparse_files
from truesky.survey_maps.depth_lookup import read_covered, read_depth_map
from truesky.survey_maps.pixel_overlap import PixelGrid, Sums, add_footprints, side_normals

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
    folder = tmp_path / "a" / "b"
    paths = healsparse_files.write(version, folder, ["lsst_r"], ["depth_point", "covered", "mask", "exposures"])
    names = [f"lsst_r_{name}.hsp" for name in ("depth_point", "covered", "mask", "exposures")]
    assert [path.name for path in paths] == names
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    depth = read_depth_map(version, "lsst_r", ["depth_point", "covered", "mask", "exposures"])
    for path, name in zip(paths, ("depth_point", "covered", "mask", "exposures"), strict=True):
        sky_map = healsparse.HealSparseMap.read(str(path))
        np.testing.assert_array_equal(sky_map.valid_pixels, depth.pixels)
        np.testing.assert_array_equal(sky_map.get_values_pix(depth.pixels), depth.columns[name])
    fraction = healsparse.HealSparseMap.read(str(paths[1]))
    area = float(fraction.get_values_pix(fraction.valid_pixels).sum()) * sky.cell_area(ORDER)
    assert area == pytest.approx(float(depth.columns["covered"].sum()) * sky.cell_area(ORDER), rel=1e-6)
    # With 16 samples per pixel, each side of the detector is placed with an error of at most an eighth of a pixel. The
    # detector is 62 pixels wide. The errors of many detectors average out.
    assert area == pytest.approx(footprint_area(version), rel=3e-3)
    whole = healsparse.HealSparseMap.read(str(paths[0])).get_valid_area(degrees=True)
    assert whole == pytest.approx(len(depth.pixels) * sky.cell_area(ORDER), rel=1e-3)


def test_the_area_of_many_detectors():
    """Sample: 40 squares as large as a VIS detector; significance 4e-9 (6 errors of the mean, from their scatter).

    One square is wrong by up to 0.8 % if its sides are parallel to rows of samples, but the errors average out.
    """
    rng, half, errors = np.random.default_rng(1), 205.0, []
    for number in range(40):
        ra, dec = 40.0 + 3.0 * number + rng.random(), -30.0 + number + rng.random()
        x, y = half * np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])
        corners = np.stack(pointing.sky_of_plane(x, y, ra, dec, rng.uniform(0.0, 90.0)), axis=1)[None]
        covered = 0.0
        for cell in sky.cells_in_cone(ra, dec, 2.0 * half / 3600.0, 8):
            grid = PixelGrid.from_cell(8, int(cell), ORDER)
            sums = Sums.zeros(len(grid.centres), 1)
            add_footprints(grid, side_normals(corners), np.zeros(1, np.int64), np.ones((1, 1)), sums)
            covered += float(sums.covered_fraction().sum())
        errors.append(covered * sky.cell_area(ORDER) / (2.0 * half / 3600.0) ** 2 - 1.0)
    assert np.std(errors) < 2e-3
    assert abs(np.mean(errors)) < 6.0 * np.std(errors) / np.sqrt(40.0) < 2e-3
    assert abs(np.mean(errors)) < 1e-3


def test_a_depth_map_of_a_band_without_rows_is_refused(version):
    with pytest.raises(BadInput, match=r"^table depth has no band lsst_u: it has euclid_j, lsst_r$"):
        read_depth_map(version, "lsst_u", ["covered"])
    with pytest.raises(BadInput, match=r"^table depth has no band lsst_r in this part of the sky: it has no rows$"):
        read_depth_map(version, "lsst_r", ["covered"], [])
    empty = read_covered(version, "lsst_u", ["covered"])
    assert (len(empty.pixels), len(empty.columns["covered"])) == (0, 0)
    assert empty.rows_at([1.0, 2.0], [0.0, 0.0]).tolist() == [-1, -1]


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
    file = tmp_path / "map"
    file.touch()
    with pytest.raises(BadInput, match="map: exists and is not a folder"):
        healsparse_files.write(version, file)
    file.unlink()
    with pytest.raises(BadInput, match="table depth has no band lsst_u: it has euclid_j, lsst_r"):
        euclid_maps.write(version, tmp_path / "x.fits", "lsst_u")
    assert not list(tmp_path.iterdir())
