"""Rows that a task reads: all nearby sources, bright ones farther out, and the limit of completeness."""

from dataclasses import asdict, dataclass, field

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields
from tests.truesky.render.drawing import test_arcs
from tests.truesky.render.exposure.test_render import field as field_of
from tests.truesky.render.fields import MISSION, exposure, fluxes, galaxies, psf_of, small, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, pointing
from truesky.render.channels.aim import electron_rate
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.exposure import scene_factory, visible_sources
from truesky.render.exposure.records import Rows, Variant
from truesky.render.products import keys
from truesky.render.sources import catalogue_rows, galaxy_shapes, selection
from truesky.request.accuracy import SURVEY

BAND, DETECTOR = "lsst_r", small("lsstcam", "R22_S11")
MARGIN = MISSION.value("survey.selection_margin", "arcsec")
FARTHER = stamp_sizes.reach(DETECTOR.pixel_scale) - MARGIN
# A giant galaxy: 8e7 electrons in LSST, with light far above the noise a few arcmin away.
GIANT = {"disk_half_light_radius": 20.0, "bulge_half_light_radius": 15.0, "bulge_fraction": 1.0,
         "bulge_sersic_index": 4.0}  # fmt: skip


@dataclass
class Catalogue:
    """Rows that lie in cells. They are seen at most `bent` deg away."""

    rows: pa.Table
    cells: np.ndarray
    drawn: set
    bent: float = 0.0
    manifest: dict = field(init=False)

    def __post_init__(self):
        self.schema = self.rows.schema
        self.manifest = {"parts": [{"name": "all", "facts": {"generation_cells": sorted(self.drawn)}}]}

    def padding(self):
        return self.bent

    def position_columns(self):
        return "ra", "dec"

    def rows_in_cells(self, cells, order, columns):
        assert order == 8
        rows = self.rows
        if "_healpix_29" in columns:
            rows = rows.append_column("_healpix_29", pa.array(np.asarray(self.cells, np.int64) << 42))
        return rows.filter(pa.array(np.isin(self.cells, cells)))


def place():
    """Return a task that does not need the cells 3 arcmin north of its detector."""
    for dec in np.arange(-28.0, -27.0, 0.01):
        task = {"ra": 53.1, "dec": dec, "radius": (DETECTOR.half_diagonal + MARGIN) / 3600}
        if sky.cell_at([53.1], [dec + 190.0 / 3600], 8)[0] not in selection.cells_of_task(task, 0.0):
            return task
    raise AssertionError("no such place")


def limits_of(exposed, detector, band="euclid_vis", mission=MISSION):
    variant = Variant(mission, SURVEY, {})
    return visible_sources.flux_limits(exposure(**exposed), detector, passbands.load(band), variant)


def rendered(distance, flux=1e6, drawn=None, found=True, **shape):
    """Render a detector with one galaxy `distance` arcsec north of its centre.

    The galaxy is read as by a task; if `found` is false, it is taken directly.
    """
    task = {"detector": "R22_S11", **place()}
    ra, dec, angle = pointing.boresight_for(DETECTOR, task["ra"], task["dec"], 0.0)
    exposed = {**field_of("EXT")[1], "ra": ra, "dec": dec, "position_angle": angle}
    body = galaxies(task["ra"], task["dec"] + distance / 3600, **{**GIANT, **shape})
    nothing = stars([], [])
    light = fluxes(body, BAND, flux)
    complete = 0.0
    if found:
        cells = sky.cell_at([task["ra"]], [task["dec"] + distance / 3600], 8)
        wanted = set(sky.cells_in_cone(task["ra"], task["dec"], 1.0, 8).tolist()) if drawn is None else drawn(task)
        least = limits_of(exposed, DETECTOR, "lsst_r").min_flux
        body, light, complete = catalogue_rows.read_sources(
            Catalogue(body, cells, wanted),
            Catalogue(light, cells, wanted),
            task,
            body.column_names,
            [BAND],
            FARTHER,
            least,
        )
    tables = body, light, nothing, fluxes(nothing, BAND, 1.0)
    return fields.rendered(exposed, DETECTOR, tables, MISSION, SURVEY, complete_margin_arcsec=MARGIN + complete)


