"""Define the records that contain a checked request, the TOML file in which a user describes a simulation."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema.tables import mission as database
from lake_schema.tables import products
from truesky.cosmology import FIDUCIAL, Cosmology
from truesky.request.accuracy import Accuracy
from truesky.request.area import Area
from truesky.request.exposures.observations import Observation
from truesky.request.exposures.pointings import Pointing
from truesky.request.files import Ingest, UserCurves, UserSources
from truesky.request.structure import Structure
from truesky.request.transients import Transients

if TYPE_CHECKING:
    from lake_schema.mission.camera_folder import Camera

STATUSES = tuple(code for code, _ in database.STATUSES)
LADDER = database.LADDER
TRUTH_CONTENTS = tuple(code for code, _ in products.CONTENTS if code != "science")
COMPRESSIONS = ("none", "rice")
# Conventions for distortion in FITS headers. This copies truesky/render/camera/tpv.py; a test compares the two.
WCS_CONVENTIONS = ("sip", "tpv")
FILE_LAYOUTS = ("detector", "exposure")
# Conventions for the names and headers of files of whole exposures.
FILE_NAMES = ("truesky", "euclid")
# Forms of the images of ground cameras. This copies truesky/render/channels/ground.py; test_readout.py compares them.
READOUTS = ("raw", "amplifiers", "electrons")
# Names of the fields of `Request` that set the format of image files.
IMAGE_OPTIONS = ("compression", "wcs", "readout")
DENSITY_MODELS = ("juric", "besancon")
BOX_CELLS = (192, 256, 384)
LENSING_NSIDES = (64, 128, 256, 512, 1024, 2048)
# Largest constant reduced shear of a request. Above it, near a critical line, the image of a source is not an ellipse.
MAX_SHEAR = 0.9
# Names of all instrument effects that a request may switch. This copies the registry of channels, because requests must
# not import the renderer; test_effect.py compares the two.
EFFECTS = (
    "adc", "amplifiers", "background", "bias_drift", "bias_structure", "bleeding", "brighter_fatter",
    "calibration_lamp", "charge_injection", "chromatic_response", "cosmic_rays", "crosstalk", "dark_current",
    "dark_map", "detector_crosstalk", "dispersed_sky", "drift", "edge_displacement", "filter_ghosts", "fringes",
    "ghosts", "group_noise", "hot_pixels", "illumination", "injection_noise", "intra_pixel", "ipc", "lamp_response",
    "lens_ghosts", "macc", "nonlinearity", "output_gain", "parallel_cti", "parallel_loss", "persistence",
    "pixel_area", "pixel_response", "poisson", "quadrants", "ramp", "ramp_cosmic_rays", "ramp_nonlinearity",
    "read_noise", "readout_cosmic_rays", "readout_trail", "reset_level", "row_noise", "satellite_trails", "serial_cti",
    "serial_loss", "shutter", "signal_adc", "signal_nonlinearity", "straylight", "trap_pumping", "tree_rings",
)  # fmt: skip
# Effects that "all" in `effects.off` does not switch off, because no image is valid without them.
ALWAYS_ON = ("adc", "amplifiers", "macc", "quadrants", "ramp", "signal_adc")
_NO_FILES = UserCurves()
_NO_INGEST = Ingest()
_SMOOTH = Structure()


@dataclass(frozen=True, slots=True)
class Universe:
    """Depth and resolution of the simulated universe.

    Attributes
    ----------
    galaxy_limit : float
        Faintest AB magnitude of galaxies, before absorption by the Milky Way's dust and intergalactic hydrogen. If two
        requests differ only in their limit, the deeper one contains all galaxies of the other.
    galaxy_band : str
        Name of the built-in passband in which `galaxy_limit` is a magnitude.
    star_limit : float
        Faintest H magnitude of stars (Vega, as observed).
    z_max : float
        Highest redshift of galaxies and quasars below z = 6. Those beyond z = 6 do not depend on it.
    box_cells : int
        Number of cells of 4 Mpc/h along each side of the periodic box with the simulated matter density.
    structure_below_cells : bool
        True if the density of halos has structure on scales below the cells of the box, which increases the clustering
        of galaxies below 4 Mpc/h, and if the matter around halos lenses. False for random positions below this scale.
        Halos from a file do not depend on it, and the matter around them does not lens.
    lensing_nside : int
        HEALPix N_side of the lensing maps computed from the matter box. Maps with 1024 need 4.8 GB in the cache on
        disc. A request without this key has the value of truesky/request/lensing_resolution.py.
    lensing : (float, float), optional
        Constant reduced shear (g1, g2) of all galaxies. In the frame (east, north), g1 > 0 stretches east-west and
        g2 > 0 from the south-west to the north-east. None for lensing by the matter box and halos.
    alignment : float
        Strength of the intrinsic alignment of galaxies with the matter around them, relative to nature; 0 for none.
    rotation : float
        Angle in degrees added to the position angle of every galaxy before lensing.
    high_redshift_boost, quasar_boost : float
        Number density of high-redshift galaxies, and of quasars, relative to nature; 0 for none.
    cosmology : Cosmology
        Parameters of the cosmology.
    variables : bool
        True for variable stars and active nuclei. The table `stars` then has the columns of light curves, quasars are
        in halos, and active galaxies have narrow lines.
    """

    galaxy_limit: float = 26.0
    galaxy_band: str = "euclid_vis"
    star_limit: float = 26.0
    z_max: float = 6.0
    box_cells: int = 256
    structure_below_cells: bool = True
    lensing_nside: int = 1024
    lensing: tuple[float, float] | None = None
    alignment: float = 1.0
    rotation: float = 0.0
    high_redshift_boost: float = 1.0
    quasar_boost: float = 1.0
    cosmology: Cosmology = FIDUCIAL
    variables: bool = False


@dataclass(frozen=True, slots=True)
class Stars:
    """Model of the Milky Way's stars.

    Attributes
    ----------
    density : str
        Model of the stellar density, one of `DENSITY_MODELS`.
    brown_dwarf_boost : float
        Number density of L and T dwarfs relative to nature; 0 for none.
    tycho2 : tuple of Path
        Files of the Tycho-2 catalogue, whose stars replace those of the model brighter than V = 11. () for none.
    catalogue : Path, optional
        File with stars that replace all stars of the model; None to use the model.
    columns : tuple of (str, str)
        Pairs (column of the table `stars`, column of the file) for `catalogue`.
    plane_limit : float, optional
        Faintest H (Vega, as observed) of stars within 5 deg of the Galactic plane and in the bulge. If None, areas
        there are refused.
    bright_limit : float, optional
        Brightest H (Vega, as observed) of stars; None for no limit.
    rows_a_file : int
        Largest expected number of stars in a file of the table `stars`. The file of a HEALPix cell with more stars is
        split into files of smaller cells, down to order 8.
    """

    density: str = "juric"
    brown_dwarf_boost: float = 1.0
    tycho2: tuple[Path, ...] = ()
    catalogue: Path | None = None
    columns: tuple[tuple[str, str], ...] = ()
    plane_limit: float | None = None
    bright_limit: float | None = None
    rows_a_file: int = 1_000_000


@dataclass(frozen=True, slots=True)
class Override:
    """A user's value and unit, which replace the value of a parameter in the mission database."""

    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class MissionChoice:
    """Selection of values of the mission parameters, which describe the instruments and the survey.

    The mission database may have several values of a parameter, each with a status.

    Attributes
    ----------
    ladder : tuple of str
        Statuses of parameter values in order of preference, such as "CBE" (current best estimate), "REQ" (required).
    overrides : tuple of (str, Override)
        Names of parameters with their values from the user.
    cameras : tuple of Camera
        Ground cameras that the user has defined.
    """

    ladder: tuple[str, ...] = LADDER
    overrides: tuple[tuple[str, Override], ...] = ()
    cameras: tuple[Camera, ...] = ()


