"""Collect the template spectra, extinction laws and passbands with which fluxes are computed, and store them as tables.

They come from the built-in libraries and from a user's files, which the request (the user's TOML file) names. Processes
that compute fluxes read them back from these tables of the lake.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Mistakes, bad_input
from lake_schema.store import read as lake_read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import file_sha256
from lake_schema.tables import galaxies as line_table
from lake_schema.tables import passbands as passband_table
from lake_schema.tables import templates as template_table
from lake_schema.tables.common import Origin
from truesky.fluxes import high_redshift, passbands
from truesky.fluxes.libraries import (
    brown_dwarfs,
    from_files,
    model_stars,
    standards,
    stars_from_files,
    stellar,
    templates,
)
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.libraries.vega import spectrum_file, vega_magnitudes
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, lines
from truesky.fluxes.spectra.continuum import dust_curves
from truesky.numerics import cache, cache_labels
from truesky.numerics.code_fingerprints import code_key
from truesky.request.files import Curves, UserCurves
from truesky.request.toml_values import refuse_name

# Prefixes of the request's keys for user files: passbands, galaxy templates, extinction laws and stars. For example,
# "fluxes.passbands.NAME" is the file of the passband NAME.
FILTER_PREFIX, _TEMPLATES_PREFIX, _LAWS_PREFIX, _STARS_PREFIX = (
    f"fluxes.{part}." for part in ("passbands", "templates", "extinction", "stars")
)


@dataclass(frozen=True, slots=True)
class FluxInputs:
    """User passbands, and libraries of templates, with which fluxes are computed.

    Attributes
    ----------
    passbands : mapping of str to Passband
        User passbands by name.
    library : Library
        Galaxy templates with the extinction laws of dust in galaxies.
    stars : Library
        Stellar templates.
    origins : mapping of str to Origin
        File name, format and checksum of each user file, by its key in the request, such as "fluxes.passbands.NAME".
    dwarf_origins : sequence of Origin
        Files, reference and checksum of the spectrum of each dwarf star; () for built-in dwarfs. The dwarfs are the
        first templates of `stars`.
    """

    passbands: Mapping[str, Passband]
    library: Library
    stars: Library
    origins: Mapping[str, Origin]
    dwarf_origins: Sequence[Origin] = ()

    def sha256(self) -> dict[str, str]:
        """Return the SHA-256 checksum of each user file, by its key in the request."""
        return {key: origin.sha256 for key, origin in self.origins.items()}


def read(user_curves: UserCurves) -> FluxInputs:
    """Read the built-in libraries of templates, with the replacements in a user's files, and the user's passbands.

    Raises
    ------
    BadInput
        If a file is absent or not valid. The message names the key of the request, the file and, if there is one, the
        row.
    """
    user_passbands, library, origins = _read_galaxies(user_curves)
    stars, star_origins, dwarf_origins = _read_stars(user_curves)
    return FluxInputs(user_passbands, library, stars, origins | star_origins, dwarf_origins)


def check_files(user_curves: UserCurves) -> dict[str, Passband]:
    """Read the user's files, and return the user's passbands by name; raises BadInput as `read` does.

    The built-in spectra of stars, which take about 12 s to compute once, are not needed.
    """
    user_passbands, _, _ = _read_galaxies(user_curves)
    if user_curves.has_stars:
        _read_stars(user_curves)
    return user_passbands


def _read_galaxies(user_curves: UserCurves) -> tuple[dict[str, Passband], Library, dict[str, Origin]]:
    """Return the user's passbands by name, the library of galaxies, and the origin of each user file by request key."""
    user_passbands, origins = read_passbands(user_curves)
    library = templates.galaxy_library()
    if user_curves.templates is not None:
        with _prefix_errors("fluxes.templates"):
            library = from_files.library(user_curves.templates.files, user_curves.templates.format)
            each = (replace(user_curves.templates, files=(file,)) for file in user_curves.templates.files)
            origins |= {f"{_TEMPLATES_PREFIX}{k}": _user_origin(curves) for k, curves in enumerate(each)}
    if user_curves.extinction:
        dust = dust_curves(library).copy()
        for code, curves in user_curves.extinction:
            key = f"{_LAWS_PREFIX}{code}"
            with _prefix_errors(key):
                dust[code] = from_files.law(curves.files[0], curves.format, library.wavelength)
                origins[key] = _user_origin(curves)
        library = replace(library, dust=dust, external=True)
    if user_curves.intergalactic:
        library = replace(library, intergalactic=True)
    return user_passbands, library, origins


