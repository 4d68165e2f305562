"""Mistakes of users are refused by the check and the forecast in one line, before anything is written."""

import pytest

from lake_schema.errors import BadInput
from truesky.commands import check, plan
from truesky.request.exposures import pointing_tables
from truesky.running import submitted_job

HEAD = 'name = "x"\nseed = 1\n'
AREA = "[area]\ncone = { ra = 53.117, dec = -27.808, radius = 0.2 }\n"
POINT = """[[pointing]]
channel = "VIS"
band = "euclid_vis"
ra = 53.117
dec = -27.808
centre_on = "3-4"
detectors = ["3-4"]
mjd = 60905.0
"""
GOOD = HEAD + AREA + POINT
WIDE = HEAD + "[area]\ncone = { ra = 53.117, dec = -27.808, radius = 4.0 }\n"
OWN = WIDE + '[[observation]]\nchannels = ["VIS"]\nra = 53.117\ndec = -27.808\n'
GROUND = WIDE + '[[observation]]\nchannels = ["EXT"]\nsurvey = "des"\nra = 53.117\ndec = -27.808\n'
TABLE = WIDE + '[[observation]]\nchannels = ["VIS"]\npointings = "p.csv"\n'
CENTRE = POINT.replace("53.117", "266.4").replace("-27.808", "-28.9").replace("60905", "60760")

BLOCK = WIDE + '[[observation]]\nchannels = ["VIS"]\n'
EXT = WIDE + '[[observation]]\nchannels = ["EXT"]\nsurvey = "des"\n'
BIAS = BLOCK + 'image_type = "bias"\nexposures = 2\n'


def pointed(old, new):
    return GOOD.replace(old, new)


