"""Exposures and tasks planned from requests, compared with published numbers of the surveys."""

import copy
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.store import validate
from lake_schema.tables.exposures import EXPOSURES, ExposureRow
from lake_schema.tables.tasks import TASKS
from tests.truesky import nightly
from truesky.render.camera import astrometry
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera.detectors import Detector
from truesky.render.camera.pointing import basis, outline
from truesky.render.channels import image_types
from truesky.render.plan_exposures import plan
from truesky.render.planning import planned_exposures, reference_survey, source_counts, survey, tasks, variants
from truesky.render.planning.observing_sequence import offsets
from truesky.render.sky import observatory, solar_aspect
from truesky.request import accuracy, schema
from truesky.request.area import Area
from truesky.request.from_toml import from_table, parse

MISSION = resolve()
DEMO = Path(__file__).parents[4] / "requests" / "demo.toml"
BASE = {"name": "x", "seed": 7, "area": {"cone": {"ra": 150.0, "dec": 20.0, "radius": 0.5}}}
VIS = {"channel": "VIS", "band": "euclid_vis", "ra": 53.117, "dec": -27.808, "mjd": 60905.0}


def made(**sections):
    return from_table(copy.deepcopy({**BASE, **sections}))


def planned(tmp_path, **sections):
    _, exposures, rows = plan(tmp_path, made(**sections))
    assert validate.find_violations(exposures, EXPOSURES) == []
    assert validate.find_violations(rows, TASKS) == []
    return exposures, rows


def test_both_detectors_of_the_demo_have_the_same_centre(tmp_path):
    _, exposures, rows = plan(tmp_path, parse(DEMO))
    for task in rows.to_pylist():
        assert float(sky.separation(task["ra"], task["dec"], 53.117, -27.808)) < 1e-9
    assert exposures["exposure_id"].to_pylist() == [1, 2]
    assert exposures["exposure_time_s"].to_pylist() == [560.53, 30.0]
    assert exposures["seeing"].to_pylist() == [0.0, pytest.approx(0.62, rel=0.8)]
    space, ground = exposures.to_pylist()
    assert (space["airmass"], space["zenith"]) == (None, None)
    # A dark zenith has 32.95 e-/s/pix; the zero point at airmass 1 is 28.36.
    assert 32.95 < ground["sky"] < 200.0
    assert (space["zero_point"], ground["zero_point"]) == pytest.approx(
        (25.93, 28.36 - 0.126 * (ground["airmass"] - 1.0)), abs=0.01
    )
    assert exposures["survey"].to_pylist() == ["demo", "demo"]
    # The ground detector has fewer sources, but a separate PSF for each colour: it takes longer and comes first.
    assert rows["detector"].to_pylist() == ["3-4", "R22_S11"]
    assert (np.diff(rows["seconds"].to_numpy()) < 0).all()
    # Bytes of the files: four quadrants with prescan and overscan, and two truth maps.
    assert rows["bytes"].to_pylist()[0] == pytest.approx(35_536_320 + 2 * 67_772_160, rel=1e-3)


def test_all_detectors_by_default(tmp_path):
    exposures, rows = planned(tmp_path, pointing=[{**VIS, "position_angle": 30.0}])
    assert len(rows) == 36
    assert exposures["position_angle"][0].as_py() == 30.0