def test_a_large_bright_source_fades_across_the_margin_and_never_vanishes():
    light = []
    for distance in (60.0, 215.0):
        one, whole = rendered(distance), rendered(distance, found=False)
        np.testing.assert_array_equal(one.science, whole.science)
        assert len(one.sources) == 1
        light.append(float(one.noise_free.sum()))
    assert (np.diff(light) < 0).all()
    assert light[-1] > 0
    assert one.complete_margin_arcsec == pytest.approx(stamp_sizes.reach(0.2), abs=0.5)


def test_sources_beyond_the_reach_or_too_faint_do_not_change_the_image():
    # No source is visible up to this distance.
    far = selection.FARTHEST + DETECTOR.half_diagonal + 1.0
    empty = rendered(far, found=False)
    assert len(empty.sources) == 0
    assert not empty.noise_free.any()
    for distance, flux in ((far, 1e6), (190.0, 0.1)):
        one = rendered(distance, flux)
        np.testing.assert_array_equal(one.science, empty.science)
        np.testing.assert_array_equal(one.noise_free, empty.noise_free)


def test_supernovae_and_nuclei_that_are_left_out_are_a_small_part_of_the_noise():
    exposed = field_of("EXT")[1]
    row = exposure(**exposed)
    limit = limits_of(exposed, DETECTOR, "lsst_r").min_point_flux
    noise = scene_factory.from_exposure(row, DETECTOR, MISSION, SURVEY).pixel_noise
    electrons = limit * electron_rate(row) * row.exposure_time_s
    assert electrons == pytest.approx(0.1 * settings_for(SURVEY).edge * noise, rel=0.01)
    assert electrons < 0.01 * noise


def test_faint_sources_in_the_cells_of_the_circle_are_read_up_to_the_reach():
    """Bright ones are read from the whole cell. Rows keep their order: first the cells of the circle, then others."""
    task = {"ra": 53.1, "dec": -28.0, "radius": 0.02}
    offsets = np.array([0.0, 0.03, 0.05, 0.06, 0.2, -0.2])
    rows = galaxies(np.full(6, 53.1), -28.0 + offsets)
    light = fluxes(rows, BAND, np.array([1.0, 1.0, 1.0, 9.0, 9.0, 1.0]))
    inner = selection.cells_of_task(task, 0.0)[0]
    outer = selection.cells_beyond_task(task, 0.0, 2e3, set(range(12 * 4**8)))[0][0]
    cells = np.array([outer if abs(offset) > 0.1 else inner for offset in offsets])[::-1]
    turned = pa.array(np.arange(6)[::-1].copy())
    tables = (Catalogue(table.take(turned), cells, set(range(12 * 4**8))) for table in (rows, light))
    found, electrons, _ = catalogue_rows.read_sources(*tables, task, ["id"], [BAND], 72.0, 5.0)
    assert found.column_names == ["id"]
    ids = rows["id"].to_numpy()
    # The cell beyond the circle is farther away than the reach.
    assert found["id"].to_pylist() == ids[[3, 1, 0]].tolist()
    assert electrons["id"].equals(found["id"])


def test_where_the_catalogue_ends_is_said():
    """If the catalogue has only the needed cells, nothing is refused, but the giant outside them is missing."""
    one = rendered(190.0, drawn=lambda task: set(selection.cells_of_task(task, 0.0)))
    assert len(one.sources) == 0
    assert MARGIN <= one.complete_margin_arcsec < 190.0 - DETECTOR.half_diagonal


@given(st.floats(0, 360, exclude_max=True), st.floats(-90, 90), st.floats(0, 0.05), st.floats(0, 1), st.floats(0, 6.28))
def test_sources_are_found_however_they_are_deflected(ra, dec, deflection, where, direction):
    """The source is seen inside the circle or at its edge. Its true position is at most the deflection away."""
    task = {"ra": ra, "dec": dec, "radius": 0.1}
    distance = where * (task["radius"] + deflection)
    b = np.radians(dec)
    d = np.radians(distance)
    height = np.clip(np.sin(b) * np.cos(d) + np.cos(b) * np.sin(d) * np.cos(direction), -1, 1)
    turned = np.arctan2(np.sin(direction) * np.sin(d) * np.cos(b), np.cos(d) - np.sin(b) * height)
    true = (ra + np.degrees(turned)) % 360.0, np.degrees(np.arcsin(height))
    assert sky.cell_at([true[0]], [true[1]], 8)[0] in selection.cells_of_task(task, deflection)


