"""Good requests are read completely, and bad requests are refused with the key."""

import copy
import tomllib
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from truesky.request import accuracy, structure
from truesky.request.files import UserCurves
from truesky.request.from_toml import from_table, parse
from truesky.request.structure import Arms, Stamps

DEMO = Path(__file__).parents[3] / "requests" / "demo.toml"
GOOD = tomllib.loads(DEMO.read_text())

BAD = [
    ("colour", "red", "colour"),
    ("seed", -1, "seed"),
    ("seed", 1.5, "seed"),
    ("seed", True, "seed"),
    ("seed", 2**63, "seed"),
    ("noise_seed", -1, "noise_seed"),
    ("noise_seed", 2**63, "noise_seed"),
    ("effects", {"off": ["all", "poisson"]}, "effects.off: 'all' must be the only item"),
    ("effects", {"on": ["all"]}, "effects.on: 'all' is not one of"),
    ("pointing.realisations", 0, r"pointing\[0\].realisations"),
    ("pointing.realisations", 1.0, r"pointing\[0\].realisations"),
    ("name", "../x", "name"),
    ("name", 5, "name"),
    *(("name", name, f"name = '{name}' is reserved") for name in ("main", "temp", "system", "memory", "pg_catalog")),
    ("name", "information_schema", "name = 'information_schema' is reserved in SQL"),
    ("accuracy", "sloppy", "accuracy"),
    ("accuracy", {"flux": 0.0, "shape": 1e-3, "position": 1e-3, "background": 1e-3}, "accuracy.flux"),
    ("accuracy", {"flux": -1.0, "shape": 1e-3, "position": 1e-3, "background": 1e-3}, "accuracy.flux"),
    ("accuracy", {"flux": float("nan"), "shape": 1e-3, "position": 1e-3, "background": 1e-3}, "accuracy.flux"),
    ("accuracy", {"flux": 1e-3}, "accuracy.shape is missing"),
    (
        "accuracy",
        {"flux": 1e-3, "shape": 1e-9, "position": 1e-3, "background": 1e-3},
        "accuracy.shape = 1e-09 cannot be reached, the best is",
    ),
    ("area", {}, "area must have exactly one"),
    ("area", {"cone": {"ra": 0, "dec": 0, "radius": 1}, "box": {"ra": [0, 1], "dec": [0, 1]}}, "area must have"),
    ("area", {"cone": {"ra": 0, "dec": 95, "radius": 1}}, "area.cone.dec"),
    ("area", {"cone": {"ra": 0, "dec": 0, "radius": -1}}, "area.cone.radius"),
    ("area", {"cone": {"ra": float("nan"), "dec": 0, "radius": 1}}, "area.cone.ra"),
    ("area", {"cone": {"ra": 0, "dec": 0}}, "area.cone.radius is missing"),
    ("area", {"cone": {"ra": 0, "dec": 0, "radius": 1, "x": 1}}, "area.cone.x"),
    ("area", {"box": {"ra": [1, 0], "dec": [0, 1]}}, "area.box.ra"),
    ("area", {"box": {"ra": [0, 1], "dec": [1, 0]}}, "area.box.dec"),
    ("area", {"box": {"ra": [0, 1], "dec": [0, 1, 2]}}, "area.box.dec"),
    ("area", {"polygon": [[0, 0], [1, 0]]}, "area.polygon"),
    ("area", {"polygon": [[0, 0], [1, 0], [1, 95]]}, r"area.polygon\[2\].dec"),
    ("area", {"polygon": [[0, 0], [2, 0], [1, 0.5], [2, 2]]}, "area.polygon"),
    ("area", {"polygon": [[0, 0], 1, [1, 1]]}, r"area.polygon\[1\]"),
    ("area", "all", "area"),
    ("structure", {"bars": True}, "structure.bars"),
    ("structure", {"arms": "many"}, "structure.arms must be true or a table"),
    ("structure", {"arms": {"pitch": 20.0}}, "structure.arms.pitch"),
    ("structure", {"arms": {"contrast": -0.1}}, "structure.arms.contrast"),
    ("structure", {"arms": {"knots": 0.6}}, "structure.arms.knots"),
    ("structure", {"arms": {"number": 10**6}}, "structure.arms.number"),
    ("structure", {"arms": {"least_radius": float("nan")}}, "structure.arms.least_radius"),
    ("structure", {"arms": {"contrast": 0, "knots": 0}}, "structure.arms: contrast or knots must be above 0"),
    ("structure", {"stamps": "a.fits"}, "structure.stamps must be a table"),
    ("structure", {"stamps": {}}, "structure.stamps.file is missing"),
    ("structure", {"stamps": {"file": "a.fits", "sky": 1}}, "structure.stamps.sky"),
    ("structure", {"stamps": {"file": "a.fits", "nearest": 1}}, "structure.stamps.nearest"),
    (
        "structure",
        {"stamps": {"file": "a.fits", "least_radius": 1.0}},
        "structure.stamps.least_radius requires nearest",
    ),
    ("universe", {"galaxy_limit": 99}, "universe.galaxy_limit"),
    ("universe", {"galaxy_limit": "26"}, "universe.galaxy_limit"),
    ("universe", {"galaxy_band": 3}, "universe.galaxy_band"),
    ("universe", {"z_max": 0}, "universe.z_max"),
    ("universe", {"box_cells": 200}, "universe.box_cells = 200 is not one of 192, 256, 384"),
    ("fluxes", {"intergalactic": "yes"}, "fluxes.intergalactic"),
    ("ingest", {"training": {"files": []}}, "ingest.training.files"),
    ("ingest", {"training": {"files": ["x"], "format": "flagship2"}}, "ingest.training.format"),
    ("ingest", {"training": {"files": ["x"]}, "galaxies": {"files": ["y"]}}, "ingest.training is not allowed"),
    ("universe", {"deep": True}, "universe.deep"),
    ("universe", {"lensing": "some"}, "universe.lensing = 'some' is not one of box, none"),
    ("universe", {"lensing": 0.1}, "universe.lensing must be .* or a table"),
    ("universe", {"lensing": {"g1": 0.1}}, "universe.lensing.g2 is missing"),
    ("universe", {"lensing": {"g1": 0.1, "g2": 1.5}}, "universe.lensing.g2"),
    ("universe", {"lensing": {"g1": 0.7, "g2": 0.7}}, r"universe.lensing = .*: \|g\| = 0.9899"),
    ("universe", {"lensing": {"g1": 0.1, "g2": float("nan")}}, "universe.lensing.g2"),
    ("universe", {"rotation": 400}, "universe.rotation"),
    ("universe", {"structure_below_cells": 1}, "universe.structure_below_cells"),
    ("universe", {"variables": "yes"}, "universe.variables"),
    ("universe", {"cosmology": 3}, "universe.cosmology must be a table"),
    ("universe", {"cosmology": {"omega_c": 0.2}}, "universe.cosmology.omega_c is not a key of a request"),
    ("universe", {"cosmology": {"h": 67}}, r"universe.cosmology.h = 67 is outside .*: did you mean 0.67\?"),
    ("universe", {"cosmology": {"h": float("nan")}}, "universe.cosmology.h = nan is outside"),
    ("universe", {"cosmology": {"omega_m": "0.3"}}, "universe.cosmology.omega_m must be a number"),
    (
        "universe",
        {"cosmology": {"omega_m": 0.12, "omega_b": 0.15}},
        "universe.cosmology: omega_b = 0.15 must be smaller than omega_m = 0.12",
    ),
    ("universe", {"cosmology": {"w0": -0.5, "wa": 0.5}}, r"universe.cosmology: w0 \+ wa = 0 must be at most -0.1"),
    ("universe", {"cosmology": {"sigma_8": 0}}, "universe.cosmology.sigma_8 = 0 is outside"),
    ("universe", {"cosmology": {"m_nu": -0.1}}, "universe.cosmology.m_nu = -0.1 is outside"),
    ("universe", {"cosmology": {"m_nu": 0.51}}, "universe.cosmology.m_nu = 0.51 is outside"),
    ("universe", {"cosmology": {"m_nu": float("nan")}}, "universe.cosmology.m_nu = nan is outside"),
    ("universe", {"cosmology": {"m_nu": 1e-160}}, "universe.cosmology: m_nu = 1e-160 must be 0, or from 0.001 to 0.5"),
    (
        "universe",
        {"cosmology": {"m_nu": 0.5, "h": 0.4, "omega_m": 0.24}},
        "universe.cosmology: m_nu = 0.5, h = 0.4 and omega_m = 0.24 make neutrinos a fraction of 0.14 of all matter, "
        "at most 0.04 is possible: decrease m_nu",
    ),
    (
        "universe",
        {"cosmology": {"m_nu": 0.06, "power": "eisenstein98"}},
        'universe.cosmology: m_nu = 0.06 requires power = "camb": eisenstein98 has no massive neutrinos',
    ),
    ("universe", {"cosmology": {"power": "class"}}, "universe.cosmology.power = 'class' is not one of"),
    ("stars", {"bright_limit": 26.0}, "stars.bright_limit = 26 leaves no star"),
    ("stars", {"bright_limit": "none"}, "stars.bright_limit"),
    ("stars", {"plane_limit": -1}, "stars.plane_limit"),
    ("stars", {"plane_limit": "none"}, "stars.plane_limit"),
    ("stars", {"density": "galaxia"}, "stars.density"),
    ("stars", {"brown_dwarf_boost": -1}, "stars.brown_dwarf_boost"),
    ("stars", {"tycho2": "tyc2.dat"}, "stars.tycho2"),
    ("stars", {"catalogue": {"columns": {}}}, "stars.catalogue.file is missing"),
    ("stars", {"catalogue": {"file": "x", "columns": {"ra": 3}}}, "stars.catalogue.columns.ra"),
    ("stars", {"columns": []}, "stars.columns"),
    ("stars", {"rows_a_file": 0}, "stars.rows_a_file"),
    ("stars", {"rows_a_file": 1e6}, "stars.rows_a_file"),
    ("mission", {"ladder": ["BEST"]}, "mission.ladder"),
    ("mission", {"ladder": ["CBE", "CBE"]}, "mission.ladder"),
    ("mission", {"ladder": "CBE"}, "mission.ladder"),
    ("mission", {"overrides": {"vis.gain": 3}}, "mission.overrides.vis.gain"),
    ("mission", {"overrides": {"vis.gain": {"value": 3.0}}}, "mission.overrides.vis.gain.unit"),
    ("mission", {"overrides": {"vis.gain": {"value": float("inf"), "unit": ""}}}, "vis.gain.value"),
    ("fluxes", {"bands": "r"}, "fluxes.bands"),
    ("fluxes", {"filters": {}}, "fluxes.filters is not a key"),
    ("fluxes", {"passbands": {"a b": {}}}, "name 'a b'"),
    ("fluxes", {"passbands": {"mine": "file.dat"}}, "fluxes.passbands.mine must be a table"),
    ("fluxes", {"passbands": {"mine": {"format": "passband_ascii", "medium": "air"}}}, "mine.file is missing"),
    ("fluxes", {"passbands": {"mine": {"file": "x", "medium": "air"}}}, "mine.format is missing"),
    ("fluxes", {"passbands": {"mine": {"file": "x", "format": "y", "medium": "sea"}}}, "mine.medium = 'sea'"),
    ("fluxes", {"templates": {"format": "cosmos"}}, "fluxes.templates.files is missing"),
    ("fluxes", {"templates": {"files": ["x"]}}, "fluxes.templates.format is missing"),
    ("fluxes", {"extinction": {"5": {"file": "x", "format": "extinction"}}}, "fluxes.extinction.5 is not a key"),
    ("fluxes", {"extinction": {"2": {"file": 3, "format": "extinction"}}}, "fluxes.extinction.2.file must be text"),
    ("fluxes", {"stars": {}}, "fluxes.stars must have basel or irtf"),
    ("fluxes", {"stars": {"basel": ["x.cor"]}}, "fluxes.stars.basel must be text"),
    ("products", {"truth": ["everything"]}, "products.truth"),
    ("products", {"compression": "zip"}, "products.compression"),
    ("products", {"wcs": "zpn"}, "products.wcs"),
    ("products", {"files": "quadrant"}, "products.files = 'quadrant'"),
    ("products", {"files": "exposure", "names": "esa"}, "products.names = 'esa' is not one of truesky, euclid"),
    ("products", {"names": "euclid"}, 'products.names = "euclid" names files of whole exposures: write files = "expo'),
    ("products", {"readout": "photons"}, "products.readout = 'photons'"),
    ("pointing", {}, "pointing must be a list"),
    ("pointing", [3], r"pointing\[0\]"),
    ("pointing.channel", "RADIO", r"pointing\[0\].channel"),
    ("pointing.ra", "north", r"pointing\[0\].ra"),
    ("pointing.dec", -91, r"pointing\[0\].dec"),
    ("pointing.mjd", 0, r"pointing\[0\].mjd"),
    ("pointing.exposure_time_s", -1, r"pointing\[0\].exposure_time_s"),
    ("pointing.detectors", "3-4", r"pointing\[0\].detectors"),
    ("pointing.camera", "../vis", r"pointing\[0\].camera: channel VIS has no camera '../vis'"),
    ("pointing.colour", 1, r"pointing\[0\].colour"),
]


