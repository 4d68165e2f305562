"""Moving bodies of the user: tables in three formats are drawn like built-in bodies; errors have one line."""

import gzip
import os
from dataclasses import asdict, replace

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.ids import kind_from_id
from lake_schema.sky.ecliptic import ecliptic, equatorial
from tests.truesky import nightly
from tests.truesky.render import fields, nominal
from tests.truesky.render.fields import MISSION, aimed, small
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, pointing
from truesky.render.products import keys
from truesky.render.sources import ephemerides, solar_system
from truesky.request import from_toml as requests
from truesky.request.from_toml import parse

DAY = 60905
PLACE = tuple(float(x) for x in equatorial(70.0, 0.0))
FORMATS = ("parquet", "csv", "fits")


def columns(found, mjd=DAY + 0.5):
    names = ("lon", "lat", "east", "north", "mag")
    return {"mjd": np.full(len(found.ids), mjd), **{name: getattr(found, name) for name in names}}


def written(path, values):
    if path.suffix == ".fits":
        Table({name: np.asarray(column) for name, column in values.items()}).write(path)
    elif path.suffix == ".csv":
        pyarrow.csv.write_csv(pa.table(values), path)
    else:
        pq.write_table(pa.table(values), path)
    return path


def test_a_table_of_our_own_population_is_drawn_as_ours(tmp_path):
    """Positions, motions and light are the same in each format, and another day has no bodies.

    The table has an additional column.
    """
    ours = solar_system.population(*PLACE, 0.1, DAY, MISSION, 1)
    assert len(ours.ids) > 100
    detector = small("vis", "3-4")
    ra, dec, angle = pointing.boresight_for(detector, *PLACE, 0.0)
    row = {"ra": ra, "dec": dec, "position_angle": angle, "mjd": DAY + 0.3, "exposure_time_s": 565.0}
    system = astrometry.wcs(detector, ra, dec, angle)
    aim = aimed(detector, system, passbands.load("euclid_vis"), {**row, "zero_point": 25.9})
    about = (aim, MISSION, 1, 0.1, None)
    expected = solar_system.trailed_sources(*about)
    assert len(expected) > 3
    order = np.argsort(expected.column)
    for kind in FORMATS:
        file = written(tmp_path / f"bodies.{kind}", {"name": [str(i) for i in ours.ids], **columns(ours)})
        bodies = ephemerides.read(file, kind)
        found = solar_system.trailed_sources(*about, bodies.on_day)
        assert set(kind_from_id(found.ids)) == {solar_system.KIND}
        assert len(np.unique(found.ids)) == len(found)
        mine = np.argsort(found.column)
        for name in ("column", "row", "electrons", "trail"):
            np.testing.assert_allclose(getattr(found, name)[mine], getattr(expected, name)[order], rtol=1e-9, atol=1e-6)
        assert len(bodies.on_day(DAY + 1).ids) == 0


def test_a_body_is_where_the_table_says_when_it_says(tmp_path):
    values = {"mjd": [DAY + 0.25], "lon": [359.99], "lat": [-3.0], "east": [36.0], "north": [-18.0], "mag": [20]}
    body = ephemerides.read(written(tmp_path / "one.csv", values), "one").on_day(DAY)
    hours = 24 * (0.25 - 0.5)
    np.testing.assert_allclose(body.positions_after(hours), np.array(equatorial([359.99], [-3.0])), atol=1e-9)
    # Ten hours later, the body is 360" east and 180" south.
    wanted = equatorial([359.99 + 0.1 / np.cos(np.radians(3.0))], [-3.05])
    np.testing.assert_allclose(body.positions_after(hours + 10.0), np.array(wanted), atol=1e-6)


