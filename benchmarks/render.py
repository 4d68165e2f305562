"""Measure the drawing of sources: CPU time per detector, comparison with other programs, and errors against galsim.

The errors are measured on galaxies that were not used to choose the parameters of the drawing code. A result is for the
accuracy "survey", unless its name contains another accuracy ("quicklook", "draft" or "reference").
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks import _errors as errors
from benchmarks import _peers as peers
from benchmarks import _scenes as scenes
from benchmarks import report
from benchmarks._scenes import LSST, VIS, Scene
from truesky.numerics import cache
from truesky.render.drawing.settings import Settings, settings_for
from truesky.render.psf import model
from truesky.request import accuracy

# Number of galaxies whose errors are measured.
NUM_TEST = 204
# Number of pairs rotated by 90 degrees for which the bias of shear is measured, divided by the number of galaxies for
# which the other errors are measured.
PAIR_FRACTION = 0.25
# Number of galaxies per magnitude bin for which the speed of galsim is measured.
NUM_PEER = 8
REPEATS = 2
# Seed of the galaxies whose errors are measured.
_SEED = 16
_NOTES = {
    "vis_survey_s": "CPU, all sources of a VIS detector, each with its own chromatic PSF (target 4.2)",
    "vis_draft_s": "the same at draft accuracy (target 1.5)",
    "vis_quicklook_s": "the same at quicklook accuracy (target: at most half of draft)",
    "lsst_survey_s": "CPU, all sources of an LSST detector (target 2.2)",
    "psf_planes_cold_s": "CPU, PSF of a detector at 9 positions and 8 wavelengths",
    "psf_planes_warm_s": "the same from the cache",
    "vis_vs_galsim_default": "time of galsim / ours, galaxies; galsim with a separate PSF for each (target 60)",
    "vis_vs_galsim_cached": "time of galsim with one PSF / ours with a separate PSF for each galaxy (target 10)",
    "vis_shared_vs_galsim_cached": "time of galsim / ours, galaxies; both with one PSF (target 20)",
    "vis_vs_ufig": "time of UFig's photons through one grey Moffat / ours, galaxies",
    "lsst_vs_ufig": "the same for an LSST detector (target 2)",
    "aperture_mag_rms": 'error in a 1" aperture (target 1e-4)',
    "aperture_mag_worst": "(target 1e-3)",
    "centroid_mas_rms": "(target 0.002)",
    "r2_rms": "with the same PSF (target 1e-4); errors of the PSF: truesky/render/drawing/psf_positions.csv",
    "r2_worst": "(target 1e-3)",
    "ellipticity_rms": "(target 2e-5)",
    "ellipticity_worst": "(target 1e-4)",
    "pixel_sigma_worst": "(target 0.02)",
    "shear_m_worst": "90-degree pairs at g = +-0.02 (target 1e-4)",
    "shear_c_worst": "(target 1e-5)",
}


def seconds(scene: Scene, settings: Settings, repeats: int, stars: bool = True, shared: bool = False) -> float:
    """Return the CPU time to draw all sources of a detector.

    Parameters
    ----------
    scene : Scene
        Detector with pixel scale, exposure time, noise and numbers of sources.
    settings : Settings
        Parameters of the drawing code, such as limits for the sizes of stamps.
    repeats : int
        Number of repeats; the shortest time counts.
    stars : bool, optional
        If True (default), draw stars and galaxies, else only galaxies.
    shared : bool, optional
        If True, use one PSF for all sources. By default each source has a PSF for its colour and position.

    Returns
    -------
    float
        CPU time in seconds.
    """
    sources, psf = scenes.sources(scene, 1, stars=None if stars else 0), _psf(scene, settings)
    if shared and psf.planes is not None:
        psf = scenes.psf_of_source(psf, sources, 0)
        sources = replace(sources, photons=None)
    # Draw a few sources before the clock starts, because functions are compiled at their first call. The brightest
    # ones are among them, because they use separate functions in double precision.
    is_bright = sources.electrons >= np.sort(sources.electrons)[-3]
    scenes.draw_sources(sources.take(is_bright | (np.arange(len(sources)) % 500 == 0)), psf, scene, settings)
    return report.best_time(lambda: scenes.draw_sources(sources, psf, scene, settings), repeats, time.process_time)


def _psf(scene: Scene, settings: Settings) -> model.Psf:
    return scenes.scene_psf(scene, settings.positions, settings.colours)


def psf_plane_seconds() -> tuple[float, float]:
    """Return the CPU time (s) to compute the PSF of a VIS detector, and the CPU time (s) to read it from the cache."""
    out = []
    with cache.use_temporary_dir():
        for _ in range(2):
            start = time.process_time()
            scenes.scene_psf(VIS)
            out.append(time.process_time() - start)
    return out[0], out[1]


def times(quick: bool, repeats: int) -> dict[str, float]:
    """Measure the speed of drawing on a VIS and an LSST detector.

    Return CPU times in s (names end in `_s`), and ratios: time of galsim or UFig / time of truesky. If `quick` is True,
    the slowest accuracy and the time of the PSF are left out. `repeats` is the number of repeats of each measurement.
    """
    tiers = {name: settings_for(target) for name, target in accuracy.PRESETS.items()}
    out = {}
    for scene in (VIS, LSST):
        for name, settings in tiers.items():
            if not quick or name != "reference":
                out[f"{scene.name}_{name}_s"] = seconds(scene, settings, repeats)
        galaxies = seconds(scene, tiers["survey"], repeats, stars=False)
        out[f"{scene.name}_galaxies_s"] = galaxies
        default, cached = peers.galsim_seconds(scene, 1 if quick else NUM_PEER)
        out |= {f"{scene.name}_galsim_default_s": default, f"{scene.name}_galsim_cached_s": cached}
        out |= {
            f"{scene.name}_vs_galsim_default": default / galaxies,
            f"{scene.name}_vs_galsim_cached": cached / galaxies,
        }
        if scene is VIS:
            shared = seconds(scene, tiers["survey"], repeats, stars=False, shared=True)
            out |= {"vis_shared_s": shared, "vis_shared_vs_galsim_cached": cached / shared}
        ufig = peers.ufig_seconds(scene)
        if ufig is not None:
            out |= {f"{scene.name}_ufig_s": ufig, f"{scene.name}_vs_ufig": ufig / galaxies}
    if not quick:
        out["psf_planes_cold_s"], out["psf_planes_warm_s"] = psf_plane_seconds()
    return out


def accuracies(quick: bool, galaxies: int) -> dict[str, float]:
    """Measure the errors of drawing against galsim, and print them.

    `galaxies` is the number of galaxies; `quick` reduces it to 6 on VIS only. Errors on VIS at survey accuracy are
    returned by their plain names, such as `r2_rms`. Other names begin with the detector and the accuracy, such as
    `lsst_draft_r2_rms`.
    """
    num_galaxies, pairs = (6, 2) if quick else (galaxies, max(round(PAIR_FRACTION * galaxies), 1))
    names = ("survey",) if quick else ("quicklook", "draft", "survey", "reference")
    tiers = {name: settings_for(accuracy.preset(name)) for name in names}
    out: dict[str, float] = {}
    for scene in (VIS,) if quick else (VIS, LSST):
        galsim_errors, bins, refused = errors.run_with_memory_limit(
            errors.against_galsim, scene, tiers, _SEED, num_galaxies
        )
        print(f"{scene.name}: {len(bins)} galaxies compared with galsim, which failed for {refused} more; rms/worst")
        response, sheared_galaxies = errors.shear_response(scene, tiers, _SEED + 1, pairs)
        for name in names:
            errors.print_table(f"{scene.name} {name}", galsim_errors[name], bins)
            m, c = np.abs(response[name]).max(axis=0)
            print(f"  shear response: |m| <= {m:.1e}, |c| <= {c:.1e} of {len(response[name])} pairs")
            row = errors.figures(galsim_errors[name]) | {"shear_m_worst": float(m), "shear_c_worst": float(c)}
            for kind, (n, worst_m, worst_c) in errors.worst_by_group(response[name], sheared_galaxies, scene).items():
                print(f"    {kind:12}{n:>6} pairs    |m| <= {worst_m:.1e}, |c| <= {worst_c:.1e}")
                row |= {f"shear_m_worst_{kind.replace(' ', '')}": worst_m}
            prefix = "" if (scene, name) == (VIS, "survey") else f"{scene.name}_{name}_"
            out |= {
                prefix + key: value for key, value in (row | errors.figures_by_bin(galsim_errors[name], bins)).items()
            }
        out |= {
            f"{scene.name}_galaxies_compared": float(len(bins)),
            f"{scene.name}_pairs": float(len(sheared_galaxies)),
            f"{scene.name}_galsim_refused": float(refused),
        }
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--galaxies", type=int, default=NUM_TEST, help="galaxies to compare with galsim")
    extra_parser.add_argument("--repeats", type=int, default=REPEATS, help="repeats; the shortest time counts")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("render", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    figures = times(options.quick, repeats) | accuracies(options.quick, extra_options.galaxies)
    report.print_and_write("render", repeats, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
