"""What a request holds: frozen records."""

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
# As truesky/render/camera/tpv.py (a test compares them).
WCS_CONVENTIONS = ("sip", "tpv")
FILE_LAYOUTS = ("detector", "exposure")
# Of ground cameras (truesky/render/channels/ground.py; test_readout.py compares them).
READOUTS = ("raw", "amplifiers", "electrons")
# Parts of a request that say how images are written.
IMAGE_OPTIONS = ("compression", "wcs", "readout")
DENSITY_MODELS = ("juric", "besancon")
BOX_CELLS = (192, 256, 384)
LENSING_NSIDES = (64, 128, 256, 512, 1024, 2048)
# Largest reduced shear: beyond it, near a critical line, a single source is not a lensed ellipse.
MAX_SHEAR = 0.9
# Of all channels that are rendered. A copy, since requests are read below the renderer (test_effect.py holds it to the
# registry of channels).
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
# What no image is a product without.
ALWAYS_ON = ("adc", "amplifiers", "macc", "quadrants", "ramp", "signal_adc")
_NO_FILES = UserCurves()
_NO_INGEST = Ingest()
_SMOOTH = Structure()


@dataclass(frozen=True, slots=True)
class Universe:
    """How deep and how fine.

    galaxy_limit, galaxy_band : faintest magnitude (AB, before the Milky Way's dust and intergalactic hydrogen), in
                               which of the embedded passbands; a shallower or nearer request has the same galaxies
                               as a deeper one has to its limit
    star_limit               : H (Vega, as observed);  z_max : highest redshift
    box_cells                : cells of 4 Mpc/h a side of the box of matter
    lensing_nside            : HEALPix resolution of the box's lensing maps: 5 GB of the cache for 1024
    lensing                  : (g1, g2), a constant reduced shear of all galaxies in place of box and halos, in the
                               frame (east, north): g1 > 0 stretches east-west, g2 > 0 from the south-west to the
                               north-east; None = the box's
    alignment                : how many times more strongly than in nature galaxies are aligned with the matter about
                               them, 0 = not at all
    rotation                 : deg, added to the position angle of every galaxy, before lensing
    high_redshift_boost, quasar_boost : how many times denser than in nature these kinds are drawn, 0 = not at all
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
    """How the Milky Way's stars are drawn.

    density           : whose laws of density
    brown_dwarf_boost : how many times denser than in nature L and T dwarfs are drawn, 0 = not at all
    tycho2            : files of Tycho-2, which replace the model brighter than V = 11
    catalogue         : file of other stars to be taken instead of the model's; columns: (ours, theirs)
    bright_limit      : brightest H (Vega, as observed) that is drawn; None = all
    plane_limit       : faintest H (Vega, as observed) within 5 deg of the plane and at the bulge; None = refused there
    rows_a_file       : above so many expected rows a cell's file is split into those of the next HEALPix order
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
    """A value that replaces what the mission's ladder would choose."""

    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class MissionChoice:
    """Which statuses of the mission's parameters are preferred, what is overridden, and the user's own cameras."""

    ladder: tuple[str, ...] = LADDER
    overrides: tuple[tuple[str, Override], ...] = ()
    cameras: tuple[Camera, ...] = ()


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects that are forced on or off, whatever a scene needs."""

    on: tuple[str, ...] = ()
    off: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Request:
    """A simulation request, checked.

    explore : parameter -> the values (JSON) that it takes in turn
    psfs    : (band, file) of PSFs in place of ours
    files   : what has a file of its own, one of FILES
    wcs     : how headers tell the distortion of the optics, one of CONVENTIONS; None = as the instrument's pipeline
    readout : how files of ground cameras are wanted, one of READOUTS
    bodies  : file of moving bodies in place of ours
    sources : the only sources that there are, in place of the universe
    structure : what galaxies have beside their profiles
    noise_seed : of all that differs between exposures of the same sky with the same detectors; None = the seed
    detectors, limit : of a plan, the detectors that are to be rendered now, () = all; and how many at most.  A
              command line gives them, and the plan is the same without
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
        """The named parts of the request as JSON values, for the key of what depends on them."""
        all_values = asdict(self)
        # Not where a camera's folder lies, but what it holds.
        all_values["mission"]["cameras"] = {camera.name: camera.sha256 for camera in self.mission.cameras}
        return {name: all_values[name] for name in names}

    def variants(self) -> Iterator[dict[str, Any]]:
        """The product of what is explored: parameter -> value; one empty variant where nothing is."""
        names = [name for name, _ in self.explore]
        for values in product(*(choices for _, choices in self.explore)):
            yield {name: json.loads(value) for name, value in zip(names, values, strict=True)}
