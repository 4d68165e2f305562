"""Random numbers that depend on what is drawn, not on where or in which order the code runs.

Three interfaces serve three uses:

rng.stream(seed, stage, cell)
    A numpy generator for one partition, for example all halos of a HEALPix cell. Use it where a partition is always
    drawn as a whole, by numpy code.
keyed.Keyed(ids, seed, stage)
    Independent numbers for each source, selected by its identifier. Use it where a deeper request adds sources between
    the others, whose numbers must not change.
compiled_draws
    The same per-key numbers inside compiled functions. Use it in loops that are compiled by numba.
"""
