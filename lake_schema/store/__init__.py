"""How the lake keeps tables: staged, published, verified, read."""