def read_passbands(user_curves: UserCurves) -> tuple[dict[str, Passband], dict[str, Origin]]:
    """Read the user's passbands.

    Returns
    -------
    passbands : dict of str to Passband
        Passbands by name.
    origins : dict of str to Origin
        File name, format and checksum of each passband, by key "fluxes.passbands.NAME".

    Raises
    ------
    BadInput
        If a passband has the name of a built-in one, or its file is not valid.
    """
    with Mistakes() as mistakes:
        read_curves = {name: mistakes.read(_read_passband, name, curves) for name, curves in user_curves.passbands}
    user_passbands = {name: band for name, (band, _) in read_curves.items()}
    return user_passbands, {f"{FILTER_PREFIX}{name}": origin for name, (_, origin) in read_curves.items()}


def _read_passband(name: str, curves: Curves) -> tuple[Passband, Origin]:
    location = curves.location or f"{FILTER_PREFIX}{name}"
    if name in passbands.names():
        raise BadInput(f"{location}: truesky has a passband {name}: choose another name for this curve")
    with _prefix_errors(curves.location or f"{location}.file"):
        return from_files.passband(curves.files[0], name, curves.medium, curves.format), _user_origin(curves)


def _read_stars(user_curves: UserCurves) -> tuple[Library, dict[str, Origin], list[Origin]]:
    """Return the stellar library, the origin of each user file by request key, and the origin of each dwarf star.

    An origin is the file name, reference and checksum. Without user files the library is the built-in one, and both
    origins are empty.
    """
    if not user_curves.has_stars:
        return templates.stellar_library(), {}, []
    low_resolution, reference, origins = stellar.TABLE, "Pecaut & Mamajek 2013", {}
    with _prefix_errors("fluxes.stars"):
        library, infrared = stars_from_files.library(user_curves.basel, user_curves.irtf)
        if user_curves.basel is not None:
            low_resolution, reference = user_curves.basel, "read as basel"
            origins[f"{_STARS_PREFIX}basel"] = _origin(reference, low_resolution)
        origins |= {
            f"{_STARS_PREFIX}irtf.{k}": _origin("read as irtf", file) for k, file in enumerate(user_curves.irtf)
        }
        spliced = f"{reference}; the last, read as irtf, in the infrared"
        dwarf_origins = [
            _origin(reference, low_resolution) if k < 0 else _origin(spliced, low_resolution, user_curves.irtf[k])
            for k in infrared
        ]
    return library, origins, dwarf_origins


def select_passbands(names: Sequence[str], user_passbands: Mapping[str, Passband]) -> list[Passband]:
    """Return the passbands with the given names, built-in or from the user; raises BadInput if a name is unknown."""
    available = (*passbands.names(), *user_passbands)
    if unknown := [name for name in names if name not in available]:
        raise bad_input(f"fluxes.bands: {refuse_name(name, available)}" for name in unknown)
    return [user_passbands[name] if name in user_passbands else passbands.load(name) for name in names]


def template_rows(flux_inputs: FluxInputs) -> pa.Table:
    """Return the rows of the table `templates`: spectra of galaxies, quasars, high-redshift galaxies and stars.

    Galaxies and stars are taken from `flux_inputs`; quasars and high-redshift galaxies are built in.
    """
    libraries = {
        "galaxy": flux_inputs.library,
        "qso": high_redshift.quasar_library(),
        "high_redshift": high_redshift.high_redshift_library(),
        "star": flux_inputs.stars,
    }
    user_origins = [origin for key, origin in flux_inputs.origins.items() if key.startswith(_TEMPLATES_PREFIX)]
    quasars = _origin("Vanden Berk et al. 2001", high_redshift.QUASAR_LINES)
    origins = {
        "galaxy": user_origins or [_galaxy_origin(k) for k in range(len(flux_inputs.library))],
        "qso": [quasars] * len(libraries["qso"]),
        "high_redshift": [_origin("power laws", Path(high_redshift.__file__))] * len(libraries["high_redshift"]),
        "star": _star_origins(flux_inputs.dwarf_origins),
    }
    return template_table.rows(libraries, origins)


def law_rows(flux_inputs: FluxInputs) -> pa.Table:
    """Return the rows of the table `extinction_laws`: k(lambda) of five laws, at the galaxy templates' wavelengths."""
    code = Path(extinction.__file__)
    embedded = (
        _origin("no dust", code),
        _origin("Prevot et al. 1984, Bouchet et al. 1985", extinction.PREVOT_TABLE),
        _origin("Calzetti et al. 2000", code),
        *(_origin("Calzetti et al. 2000 with the bump of Fitzpatrick & Massa 1986", code) for _ in range(2)),
    )
    origins = [flux_inputs.origins.get(f"{_LAWS_PREFIX}{law}", origin) for law, origin in enumerate(embedded)]
    return template_table.law_rows(flux_inputs.library.wavelength, dust_curves(flux_inputs.library), origins)


