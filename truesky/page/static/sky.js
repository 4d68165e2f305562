// The sky: densities in HEALPix cells, sources of small fields, footprints of planned and observed exposures.

import * as api from "/static/api.js";
import { Cells } from "/static/cells.js";
import { NAMES, bar, ink } from "/static/colour.js";
import { KINDS, drawFootprints, imagesAt, legend as footprintLegend, load as loadFootprints } from "/static/footprints.js";
import { graticule } from "/static/graticule.js";
import { goTo } from "/static/image.js";
import { cross, drawDots, firstOf } from "/static/marks.js";
import { pin, pinned } from "/static/pin.js";
import { copyFieldRequest } from "/static/request.js";
import { circleAround, frame, placeOf, project, unproject } from "/static/sphere.js";

const $ = (id) => document.getElementById(id);
// Single sources are shown if the height of the view (deg) is smaller than this.
const SINGLE = 0.35, ROWS_A_CELL = 50, MOST_ROWS = 500;
// The view changes to an image, if there is one, at a height (deg) smaller than this.
const PIXELS = 0.01;
const view = { ra: 0, dec: 0, height: 180 };
let page, density, overlay, cells = null, dots = null, isByKeys = false, isMoved = false, shownTable = "", where = "", value = "", held = "";

export function start(given) {
  page = given;
  const canvas = $("sky-canvas");
  overlay = canvas.parentElement.insertBefore(document.createElement("canvas"), canvas.nextSibling);
  overlay.setAttribute("aria-hidden", "true");
  overlay.style.pointerEvents = "none";
  $("sky-map").append(...NAMES.map((name) => api.h("option", {}, name)));
  $("sky-footprints").append(...KINDS.map((name) => api.h("option", {}, name)));
  $("sky-footprints").value = "tasks";
  const tables = api.lake.tables.filter((table) => table.is_catalogue);
  $("sky-table").append(...tables.map((table) => api.h("option", { title: table.meaning }, table.name)));
  if (!shownTable) shownTable = (tables.find((t) => t.name === "galaxies") ?? tables[0])?.name ?? "";
  $("sky-table").value = shownTable;
  $("sky-table").addEventListener("change", () => again($("sky-table").value, where));
  $("sky-where").addEventListener("change", () => again(shownTable, $("sky-where").value.trim()));
  $("sky-value").addEventListener("change", () => {
    value = $("sky-value").value.trim();
    again(shownTable, where);
  });
  $("sky-map").addEventListener("change", () => {
    density?.recolour($("sky-map").value);
    redraw();
  });
  $("sky-footprints").addEventListener("change", () => footprints());
  $("sky-all").addEventListener("click", () => whole(true));
  $("sky-to-table").addEventListener("click", () => {
    $("sky-data").hidden = !$("sky-data").hidden;
    asTable();
    redraw();
  });
  $("sky-go").addEventListener("change", go);
  $("sky-image").addEventListener("click", () => openAt([view.ra, view.dec], true));
  $("sky-python").addEventListener("click", () => api.copy(api.python(query()), "Python"));
  $("sky-sql").addEventListener("click", () => api.copy(query(), "SQL"));
  $("sky-request").addEventListener("click", () => copyFieldRequest([view.ra, view.dec], view.height / 2));
  canvas.addEventListener("wheel", zoomed, { passive: false });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", moved);
  canvas.addEventListener("click", (event) => event.detail < 2 && pinAt(placeAt(event)));
  canvas.addEventListener("dblclick", (event) => openAt(placeAt(event)));
}

/** Set up WebGL while the first responses are loading; return false if it is not available. */
function prepare() {
  if (density !== undefined) return Boolean(density);
  const gl = $("sky-canvas").getContext("webgl2", { antialias: true });
  density = gl ? new Cells(gl, $("sky-map").value) : null;
  if (!gl) api.say("This browser has no WebGL 2: the sky and the images cannot be drawn.", true);
  return Boolean(gl);
}

async function footprints() {
  redraw();
  try {
    await loadFootprints($("sky-footprints").value, near());
  } catch (error) {
    api.say(error.message, true);
  }
  redraw();
}

/** Add the bands of planned exposures, whose depth can be shown. */
async function depths() {
  if ($("sky-table").querySelector("optgroup")) return;
  const group = $("sky-table").appendChild(api.h("optgroup", { label: "planned exposures", hidden: true }));
  const bands = await api.get("bands").catch((error) => api.say(error.message, true)) ?? [];
  if (!bands.length) return;
  group.hidden = false;
  group.append(api.h("option", { value: "coverage of" }, "depth in all bands"), ...bands.map((band) => api.h("option", { value: `coverage of ${band}` }, `depth in ${band}`)));
  $("sky-table").value = shownTable;
}

