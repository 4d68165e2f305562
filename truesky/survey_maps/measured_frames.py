"""Make the table `measured_frames` from the rendered frames of a plan, and read it for depth maps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import command
from lake_schema.arrays import Bool, Int
from lake_schema.store import layout, read, request_links, reuse
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version, digest
from lake_schema.tables.survey.measured_frames import MEASURED_FRAMES
from truesky.render.products.keys import part_name
from truesky.survey_maps import exposure_noise

if TYPE_CHECKING:
    from truesky.reduction.frames import Frame, FrameSource

# Pixels that a cosmic ray gave at least this fraction of the noise (rms) of a pixel are lost (assumed).
_HIT = 1.0


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of a frame.

    Attributes
    ----------
    sky : float
        Rate of the sky, electrons / s / pixel.
    variance : float
        Variance of a pixel of blank sky divided by the fraction of good pixels, electrons^2: without neighbours, the
        inverse variance of a flux is a sum over good pixels.
    bad_pixels, saturated : int64 array, shape (n,) or (m,)
        HEALPix pixels of order 14 with bad pixels of the detector, and with saturated pixels.
    """

    sky: float
    variance: float
    bad_pixels: Int
    saturated: Int


def measure_frame(lake: Path, facts: Json) -> Output:
    """Measure a frame and return its row of the table `measured_frames`.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    facts : dict
        `products`, the key of a version of this table, and `part`, the name of its partition with the frame.

    Returns
    -------
    Output
        One row.

    Raises
    ------
    Damaged
        If a file of the frame differs from the manifest.
    """
    from truesky.reduction.frames import FrameSource
    from truesky.survey_maps import frame_noise

    products = read.version(lake, "products", facts["products"])
    source = FrameSource.from_products(lake, products)
    rows = {row["content"]: row for row in products.rows(partitions=[facts["part"]]).to_pylist()}
    row = rows["science"]
    frame = source.open_frame(row, source.read_exposures([row["exposure_id"]])[row["exposure_id"]])
    detector = frame.scene.detector
    assert detector is not None
    (sky,), (variance,) = exposure_noise.variances([frame.exposure], [detector], frame.scene.mission)
    hits = _read_hits(source, rows["cosmic_rays"]["path"], variance) if _has_hits(frame, rows) else None
    noise = frame_noise.measure(frame, hits)
    missing = np.array([not np.isfinite(noise.sky) or not np.isfinite(noise.variance) or noise.good == 0.0])
    columns = {
        **{name: [row[name]] for name in ("exposure_id", "detector", "channel", "band")},
        **{name: np.ma.array([getattr(noise, name)], mask=missing) for name in ("sky", "variance")},
        "planned_sky": np.array([sky]),
        "planned_variance": np.array([variance]),
        "good": np.array([noise.good]),
        "blank": np.array([noise.blank]),
        **{name: [getattr(noise, name).tolist()] for name in ("bad_pixels", "saturated")},
    }
    return Output(MEASURED_FRAMES.build(columns))


def _has_hits(frame: Frame, rows: Json) -> bool:
    """Return True if the lake has the truth map of cosmic rays of a CCD."""
    return "cosmic_rays" in rows and not frame.scene.ramp


def _read_hits(source: FrameSource, path: str, variance: float) -> Bool:
    """Return True for the pixels that cosmic rays hit noticeably, from their truth map; the noise is predicted."""
    from truesky.render.products import read_back

    light = np.asarray(read_back.electrons(read_back.image_file(source.products, path)).data, float)
    return np.asarray(light >= _HIT * np.sqrt(variance))


def find_frames(lake: Path, request: str, inputs: Json) -> read.Version | None:
    """Return the version of the table `products` with the frames of a request's plan.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    request : str
        Name of the request.
    inputs : mapping
        Facts of the depth map: the key of the version of `exposures`, the fingerprint of the mission as `mission`, the
        seed, and other settings of images as `images`.

    Returns
    -------
    Version or None
        None if the request has no frames, or if they were rendered from another plan or with other settings, which
        prints a line.
    """
    if layout.current_key(lake, "products") is None or request_links.linked_key(lake, request, "products") is None:
        return None
    products = read.version(lake, "products", request=request)
    made = products.manifest["facts"]
    settings = {"seed": inputs["seed"], **inputs["images"]}
    rendered = {"exposures": made["inputs"]["exposures"], "mission": made["mission"]}
    rendered["settings"] = {name: made["request"][name] for name in settings}
    if digest(rendered) == digest({**{name: inputs[name] for name in ("exposures", "mission")}, "settings": settings}):
        return products
    message = (
        f"request {request}: its images were rendered from another plan or with other settings and are not measured: "
        "render them again"
    )
    command.print_error("build_depth", message, 0)
    return None


def plan(products: read.Version, counted: pa.Table) -> Plan | None:
    """Plan the table `measured_frames`, with one task per frame.

    Parameters
    ----------
    products : Version
        Version of the table `products`.
    counted : pyarrow.Table
        Rows of the table `exposures` that count for depth maps.

    Returns
    -------
    Plan or None
        None if no frame is of an exposure that counts. A frame that an older version measured is not measured again.
    """
    numbers, code = set(counted["exposure_id"].to_pylist()), code_version()
    tasks = []
    for entry in products.manifest["parts"]:
        facts = entry["facts"]
        if facts["exposure_id"] in numbers:
            key = digest({"image": facts[reuse.PRODUCT], "code": code})
            tasks.append(Task(entry["name"], {"part": entry["name"], reuse.PRODUCT: key}))
    return Plan(MEASURED_FRAMES, {"products": products.key, "code": code}, tuple(tasks)) if tasks else None


def read_measured(version: read.Version, pairs: Iterable[tuple[int, str]]) -> dict[tuple[int, str], Measured]:
    """Read the measurements of frames.

    Parameters
    ----------
    version : Version
        Version of the table `measured_frames`.
    pairs : iterable of (int, str)
        Exposures and detectors; those without a frame are ignored.

    Returns
    -------
    dict of (int, str) to Measured
        The measurements of frames with blank sky, by exposure and detector.
    """
    names = [part_name({"exposure_id": number, "detector": detector}) for number, detector in pairs]
    existing = set(version.partitions)
    partitions = [name for name in names if name in existing]
    if not partitions:
        return {}
    rows = version.rows(["exposure_id", "detector", "sky", "variance", "good", "bad_pixels", "saturated"], partitions)
    return {
        (row["exposure_id"], row["detector"]): Measured(
            row["sky"],
            row["variance"] / row["good"],
            np.array(row["bad_pixels"], np.int64),
            np.array(row["saturated"], np.int64),
        )
        for row in rows.filter(pc.is_valid(rows["sky"])).to_pylist()
    }
