"""Folders of cameras: they are read, and mistakes are refused with the file and the line."""

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission import camera_folder, camera_tables, camera_template, checks, commands
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS

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
    copied, rows = (mission.rows(f"ext.{name}.amplifiers") for name in ("copied", known))
    for own, row in zip(copied, rows, strict=True):
        assert {key: own[key] for key in own if key not in ("gain", "read_noise", "full_well")}.items() <= row.items()
        for key in ("gain", "read_noise"):
            ratio = float(row[key]) / float(rows[0][key])
            assert float(own[key]) == pytest.approx(ratio * KNOWN.value(f"ext.{known}.{key}"), rel=1e-6)
    for parameter in KNOWN.parameters:
        name = parameter.key.removeprefix(f"ext.{known}.")
        # A folder has no exposure times of bands, and the level of the sky as a magnitude.
        if name != parameter.key and not name.endswith((".sky", "_r.exposure_time", "_u.exposure_time")):
            assert mission.value(f"ext.copied.{name}", parameter.unit) == parameter.value, name


def test_the_level_of_the_sky_is_that_of_the_known_camera(tmp_path):
    camera_template.write_like("lsstcam", tmp_path / "copied")
    mission = resolve(cameras=[camera_folder.read(tmp_path / "copied")])
    contrast = mission.value("ext.copied.lsst_r.zero_point") - mission.value("ext.copied.lsst_r.sky_brightness")
    rate = 10 ** (0.4 * contrast) * KNOWN.value("ext.lsstcam.fpa.pixel_scale") ** 2
    assert rate == pytest.approx(KNOWN.value("ext.lsstcam.lsst_r.sky"), rel=1e-4)


def test_the_checksum_is_of_what_the_folder_holds_wherever_it_lies(folder, tmp_path):
    first = camera_folder.read(folder)
    other = tmp_path / "elsewhere" / "my_camera"
    other.parent.mkdir()
    folder.rename(other)
    assert camera_folder.read(other).sha256 == first.sha256
    for file in camera_tables.LAYOUT, camera_tables.AMPLIFIERS, camera_tables.WAVEFRONT:
        (other / file).write_text((other / file).read_text() + "# another comment\n")
        assert camera_folder.read(other).sha256 != first.sha256
        (other / file).write_text((other / file).read_text().removesuffix("# another comment\n"))
    replace_in(other / camera_tables.BANDS, "cfis_r,,,26.", "cfis_r,,,25.")
    assert camera_folder.read(other).sha256 != first.sha256


def test_without_a_wavefront_the_telescope_has_that_of_the_others(folder):
    (folder / camera_tables.WAVEFRONT).unlink()
    mission = resolve(cameras=[camera_folder.read(folder)])
    assert mission.rows("ext.my_camera.psf.wavefront") == KNOWN.rows("ext.megacam.psf.wavefront")


def test_a_table_may_have_its_columns_in_any_order_with_comments_and_empty_lines(folder):
    before = camera_folder.read(folder)
    file = folder / camera_tables.PARAMETERS
    rows = [line.rsplit(",", 3) if '"' not in line else None for line in file.read_text().splitlines()]
    if all(rows):
        file.write_text("\n".join(",".join(reversed(row)) for row in rows))
    file.write_text("# A comment\n\n" + file.read_text() + "\n# The end\n")
    assert camera_folder.read(folder).sha256 == before.sha256