def test_an_exposure_shows_the_table_s_bodies_alone(tmp_path):
    """One bright body of the table is in the middle of the detector; built-in bodies are missing."""
    detector = small("vis", "3-4", 256)
    ra, dec, angle = nominal.pointing(detector)
    centre = astrometry.centre(detector, astrometry.wcs(detector, ra, dec, angle))
    lon, lat = (float(x) for x in ecliptic(*centre))
    start = nominal.DAY + 1
    values = {"mjd": [start], "lon": [lon], "lat": [lat], "east": [60.0], "north": [0.0], "mag": [18.0]}
    file = written(tmp_path / "one.parquet", values)
    one = nominal.rendered(detector, [], [], [], asteroids=ephemerides.read(file, "exposure").on_day)
    assert len(one.sources) == 1
    length = np.hypot(*one.sources.trail[0]) * 0.1
    assert length == pytest.approx(60.0 * nominal.TIME / 3600, rel=1e-3)
    # The trail begins in the middle.
    begin = one.sources.column[0] - one.sources.trail[0, 0] / 2, one.sources.row[0] - one.sources.trail[0, 1] / 2
    assert begin == pytest.approx((127.5, 127.5), abs=0.01)
    assert one.noise_free[:, 100:].sum() > 1e5


def test_bright_bodies_shine_around_corners(tmp_path):
    """A body on the detector and one outside it contribute as points along their trails, with all their light."""
    detector = small("vis", "3-4", 256)
    ra, dec, angle = nominal.pointing(detector)
    system = astrometry.wcs(detector, ra, dec, angle)
    start = nominal.DAY + 1
    lon, lat = ecliptic(*astrometry.sky_of_pixel(system, [127.5, 127.5, 127.5], [127.5, 500.0, 20.0]))
    values = {"mjd": [start] * 3, "lon": lon, "lat": lat, "east": [60.0, 0.0, 0.0], "north": [0.0] * 3}
    file = written(tmp_path / "bright.parquet", {**values, "mag": [12.0, 8.0, 21.0]})
    forced = nominal.off("cosmic_rays", "readout_cosmic_rays")
    one = nominal.rendered(detector, [], [], [], forced=forced, asteroids=ephemerides.read(file, "b").on_day)
    lights = one.scene.lights
    rate = nominal.TIME * 10 ** (0.4 * (one.zero_point - np.array([12.0, 8.0])))
    still = np.isclose(lights.electrons.max(), lights.electrons, rtol=1e-3, atol=0.0)
    assert still.sum() == 1
    assert lights.electrons[still][0] == pytest.approx(rate[1], rel=0.02)
    assert (lights.column[still][0], lights.row[still][0]) == pytest.approx((127.5, 500.0), abs=0.1)
    assert lights.electrons[~still].sum() == pytest.approx(rate[0], rel=0.02)
    trail = one.sources.trail[one.sources.electrons > 1e6][0]
    assert np.ptp(lights.column[~still]) == pytest.approx(abs(trail[0]) * (1 - 1 / (~still).sum()))
    middle = one.sources.column[one.sources.electrons > 1e6][0]
    assert lights.column[~still].mean() == pytest.approx(middle)
    assert np.diff(lights.column[~still]) == pytest.approx(
        np.full((~still).sum() - 1, np.diff(lights.column[~still])[0])
    )


