"""Read stars from external files. All files are synthetic: they have the published formats and invented numbers."""

import hashlib

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.store.validate import check_rows
from lake_schema.tables.templates import TEMPLATES
from truesky.fluxes import inputs, passbands
from truesky.fluxes.libraries import from_files, stars_from_files, stellar, templates
from truesky.request.files import UserCurves

NM = 9.1 + (160_000.0 - 9.1) * np.expm1(0.0075 * np.arange(1221)) / np.expm1(0.0075 * 1220)


def basel_file(
    path, models=((5750, 4.5, -0.5), (3500, 1.0, 0.2)), value=1e-5, shape=lambda teff, log_g: 1.0 + 0.0 * NM
):
    """Models (teff, log_g, metallicity) of H_nu = value * their running number * shape on NM."""
    lines = []
    for start in range(0, 1221, 8):
        lines.append("".join(f"{x:10.1f}" for x in NM[start : start + 8]))
    for k, (teff, log_g, metallicity) in enumerate(models):
        lines.append(f"{k + 1:6d}{teff:6d}{log_g:6.2f}{metallicity:6.2f}{2.0:6.2f}{0.7:6.2f}")
        h_nu = value * (k + 1) * shape(teff, log_g)
        for start in range(0, 1221, 7):
            lines.append("".join(f"{x:11.4E}" for x in h_nu[start : start + 7]))
    path.write_text("\n".join(lines) + "\n")
    return path


def black_bodies(path, temperatures=(2000, 2500, 3500, 5000, 8000, 15_000, 50_000), metallicities=(0.0,)):
    """Write Planck spectra at log g = 4.5. Models with log g = 1 and metal-poor models have other spectra."""
    models = [(t, g, m) for m in metallicities for t in temperatures for g in (1.0, 4.5)]

    def shape(teff, log_g):
        f_nu = stellar.planck(10.0 * NM, teff) * NM**2 * (NM if log_g < 4.0 else 1.0)
        return np.maximum(f_nu, 1e-90)

    return basel_file(path, models, shape=shape)


def irtf_file(path, slope, wiggle=0.05):
    um = np.arange(0.81, 2.42, 0.001)
    flux = um**slope * (1.0 + wiggle * np.sin(um * 300.0))
    np.savetxt(path, np.stack([um, flux, 0.01 * flux], 1), header="SYNTHETIC")
    return path


def test_basel(tmp_path):
    models = stars_from_files.read_basel(basel_file(tmp_path / "synthetic_lcbm05.cor"))
    assert models.teff.tolist() == [5750.0, 3500.0]
    assert models.log_g.tolist() == [4.5, 1.0]
    assert models.metallicity.tolist() == [-0.5, 0.2]
    assert models.wavelength[[0, -1]].tolist() == [91.0, 1.6e6]
    # ReadMe: f_lambda = 0.4 H_nu c / lambda^2 with c = 2.997925e17 nm/s and lambda in nm, per A.
    nm = models.wavelength / 10.0
    np.testing.assert_allclose(models.flux[0], 0.4 * 1e-5 * 2.997925e17 / nm**2, rtol=1e-5)
    np.testing.assert_allclose(models.flux[1], 2.0 * models.flux[0], rtol=1e-12)


@pytest.mark.parametrize("damage", ["cut", "header", "negative", "empty", "absent"])
def test_damaged_basel_files_are_refused(tmp_path, damage):
    path = basel_file(tmp_path / "synthetic_lcb.cor", value=-1e-5 if damage == "negative" else 1e-5)
    lines = path.read_text().splitlines()
    if damage == "cut":
        path.write_text("\n".join(lines[:-10]))
    elif damage == "header":
        path.write_text("\n".join([*lines[:153], "no model at all", *lines[154:]]))
    elif damage == "empty":
        path.write_text("\n".join(lines[:153]))
    elif damage == "absent":
        path.unlink()
    with pytest.raises(BadInput, match=r"lcb\.cor"):
        stars_from_files.read_basel(path)


