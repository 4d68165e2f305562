// The sky: densities in HEALPix cells, sources of small fields, footprints of what is planned and observed.

import * as api from "/static/api.js";
import { NAMES, bar, ink, lutTexture, program } from "/static/colour.js";
import { graticule, line } from "/static/graticule.js";
import { goTo } from "/static/image.js";
import { pin, pinned } from "/static/pin.js";
import { frame, project, unproject, vector } from "/static/sphere.js";

const $ = (id) => document.getElementById(id);
const VERTEX = `in vec3 place; in float value; uniform mat3 turn; uniform vec2 scale; uniform vec2 range; uniform bool linear; out float level;
void main() {
  vec3 v = turn * place;
  float k = sqrt(2.0 / max(1.0 + v.z, 1e-6)) * 57.29577951308232;
  gl_Position = v.z < -0.9 ? vec4(9.0, 9.0, 9.0, 1.0) : vec4(-v.x * k * scale.x, v.y * k * scale.y, 0.0, 1.0);
  level = clamp(((linear ? value : log(value)) - range.x) / max(range.y - range.x, 1e-6), 0.0, 1.0);
}`;
const FRAGMENT = `in float level; uniform sampler2D colours; uniform float alpha; out vec4 colour;
void main() { colour = vec4(texture(colours, vec2(level, 0.5)).rgb, 1.0) * alpha; }`;
const STATES = { planned: "quiet", observed: "second", failed: "bad" };
// Below this height of the view, deg, sources are shown one by one.
const SINGLE = 0.35, ROWS_A_CELL = 50;
const view = { ra: 0, dec: 0, height: 180 };
let page, gl, parts, overlay, cells = null, dots = null, regions = [], shownTable = "", where = "", value = "", held = "", colours;

export function start(given) {
  page = given;
  const canvas = $("sky-canvas");
  overlay = canvas.parentElement.insertBefore(document.createElement("canvas"), canvas.nextSibling);
  overlay.setAttribute("aria-hidden", "true");
  overlay.style.pointerEvents = "none";
  gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) return api.say("This browser has no WebGL 2: the sky and the images cannot be drawn.", true);
  parts = program(gl, VERTEX, FRAGMENT);
  $("sky-map").append(...NAMES.map((name) => api.h("option", {}, name)));
  const tables = api.lake.tables.filter((table) => table.is_catalogue);
  $("sky-table").append(...tables.map((table) => api.h("option", { title: table.meaning }, table.name)));
  if (!shownTable) shownTable = (tables.find((t) => t.name === "galaxies") ?? tables[0])?.name ?? "";
  $("sky-table").value = shownTable;
  $("sky-table").addEventListener("change", () => again($("sky-table").value, where));
  $("sky-where").addEventListener("change", () => again(shownTable, $("sky-where").value.trim()));
  api.get("bands").then((bands) => bands.length && $("sky-table").append(api.h("optgroup", { label: "planned exposures" },
    api.h("option", { value: "coverage of" }, "all bands"), ...bands.map((band) => api.h("option", { value: `coverage of ${band}` }, band)))),
    (error) => api.say(error.message, true)).then(() => ($("sky-table").value = shownTable));
  $("sky-value").addEventListener("change", () => {
    value = $("sky-value").value.trim();
    again(shownTable, where);
  });
  $("sky-map").addEventListener("change", () => {
    colours = lutTexture(gl, $("sky-map").value, colours);
    redraw();
    page.remember();
  });
  $("sky-regions").addEventListener("change", redraw);
  $("sky-all").addEventListener("click", () => whole(true));
  $("sky-to-table").addEventListener("click", asTable);
  $("sky-go").addEventListener("change", go);
  canvas.addEventListener("wheel", zoomed, { passive: false });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", moved);
  canvas.addEventListener("click", clicked);
  canvas.addEventListener("dblclick", opened);
  colours = lutTexture(gl, $("sky-map").value);
}

function again(table, condition) {
  shownTable = table;
  where = condition;
  cells = dots = null;
  held = "";
  load(true);
}

// ---------------------------------------------------------------------------------------------- data

export async function show() {
  if (!gl) return;
  if (!regions.length) regions = await api.get("regions");
  if (!cells) await load(view.height >= 180);
  else redraw();
}

const isCoverage = () => shownTable.startsWith("coverage of");

function addressOf(words) {
  if (isCoverage()) return `coverage?${new URLSearchParams({ ...words, band: shownTable.slice(12) })}`;
  return `sky/${shownTable}/density?${new URLSearchParams({ where: where || "true", ...(value ? { value } : {}), ...words })}`;
}

