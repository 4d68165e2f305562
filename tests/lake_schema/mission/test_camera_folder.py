"""Folders of cameras are read, and mistakes are refused with file and line."""

import csv

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission import camera_folder, camera_tables, camera_template, checks
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS
from truesky.commands import __main__

KNOWN = resolve()


@pytest.fixture
def folder(tmp_path):
    camera_template.write_like("megacam", tmp_path / "my_camera")
    return tmp_path / "my_camera"


def replace_in(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize("known", CAMERAS)
def test_a_folder_that_is_written_has_all_numbers_of_the_known_camera(tmp_path, known):
    camera_template.write_like(known, tmp_path / "copied")
    camera = camera_folder.read(tmp_path / "copied")
    mission = resolve(cameras=[camera])
    assert "copied" in mission.ground_cameras
    assert not list(checks.camera_faults("copied", mission))
    for key in ("layout", "psf.wavefront"):
        assert mission.rows(f"ext.copied.{key}") == KNOWN.rows(f"ext.{known}.{key}")
    assert mission.numbers("ext.copied.psf.wavefront") == KNOWN.numbers(f"ext.{known}.psf.wavefront")
    copied, rows = (mission.rows(f"ext.{name}.amplifiers") for name in ("copied", known))
    for own, row in zip(copied, rows, strict=True):
        assert {key: own[key] for key in own if key not in ("gain", "read_noise", "full_well")}.items() <= row.items()
        for key in ("gain", "read_noise"):
            ratio = float(row[key]) / float(rows[0][key])
            assert float(own[key]) == pytest.approx(ratio * KNOWN.value(f"ext.{known}.{key}"), rel=1e-6)
    for parameter in KNOWN.parameters:
        name = parameter.key.removeprefix(f"ext.{known}.")
        # A folder has no exposure times of bands, and it gives the sky level as a magnitude.
        if name != parameter.key and not name.endswith(
            (".sky", ".sky_reference", "_r.exposure_time", "_u.exposure_time")
        ):
            assert mission.value(f"ext.copied.{name}", parameter.unit) == parameter.value, name


def test_the_level_of_the_sky_is_that_of_the_known_camera(tmp_path):
    camera_template.write_like("lsstcam", tmp_path / "copied")
    mission = resolve(cameras=[camera_folder.read(tmp_path / "copied")])
    contrast = mission.value("ext.copied.lsst_r.zero_point") - mission.value("ext.copied.lsst_r.sky_brightness")
    rate = 10 ** (0.4 * contrast) * KNOWN.value("ext.lsstcam.fpa.pixel_scale") ** 2
    assert rate == pytest.approx(KNOWN.value("ext.lsstcam.lsst_r.sky"), rel=1e-4)


def test_the_checksum_does_not_depend_on_the_location(folder, tmp_path):
    first = camera_folder.read(folder)
    other = tmp_path / "elsewhere" / "my_camera"
    other.parent.mkdir()
    folder.rename(other)
    assert camera_folder.read(other).sha256 == first.sha256
    for file, old, new in (
        (camera_tables.LAYOUT, "-114.399", "-114.4"),
        (camera_tables.AMPLIFIERS, "4,106000", "5,106000"),
        (camera_tables.WAVEFRONT, "4,2,0,90", "4,2,0,91"),
        (camera_tables.BANDS, "cfis_r,,,26.", "cfis_r,,,25."),
    ):
        replace_in(other / file, old, new)
        assert camera_folder.read(other).sha256 != first.sha256
        replace_in(other / file, new, old)
    assert camera_folder.read(other).sha256 == first.sha256


def test_the_default_wavefront_is_used_if_none_is_given(folder):
    (folder / camera_tables.WAVEFRONT).unlink()
    mission = resolve(cameras=[camera_folder.read(folder)])
    assert mission.rows("ext.my_camera.psf.wavefront") == KNOWN.rows("ext.megacam.psf.wavefront")


def write_again(file, change):
    """Write a table with other rows; `change` gets all rows (the header first) and returns the new ones."""
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    with file.open("w", newline="") as stream:
        csv.writer(stream).writerows(change(list(csv.reader(lines))))


def with_columns_reversed(rows):
    return [row[::-1] for row in rows]


def with_blanks(rows):
    return [[f" {text}\t" for text in row] for row in rows]


def with_points(rows):
    whole = [column in ("nx", "ny", "x", "y", "noll", "overscan", "read_top", "x_power") for column in rows[0]]
    exponent = [column in ("y_power", "read_right", "prescan") for column in rows[0]]
    return [rows[0]] + [
        [f"0{text}.0" if a else f"{text}e0" if b else text for text, a, b in zip(row, whole, exponent, strict=True)]
        for row in rows[1:]
    ]


def with_empty_lines_and_comments(rows):
    return [["# A comment"], [], *(line for row in rows for line in (row, [" "])), ["# The end"]]


@pytest.mark.parametrize("file", camera_tables.COLUMNS)
@pytest.mark.parametrize(
    "change", [with_columns_reversed, with_blanks, with_points, with_empty_lines_and_comments], ids=lambda f: f.__name__
)
def test_a_table_may_be_written_in_another_way(folder, file, change):
    (folder / "curve.dat").write_text("6000 0.5\n")
    replace_in(folder / camera_tables.BANDS, "cfis_r,,", "mine,curve.dat,air")
    before = camera_folder.read(folder)
    write_again(folder / file, change)
    after = camera_folder.read(folder)
    assert after.parameters == before.parameters
    # Readers of the mission database get the same layout, amplifiers and wavefront.
    assert after.contents == before.contents
    assert after.models == before.models
    assert [(c.band, c.file, c.medium) for c in after.curves] == [(c.band, c.file, c.medium) for c in before.curves]
    assert after.sha256 == before.sha256


@pytest.mark.parametrize("file", camera_tables.COLUMNS)
def test_a_table_may_begin_with_a_byte_order_mark(folder, file):
    before = camera_folder.read(folder)
    (folder / file).write_text((folder / file).read_text(), encoding="utf-8-sig")
    assert camera_folder.read(folder) == before


def test_columns_that_change_places_with_their_headers_are_no_other_wavefront(folder):
    write_again(folder / camera_tables.WAVEFRONT, lambda rows: [[row[i] for i in (0, 2, 1, 3)] for row in rows])
    mission = resolve(cameras=[camera_folder.read(folder)])
    assert mission.numbers("ext.my_camera.psf.wavefront") == KNOWN.numbers("ext.megacam.psf.wavefront")


def test_a_type_that_looks_like_a_comment_is_kept(folder):
    for file in camera_tables.LAYOUT, camera_tables.AMPLIFIERS:
        text = (folder / file).read_text().replace("megacam,", '"#1, thin",')
        (folder / file).write_text("\n".join(line for line in text.splitlines() if not line.startswith("# ")))
    mission = resolve(cameras=[camera_folder.read(folder)])
    assert [row["type"] for row in mission.rows("ext.my_camera.amplifiers")] == ["#1, thin"] * 2


@pytest.mark.parametrize(("target", "words"), [("nowhere.csv", "no such file"), ("wavefront.csv", "Too many levels")])
def test_a_link_to_no_wavefront_is_refused(folder, target, words):
    (folder / camera_tables.WAVEFRONT).unlink()
    (folder / camera_tables.WAVEFRONT).symlink_to(target)
    with pytest.raises(BadInput, match=rf"my_camera/wavefront\.csv: {words}"):
        camera_folder.read(folder)


@pytest.mark.parametrize("file", ["parameters.csv", "layout.csv", "amplifiers.csv", "bands.csv"])
def test_a_missing_file_or_column_is_named(folder, file):
    text = (folder / file).read_text()
    (folder / file).unlink()
    with pytest.raises(BadInput, match=rf"my_camera/{file}: no such file"):
        camera_folder.read(folder)
    (folder / file).mkdir()
    with pytest.raises(BadInput, match=rf"my_camera/{file}: is a folder"):
        camera_folder.read(folder)
    (folder / file).rmdir()
    (folder / file).write_text("")
    with pytest.raises(BadInput, match=rf"my_camera/{file}: column \w+ is missing$"):
        camera_folder.read(folder)
    header = next(line for line in text.splitlines() if not line.startswith("#"))
    (folder / file).write_text(header + "\n")
    with pytest.raises(BadInput, match=rf"my_camera/{file}: has no rows$"):
        camera_folder.read(folder)
    (folder / file).write_text(text.replace(header, header + ",colour"))
    with pytest.raises(BadInput, match=rf"my_camera/{file}: unknown column 'colour', the columns must be"):
        camera_folder.read(folder)
    (folder / file).write_text(text.replace(header, header + "," + header.partition(",")[0]))
    with pytest.raises(BadInput, match=rf"my_camera/{file}: a column is given twice$"):
        camera_folder.read(folder)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("parameters.csv", "bias,", "offset,", r"parameters\.csv line \d+: .* no parameter 'offset'"),
        ("parameters.csv", "fpa.pixel_size,", "fpa.pixel_size,x", r"line \d+: value = 'x\d+.*' is not a number"),
        ("parameters.csv", "fpa.pixel_size,", "# fpa.pixel_size,", r"parameters\.csv: parameter fpa.pixel_size is m"),
        (
            "parameters.csv",
            "um / pix",
            "s",
            r"line \d+: fpa.pixel_size: the unit must be um / pix or a unit that converts to it, got s",
        ),
        ("parameters.csv", "um / pix", "mag(um/pix)", r"line \d+: fpa.pixel_size: 'mag\(um/pix\)' is a logarithmic"),
        (
            "parameters.csv",
            "um / pix",
            "1e-320 um/pix",
            r"line \d+: fpa.pixel_size: the unit must be um / pix .* got 1e-320 um/pix",
        ),
        ("parameters.csv", "bias,1000", "bias,99000", r"parameters\.csv line \d+: .*bias \[adu\] = 99000.0 is outside"),
        ("parameters.csv", "um / pix", "parrots", r"line \d+: fpa.pixel_size: 'parrots' is not a unit"),
        ("layout.csv", "ccd00,megacam,2048", "ccd00,megacam,0", r"layout\.csv line \d+: nx = 0 is not between 1 and"),
        ("layout.csv", "ccd00,megacam,2048", "ccd00,megacam,99.5", r"layout\.csv line \d+: nx = 99.5 is not a whole"),
        ("layout.csv", "ccd00,megacam,2048", "ccd00,megacam,1024", r"layout\.csv line \d+: .* megacam differ in size"),
        ("layout.csv", "ccd01", "ccd00", r"layout\.csv line \d+: ccd00 is given twice"),
        ("layout.csv", "ccd01", "C/1", r"layout\.csv line \d+: detector = 'C/1': a name must have letters"),
        ("layout.csv", "ccd01,megacam", "ccd01,other", r"amplifiers\.csv: detectors of type other have no"),
        ("amplifiers.csv", "megacam,A,0,0", "megacam,A,2,0", r"amplifiers\.csv line \d+: overlaps amplifier A"),
        (
            "amplifiers.csv",
            "megacam,A,0,0,1024",
            "megacam,A,0,0,9024",
            r"line \d+: reaches beyond the detector",
        ),
        (
            "amplifiers.csv",
            ",0,0,0,32,32",
            ",0,2,0,32,32",
            r"amplifiers\.csv line \d+: read_top = 2 is not betw",
        ),
        (
            "amplifiers.csv",
            ",0,0,0,32,32",
            ",0.5,0,0,32,32",
            r"amplifiers\.csv line \d+: read_right = 0.5 is no",
        ),
        (
            "amplifiers.csv",
            ",0,32,32",
            ",0,65536,32",
            r"amplifiers\.csv line \d+: overscan = 65536 is not b",
        ),
        ("wavefront.csv", "4,2,0,90", "4,2.5,0,90", r"wavefront\.csv line \d+: x_power = 2.5 is not a whole number"),
        ("bands.csv", "26.78", "99", r"bands\.csv line 2: .*cfis_r\.zero_point \[mag\] = 99.0 is outside \[0"),
        ("bands.csv", "cfis_r,,", "cfis_r,/etc/passwd,air", r"bands\.csv line 2: curve = '/etc/passwd' is outside the"),
        ("bands.csv", "cfis_r,,", "cfis_r,a/../../b,air", r"bands\.csv line 2: curve = 'a/../../b' is outside the cam"),
        (
            "bands.csv",
            "cfis_r,,",
            "cfis_r,missing.dat,air",
            r"bands\.csv line \d+: .*missing.dat: no such file",
        ),
        ("bands.csv", "cfis_r,,", "cfis_r,layout.csv,", r"bands\.csv line \d+: medium is missing"),
        ("bands.csv", "cfis_r,,", "cfis_r,layout.csv,water", r"bands\.csv line \d+: medium = 'water' is neither air"),
        ("bands.csv", "cfis_r,,", "cfis r,,", r"bands\.csv line \d+: band = 'cfis r': a name must have letters"),
        ("bands.csv", "cfis_r,,,", "cfis_r,,,nan", r"bands\.csv line \d+: zero_point = 'nan\S*' is not a number"),
        ("wavefront.csv", "4,0,0,60", "4,0,0,inf", r"wavefront\.csv line \d+: coefficient_nm = inf is not finite"),
    ],
)
def test_a_mistake_is_named_with_its_file_and_line(folder, file, old, new, words):
    replace_in(folder / file, old, new)
    with pytest.raises(BadInput, match=words) as refused:
        camera_folder.read(folder)
    assert "\n" not in str(refused.value)


