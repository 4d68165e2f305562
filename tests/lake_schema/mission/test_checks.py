"""The package's configuration is consistent, and faults are reported by name."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission import checks, parameter
from lake_schema.mission.bounds import bounds_of_parameter, check_bounds
from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.mission.parameter import CAMERAS, STATUSES, read_all_parameters
from lake_schema.tables.mission import LADDER

MISSION = resolve()


@pytest.mark.parametrize("ladder", [LADDER, ("SIM", *LADDER[:-1]), STATUSES, ("DES", "BLT", "CBE", "REQ", "SIM")])
def test_the_package_has_no_fault(ladder):
    assert list(checks.faults(resolve(ladder=ladder))) == []


def test_every_value_has_bounds_of_its_kind():
    assert [p.key for p in MISSION.parameters if not bounds_of_parameter(p.key)] == []
    for record in read_all_parameters():
        # A bound that allows a single value would be a second source of that value.
        for lo, hi, _ in bounds_of_parameter(record.key):
            assert lo < hi


def test_every_value_of_the_package_is_within_its_bounds():
    """`resolve` checks only the values of users."""
    for record in read_all_parameters():
        check_bounds(record, record.key)
    records = [replace(record, value=-1.0) if record.key == "vis.gain" else record for record in read_all_parameters()]
    with pytest.raises(OutOfRange, match=r"vis\.gain"):
        resolve(records)


def test_units_and_factors_of_the_package_are_those_of_astropy():
    """These units are not parsed, and the factors are not computed, because astropy is slow to import."""
    assert {record.unit for record in read_all_parameters()} <= parameter._SHIPPED_UNITS
    for text in parameter._SHIPPED_UNITS:
        assert isinstance(units.Unit(text), units.UnitBase)
    for (unit, to), factor in parameter._FACTORS.items():
        assert units.Unit(unit).to(units.Unit(to)) == factor


# ------------------------------------------------------------------------------------------------ faults


class Broken(MissionConfiguration):
    """Configuration with other rows in one model."""

    def rows(self, key):
        found = [dict(row) for row in super().rows(key)]
        change = self.change.get(key)
        return tuple(change(found)) if change else tuple(found)

    def numbers(self, key):
        found = super().numbers(key)
        return self.change[key](found) if key in self.change else found


def broken(key, change):
    mission = Broken(MISSION.parameters, models=MISSION.models)
    object.__setattr__(mission, "change", {key: change})
    return mission


def shifted(rows):
    rows[1]["x_mm"], rows[1]["y_mm"] = rows[0]["x_mm"], str(float(rows[0]["y_mm"]) + 5.0)
    return rows


def with_first(column, value):
    return lambda rows: [{**rows[0], column: value}, *rows[1:]]


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        *((f"ext.{camera}.layout", shifted, f"ext.{camera}.layout.*overlap") for camera in CAMERAS),
        ("ext.hsc.layout", lambda rows: [*rows, rows[0]], "overlap|twice"),
        ("ext.hsc.amplifiers", with_first("gain", "0"), "gain = 0"),
        ("vis.amplifiers", with_first("gain", "-3"), "gain = -3"),
        ("vis.amplifiers", with_first("gain", "nan"), "gain = nan"),
        ("vis.amplifiers", with_first("full_well", "0"), "positive"),
        ("env.cosmic_rays.vis_tracks", lambda rows: rows[1:], "quantiles do not go"),
        ("env.cosmic_rays.vis_tracks", lambda rows: (*rows[:3], rows[2], *rows[3:]), "ascend"),
    ],
)
def test_faults_are_named(key, change, words):
    with pytest.raises(BadInput, match=words):
        checks.check(broken(key, change))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[::-1], "do not ascend"),
        (lambda rows: ((rows[0][0], 1.001), *rows[1:]), "outside 0 to 1"),
        (lambda rows: ((rows[0][0], -0.1), *rows[1:]), "outside"),
    ],
)
def test_throughputs_are_checked(change, words):
    key = "vis.euclid_vis.throughput"
    design = resolve(ladder=("DES", "CBE", "BLT", "REQ", "SIM"))
    mission = Broken(design.parameters, models=design.models)
    object.__setattr__(mission, "change", {key: change})
    with pytest.raises(BadInput, match=words):
        checks.check(mission)


def test_worse_than_required_is_a_fault():
    worse = [
        p if p.key != "vis.read_noise" else type(p)(p.key, "CBE", 4.6, "electron", source="x")
        for p in MISSION.parameters
    ]
    with pytest.raises(BadInput, match=r"vis\.read_noise .*worse than the required 4.5"):
        checks.check(MissionConfiguration(tuple(worse), models=MISSION.models))
    # A larger full well is better.
    small = [p if p.key != "vis.full_well" else replace(p, value=1.9e5) for p in MISSION.parameters]
    with pytest.raises(BadInput, match=r"vis\.full_well .*worse than the required 200000"):
        checks.check(MissionConfiguration(tuple(small), models=MISSION.models))
    checks.check(
        MissionConfiguration(
            tuple(p if p.key != "vis.full_well" else replace(p, value=2.1e5) for p in MISSION.parameters),
            models=MISSION.models,
        )
    )
    # A value of a request has the status SIM, which may be worse than required.
    checks.check(resolve(overrides={"vis.read_noise": (9.0, "electron")}))


# ------------------------------------------------------------------------------------------------ published numbers


def macc(kind):
    return [MISSION.value(f"nisp.macc.{kind}.{part}") for part in ("groups", "reads", "drops")]


@pytest.mark.parametrize(
    ("kind", "frames", "integration", "alpha"),
    [("photometric", 76, 87.2, -0.265625), ("spectroscopic", 394, 549.6, -0.196759)],
)
def test_ramps(kind, frames, integration, alpha):
    """Compare with Kubik et al. 2016: frames of a ramp, time from first to last group, correlation of reads."""
    groups, reads, drops = macc(kind)
    assert groups * reads + (groups - 1) * drops == frames
    frame = MISSION.value("nisp.frame_time", "s")
    assert (groups - 1) * (reads + drops) * frame == pytest.approx(integration, abs=0.06)
    assert (1 - reads**2) / (3 * reads * (reads + drops)) == pytest.approx(alpha, abs=1e-6)
    assert frames * frame < MISSION.value(f"nisp.commanded_time_{kind}", "s")


def test_a_vis_quadrant_as_it_is_read():
    fpa = {k: MISSION.value(f"vis.fpa.{k}") for k in ("nx", "ny", "prescan", "overscan", "parallel_overscan")}
    assert fpa["prescan"] + fpa["nx"] / 2 + fpa["overscan"] == 2128
    assert fpa["ny"] / 2 + fpa["parallel_overscan"] == 2086
    for row in MISSION.rows("vis.amplifiers"):
        assert (int(row["nx"]), int(row["ny"])) == (2048, 2066)


def test_a_first_order_spectrum_is_512_pixels_long():
    """The dispersion is from Serrano et al. 2024."""
    for grism in ("RGS000", "RGS180"):
        rows = [
            row
            for row in MISSION.rows("nisp.traces")
            if (row["grism"], row["order"], row["axis"]) == (grism, "1", "along")
        ]
        length = sum(float(row["constant"]) for row in rows if row["power"] != "0")
        assert length == pytest.approx(512, abs=0.5)
        assert (float(rows[0]["last_nm"]) - float(rows[0]["first_nm"])) / length == pytest.approx(1.34, rel=1e-6)


def test_the_table_of_traces_has_no_redundant_values():
    """The polynomials determine ends and dispersion of a grism, so separate values would have no effect."""
    grisms = {row["grism"].lower() for row in MISSION.rows("nisp.traces")}
    beside = {
        record.key.split(".")[-1] for record in read_all_parameters() if record.key.split(".")[1] in {*grisms, "grism"}
    }
    assert beside == {"resolving_power"}


def test_the_telescope_s_pupil():
    """Area of the aperture less stop and spider: 9926 cm2 (GalSim-Euclid-Like); the clear fraction is 0.8776."""
    radius = MISSION.value("plm.aperture_diameter", "mm") / 2
    side = np.linspace(-radius, radius, 2401)
    x, y = np.meshgrid(0.5 * (side[1:] + side[:-1]), 0.5 * (side[1:] + side[:-1]))
    clear = np.hypot(x, y) <= radius
    disc = clear.sum()
    clear &= np.hypot(x, y - MISSION.value("plm.pupil.stop_y", "mm")) > MISSION.value("plm.pupil.stop_radius", "mm")
    for bar in ("spider1", "spider2", "spider3"):
        dx, dy = (at - MISSION.value(f"plm.pupil.{bar}.{axis}", "mm") for at, axis in ((x, "x"), (y, "y")))
        angle = MISSION.value(f"plm.pupil.{bar}.angle", "rad")
        across = np.abs(-np.sin(angle) * dx + np.cos(angle) * dy) <= MISSION.value("plm.pupil.spider_width", "mm") / 2
        clear &= ~(across & (np.hypot(dx, dy) <= MISSION.value("plm.pupil.spider_half_length", "mm")))
    area = clear.sum() * (side[1] - side[0]) ** 2 / 100
    assert area == pytest.approx(MISSION.value("plm.collecting_area", "cm2"), abs=5)
    assert clear.sum() / disc == pytest.approx(0.8776, abs=5e-4)


def test_focal_length_and_scale():
    focal = MISSION.value("plm.focal_length", "mm")
    assert focal / MISSION.value("plm.aperture_diameter", "mm") == pytest.approx(MISSION.value("plm.f_ratio"), abs=0.01)
    # The distortion is about one per cent.
    for plate, section in (("vis", "vis"), ("nisp", "nisp")):
        own = MISSION.value(f"{section}.fpa.pixel_scale", "arcsec / pix") / MISSION.value(
            f"{section}.fpa.pixel_size", "mm / pix"
        )
        assert MISSION.value(f"plm.{plate}_plate_scale", "arcsec / mm") == pytest.approx(own, rel=1e-3)
    assert np.degrees(1 / focal) * 3600 == pytest.approx(MISSION.value("plm.vis_plate_scale", "arcsec / mm"), rel=0.015)


# ------------------------------------------------------------------------------------------------ layouts by rule


def places(camera):
    key = f"ext.{camera}.layout"
    return np.array([[float(r["x_mm"]), float(r["y_mm"])] for r in MISSION.rows(key)])


def farthest(measured, rule):
    """Return the largest distance of a measured position from the nearest position of a rule, each used once."""
    distance = np.hypot(*(measured[:, None, i] - rule[None, :, i] for i in (0, 1)))
    assert sorted(distance.argmin(axis=1)) == list(range(len(rule)))
    return distance.min(axis=1).max()


def test_decam_is_62_ccds_by_rule():
    counts = (3, 4, 5, 6, 6, 7, 7, 6, 6, 5, 4, 3)
    rule = [(63.755 * (j - (n - 1) / 2), 33.745 * (k - 5.5)) for k, n in enumerate(counts) for j in range(n)]
    assert len(rule) == 62
    assert farthest(places("decam"), np.array(rule)) < 0.16


def test_hsc_is_104_ccds_by_rule_of_which_one_is_dead():
    a, b = (-230.305, -163.175, -96.025, -28.88), (34.87, 102.03, 169.16, 236.31)
    north, south = (38.26, 105.43, 172.56), (-166.56, -99.43, -32.26)
    columns = {k: (*a, *b) for k in range(-3, 4)} | {k: (*a[1:], *b[:3]) for k in (-4, 4)}
    columns |= {k: (*a[1:], *north) for k in (-5, -6)} | {k: (*south, *b[:3]) for k in (5, 6)}
    columns |= {-7: (*a[2:], *north[:2]), 7: (*south[1:], *b[:2])}
    rule = [(31.8454 * k, y) for k, ys in columns.items() for y in ys]
    rule += [(x, y) for x in (-143.85, 143.85) for y in (-214.35, 220.35)]
    design = resolve(ladder=("DES", "BLT", "CBE", "REQ", "SIM")).rows("ext.hsc.layout")
    # The x axis of the rule points south and its y axis west.
    measured = np.array([[-float(r["y_mm"]), float(r["x_mm"])] for r in design])
    assert len(rule) == 104
    assert farthest(measured, np.array(rule)) < 0.066
    assert len(MISSION.rows("ext.hsc.layout")) == 103


def test_megacam_is_40_ccds_by_rule():
    rule = [
        (28.573 * i, y)
        for y, reach in ((99.47, 4), (31.50, 5), (-31.45, 5), (-99.42, 4))
        for i in range(-reach, reach + 1)
    ]
    assert len(rule) == 40
    assert farthest(places("megacam"), np.array(rule)) < 0.17


@pytest.mark.parametrize(("camera", "count"), [("lsstcam", 189), ("gpc1", 60), ("jpcam", 14)])
def test_other_cameras_count_right(camera, count):
    rows = MISSION.rows(f"ext.{camera}.layout")
    assert len({row["detector"] for row in rows}) == len(rows) == count


def test_amplifiers_lie_in_their_detector_and_share_no_pixel():
    for camera in CAMERAS:
        sizes = {(r["type"], int(r["nx"]), int(r["ny"])) for r in MISSION.rows(f"ext.{camera}.layout")}
        amplifiers = MISSION.rows(f"ext.{camera}.amplifiers")
        for kind, nx, ny in sizes:
            frame = np.zeros((ny, nx), np.int8)
            own = [row for row in amplifiers if row["type"] == kind]
            assert own
            for row in own:
                x, y, w, h = (int(row[k]) for k in ("x", "y", "nx", "ny"))
                assert x + w <= nx
                assert y + h <= ny
                frame[y : y + h, x : x + w] += 1
            assert frame.max() == 1
            # Only GPC1 has gaps between its cells.
            assert (frame == 1).mean() > (0.95 if camera == "gpc1" else 0.9999)