@given(st.floats(0, 360, exclude_max=True), st.floats(-89, 89), st.floats(0, 400), st.integers(0, 9))
def test_completeness_ends_before_the_first_cell_that_is_missing(ra, dec, farther, which):
    task = {"ra": ra, "dec": dec, "radius": 0.1}
    near = selection.cells_of_task(task, 0.01)
    drawn = set(sky.cells_in_cone(ra, dec, 0.5, 8).tolist())
    whole, complete = selection.cells_beyond_task(task, 0.01, farther, drawn)
    assert complete == farther
    assert not set(whole) & set(near)
    if whole:
        missing = whole[which % len(whole)]
        some, complete = selection.cells_beyond_task(task, 0.01, farther, drawn - {missing})
        assert set(some) == set(whole) - {missing}
        assert complete < farther
        assert missing not in selection.cells_of_task({**task, "radius": 0.1 + complete / 3600}, 0.01)


def test_the_bound_on_what_shows_holds():
    """A source below the limit is below the edge at that distance, for any profile."""
    settings = settings_for(SURVEY)
    least = stamp_sizes.min_noticeable_electrons(MARGIN, 0.2, 40.0, settings)
    for index in (0.5, 1.0, 4.0, 6.0):
        for radius in (1.0, 10.0, 60.0):
            form = galaxies(0.0, 0.0, bulge_sersic_index=index, bulge_half_light_radius=radius, bulge_fraction=1.0)
            surface = galaxy_shapes.surface_brightness(galaxy_shapes.shapes(form), np.array([MARGIN]))[0, 0]
            assert least * surface * 0.2**2 < settings.edge * 40.0


@pytest.mark.parametrize("dark", [{"image_type": "bias", "exposure_time_s": 0.0}, {"image_type": "charge_injection"},
                                  {"exposure_time_s": 0.0}])  # fmt: skip
def test_a_frame_that_no_source_shows_in_reads_none(dark):
    exposed = {**field_of("VIS")[1], **dark}
    detector, task = small("vis", "3-4"), place()
    least = limits_of(exposed, detector).min_flux
    assert least == np.inf
    cells = sky.cell_at([task["ra"]], [task["dec"]], 8)
    assert np.isfinite(limits_of(field_of("VIS")[1], detector).min_flux)
    body = Catalogue(galaxies(task["ra"], task["dec"], **GIANT), cells, set(cells.tolist()))
    faint = Catalogue(fluxes(body.rows, BAND, 1.0), cells, set(cells.tolist()))
    rows, light, complete = catalogue_rows.read_sources(body, faint, task, ["id"], [BAND], FARTHER, least)
    assert len(rows) == len(light) == 0
    assert complete == FARTHER


