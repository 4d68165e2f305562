"""Tables of pointings as users write them: what stands in a line is taken, and what is wrong is refused by its line."""

import pytest

from jobs.render.planning import ground_surveys
from jobs.request.observations import Observation
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve

MISSION = resolve()
BLOCK = Observation(("EXT",), survey="lsst", exposure_time_s=77.0, detectors=("R22_S11",))
HEAD = "channel,camera,band,ra,dec,position_angle,mjd"
ROW = "EXT,lsstcam,lsst_r,-10.0,20.5,30.0,60905.25"


def read(tmp_path, text):
    path = tmp_path / "pointings.csv"
    path.write_text(text)
    return ground_surveys.read(path, BLOCK, MISSION)


def test_a_line_is_an_exposure(tmp_path):
    plain, full = read(
        tmp_path,
        f"# my survey\n{HEAD},exposure_time_s,sky,seeing,zero_point,psf,detectors,image_type\n"
        f"{ROW},,,,,,,\n\n# better\n{ROW},30,12.5,0.61,28.1,psf.fits,R22_S11 R22_S12,deep\n",
    )
    assert (plain.ra, plain.dec, plain.position_angle, plain.mjd) == (350.0, 20.5, 30.0, 60905.25)
    assert (plain.exposure_time_s, plain.image_type, plain.detectors) == (77.0, "science", ("R22_S11",))
    assert (plain.sky, plain.seeing, plain.zero_point, plain.psf) == (None, None, None, None)
    assert (full.exposure_time_s, full.sky, full.seeing, full.zero_point) == (30.0, 12.5, 0.61, 28.1)
    # Found from the table's folder.
    assert (full.psf, full.detectors, full.image_type) == (str(tmp_path / "psf.fits"), ("R22_S11", "R22_S12"), "deep")
    assert (plain.field, full.field, full.survey) == (1, 2, "lsst")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "column ra is missing"),
        (HEAD.replace(",dec", "") + "\n", "column dec is missing"),
        (f"{HEAD},colour\n{ROW},red\n", "column colour is not known"),
        (f"# one\n# two\n{HEAD}\n{ROW}\n{ROW.replace('20.5', 'x')}\n", "line 5: dec = 'x' is not a number"),
        (f"{HEAD}\n{ROW.replace('20.5', '90.1')}\n", "line 2: dec = 90.1 is outside -90 to 90"),
        (f"{HEAD}\n{ROW.replace('20.5', 'nan')}\n", "line 2: dec = nan is outside"),
        (f"{HEAD}\n{ROW.replace('EXT', 'RADIO')}\n", "line 2: channel = 'RADIO'"),
        (f"{HEAD}\n{ROW.replace('lsstcam', 'vis')}\n", "line 2: channel EXT has no camera 'vis'"),
        (f"{HEAD}\n{ROW.replace('lsst_r', 'lsst_q')}\n", "line 2: camera lsstcam has no band 'lsst_q'"),
        (f"{HEAD},image_type\n{ROW},art\n", "line 2: image_type = 'art'"),
        (f"{HEAD},seeing\n{ROW},0\n", "line 2: seeing = 0.0 is outside"),
        (f"{HEAD}\nEXT,lsstcam,lsst_r\n", "line 2: ra is missing"),
        (f"{HEAD}\n{ROW}\n" + "\n" * 2_000_000, "more than 2000000 lines"),
        (f"{HEAD}{',ra' * 7000}\n{ROW}\n", "one of more than 20000 characters"),
    ],
)
def test_what_is_wrong_is_refused_by_its_line(tmp_path, text, words):
    with pytest.raises(BadInput, match=r"pointings\.csv") as caught:
        read(tmp_path, text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