@given(st.floats(0, 360, exclude_max=True), st.floats(-90, 90), st.floats(-360, 360))
def test_cells_contain_all_that_a_detector_observes(ra, dec, angle):
    exposure = planned_exposures.Exposure(
        "VIS", "vis", "euclid_vis", "science", ra, dec, angle, 60905.0, 560.0, "x", sky=0.2
    )
    exposures = planned_exposures.table([exposure], [MISSION])
    densities = source_counts.Densities(MISSION, schema.Universe())
    rows = tasks.table(exposures, [("1-6",)], MISSION, densities)
    assert validate.find_violations(exposures, EXPOSURES) == []
    (exposed,), (task,) = exposures.to_pylist(), rows.to_pylist()
    detector = camera_detectors.detector("vis", "1-6", MISSION)
    system = astrometry.wcs(detector, *(exposed[k] for k in ("ra", "dec", "position_angle")))
    rng = np.random.default_rng(1)
    # A margin of one arcmin around the frame.
    margin = 400
    x, y = rng.uniform(-margin, detector.nx + margin, 200), rng.uniform(-margin, detector.ny + margin, 200)
    seen = astrometry.sky_of_pixel(system, x, y)
    assert (sky.separation(task["ra"], task["dec"], *seen) <= task["radius"]).all()
    assert set(sky.cell_at(*seen, 8)) <= set(task["cells"])
    # Footprints computed together agree with the projection of a single detector.
    corners = np.array(task["s_region"].split()[2:], float).reshape(4, 2)
    own = astrometry.corners(detector, system)
    assert sky.separation(corners[:, 0], corners[:, 1], own[:, 0], own[:, 1]).max() < 2e-7


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"channel": "EXT", "camera": "vis"}, r"pointing\[0\]\.camera"),
        ({"camera": "hsc"}, r"pointing\[0\]\.camera.*hsc"),
        ({"detectors": ["9-9"]}, r"pointing\[0\]\.detectors.*9-9"),
        ({"centre_on": "9-9"}, r"pointing\[0\]\.centre_on.*9-9"),
        ({"band": "euclid"}, r"pointing\[0\]\.band.*euclid_vis"),
        ({"mjd": 60950.0}, r"pointing\[0\].*126\.\d deg from the Sun.*87 to 110"),
    ],
)
def test_bad_pointings_are_refused(tmp_path, change, words):
    with pytest.raises(BadInput, match=words):
        plan(tmp_path, made(pointing=[{**VIS, **change}]))


def test_nothing_to_plan_is_refused(tmp_path):
    with pytest.raises(BadInput, match="nothing to plan"):
        plan(tmp_path, made())


# ------------------------------------------------------------------------------------------------ the wide sequence


def test_the_sequence_of_a_field(tmp_path):
    """Serrano et al. 2024: VIS with NISP-S, then J, H, Y; a short VIS exposure, a closing flat; 4218 s in all."""
    block = {"channels": ["VIS", "NISP-P", "NISP-S"], "fields": 1}
    exposures, _ = planned(tmp_path, observation=[block])
    rows = exposures.to_pylist()
    kinds = [(r["channel"], r["band"].partition("_")[2]) for r in rows if r["dither"] == 2]
    assert kinds == [("VIS", "vis"), ("NISP-S", "red"), ("NISP-P", "j"), ("NISP-P", "h"), ("NISP-P", "y")]
    assert [r["grism_angle"] for r in rows if r["channel"] == "NISP-S"] == [0.0, 184.0, -4.0, 180.0]
    assert [r["grism"] for r in rows if r["channel"] == "NISP-S"] == ["RGS000", "RGS180"] * 2
    vis = [r for r in rows if r["channel"] == "VIS"]
    assert [r["exposure_time_s"] for r in vis] == [560.53, 89.52, 560.53, 560.53, 560.53, 10.0]
    assert [r["image_type"] for r in vis] == ["science"] * 5 + ["flat"]
    assert [r["dither"] for r in vis] == [1, 1, 2, 3, 4, 4]
    # The LED of the closing flat changes from field to field.
    more, _ = planned(tmp_path, observation=[{**block, "fields": 24}])
    flats = [r for r in more.to_pylist() if r["image_type"] == "flat"]
    assert {r["lamp"] for r in flats} == {1, 2, 3, 4, 5, 6}
    assert all((r["lamp"] - flats[0]["lamp"] - r["field"] + flats[0]["field"]) % 6 == 0 for r in flats)
    start = rows[0]["mjd"] * 86400 - 8
    assert max(r["mjd"] for r in rows) * 86400 - start == pytest.approx(4218, abs=1)
    spectra = [r for r in rows if r["channel"] == "NISP-S"]
    assert {round(r["exposure_time_s"], 1) for r in spectra} == {549.6}
    assert {round(r["exposure_time_s"], 1) for r in rows if r["channel"] == "NISP-P"} == {87.2}
    # VIS and NISP-S begin together.
    assert [r["mjd"] for r in spectra] == [r["mjd"] for r in vis if r["exposure_time_s"] == 560.53]