/** Show other rows: the whole of another table, or the same view with another condition. */
function again(table, condition) {
  const isOther = table !== shownTable;
  shownTable = table;
  where = condition;
  cells = dots = null;
  held = "";
  load(isOther);
}

export async function show() {
  if (density === null) return;
  // The first request runs while the shaders are compiled.
  const loading = cells ? null : load(view.height >= 180);
  if (!prepare()) return;
  if (cells) {
    redraw();
    beside();
  }
  await loading;
}

/** Load footprints and bands after the first map, so that they do not delay it. */
function beside() {
  // Images are found by the footprints of tasks, whatever footprints are shown.
  loadFootprints("tasks").catch(() => {});
  footprints();
  depths();
}

const isCoverage = () => shownTable.startsWith("coverage of");

function addressOf(words) {
  if (isCoverage()) return `coverage?${new URLSearchParams({ ...words, band: shownTable.slice(12) })}`;
  return `sky/${shownTable}/density?${new URLSearchParams({ where: where || "true", ...(value ? { value } : {}), ...words })}`;
}

const use = (buffer) => (cells = density.filled(buffer, isCoverage() ? "depth" : value ? "mean" : "number"));

/** Show the cells of the files first, which cost no query, then cells that suit the view. */
async function load(all) {
  if (!shownTable) return;
  isMoved = false;
  try {
    if (!where && !value && !cells && !isCoverage()) {
      const buffer = await api.bytes(`sky/${shownTable}/parts`);
      if (!density) return;
      use(buffer);
      if (all && !isMoved) whole(false);
      redraw();
    }
    if (!cells) {
      use(await api.bytes(addressOf({ order: isCoverage() ? 9 : 6 })));
      if (all && !isMoved) whole(false);
    }
  } catch (error) {
    return api.say(error.message, true);
  } finally {
    beside();
  }
  await finer();
  // Adapt the view again, because the cells of files are larger than the area of their rows.
  if (all && !isMoved) whole(true);
}

function order() {
  const size = (view.height / Math.max(1, $("sky-canvas").clientHeight)) * 5;
  if (isCoverage()) return Math.max(3, Math.min(13, Math.round(Math.log2(58.6 / size))));
  // Choose cells of several pixels and several rows; smaller cells would only show Poisson noise.
  const filled = 0.5 * Math.log2((41253 * (cells?.rows ?? 1e4)) / (12 * ROWS_A_CELL));
  return Math.max(3, Math.min(14, Math.round(Math.log2(58.6 / size)), Math.floor(filled)));
}

/** A circle around the view, 1.5 times as wide. */
const near = () => ({ ra: view.ra, dec: view.dec, radius: Math.min(180, 1.5 * radius()) });

const finer = api.newest(async () => {
  const wanted = order(), here = near(), { radius } = here;
  const grid = Math.max(radius / 4, 1e-6), name = [shownTable, where, value, wanted, Math.round(view.ra / grid), Math.round(view.dec / grid), Math.round(Math.log2(radius) * 2)].join();
  if (name === held) return redraw();
  held = name;
  if (view.height < SINGLE && !isCoverage()) dots = await api.get(`sky/${shownTable}/sources?${new URLSearchParams({ ...here, where: where || "true" })}`);
  else {
    dots = null;
    use(await api.bytes(addressOf({ order: wanted, ...(radius < 60 ? here : {}) })));
  }
  if ($("sky-footprints").value === "exposures") footprints();
  asTable();
  redraw();
});

/** Show the whole area of the table. */
function whole(load_) {
  if (!cells?.head.cells) return;
  const { ra, dec, radius: far } = circleAround(cells.corners);
  const canvas = $("sky-canvas"), portrait = Math.max(1, canvas.clientHeight / Math.max(1, canvas.clientWidth));
  Object.assign(view, { ra, dec, height: Math.min(180, Math.max(0.2, 2.1 * far * portrait)) });
  if (load_) finer();
  page.remember();
}

function scale() {
  const canvas = $("sky-canvas"), half = view.height / 2;
  return [canvas.clientHeight / Math.max(1, canvas.clientWidth) / half, 1 / half];
}

export function redraw() {
  if (!density || $("sky").hidden) return;
  const turn = frame(view.ra, view.dec);
  density.paint($("sky-canvas"), cells, turn, scale(), dots ? 0.25 : 1);
  if (cells?.count) $("sky-legend").replaceChildren(...bar($("sky-map").value, api.number(cells.range[0], 3), api.number(cells.range[1], 3), legend()), api.h("div", {}, caption()));
  drawOver(turn);
  page.remember();
}

