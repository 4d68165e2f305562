"""The TAP service with pyvo, astropy and, if it is installed, taplint of stilts."""

import csv
import io
import shutil
import subprocess
import time
from urllib.parse import urlencode
from xml.etree import ElementTree

import pytest

from lake_schema import sky
from lake_schema.store import read
from tests.waiting import PATIENCE, until
from truesky.explore import adql
from truesky.page.tap import descriptions

pyvo = pytest.importorskip("pyvo")


@pytest.fixture(scope="module")
def service(page):
    return pyvo.dal.TAPService(page.tap)


def test_tables_have_units_and_sentences(service):
    assert {"galaxies", "stars", "ivoa.obscore", "tap_schema.columns"} <= set(service.tables.keys())
    columns = {column.name: column for column in service.tables["galaxies"].columns}
    assert str(columns["ra"].unit) == "deg"
    assert columns["ra"].description == "right ascension, ICRS, as observed (lensed)"
    assert '"_healpix_29"' in columns
    found = service.search("SELECT unit FROM tap_schema.columns WHERE table_name = 'galaxies' AND column_name = 'a_v'")
    assert found["unit"].tolist() == ["mag"]


def test_capabilities(service):
    tap = service.get_tap_capability()
    assert tap.get_adql().get_feature("ivo://ivoa.net/std/TAPRegExt#features-adqlgeo", "CONTAINS") is not None


def test_sync(service, shown):
    found = service.search(
        "SELECT TOP 5 id, ra, flux_halpha, kind FROM galaxies WHERE z_obs > 1 ORDER BY id"
    ).to_table()
    rows = read.version(shown, "galaxies").rows(["id", "ra", "z_obs"]).sort_by("id").to_pylist()
    expected = [row for row in rows if row["z_obs"] > 1][:5]
    assert found["id"].tolist() == [row["id"] for row in expected]
    assert found["ra"].tolist() == [row["ra"] for row in expected]
    assert (found["ra"].unit, found["flux_halpha"].unit.to_string()) == ("deg", "erg / (s cm2)")


def test_async(service):
    job = service.submit_job("SELECT count(*) AS n FROM galaxies", maxrec=10)
    try:
        assert job.phase == "PENDING"
        job.run().wait(phases=["COMPLETED", "ERROR"], timeout=PATIENCE)
        assert job.fetch_result()["n"].tolist() == [3000]
        assert job.url in [f"{service.baseurl}/async/{one.jobid}" for one in service.get_job_list()]
    finally:
        job.delete()


def test_a_job_that_fails_says_why(service):
    job = service.submit_job("SELECT nothing FROM galaxies")
    job.run().wait(phases=["COMPLETED", "ERROR"], timeout=PATIENCE)
    assert job.phase == "ERROR"
    with pytest.raises(pyvo.DALQueryError, match="nothing"):
        job.raise_if_error()
    job.delete()


def test_a_job_can_be_aborted(service, page):
    """The process of an aborted job is replaced, although its query would take days."""
    assert service.search("SELECT 1 AS a")["a"].tolist() == [1]
    lane = page.server.tap._lake_processes.process_pool
    free = len(lane._processes)
    job = service.submit_job("SELECT count(*) FROM galaxies a, galaxies b, galaxies c, galaxies d")
    job.run()
    until(lambda: job.phase == "EXECUTING" and lane._free.qsize() == free - 1)
    job.abort()
    assert job.phase == "ABORTED"
    until(lambda: lane._free.qsize() == free)
    job.delete()
    assert service.search("SELECT 1 AS a")["a"].tolist() == [1]


