"""Names, options and help of the subcommands of `truesky`.

The modules of this package import none of the modules that run the commands, so that help and messages about wrong
options need no time.
"""
