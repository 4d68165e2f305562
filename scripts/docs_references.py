"""Make the Markdown pages of the documentation site whose content comes from the code.

The pages list the keys of a request (TOML file of a user), the parameters of the instruments, the effects on images,
the settings of accuracy, and the Python interface.
"""

from __future__ import annotations

import inspect
import json
import pkgutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np

from benchmarks import effects as scene_of_effects
from benchmarks import stages
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from scripts import request_keys
from scripts.request_keys import Key
from truesky.fluxes import passbands
from truesky.randomness.rng import stream
from truesky.render.camera import detectors, traces
from truesky.render.channels import ground, nisp_p, nisp_s, registry, vis
from truesky.render.channels.aim import Aim
from truesky.render.effects.charge import bleeding
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import ghosts
from truesky.render.effects.readout import quadrants
from truesky.render.effects.scene import Frame, Lights, NeighbourCharge, Scene
from truesky.render.exposure import sky_through_grism
from truesky.request import accuracy, from_toml, schema
from truesky.request.exposures import observations, pointings

# Modules, classes and functions of the page of the Python interface, in order.
API = (
    "truesky.api.lake",
    "truesky.api.tables",
    "truesky.api.simulate",
    "truesky.api.image_options.ImageOptions",
    "truesky.api.sky_images.SkyImage",
    "truesky.api.sky_images.PsfImage",
    "truesky.api.lake_frames.LakeFrame",
    "truesky.api.given_frames.frame",
    "truesky.api.given_frames.GivenFrame",
    "truesky.api.given_frames.InjectedFrame",
    "truesky.explore.plots",
    "lake_schema.store.read",
    "lake_schema.store.layout",
    "truesky.explore.explorer",
    "truesky.render.products.read_back",
)
# Width and height of the small detector image on which effects are shown, pixels.
_SIDE = 320


def request_page() -> str:
    """Return the Markdown page about the keys of a request (TOML file of a user).

    It contains the docstring of the parser, a table of the keys that have a single value, with limits and defaults, and
    the docstrings of some sections.
    """
    head = inspect.cleandoc(from_toml.__doc__ or "")
    lines = ["# Keys of a request", "", "```text", head, "```", "", "## Values, bounds, defaults", ""]
    lines += ["| key | is a | from, to, or one of | default |", "|---|---|---|---|"]
    for name, key in sorted(request_keys.all_keys().items()):
        default = f"`{key.default}`" if key.default else ""
        lines.append(f"| `{name}` | {key.kind} | {_describe_limits(key)} | {default} |")
    for record in (schema.Universe, schema.Stars, pointings.Pointing, observations.Observation):
        text = inspect.cleandoc(record.__doc__ or "")
        lines += ["", f"## {record.__name__}", "", "```text", text, "```"]
    return "\n".join(lines) + "\n"


def _describe_limits(key: Key) -> str:
    """Return the smallest and largest number, or the allowed values, of a key of a request as text."""
    if key.lo is not None and key.hi is not None:
        return f"{key.lo:g} to {key.hi:g}"
    return ", ".join(map(str, key.legal))


def mission_page(mission: MissionConfiguration) -> str:
    """Return the Markdown page with the default value, unit, status and source of every parameter of the mission."""
    lines = [
        "# The mission database",
        "",
        "Values that the default ladder of statuses selects. A request replaces values in `[mission.overrides]`.",
    ]
    section = ""
    for record in mission.parameters:
        head = record.key.split(".")[0]
        if head != section:
            section = head
            lines += ["", f"## {head}", "", "| parameter | value | unit | status | source |", "|---|---|---|---|---|"]
        source = record.source.replace("|", "/")
        lines.append(f"| `{record.key}` | {record.value:g} | {record.unit} | {record.status} | {source} |")
    return "\n".join(lines) + "\n"


