"""TAP service for the tables and images of a lake, with ObsCore, for tools such as TOPCAT, Aladin and pyvo."""
