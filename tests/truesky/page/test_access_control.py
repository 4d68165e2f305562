"""Requests that break each rule of access are refused."""

import asyncio
import base64
import json
import re
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.waiting import PATIENCE
from truesky.page import access_control, server
from truesky.page.lake_session import MAX_WAITING


def test_the_page_answers_its_own_browser(page):
    assert page.ask("/")[0] == 200
    assert page.ask("/static/app.js")[0] == 200
    assert page.ask("/api/lake", Origin=page.origin, Sec_Fetch_Site="same-origin")[0] == 200


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}", ""])
@pytest.mark.parametrize("path", ["/", "/api/lake", "/static/app.js"])
def test_another_host_is_refused(page, host, path):
    """A foreign host name that resolves to this machine (DNS rebinding)."""
    assert page.ask(path, Host=host.replace("{port}", str(page.gate.port)))[0] == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1"])
def test_another_site_is_refused(page, origin):
    origin = origin.replace("{port}", str(page.gate.port))
    for path in ("/", "/api/lake", f"/api/{page.server.lake.key}/export?sql=SELECT+1"):
        assert page.ask(path, Origin=origin)[0] == 403
    assert page.of_lake("sql", method="POST", body=b"{}", Origin=origin)[0] == 403
    assert page.ask(f"/tap/{page.gate.tap_token}/availability", Origin=origin)[0] == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_other_sites_may_only_open_the_start_page(page, site):
    assert page.ask(f"/?token={page.gate.token}", cookie="", Sec_Fetch_Site=site)[0] == 303
    for path in ("/api/lake", "/static/app.js", f"/api/{page.server.lake.key}/export?sql=SELECT+1"):
        assert page.ask(path, Sec_Fetch_Site=site)[0] == 403


@pytest.mark.parametrize("cookie", ["", "truesky-{port}=", "truesky-{port}=wrong", "truesky-1={token}", "a=\udc80"])
@pytest.mark.parametrize("path", ["/", "/static/app.js", "/static/style.css", "/api/lake", "/api/x/sql", "/nothing"])
def test_requests_without_the_token_are_refused(page, cookie, path):
    given = cookie.replace("{port}", str(page.gate.port)).replace("{token}", page.gate.token)
    status, _, body = page.ask(path, cookie=given.encode("utf-8", "surrogateescape").decode("latin-1"))
    assert status == 401
    assert page.gate.token.encode() not in body


def test_the_token_becomes_a_cookie_that_no_script_reads(page):
    status, headers, _ = page.ask(f"/?token={page.gate.token}", cookie="")
    assert (status, headers["Location"]) == (303, "/")
    assert headers["Set-Cookie"].startswith(page.cookie)
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= set(headers["Set-Cookie"].split("; "))
    assert page.ask("/?token=wrong", cookie="")[0] == 401
    assert page.ask(f"/?token={page.gate.tap_token}", cookie="")[0] == 401


def test_tokens_are_192_random_bits():
    tokens = {access_control.new_token() for _ in range(50)}
    assert len(tokens) == 50
    assert {len(base64.urlsafe_b64decode(token)) for token in tokens} == {24}


STATIC = sorted((Path(server.__file__).parent / "static").iterdir())
MARKUP = (
    r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|setTimeout\(['\"]|\.style\.cssText"
)


@pytest.mark.parametrize("file", STATIC, ids=lambda file: file.name)
def test_text_never_becomes_markup_and_nothing_is_loaded_from_elsewhere(file):
    """Files of the page never turn text into markup or code, and have no foreign addresses and no inline code."""
    text = file.read_text(encoding="utf-8")
    # The editor is a library. It sets styles of its own elements, and names the namespace of SVG. The content security
    # policy of the page applies to it, too.
    allowed = {".style.cssText", "http://www.w3.org"} if file.name == "codemirror.js" else set()
    assert set(re.findall(MARKUP, text)) <= allowed
    assert set(re.findall(r"(?:https?:)?//[\w.-]+\.\w{2,}", text.replace("// ", ""))) <= allowed
    if file.suffix == ".html":
        assert re.findall(r"<script(?![^>]*src=)|\son\w+=|\sstyle=", text) == []


def test_tap_has_another_token(page):
    assert page.ask(f"/tap/{page.gate.tap_token}/availability", cookie="")[0] == 200
    for token in ("", "wrong", page.gate.token):
        assert page.ask(f"/tap/{token}/availability")[0] == 404


@pytest.mark.parametrize(
    "path", ["/", "/api/lake", "/static/app.js", "/nothing", "/api/x/regions", "/tap/x/sync", "/static/..%2fgate.py"]
)
@pytest.mark.parametrize("cookie", [None, ""])
def test_every_response_has_security_headers(page, path, cookie):
    _, headers, _ = page.ask(path, cookie=cookie)
    policy = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == policy["form-action"] == policy["base-uri"] == "'none'"
    expected = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store",
                "Cross-Origin-Resource-Policy": "same-origin", "Cross-Origin-Opener-Policy": "same-origin"}  # fmt: skip
    assert {name: headers[name] for name in expected} == expected


def test_no_other_site_may_read_an_answer(page):
    """No answer allows it (CORS), neither of the page nor of TAP, and browsers keep answers from other sites."""
    tap = f"/tap/{page.gate.tap_token}"
    for path in ("/", "/api/lake", "/nothing", f"{tap}/availability", f"{tap}/sync", f"{tap}/nothing"):
        _, headers, _ = page.ask(path)
        assert [name for name in headers if name.lower().startswith("access-control-")] == []
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        # A browser asks with OPTIONS before it sends another method or another content type.
        status, headers, _ = page.ask(path, method="OPTIONS", Origin="http://evil.example")
        assert status == 403
        assert [name for name in headers if name.lower().startswith("access-control-")] == []


def test_downloads_have_security_headers(page):
    status, headers, _ = page.of_lake("export?format=csv&sql=SELECT+1+AS+a")
    assert status == 200
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["Content-Disposition"] == 'attachment; filename="result.csv"'


@pytest.mark.parametrize(
    "name",
    ["..%2fgate.py", "%2e%2e/gate.py", "../gate.py", "....//gate.py", "index.html%00", "%2fetc%2fpasswd", ".", ""],
)
def test_only_files_of_the_page_are_served(page, name):
    status, _, body = page.ask(f"/static/{name}")
    assert status == 404
    assert b"hmac" not in body


@pytest.mark.parametrize("path", [
    "tile/..%2f0/0/0/0", "tile/-1/0/0/0", "tile/99/0/0/0", "tile/0/9/0/0", "tile/0/0/99/0", "image/1e3", "truth/99",
    "cutout/0?x=nan&y=1", "source/x", "source/9999999999999999999", "sky/..%2fx/parts", "sky/nothing/parts",
    "provenance/7",
])  # fmt: skip
def test_unknown_addresses_are_refused(page, path):
    status, _, body = page.of_lake(path)
    assert status == 400
    assert len(json.loads(body)["error"]) < 500


def test_a_large_body_is_refused(page):
    body = json.dumps({"sql": "SELECT 1 -- " + "x" * (300 << 10)}).encode()
    assert page.of_lake("sql", method="POST", body=body)[0] == 413
    assert page.ask(f"/tap/{page.gate.tap_token}/sync", method="POST", body=body,
                    Content_Type="application/x-www-form-urlencoded")[0] == 413  # fmt: skip


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"1", b'{"sql": 3}', b"[" * 100_000, b"\xff", b'{"where": "\\ud800"}']
)
def test_bodies_that_are_not_json_objects_are_refused(page, body):
    for address in ("sql", "charts"):
        assert page.of_lake(address, method="POST", body=body)[0] == 400
        nonsense = "application/json; charset=nonsense"
        assert page.of_lake(address, method="POST", body=b"{}", Content_Type=nonsense)[0] == 400


