"""Trace Rubin, DECam and HSC with batoid, and write their wavefronts and ghosts to lake_schema/mission/models.

    python -m scripts.trace_optics [--only wavefronts|ghosts|checks]

The package batoid (0.9 from PyPI, not a dependency of truesky) has the optical prescriptions: of Rubin as built (3.14),
one for each band, and of DECam and HSC. Each band is focused: the detector is moved along the optical axis until the
wavefront error, averaged over the field, is smallest. The checks are wavefronts, rays and positions at other places of
the field, with which tests compare the tables; then the coefficients of the distortion are printed, too.

Axes. A star in the direction s moves light along -s, and batoid's field angle is the direction of the light. The focal
plane of truesky is seen as on the sky, with the x axis to the right of the y axis; batoid's z axis points to the sky.
Hence the position (x, y) in the focal plane is batoid's field angle (x, -y), and the point (x, y) of the pupil is
batoid's (-x, y). The wavefront is the path that light has travelled too far, in nm, so that an image moves against the
slope of the wavefront. The camera's rotator is at 0.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import lake_schema  # noqa: F401  (restricts numpy, imported later, to common CPU instructions)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration, resolve
from truesky.fluxes import passbands
from truesky.render.camera.detectors import detectors
from truesky.render.psf.aberrations import Telescope

_TESTS = Path(__file__).resolve().parents[1] / "tests" / "truesky" / "render"
MODELS = Path(__file__).resolve().parents[1] / "lake_schema" / "mission" / "models"
# Highest Noll number of the tables.
NOLL = 22
# Number of rays along the diameter of the pupil.
_RAYS = 65
# Weight of the parts of the pupil through which no light passes: the wavefront there is kept small, since images are
# drawn with the whole pupil.
_RIDGE = 0.03
# Beyond the distance from the axis at which less than this fraction of the pupil is lit, the wavefront is that at this
# distance.
_LEAST_LIT = 0.6
# Degree of the polynomials in the field.
_DEGREE = {"lsstcam": 9, "decam": 9, "hsc": 11}
# Coefficients below this (nm) are left out.
_SMALLEST = 0.2
# Weight, in the fit of polynomials, of places in vignetted parts of the field.
_OUTSIDE = 0.1
# Number of rings of the field, and of places on the outermost ring.
_RINGS, _PLACES = 12, 32
# Distances from the axis, relative to the edge of the field without vignetting, at which ghosts are traced.
GHOST_PLACES = (0.0, 0.25, 0.5, 0.75, 1.0)
# Ghosts with a radius above this (mm) are left out: they are too faint to be seen.
_WIDEST = 60.0
# Number of places in each band for which tests have traced values.
_CHECKED = 8
# Number of ghosts of a camera in a band, the brightest ones.
_GHOSTS = 10
_WAVEFRONT_HEADER = """\
# Wavefront of {camera} in the band {band} ({wavelength:.0f} nm): a polynomial in (x, y), 0 in the middle and \
at a distance of 1 at
# the farthest corner of its detectors, for each Zernike mode (Noll index, circle with the radius of the aperture), \
nm rms.
# Written by scripts/trace_optics.py with batoid 0.9, prescription {file}. Do not edit.
"""
_GHOST_HEADER = """\
# Ghosts of {camera}: light reflected at the surface `first` and then at `second`. Rows: distance of the star \
from the axis,
# relative to the farthest corner. centre: position of the ghost over that of the star. radius_mm: outer \
radius in the focal
# plane; the inner one is that of the pupil. passed: fraction of the star's light that no edge stops, \
before reflectances.
# Written by scripts/trace_optics.py with batoid 0.9, prescriptions {file}. Do not edit.
"""


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera with batoid's prescription.

    Attributes
    ----------
    name : str
        Name of the camera in the mission database.
    file : str
        File of the prescription, in which {} stands for the last letter of the band.
    detector : str
        Name of the detector's surface in the prescription.
    bands : tuple of str
        Bands of the mission database. The first has the table that is used for other bands.
    """

    name: str
    file: str
    detector: str
    bands: tuple[str, ...]