def test_a_cone_reads_cells_of_the_circle(service, shown, monkeypatch):
    """Circles of all sizes give the same rows with and without the ranges of cells."""
    rows, asked = read.version(shown, "stars").rows(["id", "ra", "dec"]), []
    real = adql.to_sql
    monkeypatch.setattr(adql, "to_sql", lambda *given: asked.append(real(*given)) or asked[-1])
    for k, radius in enumerate((1e-5, 0.002, 0.02, 1.0, 60.0)):
        ra, dec = rows["ra"][k].as_py(), rows["dec"][k].as_py()
        inside = sky.separation(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ra, dec) <= radius
        text = f"SELECT id FROM stars WHERE 1 = CONTAINS(POINT(ra, dec), CIRCLE({ra}, {dec}, {radius})) ORDER BY id"
        assert service.search(text)["id"].tolist() == sorted(rows["id"].to_numpy()[inside].tolist())
        assert "_healpix_29 >=" in asked[-1]
    # Exposures and images have no cells.
    service.search(f"SELECT * FROM products WHERE CONTAINS(POINT(ra, dec), CIRCLE({ra}, {dec}, 1)) = 1")
    assert "_healpix_29" not in asked[-1]


def test_cone_and_distance(service, shown):
    rows = read.version(shown, "stars").rows(["id", "ra", "dec"])
    ra, dec, radius = rows["ra"][3].as_py(), rows["dec"][3].as_py(), 0.003
    inside = sky.separation(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ra, dec) <= radius
    expected = sorted(rows["id"].to_numpy()[inside].tolist())
    assert len(expected) > 3
    for condition in (
        f"CONTAINS(POINT('ICRS', ra, dec), CIRCLE('ICRS', {ra}, {dec}, {radius})) = 1",
        f"1 = CONTAINS(POINT(s.ra, s.dec), CIRCLE(POINT({ra}, {dec}), {radius}))",
        f"DISTANCE(POINT(ra, dec), POINT({ra}, {dec})) <= {radius}",
        f"DISTANCE(ra, dec, {ra}, {dec}) <= {radius}",
        f"INTERSECTS(POINT('', ra, dec), CIRCLE('', {ra}, {dec}, {radius})) = 1",
    ):
        assert service.search(f"SELECT id FROM stars AS s WHERE {condition} ORDER BY id")["id"].tolist() == expected


def test_images_are_found_by_place(service, shown):
    place = read.version(shown, "products").rows(["ra", "dec"]).to_pylist()[0]
    here = """SELECT * FROM ivoa.obscore
              WHERE CONTAINS(POINT('ICRS', {}, {}), s_region) = 1 AND dataproduct_subtype = 'science'"""
    found = service.search(here.format(place["ra"], place["dec"]))
    assert len(found) == 1
    row = found[0]
    assert (row["dataproduct_type"], row["access_format"], row["band_name"]) == (
        "image",
        "application/fits",
        "euclid_vis",
    )
    # The width of stars in the image, not the seeing of the air, which the plan has.
    assert row["s_resolution"] == 0.47
    assert len(service.search(here.format(place["ra"] + 0.02, place["dec"]))) == 0
    assert len(service.search(here.format(place["ra"] + 180.0, -place["dec"]))) == 0
    cone = "SELECT * FROM ivoa.obscore WHERE INTERSECTS(CIRCLE('ICRS', {}, {}, {}), s_region) = 1"
    assert len(service.search(cone.format(place["ra"], place["dec"] + 0.02, 0.001))) == 0
    assert len(service.search(cone.format(place["ra"], place["dec"] + 0.02, 0.015))) == 3
    dataset = row.getdataset().read()
    path = read.version(shown, "products").sidecar_path("images/000001/vis_science.fits")
    assert dataset == path.read_bytes()


@pytest.mark.parametrize(("query", "most", "rows"), [
    ("SELECT id FROM galaxies", 7, 7), ("SELECT TOP 7 id FROM galaxies", 7, 7),
])  # fmt: skip
def test_too_many_rows_are_reported(service, query, most, rows):
    found = service.search(query, maxrec=most)
    assert len(found) == rows
    assert found.query_status == ("OK" if "TOP" in query else "OVERFLOW")


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("SELECT nothing FROM galaxies", "nothing"),
        ("SELECT redshift FROM galaxies", "redshift does not exist; use z_obs"),
        ("SELECT TOP 1 id FROM galaxy", "did you mean galaxies"),
        ("SELECT * FROM read_csv('/etc/passwd')", "not a table"),
        ("DROP VIEW galaxies", "write a"),
        ("SELECT AREA(CIRCLE(1, 2, 3)) FROM stars", "AREA is not possible"),
    ],
)
def test_errors_are_reported_in_a_votable(service, query, words):
    with pytest.raises(pyvo.DALQueryError, match=words):
        service.search(query)