def effects_page(into: Path, mission: MissionConfiguration) -> str:
    """Return the Markdown page about all effects on images (such as cosmic rays or charge transfer inefficiency).

    For each effect it contains the docstring of its module, its parameters, and a figure of a small image before and
    after the effect. The figures are written to a new folder `effects` in the existing folder `into`.
    """
    names = {"VIS": "science", "NISP-P": "science", "NISP-S": "science", "EXT": "science"}
    channels = {name: channel.effects for name, channel in registry.CHANNELS.items()}
    order: dict[str, Effect] = {}
    users: dict[str, list[str]] = {}
    for channel, types in channels.items():
        for kind, effects in types.items():
            for effect in effects:
                order.setdefault(effect.name, effect)
                users.setdefault(effect.name, []).append(f"{channel} {kind}")
    lines = [
        "# Effects",
        "",
        "Effects are listed in physical order. An effect is left out of an image if its largest change",
    ]
    lines += ["of a pixel is less than a tenth of the pixel's noise, unless the request forces it.", ""]
    for channel, kind in names.items():
        listed = ", ".join(f"[{e.name}](#{e.name})" for e in channels[channel][kind])
        lines += [f"**{channel}, {kind}:** {listed}", ""]
    parameters = _effect_parameters(list(order.values()), mission)
    figures = _figures(into, mission)
    for name, effect in order.items():
        module = inspect.getmodule(effect.apply)
        text = inspect.cleandoc((module.__doc__ if module else "") or "")
        lines += [f"## {name}", "", "```text", text, "```", ""]
        if parameters[name]:
            lines += ["| parameter | value | unit |", "|---|---|---|"]
            lines += [f"| `{k}` | {mission.value(k):g} | {mission.parameter(k).unit} |" for k in parameters[name]]
            lines.append("")
        if name in figures:
            lines += [f"![Frame before and after {name}](effects/{name}.png)", ""]
        lines += ["Used in: " + ", ".join(users[name]) + ".", ""]
    return "\n".join(lines)


def _scene(mission: MissionConfiguration) -> tuple[Frame, Scene]:
    """Return an image (electrons) of 320 x 320 pixels and the description of a VIS exposure, to show effects on it.

    The image has points and squares of light. A bright star has a ghost on it.
    """
    detector = detectors.detector("vis", "3-4", mission)
    small = type(detector)("3-4", "vis", _SIDE, _SIDE, detector.x, detector.y, 0.0, detector.pixel_scale)
    frame = scene_of_effects.draw_light(_SIDE, _SIDE)
    frame[200, 100] += 3e6
    scene = Scene(mission, "vis", 560.53, 0.25, float(frame.max()), small)
    return frame, _with_ghost(scene, "ghost", 1e9)


def _with_ghost(scene: Scene, plate: str, electrons: float) -> Scene:
    """Add a bright star whose ghost of the first order is at column and row 150."""
    middle = Lights(np.array([150.0]), np.array([150.0]), np.array([electrons]))
    columns, rows = ghosts.offset(scene, plate, 1, middle)
    return replace(scene, lights=replace(middle, column=150.0 - columns, row=150.0 - rows))


def _effect_parameters(effects: list[Effect], mission: MissionConfiguration) -> dict[str, list[str]]:
    """Return the keys of the mission parameters that each effect reads, by name of the effect.

    They are found by recording the reads while an effect takes its parameters from the description of an exposure.
    """
    _, scene = _scene(mission)
    (_, infrared), (_, ground_scene) = _infrared_scene(mission), _ground_scene(mission)
    parameters, read_value = {}, MissionConfiguration.value
    for effect in effects:
        keys: dict[str, None] = {}

        def record_key(*arguments: str, keys: dict[str, None] = keys) -> float:
            keys[arguments[1]] = None
            return read_value(*arguments)

        with patch.object(MissionConfiguration, "value", record_key):
            if effect in vis.SKY + vis.FLAT + vis.PUMPING:
                effect.parameters(scene)
            else:
                effect.parameters(infrared if effect in nisp_p.SKY + nisp_p.FLAT else ground_scene)
        parameters[effect.name] = list(keys)
    return parameters