/** First the files' own cells, which cost nothing; then what suits the view. */
async function load(all) {
  if (!shownTable) return;
  try {
    if (!where && !value && !cells && !isCoverage()) {
      use(await api.bytes(`sky/${shownTable}/parts`));
      if (all) whole(false);
      redraw();
    }
    if (!cells) {
      use(await api.bytes(addressOf({ order: isCoverage() ? 9 : 6 })));
      if (all) whole(false);
    }
  } catch (error) {
    return api.say(error.message, true);
  }
  await finer();
  // The cells of files are wider than what is in them.
  if (all) whole(true);
}

function order() {
  const size = (view.height / Math.max(1, $("sky-canvas").clientHeight)) * 5;
  if (isCoverage()) return Math.max(3, Math.min(13, Math.round(Math.log2(58.6 / size))));
  // Cells of some pixels, and of some rows: smaller ones would show nothing but their Poisson noise.
  const filled = 0.5 * Math.log2((41253 * (cells?.rows ?? 1e4)) / (12 * ROWS_A_CELL));
  return Math.max(3, Math.min(14, Math.round(Math.log2(58.6 / size)), Math.floor(filled)));
}

const finer = api.newest(async () => {
  const box = $("sky-canvas"), radius = Math.min(180, 0.75 * Math.hypot(view.height, (view.height * box.clientWidth) / Math.max(1, box.clientHeight)));
  const wanted = order(), near = { ra: view.ra, dec: view.dec, radius };
  const grid = Math.max(radius / 4, 1e-6), name = [shownTable, where, value, wanted, Math.round(view.ra / grid), Math.round(view.dec / grid), Math.round(Math.log2(radius) * 2)].join();
  if (name === held) return redraw();
  held = name;
  if (view.height < SINGLE && !isCoverage()) dots = await api.get(`sky/${shownTable}/sources?${new URLSearchParams({ ...near, where: where || "true" })}`);
  else {
    dots = null;
    use(await api.bytes(addressOf({ order: wanted, ...(radius < 60 ? near : {}) })));
  }
  redraw();
});

function use(buffer) {
  const [head, at] = api.headed(buffer), corners = new Float32Array(buffer, at, head.cells * 8), density = new Float32Array(buffer, at + head.cells * 32, head.cells);
  const data = new Float32Array(head.cells * 24);
  for (let k = 0; k < head.cells; k++) {
    const own = [0, 1, 2, 3].map((c) => vector(corners[8 * k + 2 * c], corners[8 * k + 2 * c + 1]));
    [0, 1, 2, 0, 2, 3].forEach((c, n) => data.set([...own[c], density[k]], 24 * k + 4 * n));
  }
  const linear = isCoverage() || Boolean(value), filled = [...density].filter((d) => linear || d > 0).sort((a, b) => a - b), at5 = (share) => filled[Math.floor(share * (filled.length - 1))] ?? 1;
  cells = { head, density, corners, count: head.cells * 6, buffer: cells?.buffer ?? gl.createBuffer(), linear,
    range: isCoverage() ? [0, filled.at(-1) ?? 1] : [at5(0.01), at5(0.995)], rows: rowsOf(head, density) };
  if (cells.range[0] >= cells.range[1]) cells.range = linear ? [cells.range[0] - 0.5, cells.range[1] + 0.5] : [cells.range[0] / 2, cells.range[1] * 1.01];
  gl.bindBuffer(gl.ARRAY_BUFFER, cells.buffer);
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
}

/** Rows a square degree, of the cells that have any. */
const rowsOf = (head, density) => (head.rows * 12 * 4 ** (head.order ?? 5)) / (41253 * Math.max(1, density.length));

/** Show everything that the table has. */
function whole(load_) {
  if (!cells?.head.cells) return;
  let sum = [0, 0, 0];
  const places = [];
  for (let k = 0; k < cells.corners.length; k += 2) {
    const v = vector(cells.corners[k], cells.corners[k + 1]);
    places.push(v);
    sum = sum.map((s, i) => s + v[i]);
  }
  const size = Math.hypot(...sum) || 1, mean = sum.map((s) => s / size);
  view.ra = ((Math.atan2(mean[1], mean[0]) * 180) / Math.PI + 360) % 360;
  view.dec = (Math.asin(mean[2]) * 180) / Math.PI;
  const far = Math.acos(Math.min(1, Math.max(-1, Math.min(...places.map((v) => v[0] * mean[0] + v[1] * mean[1] + v[2] * mean[2])))));
  view.height = Math.min(180, Math.max(0.2, ((far * 180) / Math.PI) * 2.1));
  if (load_) finer();
  page.remember();
}