def test_steps_of_the_dithers(tmp_path):
    exposures, _ = planned(tmp_path, observation=[{"channels": ["NISP-S"], "fields": 25}])
    by_field = {}
    for row in exposures.to_pylist():
        by_field.setdefault(row["field"], []).append(row)
    steps = []
    for rows in by_field.values():
        probe = Detector("x", "vis", 1, 1, 0, 0, 0, 1.0)
        system = astrometry.wcs(probe, *(rows[0][k] for k in ("ra", "dec", "position_angle")))
        x, y = astrometry.pixel_of_sky(system, [r["ra"] for r in rows], [r["dec"] for r in rows])
        steps.append(np.diff(np.stack([x, y]), axis=1))
    steps = np.array(steps)
    np.testing.assert_allclose(steps.mean(axis=0), [[50, 0, 50], [100, 100, 100]], atol=3 * 11 / 3 / 5)
    # The random error of each step is 11 arcsec at three sigma.
    assert steps.std(axis=0).mean() == pytest.approx(11 / 3, rel=0.2)


def test_patterns_of_dithers(tmp_path):
    for pattern, last in (("S", (100, 300)), ("J", (50, 300))):
        quiet = resolve(overrides={"svm.aocs.pointing_error": (0.0, "arcsec")})
        np.testing.assert_allclose(offsets(pattern, quiet, 1, "x")[-1], last)
    none, _ = planned(tmp_path, observation=[{"channels": ["VIS"], "fields": 1, "dither": "none", "flat": False}])
    assert none["dither"].to_pylist() == [1, 1]


def test_fields_cover_the_area_within_the_sun_constraint(tmp_path):
    found = reference_survey.wide(made().area, MISSION, 60200.0)
    assert len({field.number for field in found}) == len(found)
    for field in found:
        assert 87 <= solar_aspect.solar_aspect(field.ra, field.dec, field.mjd) <= 110
        assert field.mjd >= 60200.0
    assert (np.diff([field.mjd for field in found]) >= MISSION.value("svm.field_time", "d") - 1e-9).all()
    # Every position of the area lies in the field of view of some field.
    rng = np.random.default_rng(3)
    ra, dec = 150 + 0.5 * rng.uniform(-1, 1, 300), 20 + 0.45 * rng.uniform(-1, 1, 300)
    inside = np.zeros(ra.size, bool)
    for field in found:
        probe = Detector("x", "vis", 7001, 7640, 0, 0, 0, 0.36)
        system = astrometry.wcs(probe, field.ra, field.dec, field.position_angle)
        x, y = astrometry.pixel_of_sky(system, ra, dec)
        inside |= (x > 0) & (x < 7001) & (y > 0) & (y < 7640)
    assert inside[made().area.contains(ra, dec)].all()


def test_the_lattice_does_not_depend_on_the_area():
    small, large = (reference_survey.lattice(Area(ra=150.0, dec=20.0, radius=radius), MISSION) for radius in (1.0, 3.0))
    assert set(small[0]) < set(large[0])
    where = {n: (a, d) for n, a, d in zip(*large, strict=True)}
    assert all(where[n] == (a, d) for n, a, d in zip(*small, strict=True))