CAMERAS = (
    Camera("lsstcam", "Rubin_v3.14_{}.yaml", "Detector", tuple(f"lsst_{band}" for band in "rugizy")),
    Camera("decam", "DECam.yaml", "D", tuple(f"des_{band}" for band in "rgiz")),
    Camera("hsc", "HSC.yaml", "D", ("hsc_g", "hsc_z")),
)


@dataclass(frozen=True, slots=True)
class Optics:
    """A telescope in a band, and the wavelength and pupil with which it is traced.

    Attributes
    ----------
    optic : batoid.Optic
        The telescope.
    wavelength : float
        Wavelength, m.
    radius, inner : float
        Outer and inner radius of the pupil, m.
    """

    optic: Any
    wavelength: float
    radius: float
    inner: float

    def rays(self, x: float, y: float, n: int = _RAYS) -> tuple[Any, Float, Float]:
        """Return the rays of a star at the field angle (x, y), rad, and their places in the pupil, m."""
        import batoid

        cosines = batoid.utils.fieldToDirCos(x, -y, projection="gnomonic")
        rays = batoid.RayVector.asGrid(
            optic=self.optic, wavelength=self.wavelength, nx=n, lx=2.0 * self.radius, dirCos=cosines
        )
        pupil = rays.copy().toCoordSys(self.optic.stopSurface.coordSys)
        self.optic.stopSurface.surface.intersect(pupil)
        return rays, -pupil.x, np.array(pupil.y)

    def chief(self, x: float, y: float) -> Float:
        """Return the position (mm) of the chief ray in the focal plane, relative to that of the axis."""
        places = []
        for angle in ((x, y), (0.0, 0.0)):
            rays, _, _ = self.rays(*angle, 3)
            self.optic.trace(rays)
            places.append(np.array([rays.x[4], rays.y[4]]))
        return np.asarray(1e3 * (places[0] - places[1]))

    def lit(self, x: float, y: float) -> float:
        """Return the fraction of the pupil through which light of the field angle (x, y), rad, arrives."""
        rays, across, along = self.rays(x, y)
        self.optic.trace(rays)
        r = np.hypot(across, along)
        ring = (r <= self.radius) & (r >= self.inner)
        return float((~rays.vignetted & ~rays.failed)[ring].mean())

    def zernikes(self, x: float, y: float) -> Float:
        """Return Zernike coefficients (nm rms; the index is the Noll number) at the field angle (x, y), rad."""
        import batoid
        import galsim

        rays, across, along = self.rays(x, y)
        middle = (_RAYS * _RAYS - 1) // 2
        self.optic.trace(rays)
        sphere = rays.coordSys.shiftLocal(rays.r[middle] + np.array([0.0, 0.0, self.optic.sphereRadius]))
        rays.toCoordSys(sphere)
        batoid.Sphere(-self.optic.sphereRadius).intersect(rays)
        path = 1e9 * (rays.t - rays.t[middle])
        r = np.hypot(across, along)
        ring = (r <= self.radius) & (r >= self.inner)
        lit = ring & ~rays.vignetted & ~rays.failed
        bright, dark = (
            galsim.zernike.zernikeBasis(NOLL, across[part], along[part], R_outer=self.radius)[1:].T
            for part in (lit, ring & ~lit)
        )
        # The mean and the tilts are free in the dark.
        dark[:, :3] = 0.0
        design = np.concatenate([bright, np.sqrt(_RIDGE) * dark])
        target = np.concatenate([path[lit], np.zeros(len(dark))])
        coefficients = np.linalg.lstsq(design, target, rcond=None)[0]
        return np.concatenate([[0.0], coefficients])


def load_optics(camera: Camera, band: str, mission: MissionConfiguration) -> Optics:
    """Return a camera's telescope in a band, as batoid prescribes it, and with the pupil of the mission database."""
    import batoid

    file = camera.file.format(band[-1])
    curve = passbands.load(band)
    photons = curve.response / curve.wavelength
    wavelength = 1e-10 * float((photons * curve.wavelength).sum() / photons.sum())
    pupil = Telescope.from_mission(f"ext.{camera.name}", mission)
    return Optics(batoid.Optic.fromYaml(file), wavelength, pupil.radius, pupil.inner)


