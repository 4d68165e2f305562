"""A lake on object storage answers queries as a lake in a folder, and other programs can read it."""

import pytest

from lake_schema.errors import BadInput, Damaged
from lake_schema.store import layout, read
from lake_schema.store.object_storage import push, s3
from tests import hats_readers
from tests import object_storage as storage
from truesky.explore import __main__
from truesky.explore.explorer import Explorer
from truesky.explore.object_storage import catalogue

BUCKET = "explored-by-all"


@pytest.fixture(scope="module")
def pushed(explored, object_storage):
    """Address of the pushed lake; a test that changes an object restores it."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in storage.CREDENTIALS.items():
            patch.setenv(name, value)
        object_storage.client.create_bucket(Bucket=BUCKET)
        place = s3.parse_address(f"s3://{BUCKET}/lake", object_storage.url)
        list(push.push(explored, place))
    return str(place)


@pytest.fixture
def there(pushed, bucket):
    """The same with environment variables that point to the store."""
    return pushed


def test_object_storage_gives_the_same_answers(explored, there, monkeypatch):
    # The address alone identifies the service.
    monkeypatch.delenv("AWS_ENDPOINT_URL")
    joined = (
        "SELECT count(*) AS n, sum(f_nu_euclid_vis) AS s FROM galaxies JOIN galaxy_fluxes USING (id) WHERE z_obs > 1"
    )
    with Explorer(explored) as near, Explorer(there) as far:
        for text in (joined, "SELECT * FROM galaxies ORDER BY id", "SELECT * FROM plain ORDER BY id"):
            here = near.sql(text, into="arrow")
            assert far.sql(text, into="arrow").equals(here, check_metadata=True)
        ra, dec = (near.sql(f"SELECT {name} FROM galaxies LIMIT 1")[name][0] for name in ("ra", "dec"))
        assert far.cone("galaxies", ra, dec, 0.2).equals(near.cone("galaxies", ra, dec, 0.2))
        assert far.tables().equals(near.tables())
        with pytest.raises(BadInput, match="has no table nothing"):
            far.describe("nothing")


def test_the_command_takes_an_address(there, capsys, bucket):
    place, _, _ = there.partition("?")
    assert __main__.main(["SELECT count(*) AS n FROM galaxies", "--lake", place, "--endpoint-url", bucket[0].url]) == 0
    assert "500" in capsys.readouterr().out
    assert __main__.main(["SELECT 1", "--lake", f"{place}/other"]) == 2
    assert "no lake was pushed there" in capsys.readouterr().err


def test_a_changed_object_is_refused_by_name_in_sql(there, bucket):
    service, name = bucket[0], BUCKET
    with Explorer(there) as lake:
        assert lake.sql("SELECT count(*) AS n FROM plain")["n"][0] == 60
        key = next(key for key in service.names(name) if key.endswith("/1.parquet"))
        data = service.data(name, key)
        service.client.put_object(Bucket=name, Key=key, Body=data[:50] + bytes([data[50] ^ 1]) + data[51:])
        try:
            with pytest.raises(Damaged, match=f"s3://{name}/{key} "):
                lake.sql("SELECT sum(value) FROM plain")
        finally:
            service.client.put_object(Bucket=name, Key=key, Body=data)


@pytest.mark.nightly
def test_lsdb_reads_it_through_pyarrow(explored, there, monkeypatch):
    monkeypatch.delenv("AWS_ENDPOINT_URL")
    galaxies = hats_readers.open_catalog(catalogue(there, "galaxies"), columns="all")
    assert len(galaxies.compute()) == 500
    here = read.version(explored, "galaxies")
    ra, dec = (here.rows()[name][0].as_py() for name in ("ra", "dec"))
    found = galaxies.cone_search(ra, dec, 1800.0).compute()
    assert sorted(found["id"]) == sorted(here.cone(ra, dec, 0.5)["id"].to_pylist())
    assert 0 < len(found) < 500


def test_a_catalogue_for_lsdb_has_a_name_and_an_address(explored, there):
    key = read.version(explored, "galaxies").key
    assert str(catalogue(there, "galaxies")).endswith(f"/lake/galaxies/v-{key}")
    with pytest.raises(BadInput, match="plain is not a catalogue"):
        catalogue(there, "plain")
    with pytest.raises(BadInput, match="is not an address"):
        catalogue(str(explored), "galaxies")


def test_duckdb_reads_it_through_a_dataset(explored, there):
    import duckdb

    rows = read.version(layout.open_lake(there), "galaxies").dataset()
    assert rows.count_rows() == 500
    n, least = duckdb.sql("SELECT count(*), min(z_obs) FROM rows").fetchall()[0]
    here = read.version(explored, "galaxies").rows(["z_obs"])["z_obs"].to_numpy()
    assert n == 500
    assert least == here.min()