// ---------------------------------------------------------------------------------------------- drawing

function scale() {
  const canvas = $("sky-canvas"), half = view.height / 2;
  return [canvas.clientHeight / Math.max(1, canvas.clientWidth) / half, 1 / half];
}

export function redraw() {
  if (!gl || $("sky").hidden) return;
  const canvas = $("sky-canvas");
  api.fit(canvas);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT);
  const turn = frame(view.ra, view.dec);
  if (cells?.count) {
    gl.useProgram(parts);
    gl.bindBuffer(gl.ARRAY_BUFFER, cells.buffer);
    for (const [name, size, from] of [["place", 3, 0], ["value", 1, 12]]) {
      const at = gl.getAttribLocation(parts, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, 16, from);
    }
    const uniform = (name) => gl.getUniformLocation(parts, name);
    gl.uniformMatrix3fv(uniform("turn"), true, turn);
    gl.uniform2fv(uniform("scale"), scale());
    gl.uniform2fv(uniform("range"), cells.linear ? cells.range : cells.range.map(Math.log));
    gl.uniform1i(uniform("linear"), cells.linear ? 1 : 0);
    gl.uniform1f(uniform("alpha"), dots ? 0.25 : 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, colours);
    gl.drawArrays(gl.TRIANGLES, 0, cells.count);
    $("sky-legend").replaceChildren(...bar($("sky-map").value, api.number(cells.range[0], 3), api.number(cells.range[1], 3), legend()));
  }
  drawOver(turn);
  page.remember();
}

function legend() {
  if (isCoverage()) return `${shownTable.slice(12) || "all bands"}: planned exposures`;
  const missing = cells?.head.missing ? `, ${api.number(cells.head.missing)} rows without one left out` : "";
  return value ? `${shownTable}: mean of ${value}${missing}` : `${shownTable}: number / deg²`;
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
  if (dots) drawDots(c, at);
  if ($("sky-regions").checked) {
    for (const region of regions) {
      const points = [...region.polygon, region.polygon[0]].map(([ra, dec]) => at(ra, dec));
      // On a ground of the page's colour: cells may have any.
      for (const [colour, wide] of [["paper", 4], [STATES[region.state], 1.6]]) {
        c.strokeStyle = ink(colour);
        c.lineWidth = wide;
        c.setLineDash(region.state === "planned" && wide < 4 ? [5, 4] : []);
        line(c, points);
      }
      const top = at(...region.polygon[0]);
      if (top && view.height < 3) {
        const text = `${region.band ?? region.channel} ${region.detector}, ${region.state}`;
        c.font = "12px DejaVu Sans, sans-serif";
        c.lineWidth = 4;
        c.setLineDash([]);
        c.strokeStyle = ink("paper");
        c.strokeText(text, top[0] + 4, top[1] - 5);
        c.fillStyle = ink(STATES[region.state]);
        c.fillText(text, top[0] + 4, top[1] - 5);
      }
    }
    c.setLineDash([]);
  }
  const own = pinned()?.place && at(...pinned().place);
  if (own) {
    c.strokeStyle = ink("accent");
    c.lineWidth = 2;
    c.beginPath();
    c.arc(...own, 9, 0, 7);
    c.stroke();
  }
}

function drawDots(c, at) {
  const mags = dots.mag.filter((m) => m !== null), faint = Math.max(...mags, 0), bright = Math.min(...mags, faint - 1);
  const star = shownTable.includes("star") || shownTable.includes("gaia");
  c.fillStyle = star ? ink("second") : ink("accent");
  dots.ra.forEach((ra, k) => {
    const point = at(ra, dots.dec[k]);
    if (!point) return;
    const share = dots.mag[k] === null ? 0.3 : (faint - dots.mag[k]) / (faint - bright);
    c.globalAlpha = 0.35 + 0.6 * share;
    c.beginPath();
    c.arc(...point, 0.9 + 4.5 * share ** 2, 0, 7);
    c.fill();
  });
  c.globalAlpha = 1;
}

// ---------------------------------------------------------------------------------------------- moves

function placeAt(event) {
  const box = $("sky-canvas").getBoundingClientRect(), unit = view.height / box.height;
  return unproject(frame(view.ra, view.dec), (event.clientX - box.left - box.width / 2) * unit, (box.height / 2 - event.clientY + box.top) * unit);
}

function moved(event) {
  const place = placeAt(event);
  $("sky-place").textContent = place ? api.place(...place) : "";
  if (!(event.buttons & 1)) return;
  pan((event.movementX / $("sky-canvas").clientHeight) * view.height, (event.movementY / $("sky-canvas").clientHeight) * view.height);
}