def plate_scale(camera: Camera, mission: MissionConfiguration) -> float:
    """Return the scale of a camera at the axis, arcsec per mm."""
    scale, size = (mission.value(f"ext.{camera.name}.fpa.pixel_{key}") for key in ("scale", "size"))
    return scale / (1e-3 * size)


def field_reach(camera: Camera, mission: MissionConfiguration) -> float:
    """Return the distance from the axis to the farthest corner of a detector, mm."""
    all_detectors = detectors(camera.name, mission)
    reach = max(np.hypot(abs(d.x), abs(d.y)) + d.half_diagonal for d in all_detectors)
    return float(reach / plate_scale(camera, mission))


def field_places(camera: Camera, optics: Optics, mission: MissionConfiguration) -> tuple[Float, Float]:
    """Return field angles (rad) on rings over the field, and the places [n, 2] there as the tables count them."""
    reach, plate = field_reach(camera, mission), plate_scale(camera, mission)
    angles = []
    for ring in range(_RINGS + 1):
        count = max(6 * round(ring * _PLACES / _RINGS / 6), 1)
        turn = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        # The rings are closer to each other near the edge, as the nodes of a polynomial should be.
        distance = np.sin(0.5 * np.pi * ring / _RINGS)
        angles += [(distance * np.cos(t), distance * np.sin(t)) for t in turn]
    corner = np.radians(reach * plate / 3600.0)
    for _ in range(3):
        corner *= reach / np.hypot(*optics.chief(corner, 0.0))
    angle = np.array(angles) * corner
    return angle, place_of(angle, optics, reach)


def place_of(angle: Float, optics: Optics, reach: float) -> Float:
    """Return the places in the focal plane of field angles [n, 2], rad, relative to the distance `reach`, mm."""
    distance = np.array([np.hypot(*optics.chief(*value)) for value in angle]) / reach
    turn = np.arctan2(angle[:, 1], angle[:, 0])
    return np.stack([distance * np.cos(turn), distance * np.sin(turn)], axis=1)


def clear_angles(optics: Optics, angle: Float) -> Float:
    """Return field angles [n, 2] of which those in vignetted parts of the field are moved to the border of these."""
    distance = np.hypot(*angle.T)
    steps = distance.max() * np.linspace(1.0, 0.7, 31)
    limit = next((value for value in steps if optics.lit(value, 0.0) >= _LEAST_LIT), steps[-1])
    return np.asarray(angle * np.minimum(1.0, limit / np.maximum(distance, 1e-12))[:, None])


def move_to_focus(camera: Camera, optics: Optics, angle: Float) -> Optics:
    """Return the telescope with the detector where the mean square of the wavefront over field angles is smallest."""
    import galsim

    axis = np.linspace(-1.0, 1.0, 81)
    x, y = (value.ravel() for value in np.meshgrid(axis, axis))
    ring = (np.hypot(x, y) <= 1.0) & (np.hypot(x, y) >= optics.inner / optics.radius)
    basis = galsim.zernike.zernikeBasis(NOLL, x[ring], y[ring])
    basis[:4] = 0.0
    # The rings are closer to each other near the edge; the weight makes them equal in area.
    distance = np.hypot(*angle.T) / np.hypot(*angle.T).max()
    weight = np.sqrt(np.maximum(1.0 - distance**2, 0.0))[:, None]
    step = 1e-5

    def fronts(shift: float) -> Float:
        moved = Optics(optics.optic.withLocallyShiftedOptic(camera.detector, [0.0, 0.0, shift]), *_rest(optics))
        front = np.array([moved.zernikes(*value) for value in angle]) @ basis
        return np.asarray(front - front.mean(axis=1, keepdims=True)) * weight

    still, slope = fronts(0.0), (fronts(step) - fronts(-step)) / (2.0 * step)
    shift = -float((still * slope).sum() / (slope * slope).sum())
    print(f"{camera.name}: detector moved by {1e6 * shift:.1f} um", file=sys.stderr)
    return Optics(optics.optic.withLocallyShiftedOptic(camera.detector, [0.0, 0.0, shift]), *_rest(optics))


def _rest(optics: Optics) -> tuple[float, float, float]:
    return optics.wavelength, optics.radius, optics.inner