def test_methods(page):
    assert page.of_lake("sql")[0] == 405
    assert page.ask("/api/lake", method="DELETE")[0] == 405


def test_another_key_is_refused(page):
    status, _, body = page.ask("/api/0123456789abcdef/regions")
    assert (status, json.loads(body)["key"]) == (409, page.server.lake.key)


def test_queries_beyond_the_queue_are_refused(page):
    """Two queries run, MAX_WAITING queries wait, and the next one is refused at once."""
    lane = page.server.lake.user_queries

    async def fill():
        taken = [lane.process() for _ in range(2)]
        for one in taken:
            await one.__aenter__()
        waiting = [asyncio.ensure_future(lane.process().__aenter__()) for _ in range(MAX_WAITING)]
        await asyncio.sleep(0)
        return taken, waiting

    async def drain(taken, waiting):
        for one in waiting:
            one.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        for one in taken:
            await one.__aexit__(None, None, None)

    def run(coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, page.loop).result(PATIENCE)

    held = run(fill())
    try:
        status, _, body = page.of_lake("sql", method="POST", body=b'{"sql": "SELECT 1"}')
        assert status == 429
        assert "waiting" in json.loads(body)["error"]
        # Queries of the page itself do not wait.
        assert page.of_lake("tile/0/0/0/0")[0] == 200
        question = {"source": "plain", "axes": ["value"], "charts": [{"axes": [0], "bins": [4]}]}
        assert page.of_lake("charts", method="POST", body=json.dumps(question).encode())[0] == 200
    finally:
        run(drain(*held))
    assert page.of_lake("sql", method="POST", body=b'{"sql": "SELECT 1"}')[0] == 200


CHARTS = {"source": "galaxies", "axes": ["z_obs"], "charts": [{"axes": [0], "bins": [10]}]}


@pytest.mark.parametrize(
    "change",
    [
        {"axes": ["z_obs) FROM galaxies --"]},
        {"axes": ["read_text('/etc/passwd')"]},
        {"axes": ["getenv('HOME')"]},
        {"axes": ["(SELECT content FROM read_text('/etc/passwd'))"]},
        {"source": "read_csv('/etc/passwd')"},
        {"source": "galaxies; DROP VIEW galaxies"},
        {"source": "'/etc/passwd'"},
        {"where": "true) UNION SELECT 1, 2 --"},
        {"where": "z_obs < 1; SELECT 1"},
        {"axes": []},
        {"axes": ["1"] * 17},
        {"charts": [{"axes": [1], "bins": [10]}]},
        {"charts": [{"axes": [0], "bins": [10**9]}]},
        {"charts": [{"axes": [0], "bins": [10], "spans": [[1, 0]]}]},
        {"charts": [{"bins": "x"}]},
        {"limits": [[5, 0, 1]]},
        {"limits": [[0, 1]]},
    ],
)
def test_forbidden_expressions_of_charts_are_refused(page, change):
    status, _, body = page.of_lake("charts", method="POST", body=json.dumps({**CHARTS, **change}).encode())
    assert status == 400, body
    assert "root:" not in body.decode()


@pytest.mark.parametrize(
    "where", ["true) OR (SELECT count(*) FROM read_text('/etc/passwd')) > (0", "1; SELECT 1", "getenv('X')"]
)
def test_forbidden_conditions_of_the_sky_are_refused(page, where):
    assert page.of_lake(f"sky/galaxies/density?order=8&where={quote(where)}")[0] == 400
    assert page.of_lake(f"sky/galaxies/sources?ra=1&dec=1&radius=1&where={quote(where)}")[0] == 400
