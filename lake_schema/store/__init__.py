"""Storage of the tables of a lake (a folder of versioned tables): making, publishing, verifying and reading them."""