def _figures(into: Path, mission: MissionConfiguration) -> set[str]:
    """Draw a figure of each effect: the image before it, the image after it, and the difference.

    Effects of sky images and of NISP-P flats are applied one after another, in physical order, to a small image. Each
    effect of VIS flats and of trap pumping is applied to the unchanged image. The files are written to a new folder
    `effects` in `into`. Return the names of the effects with a figure; effects that do not change the image have none.
    """
    frame, scene = _scene(mission)
    folder = into / "effects"
    folder.mkdir()
    drawn = set()
    light = frame
    for effect in dict.fromkeys((*vis.SKY, *vis.FLAT, *vis.PUMPING)):
        input_frame = frame if effect in vis.SKY else light
        output_frame = effect.apply(input_frame, *effect.parameters(scene), rng=stream(1, effect.name))
        # Some effects do not change such a small image, so they get no figure.
        if input_frame.shape != output_frame.shape or np.ptp(output_frame - input_frame) > 0.0:
            _draw_figure(
                folder / f"{effect.name}.png",
                _assemble_quadrants(input_frame),
                _assemble_quadrants(output_frame),
                effect.name,
            )
            drawn.add(effect.name)
        frame = output_frame if effect in vis.SKY else frame
    infrared, spectral = _infrared_scene(mission), _spectral_scene(mission)
    for effects, (frame, scene) in ((nisp_p.SKY, infrared), (nisp_p.FLAT, infrared), (nisp_s.SKY, spectral)):
        for effect in effects:
            input_frame, frame = frame, effect.apply(frame, *effect.parameters(scene), rng=stream(1, effect.name))
            images = _ramp_image(input_frame, ""), _ramp_image(frame, effect.name)
            if effect.name not in drawn and (input_frame.shape != frame.shape or np.ptp(images[1] - images[0]) > 0.0):
                _draw_figure(folder / f"{effect.name}.png", *images, effect.name)
                drawn.add(effect.name)
    frame, scene = _ground_scene(mission)
    for effect in ground.SKY:
        input_frame, frame = frame, effect.apply(frame, *effect.parameters(scene), rng=stream(1, effect.name))
        images = [image if image.ndim == 2 else scene.layout.assemble(image) for image in (input_frame, frame)]
        if effect.name not in drawn and np.ptp(images[1] - images[0]) > 0.0:
            _draw_figure(folder / f"{effect.name}.png", *images, effect.name)
            drawn.add(effect.name)
    return drawn


def _ground_scene(mission: MissionConfiguration) -> tuple[Frame, Scene]:
    """Return an image of 320 x 320 pixels and the description of an LSSTCam exposure, to show effects on it.

    The image has points and squares of light. The exposure has many satellite trails, and charge of a saturated star on
    another detector.
    """
    small = replace(detectors.detector("lsstcam", "R22_S11", mission), nx=_SIDE, ny=_SIDE)
    frame = scene_of_effects.draw_light(_SIDE, _SIDE)
    crossed = mission.with_overrides({"survey.satellites.rate": (3.0, "1 / (deg s)")})
    brightest = float(frame.max())
    scene = Scene(crossed, "ext.lsstcam", 30.0, 50.0, brightest, small, seeing=0.7, zero_point=26.82)
    bled_frame = bleeding.apply(np.where(frame > 1e4, 10.0 * frame, 0.0)[::-1], 1e5, scene.column_segments)
    assert scene.layout is not None
    pixels = scene.layout.split(bled_frame).reshape(-1)
    indices = np.flatnonzero(pixels)
    return frame, replace(
        scene, band=passbands.load("lsst_y"), neighbour_charge=NeighbourCharge(indices, pixels[indices])
    )


def _infrared_scene(mission: MissionConfiguration) -> tuple[Frame, Scene]:
    """Return an image of 320 x 320 pixels and the description of a NISP photometric exposure, to show effects on it.

    The image has points and squares of light. The exposure has persistence, and a bright star with a ghost of the
    filter.
    """
    detector = detectors.detector("nisp", "DET22", mission)
    small = type(detector)("DET22", "nisp", _SIDE, _SIDE, detector.x, detector.y, 0.0, detector.pixel_scale)
    frame = scene_of_effects.draw_light(_SIDE, _SIDE)
    persistence_charge = 10.0 * (np.hypot(*(np.indices(frame.shape) - _SIDE / 2)) < _SIDE / 10)
    scene = Scene(
        mission,
        "nisp",
        87.24,
        1.0,
        float(frame.max()),
        small,
        ramp="photometric",
        persistence_charge=persistence_charge,
    )
    return frame, _with_ghost(scene, "filter_ghost", 1e9)


