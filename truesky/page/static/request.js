// A request file for the visible field and the exposures that cover it.

import * as api from "/static/api.js";
import { imagesAt, load, within } from "/static/footprints.js";
import { scaleOf } from "/static/marks.js";

const MOST = 40;
const FACTS = ["exposure_id", "channel", "camera", "band", "image_type", "ra", "dec", "position_angle", "mjd", "exposure_time_s", "grism_angle"];

/**
 * The text of a request for a field at `place` = [ra, dec] deg with a `radius` in deg.
 * `regions` are the detectors that cover it, each with request, exposure_id and detector.
 */
async function requestOf(place, radius, regions) {
  // Exposure numbers are unique only within a request.
  const detectors = new Map(), name = (one) => `${api.of(one)}${one.exposure_id}`;
  for (const one of regions) detectors.set(name(one), [...(detectors.get(name(one)) ?? []), one]);
  const asked = [...detectors.values()].map((own) => own[0]).sort((a, b) => api.of(a).localeCompare(api.of(b)) || a.exposure_id - b.exposure_id);
  const rows = await exposures(asked.slice(0, MOST)), science = rows.filter((row) => row.image_type === "science");
  const lines = [`# Field at RA ${place[0].toFixed(6)}, Dec ${place[1].toFixed(6)} deg, from the page of ${api.lake.lake.replace(/[^\x20-\x7e]/g, "?")}.`,
    'name = "field"', "seed = 1   # seed of the universe; the seed of the lake's request gives the same sources", "",
    "[area]", `cone = { ra = ${place[0].toFixed(7)}, dec = ${place[1].toFixed(7)}, radius = ${decimal(Math.min(180, Math.max(1e-3, radius)))} }`];
  if (asked.length > MOST) lines.push("", `# The first ${MOST} of ${asked.length} exposures that cover the field.`);
  if (science.length < rows.length) lines.push("", `# ${rows.length - science.length} exposures are calibrations, which require an [[observation]].`);
  // If several requests have planned the same exposure, include it once.
  const pointings = science.map((row) => pointing(row, detectors.get(name(row)).map((one) => one.detector).sort()).join("\n"));
  for (const text of new Set(pointings)) lines.push("", text);
  return `${lines.join("\n")}\n`;
}

async function copied(make) {
  try {
    await load("tasks");
    await api.copy(await make(), "Request");
  } catch (error) {
    api.say(error.message, true);
  }
}

/** Request for a field with a radius (deg) around a position. */
export const copyFieldRequest = (place, radius) => copied(() => requestOf(place, radius, within(place, radius)));

/** Request for the exposure of an image: its detector and the field that the detector covers. */
export const copyImageRequest = (image) => copied(() => {
  const { nx, ny, plate, row } = image, place = plate.sky((nx - 1) / 2, (ny - 1) / 2);
  const own = imagesAt(place).filter((one) => one.request === image.request && one.exposure_id === row.exposure_id && one.detector === row.detector);
  return requestOf(place, 0.5 * Math.hypot(nx, ny) * scaleOf(image), own);
});

/** Rows of the table of exposures as objects, each with its request; empty if the lake has no such table. */
async function exposures(asked) {
  const tables = api.lake.tables.filter((table) => table.name.split(".").pop() === "exposures"), found = [];
  for (const request of new Set(asked.map((one) => one.request))) {
    const table = tables.find((one) => one.name === `${request}.exposures`) ?? tables.find((one) => one.name === "exposures");
    if (!table) continue;
    const has = table.columns.map((column) => column.name), names = FACTS.filter((name) => has.includes(name));
    const from = api.sqlName(table.name), numbers = asked.filter((one) => one.request === request).map((one) => one.exposure_id);
    const answer = await api.post("sql", { sql: `SELECT ${names.join(", ")} FROM ${from} WHERE exposure_id IN (${numbers.join(", ")}) ORDER BY exposure_id` });
    found.push(...answer.rows.map((row) => ({ request, ...Object.fromEntries(names.map((name, k) => [name, row[k]])) })));
  }
  return found;
}

function pointing(row, detectors) {
  const lines = ["[[pointing]]", ...["channel", "camera", "band"].map((name) => `${name} = ${JSON.stringify(row[name])}`)];
  for (const name of ["ra", "dec", "position_angle", "mjd", "exposure_time_s"]) if (typeof row[name] === "number") lines.push(`${name} = ${decimal(row[name])}`);
  if (row.channel === "NISP-S" && typeof row.grism_angle === "number") lines.push(`grism_angle = ${decimal(row.grism_angle)}`);
  return [...lines, `detectors = [${detectors.map((name) => JSON.stringify(name)).join(", ")}]`];
}

/** Format a non-integer number for TOML. */
const decimal = (value) => (Number.isInteger(value) ? value.toFixed(1) : String(value));