MISTAKES = {
    "a detector misspelt": (pointed('detectors = ["3-4"]', 'detectors = ["3_4"]'), "no detector '3_4'"),
    "a detector of another camera": (
        pointed('detectors = ["3-4"]', 'detectors = ["R22_S11"]'), "no detector 'R22_S11'",
    ),
    "centred on no detector": (pointed('centre_on = "3-4"', 'centre_on = "7-7"'), "pointing[0].centre_on"),
    "a band misspelt": (pointed("euclid_vis", "euclid_viz"), "no band 'euclid_viz'"),
    "a band of another camera": (pointed("euclid_vis", "lsst_r"), "pointing[0].band"),
    "a camera misspelt": (GOOD + 'camera = "viz"\n', "pointing[0].camera"),
    "a pointing in degrees as text": (
        pointed("ra = 53.117\ndec", 'ra = "53.117"\ndec'), "pointing[0].ra = '53.117' must be a number in degrees, or",
    ),
    "a Julian date": (
        pointed("60905.0", "2460905.5"), "pointing[0].mjd = 2460905.5 is a Julian date: write the MJD 60905",
    ),
    "a date of words": (pointed("60905.0", '"1 May 2027"'), "pointing[0].mjd = '1 May 2027' must be a number (MJD,"),
    "a PSF of spectra": (
        WIDE + '[[observation]]\nchannels = ["NISP-S"]\nfields = 1\n[psf]\nnisp_red = "x.fits"\n',
        "psf.nisp_red: spectra do not support PSF files",
    ),
    "an effect that every image needs": (GOOD + '[effects]\noff = ["adc"]\n', "effects.off: 'adc' cannot be switched"),
    "towards the Sun": (pointed("60905.0", "60950.0"), "next allowed: MJD 61042.8 (2026-01-02) to"),
    "before the launch": (pointed("60905.0", "58979.0"), "pointing[0].mjd: MJD 58979 is before the launch of Euclid"),
    "a bias before the launch": (BIAS + "mjd = 58979\n", "observation[0].mjd: MJD 58979 is before the launch of"),
    "an area too small": (pointed("0.2 }", "0.01 }"), "enough: area.cone = { ra = 53.117, dec = -27.808, radius"),
    "an area elsewhere": (
        pointed("cone = { ra = 53.117", "cone = { ra = 10.0"), "1 of 1 detector positions see sky outside",
    ),
    "in the Galactic plane": (
        HEAD + AREA.replace("53.117", "266.4").replace("-27.808", "-28.9") + CENTRE, "stars.plane_limit",
    ),
    "a flux's band misspelt": (GOOD + '[fluxes]\nbands = ["euclid_viz"]\n', "fluxes.bands: 'euclid_viz'"),
    "no file of a filter": (
        GOOD + '[fluxes.passbands.mine]\nfile = "none.txt"\nmedium = "air"\nformat = "passband_ascii"\n', "none.txt",
    ),
    "no file of galaxies' spectra": (
        GOOD + '[fluxes.templates]\nformat = "cosmos"\nfiles = ["none.sed"]\n', "none.sed",
    ),
    "no file of an extinction law": (
        GOOD + '[fluxes.extinction.3]\nformat = "extinction"\nfile = "none.ext"\n', "none.ext",
    ),
    "no file of a PSF": (GOOD + '[psf]\neuclid_vis = "none.fits"\n', "none.fits"),
    "a PSF in a band that is not observed": (GOOD + '[psf]\nlsst_r = "none.fits"\n', "psf.lsst_r: no exposure"),
    "no file of moving bodies": (GOOD + '[solar_system]\nbodies = "none.csv"\n', "none.csv"),
    "no file of stars": (
        GOOD + '[stars.catalogue]\nfile = "none.csv"\ncolumns = { ra = "a", dec = "b", mag_h = "h", teff = "t" }\n',
        "none.csv",
    ),
    "no file of Tycho-2": (GOOD + '[stars]\ntycho2 = ["none.dat"]\n', "none.dat"),
    "no catalogue of galaxies": (
        GOOD + '[ingest.galaxies]\nformat = "flagship2"\nfiles = ["none.parquet"]\n', "none.parquet",
    ),
    "a format of no name": (GOOD + '[ingest.galaxies]\nformat = "flagship9"\nfiles = ["p.csv"]\n', "flagship9"),
    "no columns of halos": (GOOD + '[ingest.halos]\nfiles = ["p.csv"]\n', "ingest.halos.columns must have ra, dec,"),
    "no file of halos": (
        GOOD + '[ingest.halos]\nfiles = ["none.parquet"]\n'
        'columns = { ra = "a", dec = "d", z_true = "z", log_mass = "m" }\n', "none.parquet: no such file",
    ),
    "no file of halos names its key": (
        GOOD + '[ingest.halos]\nfiles = ["none.parquet"]\n'
        'columns = { ra = "a", dec = "d", z_true = "z", log_mass = "m" }\n', "ingest.halos.files: ",
    ),
    "no table of sources": (
        HEAD + AREA + '[sources]\nonly = "table"\ngalaxies = "none.csv"\n' + POINT, "sources.galaxies: ",
    ),
    "no map of dust": (GOOD + '[ingest.dust]\nfile = "none.fits"\ncolumn = "EBV"\n', "none.fits"),
    "a limit in no band": (GOOD + '[universe]\ngalaxy_band = "I"\n', "universe.galaxy_band = 'I'"),
    "a limit too faint": (GOOD + "[universe]\ngalaxy_limit = 40\n", "universe.galaxy_limit = 40"),
    "a parameter misspelt": (GOOD + '[mission.overrides]\n"vis.gian" = { value = 3.0, unit = "" }\n', "vis.gian"),
    "an explored parameter misspelt": (
        GOOD + '[explore]\n"vis.gian" = { values = [3.0], unit = "" }\n',
        "explore.vis.gian: the mission database has no such parameter: did you mean vis.gain?",
    ),
    "a value out of range": (
        GOOD + '[explore]\n"vis.read_noise" = { values = [-1.0], unit = "electron" }\n',
        "explore.vis.read_noise",
    ),
    "an effect misspelt": (GOOD + '[effects]\noff = ["cosmics"]\n', "effects.off"),
    "a box the wrong way round": (
        HEAD + "[area]\nbox = { ra = [54, 52], dec = [-29, -27] }\n" + POINT, "the second must be east",
    ),
    "a survey's band in another survey": (
        GROUND + 'bands = ["lsst_r"]\n', "observation[0].bands: survey des has no band",
    ),
    "a filter that VIS has not": (OWN + 'bands = ["euclid_j"]\n', "observation[0].bands: VIS has no band 'euclid_j'"),
    "a block's detector misspelt": (OWN + 'detectors = ["9-9"]\n', "no detector '9-9'"),
    "half a place": (OWN.replace("dec = -27.808\n", ""), "observation[0].dec is missing"),
    "a place and an area": (OWN + "area = { tile = 1 }\n", "observation[0]: ra and area exclude each other"),
    "a place and fields": (OWN + "fields = 3\n", "observation[0]: ra and fields exclude each other"),
    "a place and a table": (OWN + 'pointings = "p.csv"\n', "observation[0]: ra and pointings exclude each other"),
    "an angle of the survey's fields": (
        WIDE + '[[observation]]\nchannels = ["VIS"]\nposition_angle = 3.0\n', "observation[0].position_angle requires",
    ),
    "a pattern of no name": (OWN + 'dither = "X"\n', "observation[0].dither = 'X'"),
    "Euclid's pattern on the ground": (
        GROUND + 'dither = "S"\n', "observation[0].dither = 'S' is a Euclid pattern",
    ),
    "an offset of three numbers": (OWN + "dither = [[0, 0, 0]]\n", "observation[0].dither must be"),
    "a field towards the Sun": (OWN + "mjd = 60950.0\n", "observation[0].mjd: the pointing is 126."),
    "no survey": (GROUND.replace('survey = "des"\n', ""), "observation[0].survey"),
    "Euclid and the ground together": (OWN.replace('"VIS"', '"VIS", "EXT"'), "EXT must be the only channel"),
    "no number of frames": (OWN + 'image_type = "bias"\n', "requires exposures"),
    "a calibration of another channel": (OWN + 'image_type = "standard_star"\n', "observation[0].image_type"),
    "fields that see more than the area": (
        HEAD + AREA + '[[observation]]\nchannels = ["VIS"]\nfields = 1\n', "is large enough: area.cone = { ra =",
    ),
    "dithers of a ground survey": (EXT + "dither = [[0, 0], [9, 9]]\n", "[0].dither is not for a ground survey's"),
    "fields of a ground survey": (EXT + "fields = 2\n", "observation[0].fields is not for a ground survey's pattern"),
    "visits from the ground": (GROUND + "visits = 3\n", "observation[0].visits is not for a ground camera's field"),
    "visits of a bias": (BIAS + "visits = 5\n", "observation[0].visits is not for bias, charge_injection and "),
    "dithers of a bias": (BIAS + 'dither = "J"\n', "observation[0].dither is not for bias, charge_injection and "),
    "a long bias": (BIAS + "exposure_time_s = 9\n", "observation[0].exposure_time_s is not for bias, charge_"),
    "frames of a survey's fields": (BLOCK + "exposures = 3\n", "[0].exposures is not for fields of a Euclid survey"),
    "a longer exposure of a survey": (BLOCK + "exposure_time_s = 9\n", "[0].exposure_time_s is not for fields of a"),
    "a survey of a place": (OWN + 'survey = "deep"\n', "observation[0].survey is not for a Euclid field at ra, dec"),
    "the blue grism of VIS": (OWN + "blue = true\n", "observation[0].blue is not for VIS: used by NISP-S"),
    "no table of pointings": (TABLE.replace("p.csv", "q.csv"), "observation[0].pointings"),
}  # fmt: skip
TABLES = {
    "no declination": ("ra,mjd\n53.1,60905\n", "column dec is missing"),
    "columns of other names": (
        "RA,DEC,EXPTIME,FILTER\n53.1,-27.8,30,euclid_vis\n",
        "p.csv: columns RA, DEC, EXPTIME, FILTER are unknown: did you mean ra, dec, exposure_time_s, band?",
    ),
    "a commented line of names": ("# ra,dec\n53.1,-27.8\n", "p.csv: the first line has numbers, but must have the"),
    "semicolons": ("ra;dec\n53.1;-27.8\n", "p.csv: the columns are separated by semicolons"),
    "a column of no name": ("ra,dec,mjd,angle\n53.1,-27.8,60905,0\n", "column angle is unknown"),
    "another channel's line": ("ra,dec,channel\n53.1,-27.8,EXT\n", "line 2: channel = 'EXT' is not one of"),
    "another camera's band": ("ra,dec,band\n53.1,-27.8,lsst_r\n", "line 2: camera vis has no band 'lsst_r'"),
    "a line towards the Sun": ("ra,dec,mjd\n53.1,-27.8,60950\n", "pointings: the pointing is 126."),
    "a dark before the launch": ("ra,dec,mjd,image_type\n53.1,-27.8,58979,dark\n", "MJD 58979 is before the launch"),
    "a line beyond the area": ("ra,dec,mjd\n63.1,-27.8,60905\n", "is large enough: area.cone = { ra ="),
    "a line's detector": ("ra,dec,detectors\n53.1,-27.8,9-9\n", "no detector '9-9'"),
}
CASES = {name: (text, "", words) for name, (text, words) in MISTAKES.items()}
CASES |= {name: (TABLE, rows, words) for name, (rows, words) in TABLES.items()}
UNUSED = {
    "visits": 2, "dither": '"J"', "exposures": 2, "bands": '["euclid_vis"]', "short": "false", "flat": "false",
    "blue": "true",
}  # fmt: skip
CASES |= {
    f"{key} of a table": (
        f"{TABLE}{key} = {value}\n", "ra,dec\n53.1,-27.8\n", f"[0].{key} is not for a table of pointings: its "
    )
    for key, value in UNUSED.items()
}  # fmt: skip