def with_(key, value):
    table = copy.deepcopy(GOOD)
    if key.startswith("pointing."):
        table["pointing"][0][key.partition(".")[2]] = value
    else:
        table[key] = value
    return table


@pytest.mark.parametrize(("key", "value", "words"), BAD)
def test_bad_requests_are_refused_with_their_key(key, value, words):
    with pytest.raises(BadInput, match=words) as caught:
        from_table(with_(key, value))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["name", "seed"])
def test_required_keys(key):
    table = copy.deepcopy(GOOD)
    del table[key]
    with pytest.raises(BadInput, match=f"{key} is missing"):
        from_table(table)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = ", "r.toml line 1: the value after the equals sign is missing"),
        ("name = 'x'\nname = 'y'", "r.toml line 2: name is given twice, first in line 1"),
        ("\ud800", "surrogates|codec"),
        ("x = " + "[" * 100_000, "."),
        ("# " + "x" * 2_000_000, "larger than"),
    ],
)
def test_files_that_are_not_requests(tmp_path, text, words):
    path = tmp_path / "r.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(BadInput, match=words) as caught:
        parse(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(BadInput, match="no such file"):
        parse(tmp_path / "x.toml")


def test_the_demo():
    demo = parse(DEMO)
    assert demo.bands == ("euclid_vis", "lsst_r")
    assert demo.pointings[0].detectors == ("3-4",)
    assert demo.accuracy == accuracy.SURVEY
    assert set(demo.facts("seed", "universe")) == {"seed", "universe"}


def test_fluxes_are_computed_in_the_bands_of_exposures_too():
    table = tomllib.loads(DEMO.read_text())
    table["fluxes"] = {"bands": ["euclid_h", "lsst_r"]}
    assert from_table(table).bands == ("euclid_h", "lsst_r", "euclid_vis")


def test_discs_have_structure_if_requested():
    """Facts about images mention structure only if it is requested."""
    assert structure.facts(from_table(GOOD).structure) == structure.facts(from_table(with_("structure", {})).structure)
    assert structure.facts(from_table(with_("structure", {"arms": False})).structure) == {}
    assert from_table(with_("structure", {"arms": True})).structure.arms == Arms()
    some = from_table(with_("structure", {"arms": {"contrast": 0.5, "number": 40}})).structure
    assert some.arms == Arms(contrast=0.5, number=40)
    assert structure.facts(some)["structure"]["arms"]["number"] == 40
    own = from_table(with_("structure", {"stamps": {"file": "a.fits", "nearest": True}}), Path("there")).structure
    assert own.stamps == Stamps(Path("there/a.fits"), True, 0.5)
    # The name of a library does not matter; its sha256 identifies it.
    assert structure.facts(own) == {"structure": {"stamps": {"nearest": True, "least_radius": 0.5}}}


def test_areas_are_the_same_sky_in_any_form():
    west = from_table(with_("area", {"box": {"ra": [-0.5, 0.5], "dec": [-0.5, 0.5]}}))
    polygon = from_table(with_("area", {"polygon": [[359.5, -0.5], [0.5, -0.5], [0.5, 0.5], [359.5, 0.5]]}))
    cone = from_table(with_("area", {"cone": {"ra": 0, "dec": 0, "radius": 0.4}}))
    assert set(cone.area.cells()) <= set(west.area.cells()) & set(polygon.area.cells())
    assert len(set(west.area.cells()) ^ set(polygon.area.cells())) <= 4


def test_numbers_of_any_size_are_numbers():
    with pytest.raises(BadInput, match=r"area\.cone\.ra"):
        from_table(with_("area", {"cone": {"ra": 10**400, "dec": 0, "radius": 1}}))


def test_user_curves_are_relative_to_the_request_and_add_bands(tmp_path):
    fluxes = """
[fluxes.passbands.mine]
file = "filters/mine.dat"
format = "passband_ascii"
medium = "air"
[fluxes.templates]
files = ["a.sed", "/b.sed"]
format = "cosmos"
[fluxes.extinction.3]
file = "bump.dat"
format = "extinction"
[fluxes.stars]
basel = "lcbp00.cor"
irtf = ["G2V.txt", "M0V.txt"]
"""
    (tmp_path / "r.toml").write_text(DEMO.read_text() + fluxes)
    asked = parse(tmp_path / "r.toml")
    assert asked.bands == ("euclid_vis", "lsst_r", "mine")
    ((name, mine),) = asked.curves.passbands
    assert (name, mine.medium, mine.files) == ("mine", "air", (tmp_path / "filters" / "mine.dat",))
    assert asked.curves.templates.files == (tmp_path / "a.sed", Path("/b.sed"))
    assert [code for code, _ in asked.curves.extinction] == [3]
    assert asked.curves.basel == tmp_path / "lcbp00.cor"
    assert asked.curves.irtf == (tmp_path / "G2V.txt", tmp_path / "M0V.txt")
    assert parse(DEMO).curves == UserCurves()


def test_exchanged_coordinates_of_a_pointing_are_named():
    table = tomllib.loads(DEMO.read_text())
    pointing = table["pointing"][0]
    pointing["ra"], pointing["dec"] = pointing["dec"], pointing["ra"]
    with pytest.raises(BadInput, match=r"pointing\[0\]: ra = 332.192, dec = 53.117 is outside .* ra and dec exchanged"):
        from_table(table)