def _spectral_scene(mission: MissionConfiguration) -> tuple[Frame, Scene]:
    """Return an image of 320 x 320 pixels and the description of a NISP spectroscopic exposure, to show effects on it.

    The detector is at a position at which the zeroth order of the sky background ends at the edge of the field stop.
    """
    frame, scene = _infrared_scene(mission)
    assert scene.detector is not None
    exposure = ExposureRow(
        exposure_id=1, channel="NISP-S", camera="nisp", band="nisp_red", image_type="science", ra=0.0, dec=60.0,
        position_angle=0.0, mjd=61000.0, exposure_time_s=549.6, sky=1.09, grism="RGS000", grism_angle=0.0,
        seeing=0.0, zero_point=25.0, survey="own",
    )  # fmt: skip
    (zeroth,) = (t for t in traces.traces("RGS000", 0.0, scene.detector, mission) if t.order == 0)
    moved = zeroth.polynomials(0.0, 0.0)[0][0] * scene.detector.pixel_scale
    edge = 0.5 * mission.value("plm.unvignetted_x", "arcsec")
    detector = replace(scene.detector, x=np.copysign(edge, -moved) + moved, y=0.0, rotation=0.0)
    scene = replace(scene, exposure_time_s=549.6, sky_rate=1.09, detector=detector, ramp="spectroscopic")
    return frame, replace(
        scene, sky_change=sky_through_grism.sky_change(scene, Aim.from_exposure(exposure, detector), 1)
    )


def _ramp_image(frame: Frame, name: str) -> Frame:
    """Return one image of a ramp (a stack of readouts), on which the change by the effect `name` can be seen.

    For a float32 ramp this is the last group minus the first one, or the first group for the effect "reset_level". For
    other stacks it is one plane. A two-dimensional frame is returned unchanged.
    """
    if frame.ndim == 2:
        return frame
    if frame.dtype == np.float32:
        return np.asarray(frame[0] if name == "reset_level" else frame[-1] - frame[0], float)
    return np.asarray(frame[{"ramp_cosmic_rays": 1, "ramp_nonlinearity": 3}.get(name, 0)], float)


def _assemble_quadrants(frame: Frame) -> Frame:
    """Return one image of a VIS detector from its four quadrants, including their prescan and overscan.

    A two-dimensional frame is returned unchanged.
    """
    if frame.ndim == 2:
        return frame
    placed = [quadrants.to_detector_axes(frame[i], i) for i in range(4)]
    return np.block([[placed[3], placed[2]], [placed[0], placed[1]]])


def _draw_figure(path: Path, input_frame: Frame, output_frame: Frame, name: str) -> None:
    same = input_frame.shape == output_frame.shape and name != "adc"
    figure, axes = plt.subplots(1, 3 if same else 2, figsize=(9 if same else 6, 3.2), layout="constrained")
    middle = float(np.median(output_frame))
    for axis, image, title in zip(axes, (input_frame, output_frame), ("before", "after"), strict=False):
        level = float(np.median(image)) if not same else middle
        width = max(float(np.percentile(np.abs(image - level), 99.0)), 1.0)
        axis.imshow(np.arcsinh((image - level) / (0.2 * width)), origin="lower", cmap="gray")
        unit = "adu" if name == "adc" and title == "after" else "e⁻"
        axis.set_title(f"{title}, median {np.median(image):.4g} {unit}", fontsize=9)
    if same:
        change = output_frame - input_frame
        width = max(float(np.percentile(np.abs(change), 99.7)), 0.1 * float(np.abs(change).max()))
        change_image = axes[2].imshow(change, origin="lower", cmap="RdBu_r", vmin=-width, vmax=width)
        axes[2].set_title("change, e⁻", fontsize=9)
        figure.colorbar(change_image, ax=axes[2], shrink=0.8)
    for axis in axes:
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=80)
    plt.close(figure)