def test_dwarfs_have_the_models_of_their_temperature_and_gravity(tmp_path):
    library, infrared = stars_from_files.library(black_bodies(tmp_path / "synthetic.cor"), ())
    embedded, types, grid = templates.stellar_library(), stellar.types(), passbands.grid()
    n = len(types.names)
    assert (infrared == -1).all()
    assert library.names == embedded.names
    first = templates.first_model()
    np.testing.assert_array_equal(library.flux[n:first], embedded.flux[n:first])
    # Stars of any metallicity have the black bodies of the file.
    truth = stellar.normalise(grid, stellar.planck(grid, 3600.0))
    seen = (grid > 4000.0) & (grid < 23_000.0)
    np.testing.assert_allclose(library.flux[first, seen], truth[seen], rtol=0.02)
    seen = (grid > 4000.0) & (grid < 23_000.0)
    for k in (0, 30, n - 1):
        truth = stellar.normalise(grid, stellar.planck(grid, types.teff[k]))
        np.testing.assert_allclose(library.flux[k, seen], truth[seen], rtol=0.02)


def test_dwarfs_that_no_model_covers_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"\.cor: models of 3500 \.\. 5000 K do not cover the dwarfs' 2\d+ \.\. 3\d+ K"):
        stars_from_files.library(black_bodies(tmp_path / "synthetic.cor", (3500, 5000)), ())


def test_infrared_files_alone_change_the_built_in_dwarfs(tmp_path):
    files = [irtf_file(tmp_path / f"{k}.txt", slope) for k, slope in enumerate((-3.5, -1.0))]
    library, infrared = stars_from_files.library(None, files)
    embedded, grid = templates.stellar_library(), passbands.grid()
    # Hot stars get the blue spectrum; the optical part is unchanged.
    assert (infrared[0], infrared[-1]) == (0, 1)
    blue = grid < 8100.0
    np.testing.assert_allclose(library.flux[:, blue], embedded.flux[:, blue], rtol=1e-6)
    far = (grid > 10_000.0) & (grid < 20_000.0)
    assert np.ptp(library.flux[0, far] / embedded.flux[0, far]) > 0.05


def test_each_star_records_its_files(tmp_path):
    models = black_bodies(tmp_path / "synthetic.cor")
    irtf = tuple(irtf_file(tmp_path / f"{name}.txt", slope) for name, slope in (("hot", -3.5), ("cool", -1.0)))
    own = inputs.read(UserCurves(basel=models, irtf=irtf))
    assert set(own.sha256()) == {"fluxes.stars.basel", "fluxes.stars.irtf.0", "fluxes.stars.irtf.1"}
    rows = inputs.template_rows(own)
    check_rows(rows, TEMPLATES)
    stars = [row for row in rows.select(["library", "sed", "source", "sha256"]).to_pylist() if row["library"] == "star"]
    assert stars[0]["source"] == "synthetic.cor, hot.txt: read as basel; the last, read as irtf, in the infrared"
    assert stars[0]["sha256"] == hashlib.sha256(models.read_bytes() + irtf[0].read_bytes()).hexdigest()
    assert stars[441]["source"].startswith("vega.txt")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"basel": "absent.cor"}, r"fluxes\.stars: .*absent\.cor"),
        ({"irtf": ("absent.txt",)}, r"fluxes\.stars: .*absent\.txt"),
    ],
)
def test_bad_files_are_refused_with_their_key(tmp_path, given, words):
    paths = {key: tmp_path / name if key == "basel" else (tmp_path / name[0],) for key, name in given.items()}
    with pytest.raises(BadInput, match=words):
        inputs.read(UserCurves(**paths))


def test_infrared_stars_are_spliced_by_colour():
    grid = passbands.grid()
    slopes = (-1.0, -2.0, -3.0)
    wiggle = 1.0 + 0.05 * np.sin(grid / 30.0)
    irtf = [from_files.Curve(grid[grid > 8000.0], ((grid / 1e4) ** s * wiggle)[grid > 8000.0]) for s in slopes]
    low = np.stack([7.0 * (grid / 1e4) ** s for s in (-2.9, -1.05)])
    out, chosen = stars_from_files.splice(grid, low, irtf)
    assert chosen.tolist() == [2, 0]
    outside = grid < 8200.0
    np.testing.assert_array_equal(out[:, outside], low[:, outside])
    middle = (grid > 8300.0) & (grid < 23_900.0)
    # Fine structure is from the star; the broad shape and the level are from the low-resolution spectrum.
    ratio = out[:, middle] / low[:, middle]
    assert np.abs(ratio - 1.0).max() < 0.12
    for row, slope in ((0, -3.0), (1, -1.0)):
        detail = out[row, middle] / (grid[middle] / 1e4) ** slope / wiggle[middle]
        assert np.abs(np.diff(np.log(detail))).max() < 1e-5