def test_visits_of_deep_fields(tmp_path):
    block = {"channels": ["NISP-S"], "survey": "deep", "image_type": "deep", "fields": 3, "visits": 4, "blue": True}
    pole = {"cone": {"ra": 269.7, "dec": 66.0, "radius": 0.6}}
    exposures, _ = planned(tmp_path, area=pole, observation=[block])
    rows = exposures.to_pylist()
    assert Counter((r["field"], r["visit"]) for r in rows) == {(f, v): 4 for f in (1, 2, 3) for v in (1, 2, 3, 4)}
    assert {r["band"] for r in rows if r["visit"] % 2 == 0} == {"nisp_blue"}
    assert {r["grism"] for r in rows if r["visit"] % 2 == 0} == {"BGS000"}
    # The telescope turns with the Sun.
    for row in rows:
        turned = solar_aspect.position_angle(row["ra"], row["dec"], row["mjd"]) - row["position_angle"]
        assert abs((turned + 180) % 360 - 180) < 0.5
        assert 87 <= solar_aspect.solar_aspect(row["ra"], row["dec"], row["mjd"]) <= 110


@pytest.mark.parametrize(("name", "area"), [("edf_north", 20), ("edf_south", 23), ("edf_fornax", 10)])
def test_the_deep_fields_have_their_published_areas(name, area):
    place = survey.deep_area(f"survey.{name}", MISSION)
    cells = np.array(place.cells(8))
    ra, dec = sky.positions_of_indices((cells << 42) + (1 << 41))
    found = place.contains(ra, dec).sum() * sky.cell_area(8)
    assert found == pytest.approx(area, rel=0.06)
    assert place.contains([MISSION.value(f"survey.{name}.ra")], [MISSION.value(f"survey.{name}.dec")]).all()


# ------------------------------------------------------------------------------------------------ exploration


def test_an_exploration_has_all_combinations(tmp_path):
    explore = {"vis.read_noise": {"values": [4.0, 5.0, 6.0], "unit": "electron"}, "accuracy": ["draft", "survey"]}
    pointing = [{**VIS, "detectors": ["3-4"]}]
    exposures, rows = planned(tmp_path, pointing=pointing, explore=explore)
    assert len(exposures) == len(rows) == 6
    own = [variants.variant(s, MISSION, accuracy.SURVEY, {}) for s in exposures["settings"].to_pylist()]
    assert sorted({v.mission.value("vis.read_noise") for v in own}) == [4.0, 5.0, 6.0]
    assert {v.accuracy.flux for v in own} == {5e-3, 1e-3}
    # The variants have the same noise except where parameters change it.
    assert len({image_types.identity(ExposureRow.from_row(row)) for row in exposures.to_pylist()}) == 1
    forced = variants.variant('{"effects.bleeding": false}', MISSION, accuracy.SURVEY, {"bleeding": True}).forced
    assert forced == {"bleeding": False}


def test_realisations_are_numbered(tmp_path):
    """Exposures with the same camera, band, position, angle and time are numbered, separately in each variant."""
    twice, other = {**VIS, "realisations": 2}, {**VIS, "mjd": 60906.0}
    explored = {"effects.poisson": [True, False]}
    exposures, rows = planned(tmp_path, pointing=[twice, other, {**VIS, "detectors": ["3-4"]}], explore=explored)
    assert exposures["realisation"].to_pylist() == [1, 2, 1, 3] * 2
    identities = [image_types.identity(ExposureRow.from_row(row)) for row in exposures.to_pylist()]
    assert len(set(identities)) == 4
    assert identities[:4] == identities[4:]
    # The first realisation has the same noise as an exposure without a number.
    (alone,) = planned(tmp_path, pointing=[VIS])[0].to_pylist()
    row = ExposureRow.from_row({**alone, "realisation": None})
    assert (
        image_types.identity(row)
        == identities[0]
        == ":".join(("vis", "euclid_vis", *(value.hex() for value in (row.ra, row.dec, row.position_angle, row.mjd))))
    )
    assert len(rows) == 2 * (36 * 3 + 1)
    block = {"channels": ["VIS"], "image_type": "bias", "exposures": 2, "realisations": 3}
    found, _ = planned(tmp_path, observation=[block, {**block, "image_type": "dark", "realisations": 1}])
    # Otherwise the first bias and the first dark would have the same read noise.
    assert found["realisation"].to_pylist() == [1, 2, 3, 1, 2, 3, 4, 1]


