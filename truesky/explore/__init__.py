"""Explore a lake: SQL, cone searches, histograms, maps and exports, for notebooks and the command line.

Notes
-----
A lake can contain the tables of several requests. Name a request, or write demo.galaxies for the galaxies of request
demo.

Examples
--------
In Python::

    from truesky.explore.explorer import Explorer

    with Explorer("out/demo/lake") as lake:
        lake.tables()
        lake.sql("SELECT z_obs, mag_r01 FROM galaxies WHERE z_obs < $most", most=0.5)

On the command line::

    python -m truesky.explore "SELECT count(*) FROM galaxies" --lake out/demo/lake [--name REQUEST] [--out FILE]
"""