def test_requests_without_mistakes_are_valid(tmp_path, capsys):
    (tmp_path / "p.csv").write_text("ra,dec\n53.1,-27.8\n")
    for number, text in enumerate((GOOD, OWN, GROUND, TABLE)):
        (tmp_path / f"{number}.toml").write_text(text)
        assert check.main([str(tmp_path / f"{number}.toml")]) == 0, capsys.readouterr().err


def refused_in_one_line(folder, capsys, text, rows, words, command):
    """Give a request to the check or to the forecast, which must print one line and write nothing."""
    path, lake = folder / "x.toml", folder / "lake"
    path.write_text(text)
    (folder / "p.csv").write_text(rows)
    before = sorted(folder.iterdir())
    if command == "check":
        assert check.main([str(path)]) == 2
    else:
        assert submitted_job.main(plan.JOB, ["--lake", str(lake), "--request", str(path), "--dry-run"]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(("text", "rows", "words"), CASES.values(), ids=CASES)
def test_a_mistake_is_refused_in_one_line_and_nothing_is_written(tmp_path, capsys, text, rows, words):
    refused_in_one_line(tmp_path, capsys, text, rows, words, "check")


# One of each kind: a key, a pointing table, and what is known only after the plan.
BRIEF = ("a band misspelt", "semicolons", "towards the Sun", "a line's detector")


@pytest.mark.parametrize(
    ("text", "rows", "words"),
    [pytest.param(*case, marks=() if name in BRIEF else pytest.mark.nightly, id=name) for name, case in CASES.items()],
)
def test_a_mistake_is_refused_by_the_forecast_as_well(tmp_path, capsys, text, rows, words):
    refused_in_one_line(tmp_path, capsys, text, rows, words, "forecast")


def test_an_unknown_column_does_not_hide_wrong_values(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("ra,dec,exptime\n53.1,95,30\n")
    with pytest.raises(BadInput) as caught:
        pointing_tables.read(path, ("VIS",), "science")
    first, second = caught.value.messages
    assert first.endswith("column exptime is unknown: did you mean exposure_time_s?")
    assert "line 2: dec" in second
    assert "95.0 is outside" in second