def accuracy_page(into: Path) -> str:
    """Return the Markdown page about errors and CPU time, of drawing sources and of each stage of a rendered detector.

    The figures are written to accuracy.png and stages.png in the existing folder `into`.
    """
    rows = sorted(accuracy.rows(), key=lambda row: row["seconds"])
    titles = {
        "flux": "flux, relative",
        "shape": "shape",
        "position": "position, pixels",
        "background": "pixel, σ of sky",
    }
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.4), sharey=True, layout="constrained")
    for axis, (name, title) in zip(axes, titles.items(), strict=True):
        axis.loglog([row[f"{name}_held"] for row in rows], [row["seconds"] for row in rows], "ko-", mfc="none")
        for preset, allowed_errors in accuracy.PRESETS.items():
            setting = accuracy.fastest_row(allowed_errors)
            axis.loglog(setting[f"{name}_held"], setting["seconds"], "o", ms=9, label=preset)
        axis.set_xlabel(f"largest error: {title}")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("CPU s, sources of a VIS detector")
    axes[-1].legend(fontsize=8)
    figure.savefig(into / "accuracy.png", dpi=90)
    plt.close(figure)
    lines = [
        "# Error and time",
        "",
        "`accuracy` in a request is the name of a preset, or a table of the largest allowed errors.",
    ]
    lines += ["Each row is a setting of the drawing. Its errors are measured on sources of an independent sample.", ""]
    lines += ["![Largest errors and CPU seconds of the settings](accuracy.png)", ""]
    lines += ["| accuracy | allows: " + " | allows: ".join(titles.values()) + " | reached | CPU s |", "|---" * 7 + "|"]
    for preset, allowed_errors in accuracy.PRESETS.items():
        row = accuracy.fastest_row(allowed_errors)
        allowed = " | ".join(f"{getattr(allowed_errors, name):.0e}" for name in titles)
        reached = ", ".join(f"{row[f'{name}_held']:.1e}" for name in titles)
        lines.append(f"| {preset} | {allowed} | {reached} | {row['seconds']:.2f} |")
    lines += [
        "",
        *_stages_section(into),
        "",
        "[Speed for accuracy](tutorials/02_speed_for_accuracy.md) shows the same for fluxes and for each effect.",
    ]
    return "\n".join(lines) + "\n"


def _stages_section(into: Path) -> list[str]:
    """Return the lines of Markdown about the stages of a rendered detector; the figure is stages.png in `into`."""
    figures = json.loads(stages.RESULTS.read_text(encoding="utf-8"))
    stages.draw_picture(figures, into / "stages.png")
    lines = [
        "## Whole detectors, stage by stage",
        "",
        "The accuracy also selects the effects of the detector: those that change an image noticeably. The table has",
        f"CPU seconds on {figures['machine']}. The sky error is the largest difference of a pixel of the sky from",
        "reference accuracy, in units of its noise. Scenes contain stars brighter than the 14.5 mag of the sources",
        "above. Misplaced light is in another pixel than at reference accuracy.",
        "",
        "![CPU seconds of each stage, and error, by accuracy](stages.png)",
        "",
        "| camera | accuracy | "
        + " | ".join(stages.STAGES)
        + " | all | sky error, σ | misplaced light | effects left out |",
        "|---" * (len(stages.STAGES) + 6) + "|",
    ]
    for scene in stages.SCENES:
        for preset in accuracy.PRESETS:
            values = {key: figures[f"{scene}_{preset}_{key}"] for key in ("s", "sky_sigma", "misplaced", "left_out")}
            parts = " | ".join(f"{figures[f'{scene}_{preset}_{stage}_s']:.2f}" for stage in stages.STAGES)
            errors = f"{values['sky_sigma']:.2g} | {values['misplaced']:.1e} | {values['left_out']}"
            lines.append(f"| {scene} | {preset} | {parts} | {values['s']:.2f} | {errors} |")
    return lines


def api_page() -> str:
    """Return the Markdown page of the Python interface, with a directive of Sphinx for each object that `API` lists.

    Sphinx replaces the directives by the docstrings of the objects.
    """
    lines = ["# Python interface", ""]
    for name in API:
        lines += [f"## {name}", "", "```{eval-rst}", f".. {_directive(name)}:: {name}", "```", ""]
    return "\n".join(lines)


def _directive(name: str) -> str:
    """Return the directive of Sphinx for a module, class or function."""
    documented = pkgutil.resolve_name(name)
    if inspect.ismodule(documented):
        return "automodule"
    return "autoclass" if inspect.isclass(documented) else "autofunction"