@nightly.parametrize(("rate", "away"), [(0.0, 600.0), (60.0, 1300.0)], (0,))
def test_a_bright_body_beside_the_detector_shines_in(tmp_path, rate, away):
    """Far from the body, its light equals the light of a star at its position in the middle of the exposure."""
    detector = small("vis", "3-4", 256)
    system = astrometry.wcs(detector, *nominal.pointing(detector))
    lon, lat = ecliptic(*astrometry.sky_of_pixel(system, np.array([127.5]), np.array([-away])))
    start, east = nominal.DAY + 1, rate * 0.5 * nominal.TIME / 3600.0 / 3600.0 / np.cos(np.radians(lat))
    values = {"mjd": [start], "lon": lon - east, "lat": lat, "east": [rate], "north": [0.0], "mag": [5.0]}
    file = written(tmp_path / "beside.parquet", values)
    quiet = nominal.off(*nominal.COSMIC_RAYS)
    found = nominal.rendered(detector, [], [], [], forced=quiet, asteroids=ephemerides.read(file, f"{away}").on_day)
    star = nominal.rendered(detector, [5.0], [127.5], [-away], forced=quiet)
    assert found.sources.trail_length == pytest.approx([rate * nominal.TIME / 360.0], rel=1e-3, abs=0.01)
    # The median excludes spikes. The body is bluer than the star.
    law = np.median(star.noise_free, axis=1)
    assert law.min() > 1.0
    np.testing.assert_allclose(np.median(found.noise_free, axis=1), law, rtol=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"lat": [0.0, 91.0]}, r"lat of row 2 is 91, but must be a number from -90 to 90$"),
        ({"mag": [np.nan, 20.0]}, r"mag of row 1 is NaN, but must be a number from"),
        ({"mjd": [-1.0, 2.0]}, r"mjd of row 1 is -1, but must be a number from"),
        ({"north": None}, r"has no column north; it has mjd, lon, lat, east, mag"),
    ],
)
@pytest.mark.parametrize("kind", FORMATS)
def test_what_is_wrong_is_said_in_a_line(tmp_path, kind, change, said):
    good = {"mjd": [60905.0] * 2, "lon": [1.0, 2.0], "lat": [0.0, 0.0], "east": [30.0] * 2, "north": [0.0] * 2}
    values = {key: value for key, value in {**good, "mag": [20.0, 21.0], **change}.items() if value is not None}
    file = written(tmp_path / f"bodies.{kind}", values)
    with pytest.raises(BadInput, match=said) as caught:
        ephemerides.read(file, "bad")
    assert str(caught.value).startswith((f"{file}: ", f"{file} has"))
    assert "\n" not in str(caught.value)


def test_what_is_no_table_is_refused(tmp_path):
    values = columns(solar_system.population(*PLACE, 0.1, DAY, MISSION, 1))
    plain = written(tmp_path / "plain.fits", values).read_bytes()
    rows = f"NAXIS2  = {len(values['mjd']):20d}"
    assert rows.encode() in plain
    # Compressed files: one is truncated, and one contains more bytes than fit into memory.
    half = gzip.compress(plain)[:-4000]
    promising = plain.replace(rows.encode(), f"NAXIS2  = {10**9:20d}".encode())
    for name, data in (("a.csv", b"mjd,lon\n1,2,3\n"), ("b.parquet", b"PAR1 and no more"), ("c.fits", b"SIMPLE"),
                       ("d.csv", b"mjd,lon,lat,east,north,mag\n1,2,3,4,5,faint\n"),
                       ("e.csv", b"mjd,lon,lat,east,north,mag,nam\xe9\n1,2,3,4,5,6,7\n"),
                       ("f.fits.gz", b"\x1f\x8b and no more"), ("g.fits.gz", half),
                       ("h.fits.gz", gzip.compress(promising)), ("i.dat", b"\x1f")):  # fmt: skip
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInput, match=name) as caught:
            ephemerides.read(tmp_path / name, name)
        assert "\n" not in str(caught.value)
    with pytest.raises(BadInput, match="no such file"):
        ephemerides.read(tmp_path / "none.csv", "none")


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_column_that_is_there_twice_is_refused(tmp_path, kind):
    file = tmp_path / f"twice.{kind}"
    names = ["mjd", "lon", "lat", "east", "north", "mag", "mag", "name", "name"]
    table = pa.table([pa.array([1.0])] * len(names), names=names)
    pyarrow.csv.write_csv(table, file) if kind == "csv" else pq.write_table(table, file)
    with pytest.raises(BadInput, match=r"twice\.\w+: has column mag more than once$"):
        ephemerides.read(file, "twice")
    other = tmp_path / f"names.{kind}"
    table = table.remove_column(names.index("mag"))
    pyarrow.csv.write_csv(table, other) if kind == "csv" else pq.write_table(table, other)
    with pytest.raises(BadInput, match=r"names\.\w+: has column name more than once$"):
        ephemerides.read(other, "names")