def fit_field(place: Float, values: Float, weight: Float, degree: int) -> list[tuple[int, int, int, float]]:
    """Fit a polynomial in the places [n, 2], with weights [n], to coefficients [n, noll].

    Return the Noll number, the powers of x and y, and the coefficient (nm) of each term.
    """
    powers = [(k - j, j) for k in range(degree + 1) for j in range(k + 1)]
    basis = np.stack([place[:, 0] ** i * place[:, 1] ** j for i, j in powers], axis=1)
    coefficients = np.linalg.lstsq(weight[:, None] * basis, weight[:, None] * values, rcond=None)[0]
    error = np.sqrt((((basis @ coefficients) - values)[weight == 1.0, 4:] ** 2).sum(axis=1))
    print(f"  fit: rms {np.sqrt((error**2).mean()):.1f} nm, worst {error.max():.1f} nm", file=sys.stderr)
    return [
        (noll, i, j, float(coefficients[k, noll]))
        for noll in range(4, NOLL + 1)
        for k, (i, j) in enumerate(powers)
        if abs(coefficients[k, noll]) >= _SMALLEST
    ]


def wavefront_file(camera: Camera, band: str) -> Path:
    """Return the table of the wavefront of a camera in a band."""
    return MODELS / f"wavefront_{camera.name}_{band.split('_')[-1]}.csv"


def write_wavefronts(camera: Camera, mission: MissionConfiguration) -> None:
    """Write the tables of the wavefront of a camera in all its bands."""
    for band in camera.bands:
        optics = load_optics(camera, band, mission)
        angle, place = field_places(camera, optics, mission)
        lit = clear_angles(optics, angle)
        optics = move_to_focus(camera, optics, lit[::4])
        values = np.array([optics.zernikes(*value) for value in lit])
        weight = np.where((lit == angle).all(axis=1), 1.0, _OUTSIDE)
        header = _WAVEFRONT_HEADER.format(
            camera=camera.name, band=band, wavelength=1e9 * optics.wavelength, file=camera.file.format(band[-1])
        )
        lines = [
            f"{noll},{i},{j},{nm:.1f}" for noll, i, j, nm in fit_field(place, values, weight, _DEGREE[camera.name])
        ]
        text = header + "\n".join(["noll,x_power,y_power,coefficient_nm", *lines]) + "\n"
        wavefront_file(camera, band).write_text(text, encoding="utf-8")


def surfaces(optic: Any) -> list[str]:
    """Return the names of the mirrors, of the surfaces of glass, and of the detector, in the order of the light."""
    surface_names = []
    for item in optic.items:
        if hasattr(item, "items"):
            surface_names += surfaces(item)
        elif type(item).__name__ in ("Mirror", "RefractiveInterface", "Detector"):
            surface_names.append(item.name)
    return surface_names


def trace_ghost(optics: Optics, path: list[str], x: float) -> tuple[float, float, float]:
    """Trace a ghost of a star at the field angle (x, 0), rad, by the names of the surfaces that its light passes.

    Returns
    -------
    (float, float, float)
        Position of the ghost over that of the star; outer radius, mm; fraction of the star's light in the ghost.
    """
    star, across, along = optics.rays(x, 0.0)
    ghost = star.copy()
    optics.optic.trace(star)
    optics.optic.trace(ghost, path=path)
    r = np.hypot(across, along)
    ring = (r <= optics.radius) & (r >= optics.inner)
    direct, arrived = (ring & ~rays.vignetted & ~rays.failed for rays in (star, ghost))
    arrived &= direct & np.isfinite(ghost.x) & np.isfinite(ghost.y)
    if arrived.sum() < 50:
        return 1.0, np.inf, 0.0
    basis = np.stack([np.ones(arrived.sum()), across[arrived], along[arrived]], axis=1)
    place = np.stack([ghost.x[arrived], ghost.y[arrived]], axis=1)
    fit = np.linalg.lstsq(basis, place, rcond=None)[0]
    middle = (_RAYS * _RAYS - 1) // 2
    at = np.array([star.x[middle], star.y[middle]])
    radius = 1e3 * optics.radius * float(np.sqrt(abs(np.linalg.det(fit[1:]))))
    return float(fit[0] @ at / (at @ at)), radius, float(arrived.sum() / direct.sum())


