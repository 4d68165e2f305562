"""A TAP service over the lake for other tools, with ObsCore.

service             which address is answered by what
queries, waiting    jobs that wait for their answer, and their addresses
tables, images      what there is to ask beside the lake's own tables
descriptions        what tools are told, as XML
"""
