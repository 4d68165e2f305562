"""Suggestions for names of tables and columns that do not exist."""

import re

import duckdb
import pytest

from lake_schema.errors import BadInput
from lake_schema.tables import all_tables
from truesky.explore import explorer, suggestions
from truesky.fluxes import passbands

BANDS = ["euclid_vis", "lsst_r", "des_r"]
TABLES = {table.name: list(table.names) for table in all_tables(BANDS)}
VIS = "f_nu_euclid_vis (flux density, microjansky; mag_ab(f_nu_euclid_vis) is its AB magnitude)"


MESSAGE = 'Binder Error: Referenced column "{}" not found in FROM clause!\nCandidate bindings: "zzz", "kind"'


def explained(name, table="galaxies"):
    others = {other: columns for other, columns in TABLES.items() if other != table}
    return suggestions.explain_missing_column(name, {table: TABLES[table]}, others, MESSAGE.format(name))


@pytest.mark.parametrize(
    ("name", "table", "columns"),
    [
        ("redshift", "galaxies", ["z_obs", "z_true"]),
        ("z", "halos", ["z_obs", "z_true"]),
        ("mag", "galaxies", ["mag_r01"]),
        ("magnitude", "stars", ["mag_h"]),
        ("shear1", "galaxies", ["gamma1"]),
        ("g2", "galaxies", ["gamma2"]),
        ("e1", "galaxies", ["disk_axis_ratio", "bulge_axis_ratio", "position_angle"]),
        ("size", "galaxies", ["disk_half_light_radius", "bulge_half_light_radius"]),
        ("r_e", "galaxies", ["disk_half_light_radius", "bulge_half_light_radius"]),
        ("halo_mass", "galaxies", ["log_halo_mass"]),
        ("halo_mass", "halos", ["log_mass"]),
        ("stellar_mass", "galaxies", ["log_stellar_mass"]),
        ("ra_deg", "stars", ["ra"]),
        ("sersic_index", "galaxies", ["bulge_sersic_index"]),
        ("n", "galaxies", ["bulge_sersic_index"]),
        ("temperature", "stars", ["teff"]),
        ("galaxy_id", "galaxies", ["id"]),
        ("vis", "galaxy_fluxes", ["f_nu_euclid_vis"]),
        ("mag_r", "star_fluxes", ["f_nu_lsst_r", "f_nu_des_r"]),
        ("lsst_r_flux", "galaxy_fluxes", ["f_nu_lsst_r"]),
    ],
)
def test_synonyms(name, table, columns):
    message = explained(name, table)
    assert message.startswith(f"column {name} does not exist; use {columns[0]} (")
    assert all(f"{column} (" in message for column in columns)
    assert len([part for part in message.split("; use ")[1].split(" or ") if "(" in part]) >= len(columns)


def test_columns_of_other_tables():
    assert explained("mag_vis", "star_fluxes") == f"column mag_vis does not exist; use {VIS}"
    only = {"galaxy_fluxes": TABLES["galaxy_fluxes"]}
    assert suggestions.explain_missing_column("flux_vis", {"galaxies": TABLES["galaxies"]}, only) == (
        f"column flux_vis does not exist; use galaxy_fluxes.{VIS}; add JOIN galaxy_fluxes USING (id)"
    )
    assert "use stars.teff (effective temperature)" in explained("teff")


def test_columns_of_unrelated_tables_are_not_suggested():
    """Rows of galaxies and of emission lines have no common identifier."""
    assert "pivot_wavelength" in TABLES["passbands"]
    assert explained("pivot_wavelength").startswith("column pivot_wavelength does not exist; use one of id, ")
    assert explained("pivot", "galaxies").startswith("column pivot does not exist; use one of id, ")
    assert "use exposures.mjd (" in explained("mjd", "products")


def test_names_of_passbands_are_recognised():
    for name in passbands.names():
        assert suggestions._IN_BAND.search(name), name


