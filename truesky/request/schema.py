"""Define the records that contain a checked request."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema.tables import mission as database
from lake_schema.tables import products
from truesky.request.accuracy import Accuracy
from truesky.request.area import Area
from truesky.request.files import Ingest, UserCurves, UserSources
from truesky.request.observations import Observation, Pointing
from truesky.request.structure import Structure

if TYPE_CHECKING:
    from lake_schema.mission.camera_folder import Camera

STATUSES = tuple(code for code, _ in database.STATUSES)
LADDER = database.LADDER
TRUTH_CONTENTS = tuple(code for code, _ in products.CONTENTS if code != "science")
COMPRESSIONS = ("none", "rice")
# Same as in truesky/render/camera/tpv.py (a test compares them).
WCS_CONVENTIONS = ("sip", "tpv")
FILE_LAYOUTS = ("detector", "exposure")
# Readouts of ground cameras, the same as in truesky/render/channels/ground.py (test_readout.py compares them).
READOUTS = ("raw", "amplifiers", "electrons")
# Fields of a request that set the format of images.
IMAGE_OPTIONS = ("compression", "wcs", "readout")
DENSITY_MODELS = ("juric", "besancon")
BOX_CELLS = (192, 256, 384)
LENSING_NSIDES = (64, 128, 256, 512, 1024, 2048)
# Largest reduced shear. Above it, near a critical line, the image of a source is not an ellipse.
MAX_SHEAR = 0.9
# Effects of all rendered channels. This is a copy because requests must not import the renderer; test_effect.py
# compares it with the registry of channels.
EFFECTS = (
    "adc", "amplifiers", "background", "bias_structure", "bleeding", "brighter_fatter", "calibration_lamp",
    "charge_injection", "chromatic_response", "cosmic_rays", "crosstalk", "dark_current", "dark_map",
    "detector_crosstalk", "dispersed_sky", "drift", "edge_displacement", "filter_ghosts", "fringes", "ghosts",
    "group_noise", "hot_pixels", "illumination", "injection_noise", "intra_pixel", "ipc", "lamp_response", "macc",
    "nonlinearity", "output_gain", "parallel_cti", "parallel_loss", "persistence", "pixel_area", "pixel_response",
    "poisson", "quadrants", "ramp", "ramp_cosmic_rays", "ramp_nonlinearity", "read_noise", "readout_cosmic_rays",
    "readout_trail", "reset_level", "satellite_trails", "serial_cti", "serial_loss", "shutter", "signal_adc",
    "signal_nonlinearity", "straylight", "trap_pumping", "tree_rings",
)  # fmt: skip
# Effects without which no image is valid.
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
        Faintest AB magnitude of galaxies, before the Milky Way's dust and intergalactic hydrogen. A shallower or nearer
        request contains the same galaxies as a deeper one up to its limit.
    galaxy_band : str
        Built-in passband of `galaxy_limit`.
    star_limit : float
        Faintest H magnitude of stars (Vega, as observed).
    z_max : float
        Highest redshift.
    box_cells : int
        Cells of 4 Mpc/h along each side of the matter box.
    lensing_nside : int
        HEALPix resolution of the box's lensing maps, which need 5 GB of cache for 1024.
    lensing : (float, float), optional
        Constant reduced shear (g1, g2) of all galaxies instead of the lensing by box and halos. In the frame
        (east, north), g1 > 0 stretches east-west and g2 > 0 from the south-west to the north-east.
    alignment : float
        Strength of the alignment of galaxies with the matter around them, relative to nature; 0 for none.
    rotation : float
        Angle in degrees added to the position angle of every galaxy before lensing.
    high_redshift_boost, quasar_boost : float
        Density of high-redshift galaxies and of quasars relative to nature; 0 for none.
    """

    galaxy_limit: float = 26.0
    galaxy_band: str = "euclid_vis"
    star_limit: float = 26.0
    z_max: float = 6.0
    box_cells: int = 256
    lensing_nside: int = 1024
    lensing: tuple[float, float] | None = None
    alignment: float = 1.0
    rotation: float = 0.0
    high_redshift_boost: float = 1.0
    quasar_boost: float = 1.0