function pan(dx, dy) {
  const place = unproject(frame(view.ra, view.dec), -dx, dy);
  if (place) [view.ra, view.dec] = [place[0], Math.max(-89.9, Math.min(89.9, place[1]))];
  redraw();
  finer();
}

function zoomed(event) {
  event.preventDefault();
  const before = placeAt(event);
  zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) * 0.002), before, event);
}

function zoom(by, about, event) {
  view.height = Math.min(180, Math.max(2e-4, view.height * by));
  if (about && event) {
    // The place under the cursor stays there.
    const now = placeAt(event);
    if (now) {
      view.ra = (view.ra + about[0] - now[0] + 720) % 360;
      view.dec = Math.max(-89.9, Math.min(89.9, view.dec + about[1] - now[1]));
    }
  }
  redraw();
  finer();
}

async function clicked(event) {
  const place = placeAt(event);
  if (!place || event.detail > 1 || view.height >= SINGLE) return;
  const found = await api.get(`nearest?${new URLSearchParams({ ra: place[0], dec: place[1], radius: view.height / 40 })}`).catch(() => ({}));
  if (found.id) {
    await pin(found.id);
    redraw();
    api.say(`Source ${found.id} is pinned: Images shows it.`);
  }
}

/** The image of a footprint, at that place. */
function opened(event) {
  const place = placeAt(event);
  const inside = place && regions.filter((r) => r.images.length && contains(r.polygon, place));
  if (inside?.length) {
    goTo(inside[0].images[0], place);
    page.show("images");
  }
}

function contains(polygon, [ra, dec]) {
  const turn = frame(ra, dec), points = polygon.map((corner) => project(turn, ...corner));
  const sides = points.map((p, k) => {
    const q = points[(k + 1) % points.length];
    return p && q ? p[0] * q[1] - p[1] * q[0] : NaN;
  });
  return sides.every((s) => s >= 0) || sides.every((s) => s <= 0);
}

function go() {
  const text = $("sky-go").value.trim(), numbers = text.match(/[-+−]?\d+(\.\d+)?/g)?.map((t) => Number(t.replace("−", "-"))) ?? [];
  if (numbers.length === 6 && /:/.test(text)) {
    const [h, m, s, d, n, t] = numbers, sign = /[-−]\s*\d/.test(text) ? -1 : 1;
    numbers.splice(0, 6, 15 * (h + m / 60 + s / 3600), sign * (Math.abs(d) + n / 60 + t / 3600));
  }
  if (numbers.length !== 2 || Math.abs(numbers[1]) > 90) return api.say("Go to: wanted RA and Dec, in degrees or as 03:32:28.1 -27:48:29", true);
  Object.assign(view, { ra: ((numbers[0] % 360) + 360) % 360, dec: numbers[1], height: Math.min(view.height, 0.3) });
  finer();
}

function asTable() {
  const data = $("sky-data");
  data.hidden = !data.hidden;
  if (data.hidden || !cells) return redraw();
  const rows = [...cells.density].map((d, k) => [cells.corners[8 * k], cells.corners[8 * k + 1], d]).sort((a, b) => b[2] - a[2]).slice(0, 500);
  data.replaceChildren(api.table([{ name: "RA of a corner", unit: "deg" }, { name: "Dec of a corner", unit: "deg" }, { name: legend() }], rows));
  redraw();
}

export function key(event) {
  const step = view.height / 8, move = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
  if (move) pan(...move);
  else if (event.key === "+" || event.key === "=") zoom(0.7);
  else if (event.key === "-") zoom(1 / 0.7);
  else if (event.key === "0") whole(true);
  else return;
  event.preventDefault();
}
export const state = () => ({ ...view, table: shownTable, where, value, map: $("sky-map").value });
export function restore(was) {
  for (const name of ["ra", "dec", "height"]) if (Number.isFinite(was[name])) view[name] = was[name];
  if (api.lake.tables.some((table) => table.name === was.table)) $("sky-table").value = shownTable = was.table;
  if (typeof was.table === "string" && was.table.startsWith("coverage of")) shownTable = was.table;
  if (typeof was.value === "string") $("sky-value").value = value = was.value;
  if (typeof was.where === "string") $("sky-where").value = where = was.where;
  if (NAMES.includes(was.map)) {
    $("sky-map").value = was.map;
    if (gl) colours = lutTexture(gl, was.map, colours);
  }
  cells = dots = null;
  held = "";
}
