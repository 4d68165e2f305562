"""Names are suggested for names with another spelling, and for parts of names."""

import pytest

from lake_schema.texts import spelling

BANDS = ("euclid_vis", "euclid_y", "lsst_r", "lsst_i")


@pytest.mark.parametrize(
    ("name", "existing", "closest"),
    [
        ("VIS", BANDS, ["euclid_vis"]),
        ("euclid_viz", BANDS, ["euclid_vis"]),
        ("r", BANDS, ["lsst_r"]),
        ("LSSTCam", ("decam", "lsstcam"), ["lsstcam"]),
        ("CCD_7", ("ccd70", "ccd7", "ccd1"), ["ccd7", "ccd70", "ccd1"]),
        ("galaxy_limt", ("galaxy_band", "galaxy_limit"), ["galaxy_limit"]),
        ("DET_22", ("DET12", "DET22"), ["DET22"]),
        ("whatever", BANDS, []),
        ("", BANDS, []),
    ],
)
def test_the_closest_name_comes_first(name, existing, closest):
    found = spelling.closest_names(name, existing)
    assert found[: len(closest)] == closest
    assert bool(found) == bool(closest)


def test_words_are_joined():
    assert spelling.join_words(["bias"]) == "bias"
    assert spelling.join_words(["bias", "dark"]) == "bias or dark"
    assert spelling.join_words(("LAKE", "--out", "--name"), "and") == "LAKE, --out and --name"


def test_another_filter_is_not_suggested():
    bands = ("hsc_g", "hsc_z", "lsst_g", "lsst_i", "ps1_i", "euclid_vis")
    for name in ("HSC-i", "hsc_i"):
        assert spelling.choices(name, bands) == "allowed with hsc: hsc_g, hsc_z; allowed with i: lsst_i, ps1_i"
    assert spelling.choices("lsst-g", bands).startswith("did you mean lsst_g?")
    assert spelling.choices("euclid_y", bands) == "allowed with euclid: euclid_vis"
    assert spelling.related_bands("wfi_g", bands) == ""


def test_a_suggestion_stands_before_the_allowed_names():
    assert spelling.choices("VIS", BANDS) == f"did you mean euclid_vis? allowed: {', '.join(BANDS)}"
    assert spelling.choices("whatever", BANDS) == f"allowed: {', '.join(BANDS)}"
    many = [f"n{i:03}" for i in range(100)]
    assert spelling.choices("x", many).endswith("n007, ... (100 names)")
    assert spelling.choices("n0001", many) == "did you mean n001?"


def test_a_part_of_several_names_suggests_all_of_them():
    assert spelling.did_you_mean("nisp", ("VIS", "NISP-P", "NISP-S")) == "did you mean NISP-P or NISP-S?"
    assert spelling.did_you_mean("r", [f"survey{i}_r" for i in range(9)]).count(" or ") == 2


def test_the_plural_comes_first():
    names = ("galaxy_fluxes", "galaxies", "star_fluxes", "stars")
    assert spelling.did_you_mean("galaxy", names) == "did you mean galaxies?"
    assert spelling.did_you_mean("star", names) == "did you mean stars?"
