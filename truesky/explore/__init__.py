"""Explore a lake: SQL, cone searches, histograms, maps and exports, for notebooks and the command line.

Notes
-----
A lake is the folder with all tables and images of the simulator; a request is the TOML file of a user that defines a
simulation. A lake can contain the tables of several requests. Give the name of a request to `Explorer`, or write
`demo.galaxies` in SQL for the table `galaxies` of the request `demo`.

Examples
--------
In Python::

    from truesky.explore.explorer import Explorer

    with Explorer("out/demo/lake") as lake:
        lake.tables()
        lake.sql("SELECT z_obs, mag_r01 FROM galaxies WHERE z_obs < $most", most=0.5)

On the command line::

    truesky sql out/demo/lake "SELECT count(*) FROM galaxies" [--name REQUEST] [--out FILE]
"""