@pytest.mark.parametrize("kind", FORMATS)
def test_a_body_has_one_row_a_day(tmp_path, kind):
    """An hourly ephemeris would draw each body once per row."""
    hours = np.arange(0.0, 48.0, 6.0)
    one = {**{key: np.full(len(hours), 1.0) for key in ephemerides.KEYS}, "mjd": DAY + hours / 24.0}
    daily = [0, 4]
    for names in (["2015 AB1"] * len(hours), np.full(len(hours), 433)):
        hourly = written(tmp_path / f"hourly-{names[0]}.{kind}", {**one, "name": names})
        with pytest.raises(BadInput) as caught:
            ephemerides.read(hourly, f"hourly of {names[0]}")
        said = f"name of row 2 is {str(names[0])!r}, which already has a row for MJD {DAY} (6 of 8 rows like it)"
        assert str(caught.value) == f"{hourly}: {said}"
        few = {key: np.asarray(column)[daily] for key, column in {**one, "name": names}.items()}
        file = written(tmp_path / f"daily-{names[0]}.{kind}", few)
        assert ephemerides.read(file, f"daily of {names[0]}").day.tolist() == [DAY, DAY + 1]
    # The rows of a body may be separated by rows of other bodies.
    three = {**{key: [1.0] * 3 for key in ephemerides.KEYS}, "name": ["Ceres", "Pallas", "Ceres "]}
    with pytest.raises(BadInput, match=r"name of row 3 is 'Ceres', which already has a row for MJD 1 \(1 of 3 rows"):
        ephemerides.read(written(tmp_path / f"between.{kind}", three), "between")


@pytest.mark.parametrize("kind", FORMATS)
def test_each_row_has_a_name_where_there_are_names(tmp_path, kind):
    two = {key: [1.0] * 2 for key in ephemerides.KEYS}
    with pytest.raises(BadInput, match=r"absent.*: name of row 2 is missing$"):
        ephemerides.read(written(tmp_path / f"absent.{kind}", {**two, "name": ["Ceres", ""]}), "absent")
    if kind != "csv":
        with pytest.raises(BadInput, match=r"half.*: column name (is|holds) .*, but must "):
            ephemerides.read(written(tmp_path / f"half.{kind}", {**two, "name": [0.5, 1.5]}), "half")


@nightly.parametrize("kind", FORMATS, (0,))
def test_long_tables_have_names_too(tmp_path, kind):
    count = 150_000
    values = {
        **{key: np.full(count, 1.0) for key in ephemerides.KEYS},
        "name": [f"body of number {i}" for i in range(count)],
    }
    assert len(ephemerides.read(written(tmp_path / f"long.{kind}", values), "long").day) == count


def test_names_without_end_are_refused(tmp_path):
    for kind, length in (("parquet", 3 << 20), ("fits", 300), ("csv", 3 << 20), ("parquet", 65), ("fits", 65)):
        values = {**{key: np.full(2, 1.0) for key in ephemerides.KEYS}, "name": ["x" * 64, "y" * length]}
        with pytest.raises(BadInput, match=r"endless.*: column name "):
            ephemerides.read(written(tmp_path / f"endless-{length}.{kind}", values), f"{kind} {length}")


def test_parquet_with_too_many_columns_is_refused(tmp_path):
    """A separate process with limits reads Parquet files of users."""
    names = [*ephemerides.KEYS, *(f"c{i}" for i in range(6000))]
    file = tmp_path / "wide.parquet"
    pq.write_table(pa.table([pa.array([1.0])] * len(names), names=names), file)
    with pytest.raises(BadInput, match=r"wide.parquet: "):
        ephemerides.read(file, "wide")


@pytest.mark.parametrize("kind", ["parquet", "fits"])
def test_what_is_too_long_is_not_read_to_its_end(tmp_path, monkeypatch, kind):
    file = written(tmp_path / f"long.{kind}", {key: np.full(300_000, 1.0) for key in ephemerides.KEYS})
    sizes, pieces = [], external_rows.read_batches

    def counted(*args, **options):
        for piece in pieces(*args, **options):
            sizes.append(len(piece.columns["mjd"]))
            yield piece

    monkeypatch.setattr(external_rows, "read_batches", counted)
    monkeypatch.setattr(ephemerides, "_MOST_ROWS", 1000)
    with pytest.raises(BadInput, match="has more than 1000 rows"):
        ephemerides.read(file, "longer")
    assert len(sizes) == 1
    assert sizes[0] < 100_000


