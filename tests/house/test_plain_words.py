"""The checker of prose and names finds odd phrases, and accepts plain ones."""

from pathlib import Path

import pytest

from scripts import plain_words

SETTINGS = plain_words.read_settings()
ODD = {
    "subject": "Of each pixel, the charge.",
    "what": "What a task used.",
    "that-of": "Brighter than those of the sky.",
    "open-end": "The request it belongs to is it is from.",
    "so-many": "Up to so many terms are summed.",
    "where": "None where there is no file.",
    "is-no": "What remains of it is none.",
    "per": "It takes 3 bytes a pixel.",
    "own": "Each channel has one of its own.",
    "beside": "It is stored beside the image.",
    "things-that-say": "The header is told the gain.",
    "as-of": "frame : as of `scene`.",
    "idiom": "The cache is made anew.",
    "all-of-it": "The file has all of it.",
}


def hits(tmp_path: Path, source: str, name: str = "x.py") -> list[plain_words.Hit]:
    path = tmp_path / name
    path.write_text(source)
    return plain_words.find_hits(path, SETTINGS)[0]


@pytest.mark.parametrize("rule", SETTINGS.rules, ids=lambda rule: rule.name)
def test_each_rule_finds_its_phrase(rule, tmp_path):
    assert rule.name in {hit.rule for hit in hits(tmp_path, ODD[rule.name], "x.md")}


@pytest.mark.parametrize(
    "sentence",
    [
        "Return the charge of each pixel in electrons.",
        "The number of detectors is the same as in the camera.",
        "Raises BadInput if the file does not exist, and prints what it contains.",
        "Use as many workers as there are cores.",
        "What does it cost?",
    ],
)
def test_plain_sentences_are_accepted(sentence, tmp_path):
    assert hits(tmp_path, sentence, "x.md") == []


def test_docstrings_comments_messages_and_help_are_read(tmp_path):
    source = '''
"""Of a module, nothing."""
# Of a comment
# on two lines, nothing.
def f(value):
    """Of a function, `Of a name`, nothing."""
    raise ValueError(f"of a {value} nothing remains")
parser.add_argument("--x", help="of an option, " "nothing")
text = "Of a value, nothing."
# plain-words: off
'''
    found = hits(tmp_path, source)
    kinds = [(hit.line, hit.kind) for hit in found]
    assert sorted(kinds) == [(2, "docstring"), (3, "comment"), (6, "docstring"), (7, "message"), (8, "message")]
    # A line can be excluded.
    assert hits(tmp_path, "x = 1  # Of a value, nothing. plain-words: off\n") == []


def test_code_in_markdown_is_ignored(tmp_path):
    assert hits(tmp_path, "A text.\n\n```\nOf a command, nothing.\n```\n\nOf a list, nothing.\n", "x.md")[0].line == 7


def test_vague_names_are_found(tmp_path):
    path = tmp_path / "x.py"
    path.write_text("def held(own, mask):\n    found = one = 1\ndef reusable_tasks(*, rows): pass\ndef read(): pass\n")
    found, count = plain_words.find_vague_names(path, SETTINGS)
    assert [(hit.kind, hit.text) for hit in found] == [
        ("functions", "held"),
        ("variables", "own"),
        ("variables", "found"),
        ("variables", "one"),
    ]
    assert dict(count) == {"functions": 3, "variables": 5}


def test_a_file_must_not_become_worse(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("x.py").write_text('"""Of a module, nothing."""\n')
    report = plain_words.read_files([Path("x.py")], SETTINGS)
    assert report.counts() == {"x.py": 1}
    relaxed = plain_words.Settings(SETTINGS.rules, SETTINGS.vague, SETTINGS.good, dict.fromkeys(SETTINGS.limits, 1e9))
    assert plain_words.find_failures(report, relaxed, {"x.py": 1}) == []
    assert plain_words.find_failures(report, relaxed, {})[0] == "x.py: 1 places, at most 0 are allowed"
    strict = plain_words.Settings(SETTINGS.rules, SETTINGS.vague, SETTINGS.good, {"words": 1.5})
    assert plain_words.find_failures(report, strict, {"x.py": 1}) == ["words: 333.33 > 1.5"]
