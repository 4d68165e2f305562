"""A page over a lake in the browser, and a TAP service for other tools: python -m truesky.page --lake LAKE.

gate        who may ask
opened      a lake as it is shown, and the processes that answer
server      which address is answered by what
answers, charts, sky_maps, pictures, sources, runs, downloads       what the page asks
tap         what other tools ask

The files of the page itself lie in static/: modules of JavaScript that the browser runs as they are.
"""
