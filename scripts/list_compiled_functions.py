"""Update the list of functions that a run compiles ahead, from a folder with machine code of numba.

    python -m scripts.list_compiled_functions GROUP FOLDER

FOLDER is the folder of machine code that a run with an empty cache has left ($TRUESKY_CACHE/numba/KEY). GROUP is
"catalogues", "ccd" or "infrared". Functions that are in another group already are left out. Run it after a change of
the arguments of compiled functions, for a request with channels of the group.
"""

from __future__ import annotations

import io
import json
import pickle
import sys
from pathlib import Path

from truesky.running import compile_ahead

# Packages whose functions are in the group "catalogues".
_CATALOGUE_PACKAGES = ("catalogue", "fluxes", "numerics", "randomness")
_PACKAGES = (*_CATALOGUE_PACKAGES, "render")


def signatures(folder: Path) -> dict[str, list[str]]:
    """Return the argument types of the machine code in a folder, by module and name of the function."""
    types_by_name: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("*.nbi")):
        module, function = path.name.rsplit("-", 1)[0].split(".")
        if path.parent.name.split(".")[0] not in _PACKAGES:
            continue
        stream = io.BytesIO(path.read_bytes())
        pickle.load(stream)
        _, overloads = pickle.loads(stream.read())
        # Functions with literal arguments are compiled together with the functions that call them.
        arguments = sorted({repr(key[0]) for key in overloads if "Literal" not in repr(key[0])})
        if arguments:
            types_by_name[f"truesky.{path.parent.name}.{module}:{function}"] = arguments
    return types_by_name


def main() -> None:
    """Update the list with the group and the folder in the arguments of the program."""
    group, folder = sys.argv[1:]
    listed = json.loads(compile_ahead.LIST.read_text()) if compile_ahead.LIST.exists() else {}
    listed_elsewhere = {name for other in listed for name in listed[other] if other != group}
    for name, arguments in signatures(Path(folder)).items():
        if name not in listed_elsewhere:
            # Few functions of these packages are for images of one group only, and stay in it.
            is_general = name.split(".")[1] in _CATALOGUE_PACKAGES and name not in listed.get(group, {})
            group_of_function = "catalogues" if is_general else group
            listed.setdefault(group_of_function, {})[name] = arguments
    compile_ahead.LIST.write_text(json.dumps(listed, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