@dataclass(frozen=True, slots=True)
class Stars:
    """Model of the Milky Way's stars.

    Attributes
    ----------
    density : str
        Model of the stellar density, one of `DENSITY_MODELS`.
    brown_dwarf_boost : float
        Density of L and T dwarfs relative to nature; 0 for none.
    tycho2 : tuple of Path
        Files of Tycho-2, which replace the model above the brightness V = 11.
    catalogue : Path, optional
        File of stars that replace the model.
    columns : tuple of (str, str)
        Pairs (column of ours, column of the file) for `catalogue`.
    plane_limit : float, optional
        Faintest H (Vega, as observed) within 5 deg of the Galactic plane and in the bulge. If None, requests there are
        refused.
    bright_limit : float, optional
        Brightest H (Vega, as observed); None for no limit.
    rows_a_file : int
        Expected number of rows above which the file of a cell is split into files of the next HEALPix order.
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
    """Value and unit that replace the value of a mission parameter."""

    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class MissionChoice:
    """Selection of mission parameters.

    Attributes
    ----------
    ladder : tuple of str
        Statuses of parameter values, the preferred first.
    overrides : tuple of (str, Override)
        Parameters with values from the user.
    cameras : tuple of Camera
        The user's cameras.
    """

    ladder: tuple[str, ...] = LADDER
    overrides: tuple[tuple[str, Override], ...] = ()
    cameras: tuple[Camera, ...] = ()


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects that are switched on or off for all scenes."""

    on: tuple[str, ...] = ()
    off: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Request:
    """A checked simulation request.

    Attributes
    ----------
    seed : int
        Seed of all random numbers.
    bands : tuple of str
        Passbands in which fluxes are computed.
    truth : tuple of str
        Truth images, from `TRUTH_CONTENTS`.
    explore : tuple of (str, tuple of str)
        Explored parameters, each with its values as JSON.
    strong_lens_boost : float
        Density of strong lenses relative to nature.
    compression : str
        Compression of integer images, one of `COMPRESSIONS`.
    wcs : str, optional
        Convention for the distortion in headers, one of `WCS_CONVENTIONS`; None for that of the instrument's pipeline.
    files : str
        Whether science images are also stored in one file per exposure, one of `FILE_LAYOUTS`.
    readout : str
        Form of the images of ground cameras, one of `READOUTS`.
    psfs : tuple of (str, str)
        Pairs (band, file) of PSFs that replace the models.
    bodies : Path, optional
        File of moving bodies that replace the simulated ones.
    noise_seed : int, optional
        Seed of everything that differs between exposures of the same sky with the same detectors; None to use `seed`.
    sources : UserSources, optional
        Tables that contain all sources; None for the simulated universe.
    structure : Structure
        Structure of galaxies beyond smooth profiles.
    detectors : tuple of str
        Detectors to render now, () for all. Set on the command line; the plan does not depend on it.
    limit : int, optional
        Largest number of detectors to render now. Set on the command line; the plan does not depend on it.
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
    compression: str = "none"
    wcs: str | None = None
    files: str = "detector"
    readout: str = "raw"
    psfs: tuple[tuple[str, str], ...] = ()
    bodies: Path | None = None
    noise_seed: int | None = None
    sources: UserSources | None = None
    structure: Structure = _SMOOTH
    detectors: tuple[str, ...] = ()
    limit: int | None = None

    def facts(self, *names: str) -> dict[str, Any]:
        """Return the named fields of the request as JSON values, for the key of the products that depend on them."""
        all_values = asdict(self)
        # A camera is identified by the contents of its folder, not by its path.
        all_values["mission"]["cameras"] = {camera.name: camera.sha256 for camera in self.mission.cameras}
        return {name: all_values[name] for name in names}

    def variants(self) -> Iterator[dict[str, Any]]:
        """Yield all combinations of explored parameters as {parameter: value}; a single {} if nothing is explored."""
        names = [name for name, _ in self.explore]
        for values in product(*(choices for _, choices in self.explore)):
            yield {name: json.loads(value) for name, value in zip(names, values, strict=True)}
