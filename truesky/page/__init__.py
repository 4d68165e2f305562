"""Web page that shows a lake in the browser, and a TAP service for other tools.

Start it with `python -m truesky.page --lake LAKE`. Module `server` maps addresses to handlers, `access_control` refuses
requests without a valid token, and `lake_session` holds the open lake with its query processes. The folder static/
contains the HTML, CSS and JavaScript of the page, which the browser runs without a build step.
"""