def test_a_client_that_waits_zero_seconds_gets_an_answer_at_once(page):
    address = f"/tap/{page.gate.tap_token}/async"
    slow = "SELECT count(*) FROM galaxies a, galaxies b, galaxies c, galaxies d"
    form = urlencode({"LANG": "ADQL", "QUERY": slow, "PHASE": "RUN"}).encode()
    _, headers, _ = page.ask(
        address, method="POST", body=form, cookie="", Content_Type="application/x-www-form-urlencoded"
    )
    job = headers["Location"].removeprefix(page.origin)
    for name in ("WAIT", "wait"):
        started = time.monotonic()
        status, _, body = page.ask(f"{job}?{name}=0", cookie="")
        # A client that does not limit its time waits for 60 s.
        assert (status, time.monotonic() - started < 30) == (200, True)
        assert b"COMPLETED" not in body
    page.ask(job, method="DELETE", cookie="")


def test_positions_in_a_join_with_fluxes_and_top_in_a_union(service):
    joined = service.search("SELECT TOP 3 id, ra, dec FROM galaxies JOIN galaxy_fluxes USING (id) WHERE ra >= 0")
    assert len(joined) == 3
    assert len(service.search("SELECT TOP 2 id FROM stars UNION SELECT TOP 1 id FROM galaxies")) == 3


def test_other_formats_and_uploads(page):
    def sync(**parameters):
        return page.ask(f"/tap/{page.gate.tap_token}/sync?{urlencode(parameters)}", cookie="")

    query = {"LANG": "ADQL", "QUERY": "SELECT TOP 3 id FROM galaxies ORDER BY id"}
    status, headers, body = sync(**query, FORMAT="csv")
    assert (status, headers["Content-Type"].partition(";")[0]) == (200, "text/csv")
    assert len(list(csv.DictReader(io.StringIO(body.decode())))) == 3
    status, _, body = sync(**query, MAXREC="0")
    assert (status, b"<TR>" in body, b'value="OVERFLOW"' in body) == (200, False, True)
    for wrong in (
        {"FORMAT": "pdf"},
        {"LANG": "SQL"},
        {"QUERY": ""},
        {"MAXREC": "x"},
        {"UPLOAD": "t,http://x"},
        {"REQUEST": "x"},
    ):
        status, _, body = sync(**{**query, **wrong})
        assert (status, b'value="ERROR"' in body) == (400, True)


FORM = "application/x-www-form-urlencoded"


