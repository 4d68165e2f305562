"""Look at a lake: SQL, cones, histograms, maps and downloads, for notebooks and the command line.

from truesky.explore.explorer import Explorer

with Explorer("out/demo/lake") as lake:
    lake.tables()
    lake.sql("SELECT z_obs, mag_r01 FROM galaxies WHERE z_obs < $most", most=0.5)

python -m truesky.explore "SELECT count(*) FROM galaxies" --lake out/demo/lake [--name REQUEST] [--out FILE]

A lake may hold the tables of several requests: name one, or write demo.galaxies for the galaxies of request demo.
"""
