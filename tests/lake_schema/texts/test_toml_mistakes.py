"""Common syntax errors of TOML are explained with the number and the text of the line."""

import tomllib

import pytest

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.texts import toml_mistakes

MISTAKES = {
    "True": ("a = 1\nb = True", 2, "write true, in small letters and without quotes"),
    "no": ("a = no", 1, "write false, in small letters and without quotes"),
    "False in a table": ("a = { b = False }", 1, "write false, in small letters and without quotes"),
    "None": ("a = None", 1, "remove a key without value"),
    "no value": ("a = \nb = 1", 1, "the value after the equals sign is missing"),
    "no quotes": ("name = my_field", 1, 'write text in quotes, "my_field"'),
    "curly quotes": ("name = \u201cx\u201d", 1, "write straight quotes"),
    "two equals signs": ("a == 1", 1, "write only one equals sign"),
    "no leading digit": ("a = -.5", 1, "write a digit before the decimal point, -0.5"),
    "no last digit": ("a = 5.", 1, "write a digit after the decimal point"),
    "leading zero": ("a = 07", 1, "a number must not begin with 0"),
    "decimal comma": ("a = -0,5", 1, "write a decimal point in place of the comma, -0.5"),
    "decimal comma in a table": ("c = { ra = 53,1, dec = 2 }", 1, "write a decimal point in place of the comma, 53.1"),
    "a unit": ("radius = 12 arcmin", 1, "write a number without arcmin, or text in quotes"),
    "text after text": ('a = "x" "y"', 1, 'there is text after the value, "y"'),
    "two keys": ("a = 1, b = 2", 1, "write each key = value in a line of its own"),
    "a bracket too many": ("a = [1]]", 1, "there is no open bracket for ]"),
    "a colon": ("name: 'x'", 1, "write an equals sign in place of the colon, key = value"),
    "no equals sign": ("a 1", 1, "an equals sign is missing, key = value"),
    "no comma in a table": ("cone = { ra = 5 radius = 1 }", 1, "a comma is missing before radius"),
    "a name that begins with a digit": ("a = [3-4]", 1, 'write text in quotes, "3-4"'),
    "no comma in a list": ('a = ["x" "y"]', 1, 'a comma is missing before "y"'),
    "a comma too many": ("c = { a = 1, }", 1, "remove the comma before }"),
    "a table in two lines": ("c = { a = 1,\nb = 2 }", 1, "a table { .. } must end with } on the same line"),
    "an open table": ("c = { a = 1\nb = 2", 1, "a table { .. } must end with } on the same line"),
    "an open list": ("x = 1\nfiles = [\n'a',\n'b'\n\n[area]\ny = 1", 2, "the bracket [ is not closed by ]"),
    "an open list at the end": ("a = [1, 2\n", 1, "the bracket [ is not closed by ]"),
    "an open quote": ('a = "x\nb = 1', 1, 'the quote " is not closed'),
    "an open single quote": ("a = 1\nb = 'x\nc = 1", 2, "the quote ' is not closed"),
    "an open section": ("[area\nb = 1", 1, "] is missing after the name of the section"),
    "an open list of tables": ("[[pointing]\nb = 1", 1, "]] is missing after the name of the section"),
    "a key twice": ("[u]\na = 1\n[v]\nb = 1\na = 2\nb = 3\n", 6, "v.b is given twice, first in line 4"),
    "a key twice in a table": ("c = { a = 1, a = 2 }", 1, "a is given twice"),
    "a section twice": ("[u]\na = 1\n[u]\nb = 1", 3, "[u] is given twice, first in line 1: give its keys once"),
    "a list of tables with one bracket": ("[u]\na = 1\n[[u]]\nb = 1", 1, "write [[u]] in place of [u] for a list"),
    "the second table with one bracket": ("[[u]]\na = 1\n[u]\nb = 1", 3, "write [[u]] in place of [u] for a list"),
    "a date": ("mjd = 2027-02-30", 1, "there is no such date or time"),
    "a backslash": (r'a = "C:\data"', 1, r"write \\ for \ between double quotes"),
    "no key": ("= 3", 1, "the key before the equals sign is missing"),
}


@pytest.mark.parametrize(("source", "number", "problem"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_explained(source, number, problem):
    with pytest.raises(tomllib.TOMLDecodeError) as caught:
        tomllib.loads(source)
    text = toml_mistakes.explain(source, caught.value)
    assert text.startswith(f"line {number}: {problem}")
    assert text.endswith(f" (the line is: {source.splitlines()[number - 1].strip()})")


def test_other_errors_are_unchanged():
    assert toml_mistakes.explain("a = 1", ValueError("more than 16 nested brackets (at line 1)")) == (
        "more than 16 nested brackets (at line 1)"
    )
    text = toml_mistakes.explain("a = \x00", tomllib.TOMLDecodeError("Strange (at line 1, column 5)"))
    assert text.startswith("line 1, column 5: Strange (the line is: a =")


def test_a_file_is_named_with_the_line(tmp_path):
    path = tmp_path / "request.toml"
    path.write_bytes(b"a = 1\r\nb = True\r\n" + b"c = 1\r\n" * 3)
    with pytest.raises(BadInput, match=r"request\.toml line 2: write true, .* \(the line is: b = True\)$"):
        user_files.read_toml(path, "request")
    path.write_text(f"a = {'x' * 190}")
    with pytest.raises(BadInput, match=r"\(the line is: a = x{113}\.\.\.\)$"):
        user_files.read_toml(path, "request")
