"""The command `truesky`: each of its words is one of the modules that python -m and spark-submit run."""
