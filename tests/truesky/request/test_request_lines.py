"""Messages about keys give the line of the request file."""

import pytest

from lake_schema.errors import BadInput, bad_input
from truesky.request import request_lines

TEXT = """name = "x"
# [[pointing]]
[[pointing]]
channel = "VIS"

[[observation]]
ra = 1
  [[pointing]]  # second
ra = 2
band = "r"
[area]
band = 1
polygon = [
  [53.0, -28.0],
  [54.0, -28.0],
]
[observation.area]
tile = 1
[mission.overrides] # by name
"vis.gain" = { value = 3.0 }
effects.off = []
"""


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("pointing[0].channel = 'x' is not allowed", 4),
        ("pointing[0].band is missing", 3),
        ("pointing[1].band: camera", 10),
        ("pointing[1]: no", 8),
        ("observation[0].ra", 7),
        ("observation[1].ra", 0),
        ("area.band is", 12),
        ("area.box is missing", 11),
        ("area: no cell", 11),
        ("area.polygon[1].ra = 400", 13),
        ("observation[0].area.tile = 1", 18),
        ("mission.overrides.vis.gain.unit is missing", 20),
        ("mission.cameras: no", 19),
        ("mission.overrides.effects.off = 1", 21),
        ("name = 'x' is", 1),
        ("names are", 0),
        ("pointing must be a list", 0),
    ],
)
def test_the_line_of_a_key(tmp_path, message, line):
    path = tmp_path / "a.toml"
    path.write_text(TEXT)
    place = f" line {line}" if line else ""
    assert str(request_lines.with_request_file(BadInput(message), path)) == f"request {path}{place}: {message}"


def test_each_message_has_its_line(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(TEXT)
    error = request_lines.with_request_file(bad_input(["seed is missing", "pointing[1].ra is wrong"]), path)
    assert error.messages == (f"request {path}: seed is missing", f"request {path} line 9: pointing[1].ra is wrong")


def test_a_file_that_is_gone_has_no_lines(tmp_path):
    error = request_lines.with_request_file(BadInput("pointing[0].ra is wrong"), tmp_path / "a.toml")
    assert str(error) == f"request {tmp_path / 'a.toml'}: pointing[0].ra is wrong"


@pytest.mark.parametrize("key", ["vis.]", "vis.  ]", "[", "a]b[", "x[1", "]."])
def test_brackets_in_a_key_in_quotes_are_not_indices(tmp_path, key):
    file = tmp_path / "r.toml"
    file.write_text(f'name = "x"\n[mission.overrides]\n"{key}" = 1.0\n')
    error = request_lines.with_request_file(BadInput(f"mission.overrides.{key}: is not a parameter"), file)
    assert str(error).startswith(f"request {file} line ")