@pytest.mark.parametrize("kind", FORMATS)
def test_a_table_that_no_worker_can_hold_is_refused(tmp_path, monkeypatch, kind):
    values = {key: np.full(3000, 1.0) for key in ephemerides.KEYS}
    file = written(tmp_path / f"long.{kind}", values)
    assert len(ephemerides.read(file, "long").day) == 3000
    monkeypatch.setattr(ephemerides, "_MOST_ROWS", 2999)
    with pytest.raises(BadInput, match=r"long.\w+: has more than 2999 rows"):
        ephemerides.read(file, "too long")


def test_file_format_is_recognised_by_content_not_by_name(tmp_path):
    """FITS files are recognised under any name, also if they are compressed."""
    values = columns(solar_system.population(*PLACE, 0.1, DAY, MISSION, 1))
    plain = written(tmp_path / "bodies.fits", values)
    expected = ephemerides.read(plain, "plain").rows
    (tmp_path / "bodies.fits.gz").write_bytes(gzip.compress(plain.read_bytes()))
    (tmp_path / "bodies.dat").write_bytes(plain.read_bytes())
    for name in ("bodies.fits.gz", "bodies.dat"):
        found = ephemerides.read(tmp_path / name, name).rows
        np.testing.assert_array_equal(found.ids, expected.ids)
        np.testing.assert_array_equal(found.mag, expected.mag)


def test_a_table_of_other_days_is_refused(tmp_path):
    file = written(tmp_path / "old.csv", columns(solar_system.population(*PLACE, 0.1, DAY, MISSION, 1)))
    bodies = ephemerides.read(file, "old")
    ephemerides.check(bodies, file, [DAY + 0.2, DAY + 7.0])
    ephemerides.check(bodies, file, [])
    with pytest.raises(BadInput, match=r"old.csv: has bodies of MJD 60905 to 60905, but the exposures begin on 61000"):
        ephemerides.check(bodies, file, [61000.5])


def forbidden(path, *flags):
    raise PermissionError(13, "Permission denied", str(path))


def test_a_request_names_it(tmp_path, monkeypatch):
    demo = (requests.Path(__file__).parents[4] / "requests" / "demo.toml").read_text(encoding="utf-8")
    path = tmp_path / "own.toml"
    path.write_text(demo + '\n[solar_system]\nbodies = "bodies.csv"\n', encoding="utf-8")
    request = parse(path)
    assert request.bodies == tmp_path / "bodies.csv"
    # A dark exposure on another day does not need bodies.
    kinds = (("VIS", "science", DAY + 0.3), ("EXT", "science", DAY + 90.0), ("VIS", "dark", DAY + 90.0))
    rows = [fields.exposure(channel=channel, image_type=kind, mjd=mjd) for channel, kind, mjd in kinds]
    exposed = pa.Table.from_pylist([asdict(row) for row in rows])
    with pytest.raises(BadInput, match=r"solar_system.bodies: .*bodies.csv: no such file"):
        keys.ephemeris_files(request.bodies, exposed)
    request.bodies.write_bytes(b"")
    with monkeypatch.context() as patch:
        # The user who runs the tests may have access to all files, so the refusal is simulated.
        patch.setattr(os, "open", forbidden)
        with pytest.raises(BadInput, match=r"solar_system.bodies: .*bodies.csv: Permission denied"):
            keys.ephemeris_files(request.bodies, exposed)
    written(request.bodies, columns(solar_system.population(*PLACE, 0.1, DAY, MISSION, 1)))
    assert list(keys.ephemeris_files(request.bodies, exposed)) == [str(request.bodies)]
    assert list(keys.ephemeris_files(request.bodies, exposed.slice(1))) == [str(request.bodies)]
    later = pa.Table.from_pylist([asdict(replace(row, channel="VIS")) for row in rows[1:]])
    with pytest.raises(BadInput, match=r"has bodies of MJD"):
        keys.ephemeris_files(request.bodies, later)
    path.write_text(demo + '\n[solar_system]\nbody = "bodies.csv"\n', encoding="utf-8")
    with pytest.raises(BadInput, match=r"solar_system.body"):
        parse(path)


