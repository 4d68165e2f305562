"""Small requests: the text that every one begins with, and fields that are quickly made."""

# Right ascension, declination and radius of an area that nothing depends on; and in the field of the demo.
ANYWHERE = "cone = { ra = 0, dec = 0, radius = 1 }"
FIELD = "cone = {{ ra = 53.117, dec = -27.808, radius = {} }}"


def text(more="", area=ANYWHERE, name="x", seed=1):
    """TOML; more : other keys, then sections."""
    return f'name = "{name}"\nseed = {seed}\narea = {{ {area} }}\n{more}'


def shallow(galaxies, stars, more=""):
    """The section of a universe of few sources, from the coarsest box and maps that there are; more : of its keys."""
    limits = f"galaxy_limit = {galaxies}\nstar_limit = {stars}\n"
    return f"[universe]\n{limits}box_cells = 192\nlensing_nside = 64\n{more}"


def written(folder, *args, **keys):
    """The path of such a request in a folder."""
    path = folder / "r.toml"
    path.write_text(text(*args, **keys))
    return path
