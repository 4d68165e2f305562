"""Join the science images of all detectors of an exposure in one FITS file, and make the table `exposure_files`.

The file has a primary header for the exposure, followed by the arrays of each detector as extensions.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from lake_schema.errors import Damaged
from lake_schema.fits import joined
from lake_schema.fits.images import Card
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.published import read_back
from lake_schema.store import read, reuse
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import digest
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.products import EXPOSURE_FILES
from truesky.render.camera import detectors
from truesky.render.channels import level1
from truesky.render.planning.exposure_chunks import rows as planned_rows
from truesky.render.products import head_files, headers
from truesky.render.products.keys import part_name

# Keywords in the headers of detector files whose cards go to the primary header of the file with all detectors, if they
# are equal for all detectors. The keywords `headers.PER_ARRAY_KEYWORDS` also stay in the headers of the arrays.
_EXPOSURE_KEYWORDS = (
    "TELESCOP", "INSTRUME", "OBJECT", "RA", "DEC", "AIRMASS", "DETSIZE", "CHANNEL", "FILTER", "BAND", "IMAGETYP",
    "LAMP", "TARGET", "EXPOSURE", "EXPTIME", "DATE-OBS", "MJD-OBS", "TIMESYS", "SEEING", "SEEIMAGE", "ZEROPNT", "SEED",
    "NOISSEED", "REALIS", "MISSION", "TRUESKY", "ACCFLUX", "ACCSHAPE", "ACCPOS", "ACCBACK", "READMODE", "NG", "NR",
    "ND",
    "FRTIME", "ELAPTIME", "REFPIX", "QUALLIM", "PRESCAN", "OVERSCAN", "OVERROWS", "INJROWS", "BUNIT", "OBSTYPE",
    "PROCTYPE", "PRODTYPE", "EXPNUM", "OBSID", "SEQNUM", "IMGTYPE", "CONTRLLR", "ROTPA", "ROTCOORD", "RASTART",
    "DECSTART", "AMSTART", "SHUTTIME", "DARKTIME", "INJLEVEL", "INJON", "INJOFF", "NSHUFFLE", "PHASETIM", "DEFOCUS",
    "TARGMAG", "TARGBAND", "TARGDIST",
    "EXPREQ", "TELRA", "TELDEC", "ZD", "AZ", "OBS-LONG", "OBS-LAT", "OBS-ELEV", "OUTTEMP", "PRESSURE", "HUMIDITY",
    "PROPID", "TELFOCUS", "DATA-TYP", "EXP-ID", "FILTER01", "UT-STR", "UT-END", "UT", "MJD-STR", "MJD-END", "MJD",
    "RA2000", "DEC2000", "INST-PA", "ALTITUDE", "AZIMUTH", "OUT-TMP", "OUT-PRS", "OUT-HUM", "PROP-ID", "FOC-VAL",
    "UTC-OBS", "RA_DEG", "DEC_DEG", "TELALT", "TELAZ", "LONGITUD", "LATITUDE", "TEMPERAT", "RELHUMID", "RUNID",
    "DAYOBS", "CAMCODE", "DATE", "DATE-BEG", "MJD-BEG", "DATE-END", "TRACKSYS", "ELSTART", "AZSTART", "ELEND", "AZEND",
    "VIGN_MIN", "AIRTEMP", "PROGRAM", "FOCUSZ",
)  # fmt: skip
# Cameras whose software does not read the primary header: the headers of their arrays keep all cards.
_CAMERAS_WITHOUT_PRIMARY = ("megacam",)


def plan(products: Plan, detector_counts: Mapping[int, int], names: str = "truesky") -> Plan:
    """Plan the table `exposure_files`: one partition per exposure that has images in the table `products`.

    Parameters
    ----------
    products : Plan
        Plan of the table `products`, with one partition per detector image.
    detector_counts : mapping of int to int
        Number of planned detectors of each exposure, by exposure number.
    names : str, optional
        Convention for names and headers, one of `FILE_NAMES` of truesky.request.schema. "euclid" is that of Euclid's
        raw frames, for exposures of VIS and NISP.

    Returns
    -------
    Plan
        One partition per exposure, with the names of its detectors and a key: a hash that is computed from the hashes
        of the inputs of its images. The file of an exposure is written again only if this key changes.
    """
    keys_by_exposure: dict[int, dict[str, str]] = defaultdict(dict)
    for part in products.tasks:
        keys_by_exposure[part.facts["exposure_id"]][part.facts["detector"]] = part.facts[reuse.PRODUCT]
    # The default is not among the facts, so that the keys of existing files do not change.
    convention = {} if names == "truesky" else {"names": names}
    parts = []
    for number, keys in sorted(keys_by_exposure.items()):
        detector_names = sorted(keys)
        exposure_facts = {
            "exposure_id": number, "detectors": detector_names, "planned": detector_counts[number], **convention,
        }  # fmt: skip
        key = digest({**exposure_facts, "products": [keys[name] for name in detector_names]})
        parts.append(Task(f"{number:06d}.parquet", {**exposure_facts, reuse.PRODUCT: key}))
    return Plan(EXPOSURE_FILES, {"products": products.key}, tuple(parts))


def make_exposure_file(lake: Path, facts: Json) -> Output:
    """Join the image files of an exposure's detectors in one file.

    `facts` has the exposure number, the names of the detectors, and the version of the table `products`. The result has
    the row of the table `exposure_files`, and functions that write the FITS file and its head file (true WCS as text).
    Raises Damaged if the table `products` lacks the image of one of these detectors.
    """
    products = read.version(lake, "products", facts["products"])
    in_exposure = pc.field("exposure_id") == facts["exposure_id"]
    # Open only the partitions of this exposure: the table has one partition per image, perhaps 100,000.
    part_names = {part_name({"exposure_id": facts["exposure_id"], "detector": name}) for name in facts["detectors"]}
    partitions = [name for name in products.partitions if name in part_names]
    science_rows = products.rows(partitions=partitions, where=in_exposure & (pc.field("content") == "science"))
    rows = {row["detector"]: row for row in science_rows.to_pylist()}
    if sorted(rows) != facts["detectors"]:
        raise Damaged(f"table products: version {products.key} lacks detectors of exposure {facts['exposure_id']}")
    exposures = read.version(lake, "exposures", products.manifest["facts"]["inputs"]["exposures"])
    (exposure,) = planned_rows(exposures, [facts["exposure_id"]], where=in_exposure).to_pylist()
    first = rows[facts["detectors"][0]]
    name = f"{exposure['channel']}_{exposure['band']}_science.fits"
    is_euclid = facts.get("names") == "euclid" and exposure["channel"] in level1.INSTRUMENTS
    if is_euclid:
        name = level1.file_name(ExposureRow.from_row(exposure))
    path = f"images/{exposure['exposure_id']:06d}/{name}"
    table = EXPOSURE_FILES.build(
        {
            "path": [path],
            **{name: [exposure[name]] for name in ("exposure_id", "channel", "band", "ra", "dec")},
            "detectors": [len(rows)],
            "planned": [facts["planned"]],
            "mission": [first["mission"]],
            "sources": [sum(row["sources"] for row in rows.values())],
        }
    )
    mission = read_back(read.version(lake, "mission", products.manifest["facts"]["inputs"]["mission"]))
    order = _sort_detectors(mission, exposure["camera"], facts["detectors"])
    files = [(detector.name, products.sidecar_path(rows[detector.name]["path"])) for detector in order]
    heads = [products.sidecar_path(head_files.head_path(rows[name]["path"])) for name, _ in files]
    # Arrays of VIS have the axes of the focal plane in Euclid's files.
    has_focal_plane_axes = is_euclid and exposure["channel"] in level1.FOCAL_PLANE_AXES
    turned = [detector.name for detector in order if has_focal_plane_axes and detector.upside_down]
    extra = _cards(exposure, facts, mission, is_euclid)
    writers = {
        path: partial(_write, files, *extra, _kept_keywords(exposure["camera"]), turned),
        head_files.head_path(path): partial(_write_heads, files, heads, turned),
    }
    return Output(table, writers)


def _sort_detectors(mission: MissionConfiguration, camera: str, names: Sequence[str]) -> list[detectors.Detector]:
    """Return the detectors with the given names, in the order of the mission database."""
    return [detector for detector in detectors.detectors(camera, mission) if detector.name in names]


def _cards(
    exposure: dict[str, Any], facts: Json, mission: MissionConfiguration, is_euclid: bool
) -> tuple[tuple[Card, ...], joined.ArrayCards]:
    """Return further cards of the primary header, and a function that returns further cards of an array."""
    cards: tuple[Card, ...] = (
        ("POSANGLE", exposure["position_angle"], "[deg] position angle, north through east"),
        ("NDETECT", len(facts["detectors"]), "number of detectors in this file"),
        ("NPLANNED", facts["planned"], "number of planned detectors of the exposure"),
    )
    if not is_euclid:
        return cards, joined.no_cards
    row = ExposureRow.from_row(exposure)
    cards += level1.exposure_cards(row, len(facts["detectors"]), mission)
    return cards, partial(level1.array_cards, exposure=row)


def _write_heads(files: Sequence[tuple[str, Path]], heads: Sequence[Path], turned: Sequence[str], path: Path) -> None:
    """Join the head files of image files, after turning the WCS by 180 deg for files with names in `turned`."""
    texts = []
    for (name, file), head in zip(files, heads, strict=True):
        text = head.read_text(encoding="ascii")
        if name in turned:
            sizes = joined.array_sizes(file)
            text = head_files.change_images(text, [partial(level1.turn_cards, size=size) for size in sizes])
        texts.append(text)
    head_files.write(texts, path)


def _kept_keywords(camera: str) -> tuple[str, ...]:
    """Return the keywords of the exposure that also stay in the headers of the arrays."""
    return _EXPOSURE_KEYWORDS if camera in _CAMERAS_WITHOUT_PRIMARY else headers.PER_ARRAY_KEYWORDS


def _write(
    files: Sequence[tuple[str, Path]],
    cards: Sequence[Card],
    array_cards: joined.ArrayCards,
    kept_keywords: Sequence[str],
    turned: Sequence[str],
    path: Path,
) -> None:
    changes = dict.fromkeys(turned, level1.turn_array)
    joined.join(path, files, _EXPOSURE_KEYWORDS, cards, kept_keywords, array_cards, changes)
