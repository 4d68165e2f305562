"""Extreme numbers as parameters of all addresses: the answer is valid, or status 400 with the parameter's name."""

import json
from urllib.parse import urlencode

import pytest

from tests.truesky.page.test_traces import grism  # noqa: F401

EXTREMES = ("1e300", "-1e300", str(2**63), "nan")
VIEW = {"ra": "241.9", "dec": "11.9", "radius": "0.1"}
# Addresses of the lake, the numbers in their paths, and the numbers after the question mark.
ADDRESSES = [
    ("sky/galaxies/density", {}, {"order": "8", **VIEW}),
    ("sky/galaxies/sources", {}, VIEW),
    ("coverage", {}, {"order": "8", **VIEW}),
    ("exposures", {}, VIEW),
    ("image/{number}", {"number": "0"}, {}),
    ("tile/{number}/{level}/{row}/{column}", {"number": "0", "level": "0", "row": "0", "column": "0"}, {}),
    ("truth/{number}", {"number": "0"}, {}),
    ("cutout/{number}", {"number": "0"}, {"x": "3", "y": "3"}),
    ("trace/{number}/{id}", {"number": "0", "id": "OWN"}, {"order": "1"}),
    ("trace_at/{number}", {"number": "0"}, {"x": "3", "y": "3"}),
    ("nearest", {}, VIEW),
    ("source/{id}", {"id": "OWN"}, {}),
    ("spectrum/{id}", {"id": "OWN"}, {}),
    ("provenance/{number}", {"number": "0"}, {}),
]
CHART = {"axes": [0], "bins": [5], "spans": [[0.0, 1.0]], "own": [0], "points": 10}
FORM = {"Content_Type": "application/x-www-form-urlencoded"}


def check(answer, name):
    """Check the status of an answer, and that the only line of a refusal contains the name of the parameter."""
    status, _, body = answer
    assert status in (200, 400), (status, body)
    if status == 400:
        text = json.loads(body)["error"]
        assert name in text
        assert "\n" not in text


@pytest.mark.parametrize(("path", "inside", "query"), ADDRESSES, ids=[path.split("/{")[0] for path, *_ in ADDRESSES])
def test_addresses_of_the_lake(grism, path, inside, query):  # noqa: F811
    page, own, _ = grism

    def ask(**changes):
        numbers = {**inside, **query, **changes}
        numbers = {key: str(own) if value == "OWN" else value for key, value in numbers.items()}
        return page.of_lake(
            f"{path.format(**numbers)}?{urlencode({name: value for name, value in numbers.items() if name in query})}"
        )

    assert ask()[0] == 200
    for name in (*inside, *query):
        for value in EXTREMES:
            check(ask(**{name: value}), name)


@pytest.mark.parametrize("value", ["-2", "999999999", "1.5", "1e0", ""])
def test_orders_that_no_trace_has(grism, value):  # noqa: F811
    page, own, _ = grism
    status, _, body = page.of_lake(f"trace/0/{own}?order={value}")
    assert (status, "order" in json.loads(body)["error"]) == (400, True)


@pytest.mark.parametrize("value", [*(float(text) for text in EXTREMES), 2**63])
def test_charts(grism, value):  # noqa: F811
    page, *_ = grism
    usual = {"source": "galaxies", "axes": ["z_obs"], "charts": [CHART], "limits": [[0, 0.0, 1.0]]}
    changes = [("part", {"part": value})]
    changes += [(name, {"charts": [{**CHART, name: [value]}]}) for name in ("axes", "bins", "own")]
    changes += [("points", {"charts": [{**CHART, "points": value}]})]
    changes += [("spans", {"charts": [{**CHART, "spans": [span]}]}) for span in ([value, 1.0], [0.0, value])]
    changes += [("limits", {"limits": [limit]}) for limit in ([value, 0, 1], [0, value, 1], [0, 0, value])]
    for name, change in changes:
        answer = page.of_lake("charts", method="POST", body=json.dumps({**usual, **change}).encode())
        # An index that no expression has is called an axis.
        check(answer, "axis" if b"axis has no" in answer[2] else name)


@pytest.mark.parametrize("value", EXTREMES)
def test_tap(grism, value):  # noqa: F811
    page, *_ = grism
    tap = f"/tap/{page.gate.tap_token}"
    form = {"LANG": "ADQL", "QUERY": "SELECT TOP 1 id FROM galaxies"}
    status, _, body = page.ask(f"{tap}/sync?{urlencode({**form, 'MAXREC': value})}", cookie="")
    assert (status, b"MAXREC" in body) == (400, True)
    assert page.ask(f"{tap}/file/{page.server.lake.key}/{value}", cookie="")[0] == 404
    _, headers, _ = page.ask(f"{tap}/async", method="POST", body=urlencode(form).encode(), cookie="", **FORM)
    job = headers["Location"].removeprefix(page.origin)
    for name in ("EXECUTIONDURATION", "DESTRUCTION"):
        changed = urlencode({name: value}).encode()
        status, _, body = page.ask(f"{job}/{name.lower()}", method="POST", body=changed, cookie="", **FORM)
        assert (status, name.encode() in body) == (400, True)
    assert page.ask(f"{job}?WAIT={value}", cookie="")[0] == 200
    page.ask(job, method="DELETE", cookie="")