def test_an_additional_pointing_does_not_change_other_noise(tmp_path):
    first, second = {**VIS, "detectors": ["1-1"]}, {**VIS, "mjd": 60906.0, "detectors": ["1-1"]}
    alone, _ = planned(tmp_path, pointing=[second])
    both, _ = planned(tmp_path, pointing=[first, second])
    (a,), (_, b) = alone.to_pylist(), both.to_pylist()
    assert a["exposure_id"] != b["exposure_id"]
    assert image_types.identity(ExposureRow.from_row(a)) == image_types.identity(ExposureRow.from_row(b))


# ------------------------------------------------------------------------------------------------ ground surveys


def layers(exposures, ra, dec):
    """Number of exposures of a camera, shape [n], that observe each position; gaps between detectors are ignored."""
    assert {e.position_angle for e in exposures} == {0.0}
    east, north, out = basis(*np.array([(e.ra, e.dec) for e in exposures]).T)
    places = basis(ra, dec)[2]
    near, which = np.nonzero(out.T @ places > np.cos(np.radians(2.0)))
    # On the tangent plane; x to the west.
    x, y = (
        np.degrees(3600.0) * (axis[:, near] * places[:, which]).sum(0) / (out[:, near] * places[:, which]).sum(0)
        for axis in (-east, north)
    )
    inside = [
        (side.min(axis=1) < at[:, None]) & (at[:, None] < side.max(axis=1))
        for at, side in zip((x, y), outline(camera_detectors.detectors(exposures[0].camera, MISSION)), strict=True)
    ]
    return np.bincount(which, (inside[0] & inside[1]).sum(axis=1), len(ra))


@pytest.mark.parametrize("count", [1, pytest.param(None, marks=pytest.mark.nightly)], ids=["one", "all"])
def test_numbers_of_layers_of_ground_surveys(count):
    """Compare with the table of exposures and layers of Serrano et al. 2024."""
    wanted = parse(DEMO.with_name("sc8_main.toml"))
    rules = [rule for rule in MISSION.rows("survey.external") if int(rule["exposures"])]
    assert len(wanted.observations) == 1 + len(rules)
    for block, rule in list(zip(wanted.observations[1:], rules, strict=True))[:count]:
        assert (block.survey, block.exposures) == (rule["survey"], int(rule["exposures"]))
        taken = [e for e, _ in survey.exposures(replace(wanted, observations=(block,)), MISSION)]
        assert {e.band for e in taken} == set(rule["bands"].split())
        if rule["shared"] == "0":
            taken = [e for e in taken if e.band == taken[0].band]
        assert len(taken) == block.exposures
        ra, dec, radius = block.area.bounding_circle()
        places = np.random.default_rng(5).uniform(-radius, radius, (2, 1000))
        ra, dec = ra + places[0] / np.cos(np.radians(dec)), dec + places[1]
        inside = block.area.contains(ra, dec)
        assert inside.sum() > 50
        mean = layers(taken, ra[inside][:200], dec[inside][:200]).mean()
        assert int(rule["layers_min"]) <= round(mean) <= int(rule["layers_max"]), (block.survey, block.bands, mean)


# ------------------------------------------------------------------------------------------------ pilot phase


