"""What a wheel carries besides `jobs` and `lake_schema`: the requests and notebooks that `truesky examples` copies."""
