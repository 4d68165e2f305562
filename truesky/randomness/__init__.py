"""Random numbers that depend only on the identity of a draw, not on the machine, the time or the order of the code.

An identity is a seed and names, for example (seed, "galaxies.shape", cell). Equal identities always give equal numbers.
Three interfaces serve three uses:

`rng.stream(seed, stage, cell)`
    A numpy generator for one partition, for example all halos of a HEALPix cell. Use it in numpy code if a partition
    is always drawn as a whole. If one draw is added or removed, later numbers of the stream change.
`per_source.PerSourceGenerator(ids, seed, stage)`
    One number per call for each source, which depends on the identifier of the source and not on the other sources.
    Use it in numpy code if a deeper or wider request adds sources, whose presence must not change the numbers of the
    others. `rng.uniforms` is a simple variant for a few uniform numbers per source.
`compiled_draws`
    Functions of a 64-bit key, for loops that numba compiles. Derive the key of each source with `per_source.keys` and
    the keys of its parts with `compiled_draws.child_key`.

Effects of detectors draw numbers per pixel with `truesky.render.effects.pixel_random`.
"""