@pytest.mark.parametrize("file", ["parameters.csv", "layout.csv", "amplifiers.csv", "bands.csv"])
def test_a_missing_file_or_column_is_named(folder, file):
    text = (folder / file).read_text()
    (folder / file).unlink()
    with pytest.raises(BadInput, match=rf"my_camera/{file}: no such file$"):
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
    with pytest.raises(BadInput, match=rf"my_camera/{file}: unknown column 'colour', the columns are"):
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
        ("parameters.csv", "um / pix", "s", r"line \d+: fpa.pixel_size: s does not convert to um / pix"),
        ("parameters.csv", "um / pix", "parrots", r"line \d+: fpa.pixel_size: 'parrots' is not a unit"),
        ("layout.csv", "ccd00,megacam,2048", "ccd00,megacam,0", r"layout\.csv line \d+: nx = 0 is not between 1 and"),
        ("layout.csv", "ccd00,megacam,2048", "ccd00,megacam,99.5", r"layout\.csv line \d+: nx = 99.5 is not a whole"),
        ("layout.csv", "ccd00,megacam,2048", "ccd00,megacam,1024", r"layout\.csv line \d+: .* megacam differ in size"),
        ("layout.csv", "ccd01", "ccd00", r"layout\.csv line \d+: ccd00 is given twice"),
        ("layout.csv", "ccd01", "C/1", r"layout\.csv line \d+: detector = 'C/1': a name has letters"),
        ("layout.csv", "ccd01,megacam", "ccd01,other", r"amplifiers\.csv: detectors of type other have no"),
        ("amplifiers.csv", "megacam,A,0,0", "megacam,A,2,0", r"amplifiers\.csv line \d+: overlaps amplifier A"),
        (
            "amplifiers.csv",
            "megacam,A,0,0,1024",
            "megacam,A,0,0,9024",
            r"line \d+: reaches beyond the detector",
        ),
        (
            "bands.csv",
            "cfis_r,,",
            "cfis_r,missing.dat,air",
            r"bands\.csv line \d+: .*missing.dat: no such file",
        ),
        ("bands.csv", "cfis_r,,", "cfis_r,layout.csv,", r"bands\.csv line \d+: medium is missing"),
        ("bands.csv", "cfis_r,,", "cfis_r,layout.csv,water", r"bands\.csv line \d+: medium = 'water' is not air or"),
        ("bands.csv", "cfis_r,,", "cfis r,,", r"bands\.csv line \d+: band = 'cfis r': a name has letters"),
        ("bands.csv", "cfis_r,,,", "cfis_r,,,nan", r"bands\.csv line \d+: zero_point = 'nan\S*' is not a number"),
        ("wavefront.csv", "4,0,0,60", "4,0,0,inf", r"wavefront\.csv line \d+: coefficient_nm = inf is not between"),
    ],
)
def test_a_mistake_is_named_with_its_file_and_line(folder, file, old, new, words):
    replace_in(folder / file, old, new)
    with pytest.raises(BadInput, match=words) as refused:
        camera_folder.read(folder)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("gain", "noise"), [("0", "5"), ("-1", "5"), ("nan", "5"), ("", "5"), ("1.6", "0")])
def test_an_amplifier_without_gain_or_noise_is_refused(folder, gain, noise):
    file = folder / camera_tables.AMPLIFIERS
    lines = file.read_text().splitlines()
    row = lines[-1].split(",")
    file.write_text("\n".join([*lines[:-1], ",".join([*row[:-3], gain, noise, row[-1]])]))
    with pytest.raises(BadInput, match=rf"amplifiers\.csv line {len(lines)}: (gain|read_noise)( =|.*missing)"):
        camera_folder.read(folder)


def test_detectors_that_overlap_are_a_fault_of_the_configuration(folder):
    file = folder / camera_tables.LAYOUT
    lines = file.read_text().splitlines()
    first, second = (line.split(",") for line in lines[-2:])
    file.write_text("\n".join([*lines[:-1], ",".join([second[0], *first[1:]])]))
    mission = resolve(cameras=[camera_folder.read(folder)])
    (fault,) = checks.camera_faults("my_camera", mission)
    assert fault == f"mission model ext.my_camera.layout: detectors {first[0]} and {second[0]} overlap"


@pytest.mark.parametrize("name", ["decam", "vis", "My Camera", "9", "x" * 41])
def test_a_name_that_a_camera_may_not_have_is_refused(folder, name):
    folder.rename(folder.with_name(name))
    with pytest.raises(BadInput, match=r"truesky has a camera|a camera has the name of its folder"):
        camera_folder.read(folder.with_name(name))


def test_the_command_writes_a_folder_and_never_over_another(tmp_path, capsys):
    assert commands.main(["camera", str(tmp_path / "mine"), "--like", "decam"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5
    assert commands.main(["camera", str(tmp_path / "mine"), "--like", "decam"]) == 2
    assert capsys.readouterr().err.endswith("mine: is there already\n")
    assert commands.main(["camera", str(tmp_path / "No Name"), "--like", "decam"]) == 2
    assert not (tmp_path / "No Name").exists()