def test_bright_stars_are_read_up_to_the_visible_length_of_their_spikes():
    """Spikes are visible for 18 arcmin: one star is read, and none if there are no spikes or no light."""
    detector, task = small("vis", "3-4"), place()
    exposed = {**field_of("VIS")[1], "exposure_time_s": 560.53, "sky": 0.25, "zero_point": 25.93}
    spikes = limits_of(exposed, detector).spikes
    # In a nominal exposure, the limit is 11.2 mag at 3.4 arcmin, up to which all stars are read.
    assert 23.9 - 2.5 * np.log10(spikes) == pytest.approx(11.2, abs=0.3)
    rows = stars([task["ra"]] * 2, [task["dec"] - 0.3] * 2)
    light = fluxes(rows, "euclid_vis", np.array([1.5, 0.5]) * spikes)
    cells = sky.cell_at(rows["ra"].to_numpy(), rows["dec"].to_numpy(), 8)
    drawn = set(sky.cells_in_cone(task["ra"], task["dec"], 1.0, 8).tolist())
    catalogues = Catalogue(rows, cells, drawn), Catalogue(light, cells, drawn)
    least = limits_of(exposed, detector).min_flux
    for limit, wanted in ((spikes, [0]), (np.inf, [])):
        found, light, complete = catalogue_rows.read_sources(
            *catalogues, task, rows.column_names, ["euclid_vis"], 85.0, least, limit
        )
        assert found.equals(rows.take(pa.array(wanted, pa.int64())))
        assert light["id"].equals(found["id"])
        assert complete == 85.0
    for other in ({"image_type": "dark"}, {"exposure_time_s": 0.0}, {"psf": "own.fits"}):
        assert limits_of({**exposed, **other}, detector).spikes == np.inf
    ground = field_of("EXT")[1]
    without_ghosts = {"ext.lsstcam.reflectance.glass": (0.0, "")}
    # LSST's aureole shows farther out than its spikes do; a Moffat profile has neither. Ghosts of fainter stars show.
    aureole = limits_of(ground, DETECTOR, "lsst_r", resolve(overrides=without_ghosts)).spikes
    assert 23.9 - 2.5 * np.log10(aureole) == pytest.approx(8.0, abs=0.3)
    moffat = {"ext.lsstcam.psf.profile": (1.0, "")}
    assert limits_of(ground, DETECTOR, "lsst_r", resolve(overrides=without_ghosts | moffat)).spikes == np.inf
    assert aureole / 10.0 < limits_of(ground, DETECTOR, "lsst_r", resolve(overrides=moffat)).spikes < aureole


@dataclass
class Whole:
    """Rows of a catalogue with one file."""

    table: pa.Table
    cells: list

    def __post_init__(self):
        self.schema = self.table.schema
        self.manifest = {"parts": [{"name": "all", "facts": {"generation_cells": self.cells}}], "facts": {}}

    def rows(self, columns, partitions, where):
        return self.table.filter(where).select(columns) if partitions else self.table.slice(0, 0).select(columns)

    def padding(self):
        return 0.0

    def position_columns(self):
        return "ra", "dec"


@pytest.mark.parametrize(("farther", "seen"), [(0.0, 0), (300.0, 1)])
def test_arcs_are_read_from_as_far_away_as_other_sources(farther, seen):
    """A lens is 200" outside the circle. The galaxy behind it is read, although it is faint."""
    task = place()
    where = task["ra"], task["dec"] + task["radius"] + 200.0 / 3600
    cells = sky.cell_at([where[0]], [where[1]], 8)
    behind = galaxies(*where)
    row = test_arcs.lens(int(behind["id"][0].as_py()), *where, [(0.0, 0.0, 1.0)])
    table, light = Whole(row, cells.tolist()), fluxes(behind, BAND, 1e-6)
    table.rows_in_cells = lambda wanted, order, columns: row.filter(pa.array(np.isin(cells, wanted)))
    found = catalogue_rows.read_lenses(table, task, 0.0, farther, 1.0)
    assert found["id"].to_pylist() == row["id"].to_pylist()[:seen]
    none = behind.slice(0, 0), light.slice(0, 0)
    versions = Whole(behind, cells.tolist()), Whole(light, cells.tolist())
    rows, its = catalogue_rows.add_lensed_galaxies(none, found, *versions, task, farther)
    assert rows["id"].to_pylist() == its["id"].to_pylist() == behind["id"].to_pylist()[:seen]
    again, _ = catalogue_rows.add_lensed_galaxies((rows, its), found, *versions, task, farther)
    assert again.equals(rows)
    assert len(catalogue_rows.read_lenses(table, task, 0.0, farther, np.inf)) == 0


