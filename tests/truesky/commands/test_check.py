"""The check prints all mistakes of a request in one call, in the order of the file, or what it has understood."""

import json
import re

import pytest

from lake_schema.errors import BadInput
from tests import requests
from truesky.api import simulate
from truesky.commands import check

MANY = """nam = "x"
accuracy = 1e-3

[universe]
galaxy_limt = 25
star_limit = 99
box_cells = 200

[area]
cone = { ra = 53.1, dec = -97.8, radius = "12 arcmin" }

[[pointing]]
channel = "VIS"
band = "VIS"
ra = "3h"
dec = -27.8
detectors = ["CCD_7", "3_4"]

[[pointing]]
channel = "EXT"
camera = "LSSTCam"
ra = 53.1
dec = -27.8
mjd = "2027-01-1"

[[observation]]
channels = ["EXT"]
survey = "lsst"
bands = ["r"]
visits = 2

[products]
truth = ["noisefree"]

[unversee]
"""
KEYS = [
    "seed", "nam", "accuracy", "universe.galaxy_limt", "universe.star_limit", "universe.box_cells",
    "area.cone.dec", "area.cone.radius", "pointing[0].band", "pointing[0].ra", "pointing[0].detectors",
    "pointing[0].detectors", "pointing[1].camera", "pointing[1].mjd", "observation[0].bands", "observation[0].visits",
    "products.truth", "unversee",
]  # fmt: skip
DEMO = """[[pointing]]
channel = "VIS"
centre_on = "3-4"
detectors = ["3-4"]
ra = "03:32:28.08"
dec = "-27:48:28.8"
mjd = 2025-08-18
"""


def written(folder, text):
    path = folder / "r.toml"
    path.write_text(text)
    return str(path)


def keys_of(lines):
    return [re.match(r"truesky check: request \S+(?: line \d+)?: ([\w.\[\]]+)", line)[1].rstrip(":") for line in lines]


def test_all_mistakes_are_reported_in_the_order_of_the_file(tmp_path, capsys):
    assert check.main([written(tmp_path, MANY)]) == 2
    said = capsys.readouterr()
    lines = said.err.splitlines()
    assert said.out == ""
    assert keys_of(lines) == KEYS
    suggestions = [match[1] for line in lines if (match := re.search(r"did you mean (\S+)\?", line))]
    assert suggestions == [
        "name", "galaxy_limit", "euclid_vis", "3-4", "lsstcam", "lsst_r", "noise_free", "[universe]",
    ]  # fmt: skip


def test_a_request_in_a_similar_folder_is_suggested(tmp_path, capsys):
    (tmp_path / "requests").mkdir()
    (tmp_path / "requests" / "my_field.toml").touch()
    for name in ("request/my_field.toml", "requesst/my_feeld.toml"):
        assert check.main([str(tmp_path / name)]) == 2
        assert capsys.readouterr().err.endswith(f"no such file; did you mean {tmp_path}/requests/my_field.toml?\n")
    for name in ("request/demo.toml", "tables/my_field.toml", "a/b/my_field.toml"):
        assert check.main([str(tmp_path / name)]) == 2
        assert capsys.readouterr().err.endswith(f"{tmp_path / name}: no such file\n")


def test_a_request_with_a_similar_name_is_suggested(tmp_path, capsys):
    for name in ("my_field.toml", "other.toml", "my_field.csv"):
        (tmp_path / name).touch()
    assert check.main([str(tmp_path / "my_feild.toml")]) == 2
    problem = f"{tmp_path / 'my_feild.toml'}: no such file; did you mean {tmp_path / 'my_field.toml'}?"
    assert capsys.readouterr().err == f"truesky check: request {problem}\n"
    assert check.main([str(tmp_path / "my_field")]) == 2
    assert capsys.readouterr().err.endswith("my_field.toml?\n")
    assert check.main([str(tmp_path / "demo.toml")]) == 2
    assert capsys.readouterr().err.endswith("demo.toml: no such file\n")


def test_the_ending_of_a_file_may_be_misspelt(tmp_path, capsys):
    (tmp_path / "my_field.toml").write_text("")
    (tmp_path / "my_fields.fits").write_text("")
    assert check.main([str(tmp_path / "my_field.tml")]) == 2
    assert capsys.readouterr().err.endswith(f"no such file; did you mean {tmp_path / 'my_field.toml'}?\n")
    assert check.main([str(tmp_path / "my_fields.csv")]) == 2
    assert capsys.readouterr().err.endswith("my_fields.csv: no such file\n")


def test_a_folder_is_not_a_request(tmp_path, capsys):
    assert check.main([str(tmp_path)]) == 2
    problem = f"request {tmp_path}: is a folder, but must be a TOML file; truesky verify {tmp_path} checks a lake"
    assert capsys.readouterr().err == f"truesky check: {problem}\n"


def test_python_gets_all_mistakes(tmp_path):
    with pytest.raises(BadInput) as caught:
        simulate.check(written(tmp_path, MANY))
    assert len(caught.value.messages) == len(KEYS)


def test_mistakes_of_keys_of_the_plan_and_of_files_are_reported_together(tmp_path, capsys):
    more = DEMO.replace("2025-08-18", "2025-10-02") + '[ingest.dust]\nfile = "none.fits"\ncolumn = "x"\n'
    more += '[products]\ncompression = "zip"\n[psf]\neuclid_vis = "none.psf"\n'
    path = requests.written(tmp_path, more, area=requests.FIELD.format(0.2))
    assert check.main([str(path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [any(word in line for line in lines) for word in ("none.fits", "pointing[0].mjd", "compression")] == [
        True
    ] * 3
    assert len(lines) == 3


def test_an_entry_with_a_mistake_causes_no_other_mistake(tmp_path, capsys):
    more = DEMO.replace('"VIS"', '"vis"') + '[psf]\neuclid_vis = "none.psf"\n'
    path = requests.written(tmp_path, more, area=requests.FIELD.format(0.01))
    assert check.main([str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pointing[0].channel = 'vis' is not allowed: did you mean VIS?" in line


def test_the_check_prints_what_it_has_understood(tmp_path, capsys):
    path = requests.written(tmp_path, DEMO, area=requests.FIELD.format(0.2))
    assert check.main([str(path), "--plan"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "x: good: 1 pointings, 0 observations, 1 variants",
        "x: pointing[0].ra = 03:32:28.08 is 53.117 deg",
        "x: pointing[0].dec = -27:48:28.8 is -27.808 deg",
        "x: pointing[0].mjd = 2025-08-18 is MJD 60905 (UTC)",
    ]


def test_a_request_without_exposures_has_default_bands(tmp_path, capsys):
    path = requests.written(tmp_path, area=requests.FIELD.format(0.1))
    assert check.main([str(path), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["bands"] == ["euclid_vis", "euclid_y", "euclid_j", "euclid_h", *(f"lsst_{b}" for b in "ugrizy")]
    assert summary["pointings"] == summary["observations"] == 0


@pytest.mark.parametrize("words", [[], ["--plan"], ["a", "--plans"], ["a", "b"]])
def test_wrong_arguments_are_refused_in_one_line(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        check.main(words)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("truesky check: ")
