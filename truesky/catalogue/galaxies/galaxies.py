"""Draw the rows of tables `galaxies` and `halos` in one generation cell (HEALPix cell of order 8).

The rows depend only on the seed, the cell and the model. The galaxies in halos get colours, dust and spectra. Galaxies
that may be brighter than the magnitude limit get masses and emission lines. Galaxies that are brighter also get shapes
and lensing. Each property of each galaxy has separate random numbers, so a new column or a deeper magnitude limit does
not change existing values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import sky
from lake_schema.arrays import Bool, Complex, Float, Float32, Int
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALO_LIMITS, HALOS
from truesky.catalogue import dust_map
from truesky.catalogue.cells import sort_rows
from truesky.catalogue.galaxies import (
    alignments,
    band_ratios,
    emission_lines,
    halo_lensing,
    high_redshift,
    lensing,
    morphology,
    nearest_sed,
    sequences,
    stellar_mass,
)
from truesky.catalogue.galaxies.alignments import Alignments
from truesky.catalogue.galaxies.band_ratios import BandRatios, Sed
from truesky.catalogue.galaxies.emission_lines import LineModel
from truesky.catalogue.galaxies.halo_lensing import Neighbourhood
from truesky.catalogue.galaxies.high_redshift import Kind, PositionFilter
from truesky.catalogue.galaxies.lensing import Lens, Shear
from truesky.catalogue.galaxies.morphology import Shapes
from truesky.catalogue.galaxies.nearest_sed import Training
from truesky.catalogue.galaxies.sequences import Colour, ColourLimits, Colours
from truesky.catalogue.halos import luminosity_function, matching, population, quenching
from truesky.catalogue.halos.halo_catalogue import LightCone
from truesky.catalogue.halos.luminosity_function import Inverse, Schechter
from truesky.catalogue.halos.population import CellCache, Members, Population
from truesky.catalogue.nuclei import accretion, narrow_lines
from truesky.catalogue.nuclei.accretion import Laws
from truesky.catalogue.nuclei.narrow_lines import LineTables, NarrowLines
from truesky.catalogue.nuclei.quasar_hosts import QuasarHosts
from truesky.fluxes import passbands
from truesky.fluxes.high_redshift import QUASAR
from truesky.fluxes.libraries import templates
from truesky.fluxes.passbands import Passband
from truesky.randomness.per_source import PerSourceGenerator
from truesky.request.schema import Universe

# Margin (mag) by which the faintest drawn galaxies are fainter than the magnitude limit, even with the brightest
# spectrum. Emission lines make galaxies brighter, but only one galaxy in 10^4 by more than this margin (tests).
_CANDIDATE_MARGIN = 0.25
# Emission lines are computed only for galaxies whose continuum is at most this much (mag) fainter than the limit.
_LINE_MARGIN = 0.75


@dataclass(frozen=True, slots=True, eq=False)
class NucleusModel:
    """Model of active nuclei.

    Attributes
    ----------
    laws : Laws
        Distributions of accretion rates and types.
    lines : NarrowLines
        Ratios of narrow lines.
    hosts : QuasarHosts or None
        Expected number of quasars in halos; None for random positions of quasars.
    """

    laws: Laws
    lines: NarrowLines
    hosts: QuasarHosts | None


@dataclass(frozen=True, slots=True, eq=False)
class GalaxyModel:
    """Model from which galaxies are drawn: parameters and tables of a few MB, made once by `model`.

    Attributes
    ----------
    limit : float
        Faintest apparent AB magnitude of a galaxy. It includes emission lines, but not the absorption by the Milky
        Way's dust and by intergalactic hydrogen.
    band : Passband
        Passband in which `limit` applies.
    population : Population
        Halos and the galaxies in them.
    lens : Lens
        Lensing maps of the simulated matter, or a uniform shear.
    rotation : float
        Angle that is added to the position angle of each galaxy before lensing, deg.
    alignments : Alignments or None
        Model of intrinsic alignments; None for random orientations.
    luminosities : Schechter
        Luminosity function.
    colours, colour_limits : Colours, ColourLimits
        Distributions of the colours, and the range of colours that the template spectra can have.
    halo_shares : quenching.Shares
        Fractions of satellites, and of galaxies that halos quench, by redshift and luminosity.
    selection : BandRatios
        Brightness of each template spectrum in `band` by redshift, relative to 0.1r (SDSS r blueshifted to z = 0.1).
    reference : BandRatios
        Brightness of each template spectrum in observed 0.1r by redshift, relative to rest-frame 0.1r.
    colour : BandRatios
        Brightness of each template spectrum in rest-frame 0.1g, relative to rest-frame 0.1r.
    shapes : Shapes
        Distributions of sizes and shapes.
    masses : stellar_mass.MassToLight
        Parameters of the mass-to-light ratios.
    star_formation : stellar_mass.StarFormation
        Parameters of the star formation rates.
    lines : LineModel
        Model of the emission lines.
    distant : tuple of Kind
        Quasars, and galaxies beyond redshift 6.
    training : Training or None
        The user's observed galaxies, whose spectra are used; None to choose spectra by colour.
    nuclei : NucleusModel or None
        Active nuclei; None without variable sources.
    """

    limit: float
    band: Passband
    population: Population
    lens: Lens
    rotation: float
    alignments: Alignments | None
    luminosities: Schechter
    colours: Colours
    colour_limits: ColourLimits
    halo_shares: quenching.Shares
    selection: BandRatios
    reference: BandRatios
    colour: BandRatios
    shapes: Shapes
    masses: stellar_mass.MassToLight
    star_formation: stellar_mass.StarFormation
    lines: LineModel
    distant: tuple[Kind, ...]
    training: Training | None
    nuclei: NucleusModel | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SelectedGalaxies:
    """Galaxies that are bright enough for the catalogue, as rows of a `Members` table of galaxies in halos.

    Attributes
    ----------
    row : int array, shape (n,)
        Row of each galaxy in `Members`.
    z : float array, shape (n,)
        Redshift.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
    magnitude : float array, shape (n,)
        Apparent magnitude without emission lines, from `apparent_magnitude`.
    colour : Colour
        Rest-frame colours of the spectra.
    sed : Sed
        Spectra.
    """

    row: Int
    z: Float
    m_r: Float
    magnitude: Float
    colour: Colour
    sed: Sed

    def select(self, keep: Bool) -> SelectedGalaxies:
        """Return the galaxies for which the mask `keep`, shape (n,), is True."""
        rows = self.row[keep], self.z[keep], self.m_r[keep], self.magnitude[keep]
        return SelectedGalaxies(*rows, self.colour.select(keep), self.sed.select(keep))


# A worker makes one partition after another of the same request, so it keeps the model.
@lru_cache(maxsize=1)
def model(
    seed: int, requested: Universe, light_cone: LightCone | None = None, training: Training | None = None
) -> GalaxyModel:
    """Return the model of galaxies that are brighter than a magnitude limit and nearer than a redshift.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    requested : Universe
        Section `universe` of the request, with the limits in magnitude and redshift.
    light_cone : LightCone, optional
        The user's halos, which replace the drawn halos; None to draw halos.
    training : Training, optional
        The user's observed galaxies, whose spectra are used; None to choose spectra by colour.

    Returns
    -------
    GalaxyModel
        The model.

    Notes
    -----
    A model with a larger redshift or a fainter limit contains the same halos and galaxies and more, because it draws
    from the same distributions with the same random numbers. The model takes 1 s to make. With an empty disc cache, the
    box of simulated matter and its lensing maps take longer (density_box.load, lensing.load).
    """
    library, colours = templates.galaxy_library(), sequences.model()
    selection = _selection(requested, training)
    dustiest = float(selection.ebv[-1])
    halo_population = halos_and_galaxies(seed, requested, light_cone, training)
    boosts = requested.high_redshift_boost, requested.quasar_boost
    distant = high_redshift.model(requested.cosmology, *boosts, requested.galaxy_limit, requested.z_max)
    colour = band_ratios.load(library, "sdss_g01", 0.0, dustiest)
    return GalaxyModel(
        limit=requested.galaxy_limit,
        band=passbands.load(requested.galaxy_band),
        population=halo_population,
        lens=_lens(halo_population, requested, with_far_planes=bool(distant)),
        rotation=requested.rotation,
        alignments=alignments.model(halo_population.halos.box, halo_population.halos.replicas, requested.alignment),
        luminosities=luminosity_function.schechter(),
        colours=colours,
        colour_limits=sequences.colour_limits(colour, colours.dust),
        halo_shares=quenching.shares(
            quenching.model(), halo_population.masses, halo_population.halos.matching.occupation
        ),
        selection=selection,
        reference=band_ratios.load(library, band_ratios.REFERENCE_BAND, matching.Z_LAST, dustiest),
        colour=colour,
        shapes=morphology.shapes(),
        masses=stellar_mass.mass_to_light(),
        star_formation=stellar_mass.star_formation(),
        lines=emission_lines.model(),
        distant=distant,
        training=training,
        nuclei=_nuclei(halo_population, distant) if requested.variables else None,
    )


def _nuclei(halo_population: Population, distant: tuple[Kind, ...]) -> NucleusModel:
    quasars = [kind for kind in distant if kind.code == QUASAR]
    # The user's halos may have another depth than hosts of quasars need.
    in_halos = quasars and halo_population.light_cone is None
    hosts = high_redshift.hosts(quasars[0], halo_population.halos) if in_halos else None
    return NucleusModel(accretion.laws(), narrow_lines.laws(), hosts)


def halos_and_galaxies(
    seed: int, requested: Universe, light_cone: LightCone | None = None, training: Training | None = None
) -> Population:
    """Return the model of halos and of the galaxies in them, without the colours of the galaxies.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    requested : Universe
        Section `universe` of the request, with the limits in magnitude and redshift.
    light_cone : LightCone, optional
        The user's halos, which replace the drawn halos; None to draw halos.
    training : Training, optional
        The user's observed galaxies, whose dust may be thicker than the dust of the model.

    Returns
    -------
    Population
        The population. It is complete for galaxies brighter than the magnitude limit, whatever their spectrum.
    """
    # Only these settings matter, so that the tables `halos` and `galaxies` share the population.
    names = ("galaxy_band", "galaxy_limit", "z_max", "box_cells", "structure_below_cells", "cosmology")
    settings = {name: getattr(requested, name) for name in names}
    return _population(seed, Universe(**settings), light_cone, training)


@lru_cache(maxsize=1)
def _population(seed: int, requested: Universe, light_cone: LightCone | None, training: Training | None) -> Population:
    nodes, brightest = band_ratios.brightest_offset(_selection(requested, training))

    def faintest(z: Float) -> Float:
        distance_modulus = requested.cosmology.distance_modulus(z)
        return requested.galaxy_limit + _CANDIDATE_MARGIN - distance_modulus - np.interp(z, nodes, brightest)

    volume = luminosity_function.volume(requested.z_max)
    box, fine = (seed, requested.cosmology, requested.box_cells), requested.structure_below_cells
    return population.model(*box, volume, _inverse(), faintest, light_cone, structure_below_cells=fine)


@cache
def _inverse() -> Inverse:
    """Return the table of luminosity by cumulative number density; it takes 0.2 s and is the same for every request."""
    return luminosity_function.inverse(luminosity_function.schechter(), matching.Z_LAST)


def _lens(halo_population: Population, requested: Universe, with_far_planes: bool) -> Lens:
    if requested.lensing is not None:
        return Shear(*requested.lensing)
    return lensing.load(halo_population.halos.box, requested.lensing_nside, with_far_planes)


def _selection(requested: Universe, training: Training | None) -> BandRatios:
    dustiest = max(sequences.model().dust.highest, training.dustiest if training else 0.0)
    return band_ratios.load(templates.galaxy_library(), requested.galaxy_band, matching.Z_LAST, dustiest)


def draw(cell: int, universe: GalaxyModel, cells: CellCache, dust: Float32) -> pa.Table:
    """Draw the galaxies whose true positions are in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    universe : GalaxyModel
        Model of the galaxies.
    cells : CellCache
        Cache of the halos and galaxies that are already drawn, by HEALPix cell.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag (truesky.catalogue.dust_map).

    Returns
    -------
    Table
        Rows of table `galaxies`, sorted by _healpix_29 (the HEALPix cell of order 29 of the observed position). A cell
        without galaxies gives an empty table.
    """
    lens = halo_lensing.lens_of_cell(universe.lens, cells, cell)
    return draw_members(cell, universe, population.members(cells, cell), lens, dust)


def draw_members(
    cell: int,
    universe: GalaxyModel,
    members: Members,
    lens: Lens | Neighbourhood,
    dust: Float32,
    position_filter: PositionFilter | None = None,
) -> pa.Table:
    """Draw the properties of the galaxies in a cell's halos, and the quasars and galaxies beyond z = 6 in the cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    universe : GalaxyModel
        Model of the galaxies.
    members : Members
        Galaxies in halos whose true positions are in the cell, or a selection of these galaxies.
    lens : Lens or Neighbourhood
        Lensing maps, a uniform shear, or maps with the halos that lens sources in the cell.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag.
    position_filter : callable, optional
        Function that returns True for the true positions (ra, dec) of quasars and galaxies beyond z = 6 to keep. None
        keeps all. `members` are not filtered.

    Returns
    -------
    Table
        Rows of table `galaxies` brighter than the limit, sorted by _healpix_29 (the HEALPix cell of order 29 of the
        observed position).
    """
    seed = universe.population.seed
    drawn, physical = _bright(
        universe, members, select(universe, *_draw_candidates(seed, universe, members), _LINE_MARGIN)
    )
    distance_modulus = universe.population.cosmology.distance_modulus(drawn.z)
    columns = {
        **_position_columns(lens, members, drawn.row, dust),
        "abs_mag_r01": drawn.m_r,
        "mag_r01": drawn.m_r + distance_modulus + band_ratios.offset(universe.reference, drawn.z, drawn.sed),
        "color_gr_01": drawn.colour.colour,
        **physical,
        **band_ratios.columns(drawn.sed),
        **_shape_columns(universe, members, drawn, physical["log_stellar_mass"]),
    }
    rows = [GALAXIES.build(columns)]
    hosts = universe.nuclei.hosts if universe.nuclei else None
    for kind in universe.distant:
        if kind.code == QUASAR and hosts is not None:
            rows.append(high_redshift.draw_in_halos(cell, seed, kind, hosts, lens, dust, position_filter))
            # Only the quasars beyond the halos, at z > 6, have random positions.
            kind = replace(kind, z_end=0.0)
        rows.append(high_redshift.draw(cell, seed, kind, lens, dust, position_filter))
    return sort_rows(lensing.rotate_position_angles(pa.concat_tables(rows), universe.rotation))


def halo_table(cell: int, universe: Population, cells: CellCache) -> pa.Table:
    """Return the rows of table `halos` whose true positions are in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    universe : Population
        Model of the halos.
    cells : CellCache
        Cache of the halos that are already drawn, by HEALPix cell.

    Returns
    -------
    Table
        Rows of table `halos`, sorted by _healpix_29 (the HEALPix cell of order 29 of the position).
    """
    hosts = population.halos_of(cells, cell)
    ra, dec = sky.positions_of_indices(hosts.index)
    z = universe.halos.distances.redshift(hosts.chi)
    return HALOS.build(
        {
            "id": hosts.id,
            "ra": ra,
            "dec": dec,
            "_healpix_29": hosts.index,
            "z_true": z,
            "z_obs": population.observed_redshift(z, hosts.velocity),
            "log_mass": hosts.log_mass,
            "concentration": universe.masses.interpolate_pairs(universe.masses.concentration, z, hosts.log_mass),
        }
    )


def halo_limits(universe: Population) -> pa.Table:
    """Return table `halo_limits`: redshifts, and log10 of the mass (Msun/h) above which table `halos` is complete.

    The last row is at the largest distance of galaxies in `universe`.
    """
    chi = universe.halos.steps.middle
    chi = np.append(chi[chi < universe.halos.max_distance], universe.halos.max_distance)
    return HALO_LIMITS.build(
        {
            "z_true": universe.halos.distances.redshift(chi),
            "log_mass": universe.halos.mass_limit(chi) + universe.halos.host_offset,
        }
    )


def select(
    universe: GalaxyModel, z: Float, m_r: Float, colour: Colour, sed: Sed, deeper: float = 0.0
) -> SelectedGalaxies:
    """Select the galaxies whose continuum is brighter than the limit, and compute the colours of their spectra.

    Parameters
    ----------
    universe : GalaxyModel
        The model with limit and passband.
    z : float array, shape (n,)
        Redshift.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
    colour : Colour
        Drawn colours, which the spectra may not reach exactly.
    sed : Sed
        Spectra of the n galaxies.
    deeper : float
        Galaxies that are fainter than the limit by less than this are also selected, mag.

    Returns
    -------
    SelectedGalaxies
        The selected galaxies, with the colours of their spectra instead of the drawn colours.
    """
    magnitude = apparent_magnitude(universe, z, m_r, sed)
    row = np.flatnonzero(magnitude < universe.limit + deeper)
    selected_sed = sed.select(row)
    realised = replace(colour.select(row), colour=band_ratios.colours(universe.colour, selected_sed))
    return SelectedGalaxies(row, z[row], m_r[row], magnitude[row], realised, selected_sed)


def _bright(
    universe: GalaxyModel, members: Members, drawn: SelectedGalaxies
) -> tuple[SelectedGalaxies, dict[str, Float]]:
    """Return the galaxies whose magnitude with emission lines is brighter than the limit, and some of their columns.

    The columns, by name, are log10 of the stellar mass (Msun) and of the star formation rate (Msun/yr), and the fluxes
    of emission lines (erg s-1 cm-2).
    """
    seed, source_ids, colour = universe.population.seed, members.id[drawn.row], drawn.colour
    cosmology = universe.population.cosmology
    log_mass = stellar_mass.log_stellar_mass(universe.masses, cosmology.h, drawn.m_r, colour.colour, drawn.z)
    main = stellar_mass.main_sequence(universe.star_formation, log_mass, drawn.z)
    rng = PerSourceGenerator(source_ids, seed, "galaxies.star_formation")
    log_sfr = stellar_mass.log_sfr(universe.star_formation, main, colour.sequence, colour.deviate, rng)
    rng = PerSourceGenerator(source_ids, seed, "galaxies.lines")
    fluxes = emission_lines.fluxes(universe.lines, cosmology, drawn.z, log_mass, log_sfr, colour.red, rng)
    if universe.nuclei is not None:
        nuclei = accretion.draw(universe.nuclei.laws, source_ids, seed, drawn.z, log_mass)
        rng = PerSourceGenerator(source_ids, seed, "active_nuclei.lines")
        tables = LineTables(universe.lines.hydrogen, universe.lines.dust)
        added = narrow_lines.fluxes(universe.nuclei.lines, tables, cosmology, nuclei, drawn.z, log_mass, rng)
        fluxes = {name: flux + added[name] for name, flux in fluxes.items()}
    light = emission_lines.mean_line_flux(universe.band, members.z_obs[drawn.row], fluxes)
    is_bright = emission_lines.magnitude_with_light(drawn.magnitude, light) < universe.limit
    columns = {"log_stellar_mass": log_mass, "log_sfr": log_sfr, **fluxes}
    return drawn.select(is_bright), {name: column[is_bright] for name, column in columns.items()}


def apparent_magnitude(universe: GalaxyModel, z: Float, m_r: Float, sed: Sed) -> Float:
    """Return the apparent magnitude without emission lines in the passband of the magnitude limit.

    Parameters
    ----------
    universe : GalaxyModel
        The model with the passband.
    z : float array, shape (n,)
        Redshift.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
    sed : Sed
        Spectra of the n galaxies.

    Returns
    -------
    float array, shape (n,)
        AB magnitude without magnification, and without absorption by intergalactic hydrogen and the Milky Way's dust.

    Notes
    -----
    The error is below 0.001 mag (tests/truesky/catalogue/galaxies/test_band_ratios.py).
    """
    return m_r + universe.population.cosmology.distance_modulus(z) + band_ratios.offset(universe.selection, z, sed)


def _draw_candidates(seed: int, universe: GalaxyModel, members: Members) -> tuple[Float, Float, Colour, Sed]:
    """Return redshift, absolute 0.1r magnitude (h = 1), colour and spectrum of each galaxy in `members`."""
    z, colours, colour_limits = members.z, universe.colours, universe.colour_limits
    m_r = universe.population.halos.matching.magnitude(z, members.proxy)
    satellites = quenching.satellite_share(universe.halo_shares, members)
    share = sequences.red_fraction(colours.fraction, m_r, z, satellites)
    odds = quenching.odds(universe.halo_shares, members, share)
    colour = sequences.draw(
        colours, colour_limits, m_r, z, odds, PerSourceGenerator(members.id, seed, "galaxies.colour")
    )
    if universe.training is not None:
        rng = PerSourceGenerator(members.id, seed, "galaxies.nearest")
        return z, m_r, colour, nearest_sed.assign(universe.training, colour.colour, m_r, z, rng)
    law, ebv = sequences.draw_dust(
        colours, colour_limits, m_r, z, colour, PerSourceGenerator(members.id, seed, "galaxies.dust")
    )
    return z, m_r, colour, band_ratios.sed_of_colour(universe.colour, colour.colour, law, ebv)


def _position_columns(
    lens: Lens | Neighbourhood, members: Members, row: Int, dust: Float32
) -> dict[str, npt.NDArray[np.generic]]:
    places = halo_lensing.columns(lens, members.ra[row], members.dec[row], members.chi[row])
    return {
        "id": members.id[row],
        "halo_id": members.halo_id[row],
        **places,
        "kind": members.kind[row],
        "density_boost": np.ones(row.size),
        "z_true": members.z[row],
        "z_obs": members.z_obs[row],
        "log_halo_mass": members.host_mass[row],
        "a_v": dust_map.a_v(dust, places["ra"], places["dec"]),
    }


def _shape_columns(
    universe: GalaxyModel, members: Members, drawn: SelectedGalaxies, log_mass: Float
) -> dict[str, npt.NDArray[np.generic]]:
    source, seed, shapes = members.id[drawn.row], universe.population.seed, universe.shapes
    scale = universe.population.cosmology.kpc_per_arcsec(drawn.z)
    rng = PerSourceGenerator(source, seed, "galaxies.size")
    radius = morphology.half_light_radius(shapes.size, drawn.z, log_mass, drawn.colour.red, scale, rng)
    rng = PerSourceGenerator(source, seed, "galaxies.bulge")
    fraction = morphology.bulge_fraction(shapes.bulge, log_mass, drawn.colour.red, rng)
    sersic = morphology.sersic_index(shapes.bulge, drawn.colour.red, rng)
    ratio = morphology.radius_ratio(shapes.bulge, drawn.colour.red, rng)
    bulge_radius, disc_radius = morphology.component_radii(shapes, radius, fraction, ratio, sersic)
    colour = morphology.bulge_colour(
        shapes.bulge, source.size, PerSourceGenerator(source, seed, "galaxies.bulge_colour")
    )
    rng = PerSourceGenerator(source, seed, "galaxies.shape")
    disc_ratio = morphology.disc_axis_ratio(shapes, drawn.z.size, rng)
    return {
        "bulge_half_light_radius": bulge_radius,
        "disk_half_light_radius": disc_radius,
        "bulge_fraction": fraction,
        "bulge_color": colour,
        "bulge_sersic_index": sersic,
        "bulge_axis_ratio": morphology.bulge_axis_ratio(shapes, drawn.z.size, rng),
        "disk_axis_ratio": disc_ratio,
        "inclination": morphology.inclination(disc_ratio, shapes.scale_height),
        "position_angle": alignments.position_angles(
            universe.alignments,
            rng.random(drawn.z.size),
            _mean_ellipticities(universe, members, drawn),
            drawn.colour.red,
        ),
    }


def _mean_ellipticities(universe: GalaxyModel, members: Members, drawn: SelectedGalaxies) -> Complex:
    """Return the mean intrinsic ellipticity of each galaxy as a complex number, 0 without an alignment model.

    Central galaxies follow the tidal field, and satellites point to their central galaxy.
    """
    mean, alignment_model = np.zeros(drawn.row.size, complex), universe.alignments
    if alignment_model is None:
        return mean
    is_central = members.kind[drawn.row] == population.CENTRAL
    row, red = drawn.row[is_central], drawn.colour.red[is_central]
    mean[is_central] = alignments.central_ellipticity(
        alignment_model, members.ra[row], members.dec[row], members.chi[row], drawn.m_r[is_central], red
    )
    row, red = drawn.row[~is_central], drawn.colour.red[~is_central]
    direction, separation = alignments.direction_to_cells(members.ra[row], members.dec[row], members.host_index[row])
    radius = universe.population.masses.radius(members.host_mass[row]) / members.chi[row]
    mean[~is_central] = alignments.satellite_ellipticity(alignment_model, direction, separation / radius, red)
    return mean
