"""Random numbers that depend only on the identity of a draw, not on the machine, the time or the order of the code.

An identity is a seed, names and numbers, for example (seed, "galaxies.shape", cell), where cell is a HEALPix index.
Equal identities always give equal numbers. Three interfaces serve three uses:

`rng.stream(seed, stage, cell)`
    A numpy generator for one file of a table, for example all halos of a HEALPix cell; `stage` is the name of the
    computation. Use it in numpy code if the whole file is always drawn at once. If one draw is added or removed, all
    later numbers of the generator change.
`per_source.PerSourceGenerator(ids, seed, stage)`
    One number per call for each source, which depends on the identifier of the source and not on the other sources.
    Use it in numpy code if a deeper or wider request adds sources, whose presence must not change the numbers of the
    others. `rng.uniforms` is a simple variant for a few uniform numbers per source.
`compiled_draws`
    Functions of a 64-bit key, for loops that numba compiles. Derive the key of each source with `per_source.keys`, and
    the keys of its properties or draws with `compiled_draws.child_key`.

Detector effects draw their numbers per pixel with `truesky.render.effects.pixel_random`.
"""