@nightly.parametrize(
    ("rate", "turn"), [(300.0, 0.0), pytest.param(3000.0, 1.1, marks=pytest.mark.nightly), (1e5, 0.4)], (2,)
)
def test_a_fast_body_is_seen_however_far_its_trail_goes(tmp_path, rate, turn):
    """The light that a body leaves on the detector is proportional to the time it takes to cross it."""
    detector = small("vis", "3-4", 256)
    system = astrometry.wcs(detector, *nominal.pointing(detector))
    lon, lat = (float(x) for x in ecliptic(*astrometry.centre(detector, system)))
    # The body is in the middle after a tenth of the exposure, so the middle of its trail is elsewhere.
    when = nominal.DAY + 1 + 0.1 * nominal.TIME / 86400.0
    values = {"mjd": [when], "lon": [lon], "lat": [lat], "east": [rate * np.cos(turn)], "north": [rate * np.sin(turn)]}
    file = written(tmp_path / "fast.parquet", {**values, "mag": [12.0]})
    quiet = nominal.off(*nominal.COSMIC_RAYS)
    one = nominal.rendered(detector, [], [], [], forced=quiet, asteroids=ephemerides.read(file, f"{rate}").on_day)
    assert len(one.sources) == 1
    # Parts far from the detector are cut off.
    (length,), (trail,) = one.sources.trail_length, one.sources.trail
    whole = rate * nominal.TIME / 360.0
    reach = 10.0 * (detector.half_diagonal + 204.8)
    assert length == pytest.approx(min(0.1 * whole, reach) + min(0.9 * whole, reach), rel=1e-2)
    # Electrons per pixel of the trail, times its length in a square, in which it begins or which it crosses.
    bright = nominal.TIME * 10 ** (0.4 * (one.zero_point - 12.0)) / whole
    assert one.sources.electrons[0] / length == pytest.approx(bright, rel=0.03)
    half = 28.0 * length / np.abs(trail).max()
    crossed = half + min(half, 0.1 * whole)
    square = one.noise_free[100:156, 100:156].astype(float)
    assert square.sum() == pytest.approx(bright * crossed, rel=0.1)
    along = np.abs(trail).argmax()
    assert (square[28] if along else square[:, 28]).argmax() == pytest.approx(28, abs=2)


def test_a_body_comes_near_on_its_way():
    """Trails are found if they come within the circle, wherever their middles are."""
    rng, n, reach = np.random.default_rng(1), 4000, 0.3
    lon, lat, angle = 70.0 + rng.uniform(-2, 2, n), rng.uniform(-2, 2, n), rng.uniform(0, 2 * np.pi, n)
    rate = 10.0 ** rng.uniform(2, 5, n)
    bodies = solar_system.Population(
        np.arange(n), lon, lat, rate * np.cos(angle), rate * np.sin(angle), np.full(n, 20.0)
    )
    detector = small("vis", "3-4")
    row = dict(zip(("ra", "dec", "position_angle"), pointing.boresight_for(detector, *PLACE, 0.0), strict=True))
    system = astrometry.wcs(detector, *row.values())
    row |= {"mjd": DAY + 0.5, "exposure_time_s": 600.0, "zero_point": 25.9}
    aim = aimed(detector, system, passbands.load("euclid_vis"), row)
    found = solar_system.trailed_sources(aim, MISSION, 1, reach, None, lambda day: bodies)
    hours = np.linspace(0.0, 1 / 6, 501)
    away = np.min([sky.separation(*bodies.positions_after(hour), *PLACE) for hour in hours], axis=0)
    sure = np.abs(away - reach) > 1e-3
    np.testing.assert_array_equal(np.isin(bodies.ids, found.ids)[sure], (away < reach)[sure])
    assert 100 < len(found) < 1000
    # At most the part of a trail within the circle is kept, as bright per length as the whole.
    kept = found.trail_length * detector.pixel_scale / 3600.0
    assert kept.max() <= 2.01 * reach
    light = found.electrons / found.trail_length * rate[found.ids]
    np.testing.assert_allclose(light, np.median(light), rtol=0.05)