def test_similar_names_and_names_of_subqueries():
    assert explained("z_ob") == "column z_ob does not exist; did you mean z_obs?"
    assert explained("zz") == "column zz does not exist; did you mean zzz?"
    assert explained("qqqq", "halos").startswith("column qqqq does not exist; use one of ")
    assert explained("qqqq", "halos").endswith("; a text must be in single quotes")
    assert explained("redshfit", "halos") == explained("redshift", "halos").replace("redshift does", "redshfit does")
    both = {"galaxies": TABLES["galaxies"], "halos": TABLES["halos"]}
    assert "use galaxies.z_obs (" in suggestions.explain_missing_column("redshift", both, {})


def test_names_in_arguments_have_the_same_suggestions():
    others = {name: columns for name, columns in TABLES.items() if name != "stars"}
    text = explorer.explain_columns(["RA", "temp", "kmag", "qqqq", "rrrr"], "stars", TABLES["stars"], others)
    assert re.fullmatch(
        r"table stars has no column RA; use ra \(right asc[^;]*\); no column temp; use teff \(effective [^;]*\); "
        r"no column kmag: the lake has fluxes only in [^;]*; fluxes.bands in the request adds other bands; "
        r"no column qqqq and rrrr; it has id, .*",
        text,
    )
    del others["gaia"]
    assert "; no column" not in explorer.explain_columns(["gmag"], "stars", TABLES["stars"], others)
    assert "mag_h" not in explorer.explain_columns(["gmag"], "stars", TABLES["stars"], others)
    only = {"galaxy_fluxes": TABLES["galaxy_fluxes"]}
    text = explorer.explain_columns(["flux_vis"], "galaxies", TABLES["galaxies"], only)
    assert text.startswith("table galaxies has no column flux_vis; use galaxy_fluxes.f_nu_euclid_vis (")
    assert "; in lake.sql add JOIN galaxy_fluxes USING (id)" in text


@pytest.mark.parametrize(("message", "name"), [(MESSAGE.format("X"), "x"), ('Table "x" does not exist', None)])
def test_the_missing_column_of_a_message(message, name):
    assert suggestions.missing_column(message) == name


@pytest.mark.parametrize(
    "name",
    [
        "gaia_g",
        "f_nu_lsst_i",
        "f_nu_euclid_vs",
        "mag_lsst_i",
        "lsst_i_flux",
        "flux_g",
        "kmag",
        "g_mag",
        "magk",
        "hflux",
    ],
)
def test_no_other_band_is_suggested(name):
    remedy = "the lake has fluxes only in euclid_vis, lsst_r and des_r; fluxes.bands in the request adds other bands"
    assert explained(name, "galaxy_fluxes") == f"column {name} does not exist: {remedy}"
    only = {"galaxy_fluxes": TABLES["galaxy_fluxes"]}
    assert suggestions.explain_missing_column("mag_i", {"galaxies": TABLES["galaxies"]}, only).endswith(remedy)