@dataclass(frozen=True, slots=True)
class Effects:
    """Names of instrument effects that are switched on or off for all images.

    `on` has the effects that are applied to all images, `off` those that are applied to none. An effect in neither of
    them is applied to an image if it changes a pixel noticeably.
    """

    on: tuple[str, ...] = ()
    off: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Request:
    """A checked simulation request, with all keys of the user's file.

    Attributes
    ----------
    name : str
        Name of the request.
    seed : int
        Seed of all random numbers.
    accuracy : Accuracy
        Largest errors of fluxes, shapes, positions and pixels.
    area : Area
        Area of the sky.
    universe : Universe
        Depth and resolution of the simulated universe.
    stars : Stars
        Model of the stars.
    mission : MissionChoice
        Selection of the parameters of instruments and survey.
    bands : tuple of str
        Passbands in which fluxes are computed.
    pointings : tuple of Pointing
        Single exposures.
    truth : tuple of str
        Additional images with one component of the truth each, such as the image without noise; from `TRUTH_CONTENTS`.
    curves : UserCurves
        User files of spectra, extinction laws and passbands.
    observations : tuple of Observation
        Blocks of exposures that the planner schedules.
    effects : Effects
        Instrument effects that are switched on or off.
    explore : tuple of (str, tuple of str)
        Parameters that take several values, each with its values as JSON texts. All combinations are rendered.
    ingest : Ingest
        User catalogues and maps that replace simulated ones.
    strong_lens_boost : float
        Number density of strong lenses relative to nature.
    transients : Transients, optional
        Supernovae that explode during a window of time; None for none.
    compression : str
        Compression of integer images, one of `COMPRESSIONS`.
    wcs : str, optional
        Convention for distortion in FITS headers, one of `WCS_CONVENTIONS`; None for that of the instrument's pipeline.
    files : str
        "exposure" if science images are also stored in one file per exposure, "detector" if not.
    file_names : str
        Convention for names and headers of files of whole exposures, one of `FILE_NAMES`.
    readout : str
        Form of the images of ground cameras, one of `READOUTS`.
    psfs : tuple of (str, str)
        Pairs (band, file) of PSFs that replace the models.
    bodies : Path, optional
        File of moving bodies of the solar system that replace the simulated ones.
    noise_seed : int, optional
        Seed of everything that differs between exposures of the same sky with the same detectors; None to use `seed`.
    sources : UserSources, optional
        Tables that contain all sources; None for the simulated universe.
    structure : Structure
        Spiral arms, knots and images of galaxies, in place of smooth profiles.
    detectors : tuple of str
        Detectors to render now, () for all. Set on the command line; the list of planned images does not depend on it.
    limit : int, optional
        Largest number of detectors to render now, None for all. Set on the command line; the list of planned images
        does not depend on it.
    density : float
        Number of random points per arcmin2. Set on the command line.
    band : tuple of str
        Passbands whose areas the random points cover, () for the only one. Set on the command line.
    magnitude : float, optional
        AB magnitude of the galaxies whose detection random points contain. Set on the command line.
    model : tuple of str
        Files of models of detection and measurement. Set on the command line.
    extrapolate : bool
        True to use models outside their range of depths. Set on the command line of `truesky emulate`.
    """

    name: str
    seed: int
    accuracy: Accuracy
    area: Area
    universe: Universe
    stars: Stars
    mission: MissionChoice
    bands: tuple[str, ...]
    pointings: tuple[Pointing, ...]
    truth: tuple[str, ...]
    curves: UserCurves = _NO_FILES
    observations: tuple[Observation, ...] = ()
    effects: Effects = Effects()
    explore: tuple[tuple[str, tuple[str, ...]], ...] = ()
    ingest: Ingest = _NO_INGEST
    strong_lens_boost: float = 1.0
    transients: Transients | None = None
    compression: str = "none"
    wcs: str | None = None
    files: str = "detector"
    file_names: str = "truesky"
    readout: str = "raw"
    psfs: tuple[tuple[str, str], ...] = ()
    bodies: Path | None = None
    noise_seed: int | None = None
    sources: UserSources | None = None
    structure: Structure = _SMOOTH
    detectors: tuple[str, ...] = ()
    limit: int | None = None
    density: float = 30.0
    band: tuple[str, ...] = ()
    magnitude: float | None = None
    model: tuple[str, ...] = ()
    extrapolate: bool = False

    def facts(self, *names: str) -> dict[str, Any]:
        """Return the named fields of the request as JSON values, from which hashes of tables and images are computed.

        Raises KeyError if there is no such field.
        """
        all_values = asdict(self)
        # Without variable sources, the facts must be as before this key existed, so that hashes do not change.
        if not self.universe.variables:
            del all_values["universe"]["variables"]
        # A camera is identified by the contents of its folder, not by its path.
        all_values["mission"]["cameras"] = {camera.name: camera.sha256 for camera in self.mission.cameras}
        return {name: all_values[name] for name in names}

    def variants(self) -> Iterator[dict[str, Any]]:
        """Yield all combinations of values in `explore` as {parameter: value}; a single {} if `explore` is empty."""
        names = [name for name, _ in self.explore]
        for values in product(*(choices for _, choices in self.explore)):
            yield {name: json.loads(value) for name, value in zip(names, values, strict=True)}