def test_interleaved_amplifiers_that_leave_the_last_columns_are_refused(tmp_path):
    """Nothing in a raw file would tell how many columns the detector has."""
    camera_template.write_like("hsc", tmp_path / "mine")
    camera_folder.read(tmp_path / "mine")
    layout = tmp_path / "mine" / "layout.csv"
    layout.write_text(layout.read_text().replace(",hsc,2048,", ",hsc,2050,"))
    with pytest.raises(BadInput, match=r"amplifiers\.csv line \d+: interleaved amplifiers must reach the last column"):
        camera_folder.read(tmp_path / "mine")


@pytest.mark.parametrize(("gain", "noise"), [("0", "5"), ("-1", "5"), ("nan", "5"), ("", "5"), ("1.6", "0")])
def test_an_amplifier_without_gain_or_noise_is_refused(folder, gain, noise):
    file = folder / camera_tables.AMPLIFIERS
    lines = file.read_text().splitlines()
    row = lines[-1].split(",")
    file.write_text("\n".join([*lines[:-1], ",".join([*row[:-3], gain, noise, row[-1]])]))
    with pytest.raises(BadInput, match=rf"amplifiers\.csv line {len(lines)}: (gain|read_noise)( =|.*missing)"):
        camera_folder.read(folder)


@pytest.mark.parametrize("name", ["gain", "bias", "fpa", "psf", "layout", "amplifiers", "read_noise"])
def test_a_band_may_not_have_the_name_of_a_parameter(folder, name):
    replace_in(folder / camera_tables.BANDS, "cfis_r,", f"{name},")
    with pytest.raises(BadInput, match=rf"bands\.csv line 2: band = '{name}' is the name of a parameter or table"):
        camera_folder.read(folder)