def line_rows(flux_inputs: FluxInputs) -> pa.Table:
    """Return the rows of the table `emission_lines`, which are always the built-in lines.

    `flux_inputs` is not used, because a user cannot give lines. It is a parameter so that all four functions that make
    a table have the same signature.
    """
    emission_lines = lines.line_list()
    return line_table.line_rows(
        emission_lines, lines.width_law(), [_origin(line.source, lines.TABLE) for line in emission_lines]
    )


def passband_rows(flux_inputs: FluxInputs) -> pa.Table:
    """Return the rows of the table `passbands`: all built-in passbands, then the user's."""
    bands = [*(passbands.load(name) for name in passbands.names()), *flux_inputs.passbands.values()]
    origins = [_passband_origin(name) for name in passbands.names()]
    origins += [flux_inputs.origins[f"{FILTER_PREFIX}{name}"] for name in flux_inputs.passbands]
    pivots, widths = [passbands.pivot_wavelength(b) for b in bands], [passbands.log_width(b) for b in bands]
    return passband_table.rows(bands, pivots, widths, origins, vega_magnitudes(bands))


def galaxy_library_from_facts(lake: Folder, facts: Mapping[str, Any]) -> Library:
    """Return the galaxy library with which a table of fluxes is computed.

    `facts` has the recorded inputs of this table: `files` has the checksums of user files. `sources` has the keys
    (hashes) of the versions of input tables, such as `templates`. The library is read from the lake if it
    contains a user's templates or extinction laws.
    """
    library = templates.galaxy_library()
    if any(key.startswith((_TEMPLATES_PREFIX, _LAWS_PREFIX)) for key in facts.get("files", ())):
        library = published_library(lake, facts["sources"]["templates"], facts["sources"]["extinction_laws"])
    return replace(library, intergalactic=True) if facts.get("intergalactic") else library


def stellar_library_from_facts(lake: Folder, facts: Mapping[str, Any]) -> Library:
    """Return the stellar library with which a table of fluxes is computed.

    `facts` has the recorded inputs of this table: `files` has the checksums of user files. `sources` has the keys
    (hashes) of the versions of input tables, such as `templates`. The library is read from the lake if it
    contains a user's stars.
    """
    if not any(key.startswith(_STARS_PREFIX) for key in facts.get("files", ())):
        return templates.stellar_library()
    return published_stars(lake, facts["sources"]["templates"])


def passband_from_facts(lake: Folder, facts: Mapping[str, Any], name: str) -> Passband:
    """Return a passband with which a table of fluxes is computed.

    Parameters
    ----------
    lake : Folder
        Root folder of the lake.
    facts : mapping of str to object
        Recorded inputs of the flux table: `files` are the checksums of user files, `sources` the keys (hashes) of the
        versions of the table `passbands` and others.
    name : str
        Name of the passband.

    Returns
    -------
    Passband
        The user's passband, read from the lake, if `files` contains one of this name, otherwise the built-in passband.
    """
    if f"{FILTER_PREFIX}{name}" not in facts.get("files", ()):
        return passbands.load(name)
    return published_passband(lake, facts["sources"]["passbands"], name)


@lru_cache(maxsize=2)
def published_library(lake: Folder, templates_key: str, laws_key: str) -> Library:
    """Read the galaxy library from the tables `templates` and `extinction_laws` of a lake.

    Parameters
    ----------
    lake : Folder
        Root folder of the lake.
    templates_key, laws_key : str
        Keys (hashes) of the versions of these tables.

    Returns
    -------
    Library
        Galaxy templates and extinction laws, memory-mapped from the cache on disc.
    """

    def read_rows() -> dict[str, Array]:
        rows = lake_read.version(lake, "templates", templates_key).rows(where=pc.field("library") == "galaxy")
        rows = rows.sort_by("sed")
        laws = lake_read.version(lake, "extinction_laws", laws_key).rows().sort_by("law")
        flux, dust = (np.stack(column.to_numpy()).astype(np.float32) for column in (rows["flux"], laws["k"]))
        first, step = (float(rows[name][0].as_py()) for name in ("first_wavelength", "wavelength_step"))
        return {"wavelength": first + step * np.arange(flux.shape[1]), "flux": flux, "dust": dust}

    key = cache.content_key(templates_key, laws_key, code_key(__name__))
    arrays = cache.cached_arrays("published_library", key, read_rows)
    names = tuple(str(k) for k in range(len(arrays["flux"])))
    return Library(arrays["wavelength"], arrays["flux"], names, dust=arrays["dust"], external=True)


