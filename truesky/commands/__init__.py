"""The command `truesky` with its subcommands. Each subcommand runs a module that `python -m` or Spark can also run."""