def find_ghosts(camera: Camera, band: str, mission: MissionConfiguration) -> list[tuple[str, ...]]:
    """Return the rows of the table of the brightest ghosts of a camera in a band."""
    optics = load_optics(camera, band, mission)
    angle, _ = field_places(camera, optics, mission)
    corner = float(np.hypot(*clear_angles(optics, angle).T).max())
    places = [corner * max(place, 0.02) for place in GHOST_PLACES]
    distances = np.hypot(
        *place_of(np.array([(value, 0.0) for value in places]), optics, field_reach(camera, mission)).T
    )
    names = surfaces(optics.optic)
    glass = [i for i, name in enumerate(names) if name not in ("M1", "M2", "M3", "PM")]
    candidates = []
    for j in glass:
        for i in glass:
            if i < j:
                path = [*names[: j + 1], *names[i:j][::-1], *names[i + 1 :]]
                # Nominal reflectances, by which the brightest ghosts are chosen.
                bright = 0.1 if j == len(names) - 1 else 0.01
                _, radius, passed = trace_ghost(optics, path, places[2])
                if radius < _WIDEST:
                    candidates.append((bright * passed / radius**2, i, j, path))
    candidates.sort(reverse=True)
    rows = []
    for _, i, j, path in candidates[:_GHOSTS]:
        first, last = "detector" if j == len(names) - 1 else names[j], (1.0, 1.0)
        for distance, place in zip(distances, places, strict=True):
            centre, radius, passed = trace_ghost(optics, path, place)
            # If no light arrives, take the geometry of the nearest place with light.
            last = (centre, radius) if passed else last
            numbers = f"{last[0]:.4f}", f"{last[1]:.3f}", f"{passed:.3f}"
            rows.append((band, first, names[i], f"{distance:.4f}", *numbers))
    return rows


def write_ghosts(camera: Camera, mission: MissionConfiguration) -> None:
    """Write the table of the ghosts of a camera in all its bands."""
    files = ", ".join(sorted({camera.file.format(band[-1]) for band in camera.bands}))
    columns = "band,first,second,distance,centre,radius_mm,passed"
    lines = [",".join(row) for band in camera.bands for row in find_ghosts(camera, band, mission)]
    text = _GHOST_HEADER.format(camera=camera.name, file=files) + "\n".join([columns, *lines]) + "\n"
    (MODELS / f"ghosts_{camera.name}.csv").write_text(text, encoding="utf-8")


def fit_distortion(camera: Camera, mission: MissionConfiguration) -> None:
    """Print the coefficients of a radial distortion, of the powers 2, 4 and 6 of the distance (mm) from the axis."""
    band = camera.bands[0]
    optics = load_optics(camera, band, mission)
    angle, _ = field_places(camera, optics, mission)
    edge = float(np.hypot(*clear_angles(optics, angle).T).max())
    x = edge * np.sqrt(np.linspace(0.001, 1.0, 60))
    distance = np.array([np.hypot(*optics.chief(value, 0.0)) for value in x])
    basis = np.stack([distance ** (1 + power) for power in (0, 2, 4, 6)], axis=1)
    size = basis.max(axis=0)
    coefficients = np.linalg.lstsq(basis / size, x, rcond=None)[0] / size
    error = np.abs(basis @ coefficients - x).max() * 206264.8
    ratios = ", ".join(f"{value / coefficients[0]:.4e}" for value in coefficients[1:])
    print(f"{camera.name}: {206264.8 * coefficients[0]:.5f} arcsec/mm, within {error:.4f} arcsec")
    print(f"  {ratios} per mm^2, mm^4, mm^6")