def test_detectors_that_overlap_are_refused(folder):
    file = folder / camera_tables.LAYOUT
    lines = file.read_text().splitlines()
    first, second = (line.split(",") for line in lines[-2:])
    file.write_text("\n".join([*lines[:-1], ",".join([second[0], *first[1:]])]))
    words = rf"layout\.csv line {len(lines)}: detectors {first[0]} and {second[0]} overlap$"
    with pytest.raises(BadInput, match=words):
        camera_folder.read(folder)


def test_detectors_that_overlap_with_a_larger_pixel_are_a_fault_of_the_configuration(folder):
    larger = {"ext.my_camera.fpa.pixel_size": (14.5, "um / pix")}
    mission = resolve(cameras=[camera_folder.read(folder)], overrides=larger)
    fault = next(checks.camera_faults("my_camera", mission))
    assert fault.startswith("mission model ext.my_camera.layout: detectors ccd00 and ccd01 overlap")


@pytest.mark.parametrize("name", ["decam", "vis", "My Camera", "9", "x" * 41])
def test_a_name_that_a_camera_may_not_have_is_refused(folder, name):
    folder.rename(folder.with_name(name))
    with pytest.raises(BadInput, match=r"truesky already has a camera|the folder's name is the camera's name"):
        camera_folder.read(folder.with_name(name))


def test_the_command_writes_a_folder_and_never_over_another(tmp_path, capsys):
    assert __main__.main(["mission", "camera", str(tmp_path / "mine"), "--like", "decam"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5
    assert __main__.main(["mission", "camera", str(tmp_path / "mine"), "--like", "decam"]) == 2
    assert capsys.readouterr().err.endswith("mine: already exists\n")
    assert __main__.main(["mission", "camera", str(tmp_path / "No Name"), "--like", "decam"]) == 2
    assert not (tmp_path / "No Name").exists()
    assert __main__.main(["mission", "camera", str(tmp_path / "other"), "--like", "lsst"]) == 2
    assert capsys.readouterr().err.endswith("hsc (did you mean lsstcam?)\n")
    assert not (tmp_path / "other").exists()


def test_a_path_that_the_system_does_not_take_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    long = "x" * 300
    for name in ("loop", long):
        with pytest.raises(BadInput, match=r"loop: no such folder|x: File name too long"):
            camera_folder.read(tmp_path / name)
        assert __main__.main(["mission", "camera", name, "--like", "decam"]) == 2
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1
        assert said.endswith(("already exists\n", "File name too long\n"))
    assert __main__.main(["mission", "camera", "loop/mine", "--like", "decam"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