function legend() {
  if (isCoverage()) return `${shownTable.slice(12) || "all bands"}: planned exposures`;
  const missing = cells?.head.missing ? `, ${api.number(cells.head.missing)} rows without a value omitted` : "";
  return value ? `${shownTable}: mean of ${value}${missing}` : `${shownTable}: number / deg²`;
}

/** Describe what is omitted: cells below the 1 % or above the 99.5 % quantile are beyond the colour scale; only the brightest of many sources are shown. */
function caption() {
  if (dots) {
    const here = dots.ra.length, most = dots.most ?? 20000, all = dots.total ?? (here < most ? here : null);
    if (all === here) return `${api.number(here)} individual sources`;
    return `${dots.by ? `the ${firstOf(dots)} ${api.number(here)} by ${dots.by}` : `the first ${api.number(here)}`} of ${all === null ? "more" : api.number(all)} sources`;
  }
  const outside = isCoverage() ? 0 : cells.beyond;
  return outside ? `outside the colour scale: ${api.number(outside)} of ${api.number(cells.density.length)} cells` : "";
}

function drawOver(turn) {
  const [width, height, ratio] = api.fit(overlay), c = overlay.getContext("2d"), unit = height / view.height;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  const at = (ra, dec) => {
    const p = project(turn, ra, dec);
    return p && [width / 2 + p[0] * unit, height / 2 - p[1] * unit];
  };
  graticule(c, view, at, [width, height]);
  if (dots) drawDots(c, dots, at, ink(/star|gaia/.test(shownTable) ? "second" : "accent"));
  drawFootprints(c, $("sky-footprints").value, view, at, [width, height]);
  footprintLegend($("sky-footprints").value);
  const own = pinned()?.place && at(...pinned().place);
  if (own) {
    c.strokeStyle = ink("accent");
    c.lineWidth = 2;
    c.beginPath();
    c.arc(...own, 9, 0, 7);
    c.stroke();
  }
  if (isByKeys) cross(c, [width / 2, height / 2], ink("ink"));
}

function placeAt(event) {
  const box = $("sky-canvas").getBoundingClientRect(), unit = view.height / box.height;
  return unproject(frame(view.ra, view.dec), (event.clientX - box.left - box.width / 2) * unit, (box.height / 2 - event.clientY + box.top) * unit);
}

function moved(event) {
  const place = placeAt(event);
  isByKeys = false;
  $("sky-place").textContent = place ? api.place(...place) : "";
  if (!(event.buttons & 1)) return;
  pan((event.movementX / $("sky-canvas").clientHeight) * view.height, (event.movementY / $("sky-canvas").clientHeight) * view.height);
}

/** Remember that the user has moved, so that a table that arrives later does not reset the view. */
function went() {
  isMoved = true;
  redraw();
  finer();
}

function pan(dx, dy) {
  const place = unproject(frame(view.ra, view.dec), -dx, dy);
  if (place) [view.ra, view.dec] = [place[0], Math.max(-89.9, Math.min(89.9, place[1]))];
  went();
}

function zoomed(event) {
  event.preventDefault();
  const before = placeAt(event);
  isByKeys = false;
  zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) * 0.002), before, event);
}

function zoom(by, about, event) {
  view.height = Math.min(180, Math.max(2e-4, view.height * by));
  if (about && event) {
    // Keep the position under the cursor.
    const now = placeAt(event);
    if (now) {
      view.ra = (view.ra + about[0] - now[0] + 720) % 360;
      view.dec = Math.max(-89.9, Math.min(89.9, view.dec + about[1] - now[1]));
    }
  }
  const unit = $("sky-canvas").clientHeight / view.height;
  if (by < 1 && view.height < PIXELS && openAt(about ?? [view.ra, view.dec], false, unit)) {
    view.height = 2 * PIXELS;
    return;
  }
  went();
}

async function pinAt(place) {
  if (!place || view.height >= SINGLE) return;
  try {
    const { id } = await api.get(`nearest?${new URLSearchParams({ ra: place[0], dec: place[1], radius: view.height / 40 })}`);
    if (!id) return isByKeys && api.say("No source is near the centre.");
    await pin(id);
    redraw();
    if (pinned().id === id) api.say(`Source ${id} is pinned. The view Images shows it.`);
  } catch (error) {
    api.say(error.message, true);
  }
}