def test_exposure_counts_of_the_pilot_phase():
    """Compare with the table of the pilot phase's products in Serrano et al. 2024."""
    own = [e for e, _ in survey.exposures(parse(DEMO.with_name("sc8_pilot.toml")), MISSION)]
    count = Counter((e.channel, e.survey, e.image_type) for e in own)
    ground = {"des": 76, "lsst": 65, "cfis": 14, "jedis": 23, "ps1": 40, "wishes": 7}
    assert count == {
        ("VIS", "wide", "science"): 16,
        ("NISP-P", "wide", "science"): 48,
        ("NISP-S", "wide", "science"): 16,
        ("VIS", "calibration", "bias"): 60,
        ("VIS", "calibration", "flat"): 60,
        ("NISP-P", "calibration", "dark"): 600,
        ("NISP-P", "calibration", "flat"): 750,
        ("NISP-P", "calibration", "self_calibration"): 180,
        ("NISP-P", "calibration", "standard_star"): 24,
        ("NISP-S", "calibration", "standard_star"): 8,
        ("NISP-S", "calibration", "planetary_nebula"): 16,
        ("EXT", "calibration", "flat"): 40,
        ("EXT", "calibration", "bias"): 10,
        **{("EXT", name, "science"): number for name, number in ground.items()},
    }
    detectors = {"lsst": 189, "cfis": 40, "jedis": 14, "ps1": 60, "wishes": 103, "des": 62}
    for e in own:
        if e.survey in detectors:
            assert len(camera_detectors.detectors(e.camera, MISSION)) == detectors.pop(e.survey)
        if not detectors:
            break
    assert not detectors
    lamps = Counter(e.lamp for e in own if e.channel == "NISP-P" and e.image_type == "flat")
    assert lamps == dict.fromkeys(range(1, 6), 150)


@nightly.parametrize(("name", "fields"), [("sc8_main", 331), ("sc8_deep", 3 * 10)], (1,))
def test_exposure_counts_of_the_main_and_deep_runs(name, fields):
    """Compare with the tables of Serrano et al. 2024, which have 3948 for the three bands of the main run."""
    wanted = parse(DEMO.with_name(f"{name}.toml"))
    own = survey.exposures(replace(wanted, observations=wanted.observations[:1]), MISSION)
    count = Counter(e.channel for e, _ in own)
    assert count == {"VIS": 4 * fields, "NISP-P": 3 * 4 * fields, "NISP-S": 4 * fields}
    assert len({(e.field, e.visit) for e, _ in own}) == fields


def test_other_requests_can_be_planned():
    files = sorted(DEMO.parent.glob("*.toml"))
    assert DEMO in files
    for path in files:
        assert parse(path).name == path.stem
        assert tomllib.loads(path.read_text())["name"] == path.stem


@pytest.mark.parametrize(
    "pointing",
    [{"channel": "VIS"}, {"channel": "NISP-P"}, {"channel": "NISP-S"}, {"channel": "EXT", "camera": "lsstcam"}],
    ids=lambda pointing: pointing["channel"],
)
def test_a_pointing_without_a_date_begins_when_its_field_can_be_observed(pointing):
    request = made(pointing=[{**pointing, "ra": 53.117, "dec": -27.808}])
    ((exposure, _),) = survey.exposures(request, MISSION)
    # LSSTCam saw the sky on 2025-04-15 for the first time.
    earliest = MISSION.value("svm.launch", "d") if exposure.channel != "EXT" else 60780.0
    assert earliest <= exposure.mjd < earliest + 400.0
    if pointing["channel"] == "EXT":
        site = observatory.Site.from_mission("ext.lsstcam", MISSION)
        assert observatory.sun_altitude(np.array([exposure.mjd]), site)[0] < -12.0
    else:
        assert solar_aspect.is_allowed(53.117, -27.808, exposure.mjd, MISSION)
        # The Sun forbids the day before, or the mission begins on this date.
        assert exposure.mjd == earliest or not solar_aspect.is_allowed(53.117, -27.808, exposure.mjd - 1.0, MISSION)
