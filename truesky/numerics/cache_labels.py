"""Label the arrays that are computed once, so that a forecast can look for them without the inputs of their keys.

The key of an entry of the cache is a hash of all inputs of a computation, some of which take seconds to make, such as
spectra. A label is a hash of the code and of the few values of a request from which these inputs follow. It only serves
to find an entry: no result depends on it.
"""

from __future__ import annotations

from collections.abc import Iterable

from lake_schema.mission.parameter import Parameter
from lake_schema.store.provenance import code_version
from truesky.numerics.cache import content_key
from truesky.numerics.code_fingerprints import code_key

# Prefixes of the mission parameters on which the PSF of a camera of Euclid depends; the camera's own come in addition.
_PSF_PARAMETERS = ("plm.", "svm.aocs.jitter")


def label_spectra() -> str:
    """Return the label of the libraries of spectra."""
    return content_key(code_key("truesky.fluxes.libraries.templates"))


def label_dust_map(seed: int) -> str:
    """Return the label of the simulated dust map of a seed."""
    return content_key(code_key("truesky.catalogue.dust_map"), seed)


def label_halo_tables(cosmology: str) -> str:
    """Return the label of the tables of halos (abundance, bias, concentration) in a cosmology, by its fingerprint."""
    return content_key(code_key("truesky.catalogue.matter.linear_theory"), cosmology)


def label_halo_bias(cosmology: str) -> str:
    """Return the label of the table of the halo bias of a log-normal density in a cosmology, by its fingerprint."""
    return content_key("bias", code_key("truesky.catalogue.matter.density_box"), cosmology)


def label_box(kind: str, cosmology: str, seed: int, cells: int) -> str:
    """Return the label of fields of the box of matter.

    Parameters
    ----------
    kind : str
        "box" for density and velocities, or "tides" for the tidal field.
    cosmology : str
        Fingerprint of the cosmology.
    seed : int
        Seed of the box.
    cells : int
        Number of cells per side of the box.

    Returns
    -------
    str
        The label.
    """
    return content_key(kind, code_key("truesky.catalogue.matter.density_box"), cosmology, seed, cells)


def label_lensing(cosmology: str, seed: int, cells: int, nside: int, with_far_planes: bool) -> str:
    """Return the label of the lensing maps of a box of matter.

    Parameters
    ----------
    cosmology : str
        Fingerprint of the cosmology.
    seed : int
        Seed of the box.
    cells : int
        Number of cells per side of the box.
    nside : int
        HEALPix resolution of the maps.
    with_far_planes : bool
        True if there are maps for sources beyond z = 6.

    Returns
    -------
    str
        The label.
    """
    maps = nside, int(with_far_planes)
    return content_key(code_key("truesky.catalogue.galaxies.lensing"), cosmology, seed, cells, *maps)


def label_band_ratios(band: str) -> str:
    """Return the label of the table of the light of galaxies in a band relative to the reference band."""
    return content_key(code_key("truesky.catalogue.galaxies.band_ratios"), band)


def label_galaxy_table(band: str, step: float, n_ebv: int, n_av: int) -> str:
    """Return the label of the flux table of galaxies in a band.

    Parameters
    ----------
    band : str
        Name of the passband.
    step : float
        Distance of the redshift nodes in ln(1 + z).
    n_ebv, n_av : int
        Number of Chebyshev coefficients in E(B-V) and in A(V).

    Returns
    -------
    str
        The label. It does not depend on the spectra and the response curve in the user's files.
    """
    return content_key("galaxies", code_key("truesky.fluxes.tables.build_tables"), band, step, n_ebv, n_av)


def label_star_table(band: str) -> str:
    """Return the label of the flux table of stars in a band."""
    return content_key("stars", code_key("truesky.fluxes.tables.build_tables"), band)


def label_published() -> str:
    """Return the label of the spectra that are read from a lake to compute fluxes, apart from the user's own."""
    return content_key("published", code_version())


def label_profiles() -> str:
    """Return the label of the table of Sersic profiles."""
    return content_key(code_key("truesky.render.sources.sersic"))


def label_psf(section: str, detector: str, light: str, positions: int, parameters: Iterable[Parameter]) -> str:
    """Return the label of the PSF images of a detector of Euclid.

    Parameters
    ----------
    section : str
        Prefix of the camera's parameters in the mission database, such as "vis".
    detector : str
        Name of the detector.
    light : str
        Name of the passband, or "spectra" for images through a grism.
    positions : int
        Number of positions on the detector at which the PSF is computed.
    parameters : iterable of Parameter
        All parameters of the mission. Only those of telescope and camera that affect the PSF change the label.

    Returns
    -------
    str
        The label.
    """
    prefixes = (*_PSF_PARAMETERS, f"{section}.psf", f"{section}.diffusion")
    values = repr([(p.key, p.value, p.unit) for p in parameters if p.key.startswith(prefixes)])
    return content_key(code_key("truesky.render.psf.euclid"), section, detector, light, positions, values)
