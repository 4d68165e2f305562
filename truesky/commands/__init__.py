"""The command `truesky`. Each subcommand runs a module that python -m or spark-submit can also run."""
