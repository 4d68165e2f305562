"""TAP service (IVOA Table Access Protocol) for the tables and images of a lake, for tools such as TOPCAT and pyvo.

The images are described by the table ivoa.obscore (ObsCore).
"""
