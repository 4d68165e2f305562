"""Small requests: the lines that all have in common, and universes that are quick to make."""

# Area for tests that do not depend on it, and area in the field of the demo request with a given radius (deg).
ANYWHERE = "cone = { ra = 0, dec = 0, radius = 1 }"
FIELD = "cone = {{ ra = 53.117, dec = -27.808, radius = {} }}"


def text(more="", area=ANYWHERE, name="x", seed=1):
    """Return the TOML text of a request. `more` contains further keys, and then sections."""
    return f'name = "{name}"\nseed = {seed}\narea = {{ {area} }}\n{more}'


def shallow(galaxies, stars, more=""):
    """Return the [universe] section for few sources, with the coarsest box and maps that are allowed.

    `more` contains further keys of the section.
    """
    limits = f"galaxy_limit = {galaxies}\nstar_limit = {stars}\n"
    return f"[universe]\n{limits}box_cells = 192\nlensing_nside = 64\n{more}"


def written(folder, *args, **keys):
    """Write such a request to a folder and return its path."""
    path = folder / "r.toml"
    path.write_text(text(*args, **keys))
    return path
