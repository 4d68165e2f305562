// Footprints on the sky with their state: exposures, tasks (one detector of an exposure each) or products.

import * as api from "/static/api.js";
import { ink } from "/static/colour.js";
import { line } from "/static/graticule.js";
import { frame, project, vector } from "/static/sphere.js";

const $ = (id) => document.getElementById(id);
export const KINDS = ["exposures", "tasks", "products", "nothing"];
// Colour and dashes: states can be distinguished without colour.
const STATES = { planned: ["quiet", [5, 4]], partly: ["accent", [10, 3, 2, 3]], observed: ["second", []], failed: ["bad", [2, 3]] };
// Names are written if the height of the view (deg) is below NAMED and at most MOST_NAMED footprints are in view.
const NAMED = 3, MOST_NAMED = 80;
// Line spacing of names in pixels.
const LINE = 14;
const known = {};

/** Load footprints once; if there are too many exposures, load those within the circle `near` = { ra, dec, radius } in deg. Returns a promise. */
export function load(kind, near) {
  if (kind === "nothing") return Promise.resolve();
  if (kind === "exposures") return exposures(near);
  known.regions ??= api.get("regions").then((found) => (known.regions.rows = found), (error) => {
    delete known.regions;
    throw error;
  });
  return known.regions;
}

/** Load all exposures; if the server refuses because they are too many, load those near the view. `of` is the loaded circle. */
async function exposures(near) {
  const has = known.exposures, isFirst = !has;
  if (has?.of && away(has.of, near) + near.radius <= has.of.radius) return has.under;
  // Load somewhat more than the view, so that not every move needs a request.
  const of = isFirst ? { ...near, radius: Infinity } : { ...near, radius: Math.min(180, 1.5 * near.radius) };
  const mine = (known.exposures = { of, rows: has?.rows ?? [], said: has?.said });
  mine.under = api.get(isFirst ? "exposures" : `exposures?${new URLSearchParams(of)}`).then((found) => Object.assign(mine, { rows: found, said: "" }), (error) => {
    Object.assign(mine, { of: null, rows: [], said: error.message });
    if (isFirst) return exposures(near);
  });
  return mine.under;
}

/** Angular distance of two positions in deg. */
function away(one, other) {
  const a = vector(one.ra, one.dec), b = vector(other.ra, other.dec);
  return (2 * Math.asin(Math.min(1, Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]) / 2)) * 180) / Math.PI;
}

/** [{state, polygons, name}] of a kind that are loaded. */
function shown(kind) {
  if (kind === "exposures") return (known.exposures?.rows ?? []).map((one) => ({ ...one, polygons: one.outline,
    name: `${api.of(one)}${one.band ?? one.channel} exposure ${one.exposure_id}, ${one.done} of ${one.all} detectors${one.failed ? `, ${one.failed} failed` : ""}` }));
  const rows = known.regions?.rows ?? [];
  if (kind === "tasks") return rows.map((one) => ({ ...one, polygons: [one.polygon], name: `${api.of(one)}${one.band ?? one.channel} ${one.detector}, ${one.state}` }));
  return kind === "products" ? rows.filter((one) => one.images.length).map((one) => ({ ...one, polygons: [one.polygon],
    name: `${api.of(one)}${one.band ?? one.channel} ${one.detector}: ${one.contents?.map((content) => content.replace("_", " ")).join(", ") ?? one.images.length}` })) : [];
}

/** Detectors with images that contain a position. */
export function imagesAt(place) {
  return (known.regions?.rows ?? []).filter((one) => one.images.length && contains(one.polygon, place));
}

/** Detectors and exposures whose footprints have a corner in a circle or contain its centre. */
export function within(place, radius) {
  const turn = frame(...place);
  const near = (corner) => {
    const p = project(turn, ...corner);
    return p && Math.hypot(...p) < radius;
  };
  return (known.regions?.rows ?? []).filter((one) => one.polygon.some(near) || contains(one.polygon, place));
}

function contains(polygon, [ra, dec]) {
  const turn = frame(ra, dec), points = polygon.map((corner) => project(turn, ...corner));
  const sides = points.map((p, k) => {
    const q = points[(k + 1) % points.length];
    return p && q ? p[0] * q[1] - p[1] * q[0] : NaN;
  });
  return sides.every((s) => s >= 0) || sides.every((s) => s <= 0);
}

/** Draw the footprints of a kind; `at`: RA, Dec -> screen. */
export function drawFootprints(c, kind, view, at, [width, height]) {
  const seen = [];
  for (const one of shown(kind)) {
    for (const polygon of one.polygons) {
      const points = [...polygon, polygon[0]].map((corner) => at(...corner));
      const [xs, ys] = [0, 1].map((k) => points.filter(Boolean).map((p) => p[k]));
      if (xs.length && Math.max(...xs) > 0 && Math.min(...xs) < width && Math.max(...ys) > 0 && Math.min(...ys) < height) seen.push([one, points]);
    }
  }
  for (const [one, points] of seen) {
    const [ink_, dashes] = STATES[one.state];
    // Draw a line in the colour of the page below, because cells may have any colour.
    for (const [colour, wide] of [["paper", 4], [ink_, 1.6]]) {
      c.strokeStyle = ink(colour);
      c.lineWidth = wide;
      c.setLineDash(wide < 4 ? dashes : []);
      line(c, points);
    }
  }
  c.setLineDash([]);
  if (view.height >= NAMED || seen.length > MOST_NAMED) return;
  const taken = [];
  for (const [one, points] of seen) {
    const [x, first] = points.find(Boolean);
    let y = first;
    // If names of several requests fall on the same place, write them below each other.
    while (taken.some(([u, v]) => Math.abs(u - x) < LINE && Math.abs(v - y) < LINE)) y += LINE;
    taken.push([x, y]);
    write(c, one, [x, y]);
  }
}

function write(c, one, [x, y]) {
  c.font = "12px DejaVu Sans, sans-serif";
  c.textAlign = "left";
  c.lineWidth = 4;
  c.strokeStyle = ink("paper");
  c.strokeText(one.name, x + 4, y - 5);
  c.fillStyle = ink(STATES[one.state][0]);
  c.fillText(one.name, x + 4, y - 5);
}

/** Legend of the lines with the number of footprints in each state. */
export function legend(kind) {
  const all = shown(kind), said = kind === "exposures" && known.exposures?.said, rows = said ? [api.h("div", {}, said)] : [];
  for (const state of Object.keys(STATES)) {
    const some = all.filter((one) => one.state === state).length;
    if (some) rows.push(api.h("div", {}, swatch(...STATES[state]), ` ${state}: ${api.number(some)}`));
  }
  $("sky-states").replaceChildren(...(rows.length ? [api.h("div", {}, kind), ...rows] : []));
}

function swatch(colour, dashes) {
  const made = api.h("canvas", { class: "swatch", width: 72, height: 16, "aria-hidden": "true" }), c = made.getContext("2d");
  c.scale(2, 2);
  c.strokeStyle = ink(colour);
  c.lineWidth = 1.6;
  c.setLineDash(dashes);
  line(c, [[0, 4], [36, 4]]);
  return made;
}