def test_rows_shared_by_several_exposures_are_read_once():
    """Queries with several bands, circles, limits and columns return the same sources as a filter of all rows."""
    rng = np.random.default_rng(3)
    task = place()
    ra, dec = (task[name] + rng.uniform(-0.8, 0.8, 400) for name in ("ra", "dec"))
    rows = galaxies(ra, dec)
    cells = sky.cell_at(ra, dec, 8)
    bands = {f"f_nu_{band}": rng.uniform(0.0, 9.0, 400).astype(np.float32) for band in ("euclid_y", "euclid_h")}
    light = pa.table({"id": rows["id"], "_healpix_29": sky.healpix_29(ra, dec), **bands})
    versions = Whole(rows, cells.tolist()), Whole(light, cells.tolist())
    asked = []

    def rows_in_cells(wanted, order, columns):
        asked.append(columns)
        return light.filter(pa.array(np.isin(cells, wanted))).select(columns)

    versions[1].rows_in_cells = rows_in_cells
    least = float(bands["f_nu_euclid_h"][7])
    aside = {**task, "dec": task["dec"] + 0.4}
    wanted = [
        catalogue_rows.BrightQuery(task, ["id", "ra"], "euclid_h", least),
        catalogue_rows.BrightQuery(aside, ["dec", "id"], "euclid_y", 2.0, 600.0),
        catalogue_rows.BrightQuery(aside, ["id"], "euclid_h", np.inf),
        catalogue_rows.BrightQuery(task, ["ra"], "euclid_y", 100.0),
    ]
    found = catalogue_rows.read_bright(*versions, wanted)
    assert len(asked) == 1
    for one, (its, own) in zip(wanted, found, strict=True):
        near = selection.cells_within_reach(one.task, 0.0, one.reach_arcsec) if np.isfinite(one.min_flux) else []
        flux = bands[f"f_nu_{one.band}"].astype(float)
        expected = np.flatnonzero(np.isin(cells, near) & (flux >= one.min_flux))
        assert own.equals(light.take(expected).select(["id", f"f_nu_{one.band}"]))
        assert its.equals(rows.take(expected).select(one.columns))
        assert len(its) == 0 or one.min_flux < 100.0
    assert len(found[0][0]) > 5
    assert len(found[1][0]) > 5
    assert catalogue_rows.read_bright(*versions, []) == []
    alone = [catalogue_rows.read_bright(*versions, [one])[0] for one in wanted]
    assert all(a.equals(c) and b.equals(d) for (a, b), (c, d) in zip(alone, found, strict=True))


@dataclass
class Files:
    """Files of a catalogue or of its fluxes, each with some cells."""

    columns: tuple
    cells: dict
    sums: dict

    def __post_init__(self):
        self.schema = pa.schema([(name, pa.int64()) for name in self.columns])
        parts = [{"name": name, "facts": {"generation_cells": cells}} for name, cells in self.cells.items()]
        self.manifest = {"parts": parts, "facts": {}}

    def padding(self):
        return 0.0

    def partition_sha256(self, name):
        return self.sums[name]


@pytest.mark.parametrize(("channel", "camera", "name"), [("VIS", "vis", "3-4"), ("EXT", "lsstcam", "R22_S11")])
def test_large_galaxies_are_read_and_drawn_up_to_their_visible_radius(channel, camera, name):
    """A galaxy of 7 mag and two arcmin is drawn from a third of a degree away. A small or a faint one is not."""
    detector, task = small(camera, name), place()
    exposed = {**field_of(channel)[1], "exposure_time_s": 560.53, "sky": 0.25, "zero_point": 25.93}
    band = "euclid_vis" if channel == "VIS" else "lsst_r"
    limit = limits_of(exposed, detector, band).far_galaxy
    form = {"bulge_sersic_index": [4.0, 1.0, 4.0], "bulge_half_light_radius": [120.0, 2.0, 120.0]}
    rows = galaxies([task["ra"]] * 3, [task["dec"] - 0.3] * 3, bulge_fraction=1.0, **form)
    mags = np.array([7.0, 7.0, 27.0])
    light = fluxes(rows, "euclid_vis", 10 ** (-0.4 * (mags - 23.9)))
    cells = sky.cell_at(np.full(3, task["ra"]), np.full(3, task["dec"] - 0.3), 8)
    drawn = set(sky.cells_in_cone(task["ra"], task["dec"], 1.0, 8).tolist())
    catalogues = Catalogue(rows, cells, drawn), Catalogue(light, cells, drawn)
    found, light, _ = catalogue_rows.read_sources(
        *catalogues, task, rows.column_names, ["euclid_vis"], 85.0, limit, limit
    )
    assert found["id"].to_pylist() == rows["id"].to_pylist()[:2]
    assert light["id"].equals(found["id"])
    system = astrometry.wcs(detector, *pointing.boresight_for(detector, task["ra"], task["dec"], 0.0))
    electrons = light["f_nu_euclid_vis"].to_numpy() * 560.53 * 10 ** (0.4 * (25.93 - 23.9))
    noise, settings = 12.0, settings_for(SURVEY)
    aim = fields.aimed(detector, system, passbands.load(band))
    given = Rows(found, light, stars([], []), light.slice(0, 0))
    seen, sizes = visible_sources.select_sources(given, (electrons, np.zeros(0)), aim, psf_of(camera), noise, settings)
    assert seen.ids.tolist() == rows["id"].to_pylist()[:1]
    image = stamps.draw(seen, sizes, psf_of(camera), detector.nx, detector.ny)
    assert image.min() > 0.1 * noise
    assert limits_of({**exposed, "image_type": "bias"}, detector, band).far_galaxy == np.inf