@lru_cache(maxsize=2)
def published_stars(lake: Folder, templates_key: str) -> Library:
    """Read the stellar library from the table `templates` of a lake.

    `templates_key` is the key (hash) of the version of the table. The spectra are memory-mapped from the cache on disc.
    """

    def read_rows() -> dict[str, Array]:
        rows = lake_read.version(lake, "templates", templates_key).rows(where=pc.field("library") == "star")
        return {"flux": np.stack(rows.sort_by("sed")["flux"].to_numpy()).astype(np.float32)}

    key = cache.content_key(templates_key, code_key(__name__))
    arrays = cache.cached_arrays("published_stars", key, read_rows, cache_labels.label_published())
    return replace(templates.stellar_library(), flux=arrays["flux"], external=True)


def published_passband(lake: Folder, key: str, name: str) -> Passband:
    """Read a passband from the table `passbands` of a lake.

    Parameters
    ----------
    lake : Folder
        Root folder of the lake.
    key : str
        Key (hash) of the version of the table.
    name : str
        Name of a passband in this table.

    Returns
    -------
    Passband
        The passband.
    """
    row = lake_read.version(lake, "passbands", key).rows(where=pc.field("name") == name).to_pylist()[0]
    response = np.array(row["response"])
    wavelength = row["first_wavelength"] + row["wavelength_step"] * np.arange(len(response))
    return Passband(name, wavelength, response, row["medium"])


@contextmanager
def _prefix_errors(key: str) -> Iterator[None]:
    """Convert errors (BadInput, OSError, ValueError) inside the `with` block to BadInput with a prefix.

    The prefix is the key of the request that names the user's file.
    """
    try:
        yield
    except (BadInput, OSError, ValueError) as error:
        raise BadInput(f"{key}: {' '.join(str(error).split())}") from None


def _user_origin(curves: Curves) -> Origin:
    (file,) = curves.files
    return Origin(f"{file.name}, read as {curves.format}", file_sha256(file))


def _origin(reference: str, *files: Path) -> Origin:
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    return Origin(f"{', '.join(file.name for file in files)}: {reference}", digest)


def _galaxy_origin(template: int) -> Origin:
    code, young = Path(templates.__file__), templates.YOUNG
    files = [
        code if name == young else spectrum_file(f"CWW_{name}_ext.sed") for name in templates.template_anchors(template)
    ]
    return _origin("Coleman, Wu & Weedman 1980, as GalSim has them" + ", and a burst" * (code in files), *files)


def _star_origins(user_origins: Sequence[Origin]) -> list[Origin]:
    """Return the origin (files, reference and checksum) of each template of the stellar library.

    `user_origins` has the origin of each dwarf from a user's file; it is empty if the dwarfs are built in.
    """
    dwarfs = _origin("Pecaut & Mamajek 2013", stellar.TABLE)
    first = [*user_origins] or [dwarfs] * len(stellar.types().names)
    colours = _origin("Castelli & Kurucz 2003, as astroARIADNE has them", model_stars.TABLE)
    # Give each model star the origin of the user's dwarf of next higher temperature. Spectra of model stars are
    # computed from the user's dwarfs, or have infrared parts from the user's files.
    models = (
        [user_origins[k] for k in model_stars.nearest_dwarfs(stellar.types())]
        if user_origins
        else [colours] * len(model_stars.names())
    )
    vega = _origin("CALSPEC alpha_lyr_mod_001, as GalSim has it; lambda^-3.95 beyond it", spectrum_file("vega.txt"))
    white_dwarf = _origin("Bohlin, Hubeny & Rauch 2020", Path(standards.__file__))
    nebula = _origin("the references in the file", standards.NEBULA)
    return [*first, *[dwarfs] * brown_dwarfs.COUNT, vega, white_dwarf, nebula, *models]


def _passband_origin(name: str) -> Origin:
    source, note = passbands.provenance(name)
    kind, _, detail = source.partition(":")
    if kind != "speclite":
        return _origin(f"{source}, {note}", passbands.TABLE)
    spec = importlib.util.find_spec("speclite")
    if spec is None or not spec.submodule_search_locations:
        raise BadInput("package speclite is not installed: its passbands are required")
    folder = Path(spec.submodule_search_locations[0]) / "data" / "filters"
    return _origin(f"{note}, as speclite has it", folder / f"{detail}.ecsv")