@pytest.mark.parametrize(
    ("name", "table", "column"),
    [
        ("fnu_lsst_r", "galaxy_fluxes", "f_nu_lsst_r"),
        ("mag_r1", "galaxies", "mag_r01"),
        ("hmag", "stars", "mag_h"),
        ("h_mag", "stars", "mag_h"),
        ("magh", "stars", "mag_h"),
    ],
)
def test_the_same_band_is_suggested(name, table, column):
    assert explained(name, table) == f"column {name} does not exist; did you mean {column}?"


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("galaxy", ["galaxies"]),
        ("demo.galaxy", ["demo.galaxies"]),
        ("fluxes", ["galaxy_fluxes", "star_fluxes"]),
        ("images", ["products"]),
        ("galxies", ["galaxies"]),
        ("qqqq", []),
    ],
)
def test_tables(name, found):
    assert list(suggestions.suggest_tables(name, {*TABLES, "demo.galaxies"}))[: len(found) or None] == found


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("SELECT redshift FROM galaxies", r"redshift does not exist; use z_obs \(observed.*\) or z_true \("),
        ("SELECT g.redshift FROM galaxies AS g", r"redshift does not exist; use g.z_obs \("),
        ("SELECT 1 FROM galaxies JOIN galaxy_fluxes USING (redshift)", r"use galaxies.z_obs \("),
        ("SELECT * EXCLUDE (redshift) FROM galaxies", r"redshift does not exist; use z_obs \("),
        ("SELECT vis FROM galaxies", r"galaxy_fluxes.f_nu_euclid_vis \(.*; add JOIN galaxy_fluxes USING \(id\)"),
        (
            "SELECT mag FROM galaxies WHERE z < 1",
            r"^SQL: column mag does .*mag_r01.*; column z does .* or z_true \([^)]*\)$",
        ),
        (
            "SELECT redshift, current_date FROM galaxies WHERE mag_r01 > 1",
            r"^SQL: column redshift [^;]*; use [^;]*$",
        ),
        ("SELECT ra FROM (SELECT z FROM galaxies)", "^SQL: column z does not exist; use z_obs [^;]*$"),
        (
            'SELECT id FROM galaxies WHERE kind = "Red"',
            "\"Red\" means a column, .* double quotes: write 'Red' for the text$",
        ),
        ('SELECT id FROM galaxies WHERE kind IN ("Red", 1)', "column red does not exist"),
        ('SELECT id FROM galaxies WHERE "redshift" = 1', "column redshift does not exist; use z_obs"),
        (
            "SELECT f.galaxy_id, g.redshfit, ra FROM galaxies g JOIN galaxy_fluxes f USING (id) WHERE f.z > 1",
            r"^SQL: column f.galaxy_id does not exist; use f.id \([^)]*\); column g.redshfit does not exist; "
            r"use g.z_obs \([^)]*\) or g.z_true \([^)]*\); column f.z does not exist; use g.z_obs \([^)]*\) or g",
        ),
        (
            "SELECT g.id, g.zz, h.zz FROM galaxies g, galaxies h",
            "column g.zz .* use one of id, .*; column h.zz does not exist$",
        ),
        ("SELECT s.mm FROM (SELECT ra, z_obs AS zz FROM galaxies) s", "column s.mm does not exist; use one of ra, zz$"),
        (
            "WITH t AS (SELECT z_obs FROM galaxies) SELECT t.z FROM t",
            r"column t.z does not exist; use t.z_obs \([^)]*\)$",
        ),
        (
            "SELECT x.id, y.id FROM galaxies g JOIN galaxy_fluxes f USING (id)",
            r"^SQL: FROM has no table or alias x or y; it has g \(galaxies\) and f \(galaxy_fluxes\)$",
        ),
        ("SELECT galaxies.id FROM galaxies g", "table galaxies has the alias g in this query: write g.id$"),
        (
            "SELECT galaxies.id, galaxy_fluxes.f_nu_euclid_vis FROM galaxies",
            r"alias galaxy_fluxes; it has galaxies; add JOIN galaxy_fluxes USING \(id\)$",
        ),
        ("SELECT name, ra FROM galaxies", r"^SQL: column name does not exist; use id \(identifier of the source\)$"),
        ("SELECT id FROM galaxy", "'galaxy' is not a table of the lake; did you mean galaxies?"),
        ("SELECT id FROM nothing_like_it", r"is not a table of the lake \(galaxies, galaxy_fluxes"),
    ],
)
def test_queries(explorer, query, words):
    with pytest.raises(BadInput, match=words if words.startswith("^") else f"^SQL: .*{words}") as error:
        explorer.sql(query)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("SELECT kind, count(*) FROM t", "column kind must be in GROUP BY, or in an aggregate function such as"),
        ("SELECT kind FROM t HAVING n > 1", "column n must be in GROUP BY, or in an aggregate function such as"),
        (
            "SELECT n FROM t WHERE avg(n) > 1",
            "WHERE cannot contain aggregate functions such as count: write .* in HAVING",
        ),
        ("SELECT n FROM t JOIN u USING (kind) WHERE u.n = n", "several tables have a column n: write t.n or u.n in"),
        ("SELECT 1 FROM t AS a, t AS a WHERE a.n = 1", "FROM has a twice: give each table another alias"),
        ("SELECT n FROM t WHERE n > 1 AND", "syntax error near AND: something is missing after AND$"),
        (
            "SELECT n FROM t WHERE n > 1 AND ORDER BY n",
            "syntax error near ORDER: a condition is missing between AND and",
        ),
        ("SELECT n FROM t WHERE n > 1 AND GROUP BY n", "syntax error near GROUP: .* between AND and GROUP BY$"),
        ("SELECT n FROM t WHERE OR n > 1", "syntax error near OR: a condition is missing between WHERE and OR$"),
        ("SELECT n FROM t WHERE ORDER BY n", "syntax error near ORDER: a condition is missing between WHERE and ORDER"),
        ("SELECT n FROM t\nWHERE n > 1 AND\nLIMIT 1", "syntax error near LIMIT: .* is missing between AND and LIMIT$"),
        ("SELECT n FROM t WHERE (n > 1 OR) LIMIT 1", r"syntax error near \): .* is missing between OR and \)$"),
        ("SELECT n FROM t WHERE n > ORDER BY n", "syntax error near ORDER: a value is missing between > and ORDER BY$"),
        ("SELECT n FROM t WHERE n BETWEEN 1 AND LIMIT 1", "syntax error .* a value is missing between AND and LIMIT$"),
        ("SELECT n FROM t LIMIT 1 ORDER BY n", "syntax error near ORDER: columns are separated by commas"),
        ("SELECT n FROM t WHERE n BETWEEN 1 TO 2", "syntax error near TO: write BETWEEN 1 AND 2$"),
        ("SELECT n FROM t WHERE n > -27:48", "syntax error near :: write positions in degrees"),
        ("SELECT n FROM t JOIN u WHERE n > 1", "syntax error near WHERE: JOIN must have ON or USING"),
        ("SELECT pow(n) FROM t", r"pow does not accept arguments of type INTEGER; write pow\(x DOUBLE, y DOUBLE\)$"),
        ("SELECT max(n, n / 2) FROM t", r"max accepts one column: the larger of two is greatest\(a, b\)"),
        (
            "SELECT n FROM t WHERE n > $lo",
            r"these parameters have no value: lo; in Python write lake.sql\(query, lo=...\)$",
        ),
        ("SELECT n FROM t WHERE n > [1]", r"values of type INTEGER and INTEGER\[\] cannot be compared$"),
        ("SELECT n FROM t WHERE row_number() OVER () > 1", "WHERE cannot contain window functions: .* in QUALIFY"),
        ("SELECT stdev(n) FROM t", r"function stdev does not exist; did you mean stddev\?$"),
        ("SELECT qqqqqqqq(n) FROM t", "function qqqqqqqq does not exist$"),
        ("SELECT 'high'::FLOAT", "'high' is text where a number is required$"),
        ("SELECT x.n FROM t", "FROM has no table or alias x; it has t$"),
        ("SELECT sum(kind) FROM t", "sum does not accept arguments of type VARCHAR$"),
        ("SELECT twice()", r"write twice\(x\) for twice$"),
        ("SELECT n frm t", "syntax error near t: did you mean FROM for frm"),
        ("SELECT n, average(n) FROM t", "function average does not exist; did you mean avg"),
        ("SELECT n n n FROM t", "syntax error near n: columns are separated by commas"),
        ("SELECT n FROM t LIMIT -1", r"LIMIT/OFFSET cannot be negative \(near -1\)$"),
        ("SELECT avg(sum(n)) FROM t", r"aggregate function calls cannot be nested \(near sum\(n\)\)$"),
    ],
)
def test_messages_are_sentences(query, message):
    with duckdb.connect() as database:
        database.execute("CREATE TABLE t (n INTEGER, kind VARCHAR)")
        database.execute("CREATE TABLE u (n INTEGER, kind VARCHAR)")
        database.execute("CREATE MACRO twice(x) AS 2 * x")
        with pytest.raises(duckdb.Error) as error:
            database.execute(query).fetchall()
    text = suggestions.plain_message(str(error.value), query)
    assert re.match(message, text), text
    assert "Error" not in text
    assert "\n" not in text


