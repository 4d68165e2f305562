"""Web page that shows a lake (the folder with all tables and images) in the browser, and a TAP service for other tools.

Start both with `truesky page LAKE`. Module `server` maps addresses to handlers, `access_control`
refuses HTTP requests without a valid token, and `lake_session` holds the open lake with its query processes. The folder
static/ contains the HTML, CSS and JavaScript of the page, which the browser runs without a build step.
"""