/** Open the image of a footprint at a position; return true if there is one. */
function openAt(place, isSaid = false, unit = null) {
  const inside = place ? imagesAt(place) : [];
  if (!inside.length) {
    if (isSaid) api.say("No image contains the centre of the view.");
    return false;
  }
  goTo(inside[0].images[0], place, unit);
  page.show("images");
  return true;
}

/** Show a position of an image with the same scale; `unit` is the number of screen pixels per degree. */
export function goToPlace([ra, dec], unit) {
  Object.assign(view, { ra, dec, height: Math.min(180, Math.max(2 * PIXELS, $("image-canvas").clientHeight / unit)) });
  page.show("sky").then(finer);
}

const radius = () => 0.5 * Math.hypot(view.height, (view.height * $("sky-canvas").clientWidth) / Math.max(1, $("sky-canvas").clientHeight));

/** Open the query editor with a query for the rows in view. */
function query() {
  const near = `separation(ra, dec, ${view.ra.toFixed(7)}, ${view.dec.toFixed(7)}) <= ${Math.min(180, radius()).toPrecision(6)}`;
  const tasks = api.lake.tables.filter((table) => table.name.split(".").pop() === "tasks").map((table) => `SELECT * FROM ${api.sqlName(table.name)}`);
  const table = isCoverage() ? `(${tasks.join(" UNION ALL ")})` : api.sqlName(shownTable);
  return `SELECT *\nFROM ${table}\nWHERE ${where && !isCoverage() ? `(${where}\n)\n  AND ` : ""}${near}\n`;
}

function go() {
  const place = placeOf($("sky-go").value);
  if (!place) return api.say("Enter RA and Dec in degrees or as 03:32:28.1 -27:48:29", true);
  Object.assign(view, { ra: place[0], dec: place[1], height: Math.min(view.height, 0.3) });
  went();
}

/** Show the numbers of the map as a table, if it is open. */
function asTable() {
  const data = $("sky-data");
  if (data.hidden || !cells) return;
  if (dots) {
    const rows = dots.ra.slice(0, MOST_ROWS).map((ra, k) => [dots.id[k], api.degrees(ra), api.degrees(dots.dec[k]), dots.mag[k]]);
    return data.replaceChildren(api.table([{ name: "id" }, { name: "RA", unit: "deg" }, { name: "Dec", unit: "deg" }, { name: dots.by ?? "magnitude" }], rows,
      api.cut(rows.length, dots.ra.length, `sources, the ${firstOf(dots)} first`)));
  }
  const all = [...cells.density].map((d, k) => [api.degrees(cells.corners[8 * k]), api.degrees(cells.corners[8 * k + 1]), d]);
  const rows = all.sort((a, b) => b[2] - a[2]).slice(0, MOST_ROWS);
  data.replaceChildren(api.table([{ name: "RA of a corner", unit: "deg" }, { name: "Dec of a corner", unit: "deg" }, { name: legend() }], rows,
    api.cut(rows.length, all.length, "cells, the largest values first")));
}

export function key(event) {
  const step = view.height / 8, move = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
  const isHere = event.target === $("sky-canvas") || event.target === document.body;
  isByKeys = true;
  if (move) pan(...move);
  else if (event.key === "+" || event.key === "=") zoom(0.7);
  else if (event.key === "-") zoom(1 / 0.7);
  else if (event.key === "0") whole(true);
  else if (event.key === "o" || event.key === "O") openAt([view.ra, view.dec], true);
  else if (event.key === "Enter" && isHere) view.height < SINGLE ? pinAt([view.ra, view.dec]) : api.say(`Zoom in to less than ${SINGLE} deg to pin a source.`);
  else return;
  event.preventDefault();
  $("sky-place").textContent = api.place(view.ra, view.dec);
  api.tell($("sky-place").textContent);
}
export const state = () => ({ ...view, table: shownTable, where, value, map: $("sky-map").value, footprints: $("sky-footprints").value });
export function restore(was) {
  for (const name of ["ra", "dec", "height"]) if (Number.isFinite(was[name])) view[name] = was[name];
  if (api.lake.tables.some((table) => table.name === was.table)) $("sky-table").value = shownTable = was.table;
  if (typeof was.table === "string" && was.table.startsWith("coverage of")) shownTable = was.table;
  if (typeof was.value === "string") $("sky-value").value = value = was.value;
  if (typeof was.where === "string") $("sky-where").value = where = was.where;
  if (KINDS.includes(was.footprints)) $("sky-footprints").value = was.footprints;
  if (NAMES.includes(was.map)) {
    $("sky-map").value = was.map;
    density?.recolour(was.map);
  }
  cells = dots = null;
  held = "";
}