def test_other_messages_are_unchanged():
    assert suggestions.plain_message("no such thing") == "no such thing"


@pytest.mark.parametrize(
    ("query", "words"),
    [
        (
            "SELECT DISTINCT TOP 10 id FROM galaxies",
            "^SQL: TOP is possible only in TAP queries: write LIMIT 10 at the end",
        ),
        ("SELECT POINT('ICRS', ra, dec) FROM galaxies", "^SQL: the function POINT is .* TAP .*separation.*in_area"),
        (
            "SELECT id FROM galaxies WHERE 1 = CONTAINS(POINT('ICRS', ra, dec), CIRCLE('ICRS', 53.2, -28.1, 0.1))",
            r"function CONTAINS is .* TAP .*write separation\(ra, dec, 53.2, -28.1\) < 0.1 \(deg\) for a circle, or",
        ),
        ("SELECT DISTANCE(POINT(ra, dec), POINT(1, 2)) FROM galaxies", r"write separation\(ra, dec, 1, 2\) \(deg\)$"),
        (
            "SELECT id FROM galaxies AS g WHERE q3c_radial_query(g.ra, g.dec, 53.2, -28.1, 6/60.)",
            r"^SQL: function q3c_radial_query does not exist: write "
            r"separation\(g.ra, g.dec, 53.2, -28.1\) < 6/60. \(deg\)$",
        ),
        ("SELECT q3c_join(ra, dec) FROM galaxies", r": write separation\(ra, dec, RA, DEC\) < RADIUS \(deg\)$"),
        (
            "SELECT angDist(ra, dec, 53.2, $d) FROM galaxies",
            r"angdist .* write separation\(ra, dec, 53.2, \$d\) \(deg\)$",
        ),
        (
            "SELECT id FROM galaxies WHERE ST_DWithin(ST_MakePoint(ra, dec), ST_Point(53.2, -28.1), 0.1)",
            r"write separation\(ra, dec, 53.2, -28.1\) < 0.1 \(deg\)$",
        ),
        (
            "SELECT id FROM galaxies g JOIN dbo.fGetNearbyObjEq(53.2, -28.1, 3) n ON g.id = n.objID",
            r"write FROM galaxies WHERE separation\(ra, dec, 53.2, -28.1\) < 0.05 \(deg\)$",
        ),
        ("SELECT percentile(z_obs, 50) FROM galaxies", r"write quantile_cont\(z_obs, 0.5\)$"),
        ("SELECT percentile(z_obs, 0.9) FROM galaxies", r"write quantile_cont\(z_obs, 0.9\)$"),
        (
            "SELECT id FROM galaxies WHERE kind = 'QSO'",
            r"^SQL: column kind contains numbers \(0 central galaxy; .*; 2 QSO; .*\): write kind = 2$",
        ),
        ("SELECT id FROM galaxies AS g WHERE g.kind NOT IN ('satelite')", "write 1 in place of 'satelite'$"),
        ("SELECT id FROM galaxies AS g WHERE g.kind <> 'satelite'", "write kind <> 1$"),
        ("SELECT id FROM galaxies WHERE 'comet' = kind", "write one of these numbers in place of 'comet'$"),
        (
            "SELECT id FROM galaxies WHERE z_obs > $z AND z_obs < $b",
            r"^SQL: these parameters have no value: b, z; in Python write lake.sql\(query, b=..., z=...\)$",
        ),
        ("SELECT id FROM galaxies WHERE ra > 'high'", "^SQL: 'high' is text where a number is required$"),
        (
            "SELECT id FROM galaxies WHERE separation(ra, dec, 53.1, -27.8) < 1 arcsec AND z_obs > 1",
            "^SQL: 1 arcsec is not possible, because SQL takes plain numbers: write 0.000277778, because .* in deg$",
        ),
        (
            "SELECT separation(ra, dec, 1, 2) AS sep FROM galaxies WHERE sep > 1 arcmin",
            "write 0.0166667, because sep is in deg$",
        ),
        (
            "SELECT id FROM galaxies g WHERE g.disk_half_light_radius < 0.5 deg",
            "write 1800, because the unit of column disk_half_light_radius is arcsec$",
        ),
        (
            'SELECT id FROM galaxies WHERE disk_half_light_radius < 0.5"',
            '^SQL: 0.5" is not possible, because SQL takes plain numbers: write 0.5, because the unit of',
        ),
        (
            "SELECT id FROM galaxies WHERE ra BETWEEN 53 deg AND 54 deg",
            "write 53, because the unit of column ra is deg$",
        ),
        (
            "SELECT id FROM galaxies WHERE disk_half_light_radius > 1 kpc",
            ": the unit of column disk_half_light_radius is",
        ),
        ("SELECT id FROM galaxies WHERE z_obs > 1 s", "plain numbers: column z_obs has no unit$"),
        (
            "SELECT id FROM galaxy_fluxes WHERE f_nu_euclid_vis > 1 nJy",
            "write 0.001, because .* f_nu_euclid_vis is uJy$",
        ),
        ("SELECT id FROM galaxies WHERE foo > 1 deg", "truesky describe LAKE TABLE prints the units of the columns$"),
        (
            "SELECT id FROM galaxies WHERE z_obs < 2 AND > 1",
            "write the column in each comparison, such as z_obs > 1 AND",
        ),
        ("SELECT * galaxies", "^SQL: FROM is missing before the name of the table: SELECT"),
        ("SELECT id FROM galaxies WHERE z_obs > 1,5", "write a decimal point in place of the comma$"),
        ("SELECT id FROM galaxies WHERE ra > '53.1 deg'", "number is required: write 53.1, in the unit of the column$"),
        ("SELECT id FROM galaxies ORDER z_obs", "syntax error near z_obs: write ORDER BY$"),
        ("SELECT id FROM galaxies WHERE kind IS 'QSO'", "write = 'QSO' in place of IS 'QSO'$"),
        ("SELECT id FROM galaxies LIMIT 10 WHERE z_obs > 1", "WHERE comes before GROUP BY, ORDER BY and LIMIT$"),
        (
            "SELECT id FROM galaxies WHERE cone(53.1, -27.8, 60)",
            r"^SQL: function cone does not exist: write separation\(ra, dec, 53.1, -27.8\) < RADIUS \(deg\)$",
        ),
        (
            "SELECT id FROM galaxies WHERE in_area(53.1, -27.8, 0.1)",
            r"^SQL: in_area\(ra, dec\) selects the area of the request; for a circle write separation\(ra, dec, RA,",
        ),
        (
            "SELECT id FROM galaxies WHERE ra BETWEEN '53:30:00' AND '53:40:00'",
            "^SQL: column ra is in deg: write 53.5 in place of '53:30:00'$",
        ),
        (
            "SELECT id FROM galaxies WHERE ra > '03:32:28'",
            "^SQL: column ra is in deg: write 53.11667 in place of '03:32:28', if this is in hours$",
        ),
        (
            "SELECT id FROM galaxies WHERE dec < '-27:48'",
            "^SQL: column dec is in deg: write -27.8 in place of '-27:48'$",
        ),
        ("galaxies", r"^SQL: galaxies is a table: write SELECT \* FROM galaxies$"),
        ("SHOW TABLES", r"SHOW and DESCRIBE are not possible: truesky sql LAKE lists the tables, .* lake.tables"),
        ("DELETE FROM galaxies", "^SQL: DELETE is not possible: write a SELECT, because the tables can only be read$"),
        ("SELECT 1; SELECT 2", r"^SQL: the text contains 2 statements \(SELECT, SELECT\): write a single SELECT$"),
        (" ", "^SQL: the query is empty: write a single SELECT$"),
    ],
)
def test_sentences_about_queries(explorer, query, words):
    with pytest.raises(BadInput, match=words):
        explorer.sql(query)