@pytest.mark.parametrize(
    "character", ["\0", "\1", "\x1f", "\x7f", "\t", "\n", "\ufffe", "\uffff", "\ud800", "\U0001f30c"]
)
@pytest.mark.parametrize("place", ["name", "form", "address", "change"])
def test_documents_about_jobs_can_be_read_whatever_the_parameters_contain(page, character, place):
    """Jobs keep characters that XML allows; a parameter with any other character is refused and named."""
    address, query, form = f"/tap/{page.gate.tap_token}/async", "", {"LANG": "ADQL", "QUERY": "SELECT 1 AS a"}

    def post(address, form):
        encoded = urlencode(form, errors="surrogatepass").encode()
        return page.ask(address, method="POST", body=encoded, cookie="", Content_Type=FORM)

    own = {f"RUNID{character}": "x"} if place == "name" else {"RUNID": f"x{character}"}
    if place == "address":
        query = f"?{urlencode(own, errors='surrogatepass')}"
    status, headers, body = post(address + query, form if place in ("address", "change") else {**form, **own})
    if place == "change":
        job = headers["Location"].removeprefix(page.origin)
        status, _, body = post(f"{job}/parameters", own)
        if status != 303:
            page.ask(job, method="DELETE", cookie="")
    if character in "\0\1\x1f\ufffe\uffff":
        text = ElementTree.fromstring(body).find(".//{*}INFO").text
        assert (status, text.startswith("RUNID"), f"U+{ord(character):04X}" in text) == (400, True, True)
        return
    assert status == 303
    job = headers["Location"].removeprefix(page.origin)
    for part in ("", "/parameters"):
        parameters = ElementTree.fromstring(page.ask(job + part, cookie="")[2]).iterfind(".//{*}parameter")
        (found,) = (one.get("id") + one.text for one in parameters if one.get("id").startswith("RUNID"))
        # The HTTP library replaces the three bytes of a surrogate, which are not valid UTF-8.
        shown = "\ufffd" * 3 if character == "\ud800" else character
        assert found == (f"RUNID{shown}x" if place == "name" else f"RUNIDx{shown}")
    page.ask(job, method="DELETE", cookie="")


@pytest.mark.parametrize(
    ("content_type", "body"),
    [
        (f"{FORM}; charset=nonsense", b"LANG=ADQL"),
        (f"{FORM}; charset=utf-16", b"LANG=ADQL"),
        (FORM, b"LANG=\xff"),
        ("multipart/form-data", b"LANG=ADQL"),
        ("multipart/form-data; boundary=X", b"LANG=ADQL"),
        ("multipart/form-data; boundary=X",
         b'--X\r\nContent-Disposition: form-data; name="LANG"\r\n\r\n\xed\xa0\x80\r\n--X--\r\n'),
        ("multipart/form-data; boundary=X",
         b'--X\r\nContent-Disposition: form-data; name="LANG"\r\nContent-Type: text/plain; charset=utf-7\r\n\r\n+2AA-'
         b"\r\n--X--\r\n"),
    ],
)  # fmt: skip
def test_forms_that_cannot_be_read_are_refused(page, content_type, body):
    for address in ("async", "sync"):
        path = f"/tap/{page.gate.tap_token}/{address}"
        status, _, answer = page.ask(path, method="POST", body=body, cookie="", Content_Type=content_type)
        assert (status, b'value="ERROR"' in answer) == (400, True)


def test_errors_and_descriptions_of_documents_can_be_read():
    """Texts of the lake and of errors may contain any character."""
    text = "a\0\ufffe\ud800<&\"'z"
    document = descriptions.describe_job({"runId": text}, {text: text}, f"http://x/{text}", text)
    root = ElementTree.fromstring(document.encode())
    assert root.find("{*}runId").text == root.find(".//{*}message").text == "a\ufffd\ufffd\ufffd<&\"'z"
    assert root.find(".//{*}parameter").get("id") == root.find(".//{*}parameter").text == root.find("{*}runId").text


def test_unknown_addresses(page):
    for path, status in (
        ("nothing", 404), ("async/nothing", 404), ("async/nothing/phase", 404), ("file/x/0", 404),
        (f"file/{page.server.lake.key}/x", 404), (f"file/{page.server.lake.key}/99", 404),
    ):  # fmt: skip
        assert (path, page.ask(f"/tap/{page.gate.tap_token}/{path}", cookie="")[0]) == (path, status)


@pytest.mark.skipif(shutil.which("stilts") is None, reason="stilts is not installed (Debian: apt install stilts)")
def test_taplint_finds_nothing(page):
    done = subprocess.run(["stilts", "taplint", f"tapurl={page.tap}"], capture_output=True, text=True, timeout=300)
    said = done.stdout.splitlines()
    assert [line for line in said if line.startswith(("E-", "W-"))] == []
    assert any(line.startswith("Totals: Errors: 0; Warnings: 0;") for line in said), done.stdout[-2000:] + done.stderr
    assert sum(line.startswith("Section OBS") for line in said) == 1