def check_tables(camera: Camera, mission: MissionConfiguration) -> tuple[list[str], list[str], list[str]]:
    """Return lines of the tables with which tests compare: wavefronts, displacements of rays, and distortion."""
    reach, rng = field_reach(camera, mission), np.random.default_rng(7)
    fronts, rays, places = [], [], []
    for band in camera.bands:
        optics = load_optics(camera, band, mission)
        angle, _ = field_places(camera, optics, mission)
        lit = clear_angles(optics, angle)
        optics = move_to_focus(camera, optics, lit[::4])
        edge = 0.9 * np.hypot(*lit.T).max()
        distance, turn = edge * np.sqrt(rng.random(_CHECKED)), 2.0 * np.pi * rng.random(_CHECKED)
        chosen = np.stack([distance * np.cos(turn), distance * np.sin(turn)], axis=1)
        for value, at in zip(chosen, place_of(chosen, optics, reach), strict=True):
            numbers = ",".join(f"{nm:.1f}" for nm in optics.zernikes(*value)[4:])
            fronts.append(f"{camera.name},{band},{at[0]:.5f},{at[1]:.5f},{numbers}")
        if band != camera.bands[0]:
            continue
        for value in chosen:
            at = optics.chief(*value) @ np.diag([1.0, -1.0])
            arcsec = 206264.806 * value
            places.append(f"{camera.name},{arcsec[0]:.4f},{arcsec[1]:.4f},{at[0]:.6f},{at[1]:.6f}")
        for value in chosen[np.argsort(distance)[[2, 5]]]:
            at = place_of(value[None], optics, reach)[0]
            for u, v, x, y in apparent_displacements(optics, *value):
                rays.append(f"{camera.name},{band},{at[0]:.5f},{at[1]:.5f},{u:.4f},{v:.4f},{x:.1f},{y:.1f}")
    return fronts, rays, places


def apparent_displacements(optics: Optics, x: float, y: float) -> Float:
    """Return the rays of a star: place in the pupil over its radius, and apparent displacement of the star, mas."""
    step, n = 1e-5, 21
    sides = []
    for dx, dy in ((step, 0.0), (0.0, step)):
        ends = []
        for sign in (1.0, -1.0):
            few, _, _ = optics.rays(x + sign * dx, y + sign * dy, 3)
            optics.optic.trace(few)
            ends.append(np.array([few.x[4], few.y[4]]))
        sides.append((ends[0] - ends[1]) / (2.0 * step))
    rays, across, along = optics.rays(x, y, n)
    optics.optic.trace(rays)
    r = np.hypot(across, along)
    lit = (r <= optics.radius) & (r >= optics.inner) & ~rays.vignetted & ~rays.failed
    middle = (n * n - 1) // 2
    moved = np.stack([rays.x - rays.x[middle], rays.y - rays.y[middle]])
    angle = np.linalg.solve(np.stack(sides, axis=1), moved) * 206264806.0
    return np.stack([across / optics.radius, along / optics.radius, *angle], axis=1)[lit]


def write_checks(mission: MissionConfiguration) -> None:
    """Write the tables with which tests compare the wavefront and the distortion of all cameras."""
    lines: tuple[list[str], ...] = ([], [], [])
    for camera in CAMERAS:
        fit_distortion(camera, mission)
        for total, camera_lines in zip(lines, check_tables(camera, mission), strict=True):
            total += camera_lines
    zernikes = ",".join(f"z{noll}" for noll in range(4, NOLL + 1))
    names = "psf/batoid_wavefronts", "psf/batoid_rays", "camera/batoid_distortion"
    columns = (
        f"camera,band,x,y,{zernikes}",
        "camera,band,x,y,pupil_x,pupil_y,dx_mas,dy_mas",
        "camera,x_arcsec,y_arcsec,x_mm,y_mm",
    )
    for name, header, camera_lines in zip(names, columns, lines, strict=True):
        text = "\n".join(["# Written by scripts/trace_optics.py with batoid 0.9.", header, *camera_lines]) + "\n"
        (_TESTS / f"{name}.csv").write_text(text, encoding="utf-8")


def main() -> None:
    """Write all tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", choices=("wavefronts", "ghosts", "checks"), help="write only these files")
    only = parser.parse_args().only
    mission = resolve()
    for camera in CAMERAS:
        if only in (None, "wavefronts"):
            write_wavefronts(camera, mission)
        if only in (None, "ghosts"):
            write_ghosts(camera, mission)
    if only in (None, "checks"):
        write_checks(mission)


if __name__ == "__main__":
    main()