def test_a_product_depends_on_distant_sources_that_may_be_visible():
    """A file 0.3 deg away matters to all products if it contains galaxies, and to some if it contains stars."""
    task = place()
    cells = {"near": selection.cells_of_task(task, 0.0)}
    cells["far"] = [int(sky.cell_at([task["ra"]], [task["dec"] - 0.3], 8)[0])]
    assert not set(cells["near"]) & set(cells["far"])
    some = [
        asdict(exposure(exposure_id=1, camera="vis", channel="VIS", psf="")),
        asdict(exposure(exposure_id=2, camera="lsstcam", channel="EXT", psf="")),
        asdict(exposure(exposure_id=3, camera="nisp", channel="NISP-S", psf="")),
    ]
    tasks = [
        {**task, "exposure_id": 1, "detector": "3-4", "cells": 1},
        {**task, "exposure_id": 2, "detector": "R22_S11", "cells": 1},
        {**task, "exposure_id": 3, "detector": "DET22", "cells": 1},
    ]
    found = []
    for changed in ("", "stars", "galaxies", "strong_lenses"):
        inputs = {}
        for name in ("galaxies", "stars", "galaxy_fluxes", "star_fluxes", "strong_lenses"):
            inputs[name] = Files((), cells, {"near": "a", "far": "b" if name == changed else "a"})
        facts = {"request": {}, "mission": "m", "code": "c"}
        found.append(keys.product_keys(facts, pa.Table.from_pylist(some), tasks, inputs, MISSION))
    (vis, ext, spectra), (vis_stars, ext_stars, _), (vis_galaxies, ext_galaxies, _), lenses = found
    assert lenses[:2] == [vis, ext]
    assert lenses[2] != spectra
    assert vis_stars != vis
    assert ext_stars != ext
    assert vis_galaxies != vis
    assert ext_galaxies != ext


@given(st.floats(-89.9, 89.9), st.floats(-5000.0, 5000.0), st.floats(-5000.0, 5000.0), st.floats(51544.5, 70000.0))
def test_stars_move_along_great_circles(dec, east, north, mjd):
    """Positions agree with astropy (without parallax and radial velocity). Stars without a known motion stay."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    rows = stars([10.0, 10.0], [dec, dec])
    rows = rows.append_column("pm_ra", pa.array([east, None], pa.float32()))
    rows = rows.append_column("pm_dec", pa.array([north, None], pa.float32()))
    found = catalogue_rows.apply_proper_motion(rows, mjd)
    assert (found["ra"][1].as_py(), found["dec"][1].as_py()) == pytest.approx((10.0, dec), abs=1e-12)
    there = SkyCoord(
        10.0 * u.deg,
        dec * u.deg,
        pm_ra_cosdec=np.float32(east) * u.mas / u.yr,
        pm_dec=np.float32(north) * u.mas / u.yr,
        obstime=Time(2015.5, format="jyear"),
    ).apply_space_motion(Time(mjd, format="mjd"))
    apart = sky.separation(found["ra"].to_numpy()[:1], found["dec"].to_numpy()[:1], there.ra.deg, there.dec.deg)
    # The path of astropy is straight in space, which differs from the circle by a millionth of its length.
    assert 3.6e6 * apart[0] < 0.1
    assert found.schema.equals(rows.schema)
    assert catalogue_rows.apply_proper_motion(stars([10.0], [dec]), mjd).equals(stars([10.0], [dec]))
