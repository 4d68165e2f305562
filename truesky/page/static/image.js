// Images: tiles of every product, stretched and coloured by WebGL, with true sources.

import * as api from "/static/api.js";
import { NAMES, bar, lutTexture, program } from "/static/colour.js";
import { pin, pinned, onPin, redraw as redrawPin } from "/static/pin.js";
import { compass, cross, radiusOf, scaleOf } from "/static/marks.js";
import { copyImageRequest } from "/static/request.js";
import { Plate } from "/static/sphere.js";
import { Tiles } from "/static/tiles.js";
import { drawTraces, use } from "/static/trace.js";
import { asked as truthOf, caption, drawSources, sourcesOf, tip } from "/static/truth.js";

const $ = (id) => document.getElementById(id);
const VERTEX = `in vec2 corner; uniform mat3 toScreen; uniform vec4 box; out vec2 at;
void main() {
  at = corner;
  vec3 p = toScreen * vec3(box.xy + corner * box.zw, 1.0);
  gl_Position = vec4(p.xy, 0.0, 1.0);
}`;
const FRAGMENT = `in vec2 at; uniform sampler2D pixels; uniform sampler2D colours; uniform vec3 levels; uniform int stretch; out vec4 colour;
void main() {
  float v = texture(pixels, at).r;
  float x = v - levels.x, w = levels.y - levels.x, k = levels.z, t;
  if (stretch == 0) t = asinh(x / k) / asinh(w / k);
  else if (stretch == 1) t = x / w;
  else if (stretch == 2) t = log(1.0 + max(x, 0.0) / k) / log(1.0 + w / k);
  else t = sqrt(max(x, 0.0) / w);
  colour = isnan(v) ? vec4(0.25, 0.0, 0.25, 1.0) : texture(colours, vec2(clamp(t, 0.0, 1.0), 0.5));
}`;
const STRETCHES = ["asinh", "linear", "log", "sqrt"];
// Level in sigmas at which asinh turns from linear to logarithmic; duration of a blink in ms.
const KNEE = 4, BLINK_MS = 750;
const view = { one: -1, two: -1, x: 0, y: 0, zoom: 0 }, opened = new Map();
let page, list = null, gl, drawing, quad, colours, other = false, blinking = null, wanted = null, asked = false, isByKeys = false, cursor = null, tiles;

export function start(given) {
  page = given;
  const canvas = $("image-canvas");
  $("image-map").append(...NAMES.map((name) => api.h("option", {}, name)));
  $("image-map").value = "gray";
  $("image-map").addEventListener("change", () => {
    if (gl) lutTexture(gl, $("image-map").value, colours);
    redraw();
  });
  for (const name of ["image-stretch", "image-black", "image-white", "image-mended", "image-truth"]) $(name).addEventListener("input", redraw);
  $("image-one").addEventListener("change", () => choose(Number($("image-one").value)));
  $("image-two").addEventListener("change", async () => {
    view.two = Number($("image-two").value);
    if (view.two >= 0) await open(view.two);
    redraw();
  });
  $("image-blink").addEventListener("click", blink);
  $("image-all").addEventListener("click", () => whole());
  $("image-sky").addEventListener("click", toSky);
  $("image-request").addEventListener("click", () => copyImageRequest(opened.get(view.one)));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) * 0.002), event);
  }, { passive: false });
  canvas.addEventListener("pointermove", moved);
  canvas.addEventListener("pointerleave", () => {
    cursor = null;
    $("image-tip").hidden = true;
  });
  let from = [0, 0];
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    from = [event.clientX, event.clientY];
  });
  canvas.addEventListener("click", (event) => Math.hypot(event.clientX - from[0], event.clientY - from[1]) < 4 && pinAt(...pixelAt(event)));
  onPin(redraw);
  use({ show: async (number, x, y) => {
    await choose(number).catch((error) => api.say(error.message, true));
    Object.assign(view, { x, y, zoom: Math.max(1, view.zoom) });
    redraw();
  } });
}

/** Set up WebGL when the first image is shown; return false if it is not available. */
function prepare() {
  if (gl !== undefined) return Boolean(gl);
  gl = $("image-canvas").getContext("webgl2");
  if (!gl) return false;
  drawing = program(gl, VERTEX, FRAGMENT);
  tiles = new Tiles(gl, redraw);
  quad = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, quad);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]), gl.STATIC_DRAW);
  colours = lutTexture(gl, $("image-map").value);
  return true;
}

/** Show an image at a position on the sky in deg; `unit` is the number of screen pixels per degree. */
export function goTo(number, place, unit = null) {
  wanted = { number, place, unit };
}

/** Show the sky at the centre of the view with the same scale. */
function toSky() {
  if (opened.has(view.one)) page.toSky(opened.get(view.one).plate.sky(view.x, view.y), view.zoom / scaleOf(opened.get(view.one)));
}

export async function show() {
  if (!prepare()) return;
  list ??= await api.get("images");
  if (!list.length) return api.say("The lake has no images.");
  if (!$("image-one").childElementCount) {
    const name = (one) => `${api.of(one)}${one.exposure_id} ${one.channel} ${one.band} ${one.detector}: ${one.content.replace("_", " ")}`;
    $("image-one").append(...list.map((one) => api.h("option", { value: one.number }, name(one))));
    $("image-two").append(api.h("option", { value: -1 }, "nothing"), ...list.map((one) => api.h("option", { value: one.number }, name(one))));
  }
  if (wanted) {
    const { number, place, unit } = wanted;
    wanted = null;
    await choose(number, place, false, unit);
  } else if (view.one < 0 || view.one >= list.length) await choose(list.findIndex((one) => one.content === "science"));
  else await choose(view.one, null, true);
  redrawPin();
}

async function open(number) {
  if (!opened.has(number)) {
    $("image-place").textContent = "Making the tiles of this image (only once).";
    const about = await api.get(`image/${number}`).finally(() => ($("image-place").textContent = ""));
    opened.set(number, { ...about, plate: new Plate(about.grid) });
  }
  return opened.get(number);
}

/** Show another image; keep the position on the sky if both images contain it. */
async function choose(number, place = null, same = false, unit = null) {
  const before = opened.get(view.one), sky = place ?? (before && !same ? before.plate.sky(view.x, view.y) : null);
  const now = await open(Math.max(0, number));
  if (view.two >= 0) await open(view.two).catch(() => (view.two = -1));
  view.one = now.number;
  $("image-one").value = view.one;
  $("image-two").value = view.two;
  const at = sky && now.plate.pixel(...sky);
  if (at && at[0] > 0 && at[1] > 0 && at[0] < now.nx && at[1] < now.ny) {
    [view.x, view.y] = at;
    if (place) view.zoom = unit ? bounded(unit * scaleOf(now)) : 4;
    else if (before) view.zoom *= scaleOf(now) / scaleOf(before);
  } else if (!same || !view.zoom) whole(now);
  $("image-mended").disabled = !now.is_mendable;
  redraw();
}

const bounded = (zoom) => Math.min(64, Math.max(0.02, zoom));

function whole(image = opened.get(view.one)) {
  const canvas = $("image-canvas");
  Object.assign(view, { x: (image.nx - 1) / 2, y: (image.ny - 1) / 2, zoom: 0.98 * Math.min(canvas.clientWidth / image.nx, canvas.clientHeight / image.ny) });
  redraw();
}

// ---------------------------------------------------------------------------------------------- drawing

/** [a, b, c, d, e, f] of x' = a x + b y + c, y' = d x + e y + f, which map pixels of an image to pixels of the first image. */
function toFirst(image) {
  const first = opened.get(view.one);
  if (image === first) return [1, 0, 0, 0, 1, 0];
  const at = image.plate.pixel(...first.plate.sky(view.x, view.y)), back = (x, y) => first.plate.pixel(...image.plate.sky(x, y));
  const o = back(...at), p = back(at[0] + 100, at[1]), q = back(at[0], at[1] + 100);
  const a = (p[0] - o[0]) / 100, d = (p[1] - o[1]) / 100, b = (q[0] - o[0]) / 100, e = (q[1] - o[1]) / 100;
  return [a, b, o[0] - a * at[0] - b * at[1], d, e, o[1] - d * at[0] - e * at[1]];
}

/** 1, or -1 if the first image has south at the top. The view is then turned by 180 deg, because such detectors are mounted upside down. */
function turn() {
  const { plate, nx, ny } = opened.get(view.one);
  return plate.plane(nx / 2, ny / 2 + 1)[1] >= plate.plane(nx / 2, ny / 2)[1] ? 1 : -1;
}

const current = () => opened.get(other && view.two >= 0 ? view.two : view.one);

export function redraw() {
  if (asked || !gl || $("images").hidden || !opened.has(view.one)) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    paint();
    marks();
    // Update the value under the cursor, because new tiles or another image may be shown.
    if (isByKeys) told(atCentre(), middle());
    else if (cursor) told(pixelOn(...cursor, $("image-canvas").getBoundingClientRect()), cursor);
    page.remember();
  });
}

function paint() {
  const canvas = $("image-canvas"), image = current(), [width, height] = api.fit(canvas);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(0.02, 0.024, 0.04, 1);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.useProgram(drawing);
  const [a, b, c, d, e, f] = toFirst(image), scale = 2 * view.zoom * turn(), sx = scale / width, sy = scale / height;
  const matrix = [a * sx, b * sx, (c - view.x) * sx, d * sy, e * sy, (f - view.y) * sy, 0, 0, 1];
  const uniform = (name) => gl.getUniformLocation(drawing, name);
  gl.uniformMatrix3fv(uniform("toScreen"), true, matrix);
  const black = image.sky + Number($("image-black").value) * image.noise, white = image.sky + image.noise * 10 ** Number($("image-white").value);
  gl.uniform3f(uniform("levels"), black, Math.max(white, black + 1e-6 * image.noise), KNEE * image.noise);
  $("image-legend").replaceChildren(...bar($("image-map").value, api.number(black, 4), api.number(white, 4), [image.unit, $("image-stretch").value].filter(Boolean).join(", ")), api.h("div", { class: "caption" }));
  gl.uniform1i(uniform("stretch"), STRETCHES.indexOf($("image-stretch").value));
  gl.uniform1i(uniform("pixels"), 0);
  gl.uniform1i(uniform("colours"), 1);
  gl.activeTexture(gl.TEXTURE1);
  gl.bindTexture(gl.TEXTURE_2D, colours);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindBuffer(gl.ARRAY_BUFFER, quad);
  const corner = gl.getAttribLocation(drawing, "corner");
  gl.enableVertexAttribArray(corner);
  gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0);
  // Draw the coarsest level first. It is visible until finer tiles have arrived.
  const best = Math.max(0, Math.min(image.levels.length - 1, Math.floor(Math.log2(1 / (view.zoom * Math.hypot(a, d) * (devicePixelRatio || 1))))));
  for (const level of new Set([image.levels.length - 1, best])) drawLevel(image, level, [width, height], [a, b, c, d, e, f], uniform("box"));
}

function drawLevel(image, level, [width, height], [a, b, c, d, e, f], box) {
  const size = 2 ** level, step = image.tile * size, det = a * e - b * d, mended = image.is_mendable && $("image-mended").checked;
  const corners = [[-1, -1], [1, -1], [-1, 1], [1, 1]].map(([u, v]) => {
    const x = view.x + (u * width) / 2 / view.zoom - c, y = view.y + (v * height) / 2 / view.zoom - f;
    return [(e * x - b * y) / det, (a * y - d * x) / det];
  });
  const range = (k, count) => [Math.max(0, Math.floor((Math.min(...corners.map((p) => p[k])) + 0.5) / step)),
    Math.min(count - 1, Math.floor((Math.max(...corners.map((p) => p[k])) + 0.5) / step))];
  const [c0, c1] = range(0, Math.ceil(image.levels[level][0] / image.tile)), [r0, r1] = range(1, Math.ceil(image.levels[level][1] / image.tile));
  for (let row = r0; row <= r1; row++) {
    for (let column = c0; column <= c1; column++) {
      const found = tiles.get(image, level, row, column, mended);
      if (!found.texture) continue;
      gl.bindTexture(gl.TEXTURE_2D, found.texture);
      gl.uniform4f(box, column * step - 0.5, row * step - 0.5, found.width * size, found.height * size);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }
}

/** Draw the overlay: true sources, the pinned source, a compass and a scale bar. */
function marks() {
  const canvas = $("image-marks"), [width, height, ratio] = api.fit(canvas), c = canvas.getContext("2d"), image = current();
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  const [a, b, e0, d, e, f] = toFirst(image);
  const scale = view.zoom * turn(), at = (x, y) => [width / 2 + (a * x + b * y + e0 - view.x) * scale, height / 2 - (d * x + e * y + f - view.y) * scale];
  const truth = $("image-truth").checked && sourcesOf(image, redraw);
  if (truth) drawSources(c, truth, at, [width, height]);
  $("image-legend").querySelector(".caption")?.replaceChildren(truth ? caption(truth) : "");
  const own = pinned()?.place && image.plate.pixel(...pinned().place);
  if (own) {
    const p = at(...own);
    c.strokeStyle = "#ffd27d";
    c.lineWidth = 2;
    c.beginPath();
    for (const [u, v] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      c.moveTo(p[0] + 9 * u, p[1] + 9 * v);
      c.lineTo(p[0] + 22 * u, p[1] + 22 * v);
    }
    c.stroke();
  }
  if (pinned()) drawTraces(c, pinned(), image, at);
  compass(c, image, view, at, [width, height]);
  if (isByKeys) cross(c, [width / 2, height / 2], "#ffffff");
}

// ---------------------------------------------------------------------------------------------- moves

/** Column and row under the cursor in the visible image. */
function pixelAt(event) {
  const box = $("image-canvas").getBoundingClientRect();
  return pixelOn(event.clientX - box.left, event.clientY - box.top, box);
}

/** Column and row at a position on the canvas. */
function pixelOn(left, top, box) {
  const image = current(), [a, b, c, d, e, f] = toFirst(image), det = a * e - b * d;
  const scale = view.zoom * turn();
  const x = view.x + (left - box.width / 2) / scale - c, y = view.y - (top - box.height / 2) / scale - f;
  return [(e * x - b * y) / det, (a * y - d * x) / det];
}

function moved(event) {
  if (!opened.has(view.one)) return;
  if (event.buttons & 1) {
    view.x -= (event.movementX / view.zoom) * turn();
    view.y += (event.movementY / view.zoom) * turn();
    return redraw();
  }
  isByKeys = false;
  const box = $("image-canvas").getBoundingClientRect();
  cursor = [event.clientX - box.left, event.clientY - box.top];
  told(pixelAt(event), cursor);
}

/** Show position, value and source of a pixel in a box at the position `at` on the screen. */
function told([x, y], at) {
  const image = current();
  $("image-place").textContent = x > -0.5 && y > -0.5 && x < image.nx - 0.5 && y < image.ny - 0.5
    ? `${api.place(...image.plate.sky(x, y))}\npixel ${Math.round(x)}, ${Math.round(y)}   ${valueAt(image, Math.round(x), Math.round(y))}` : "";
  tip(image, [x, y], 10 / view.zoom, at);
}

/** Pixel of the visible image at the centre of the view. */
const atCentre = () => pixelOn(...middle(), $("image-canvas").getBoundingClientRect());

const middle = () => [$("image-canvas").clientWidth / 2, $("image-canvas").clientHeight / 2];

/** Show and announce position, value and source at the centre, for users of the keyboard. */
function toldAtCentre() {
  told(atCentre(), middle());
  api.tell([$("image-place").textContent, $("image-tip").hidden ? "" : $("image-tip").textContent].join("\n"));
}

function valueAt(image, x, y) {
  const found = tiles.value(image, x, y, image.is_mendable && $("image-mended").checked);
  return found ? `${api.number(found.value, 5)} ${image.unit}${found.level ? `, mean of ${4 ** found.level} pixels` : ""}` : "";
}

function zoom(by, event) {
  if (!opened.has(view.one)) return;
  const box = $("image-canvas").getBoundingClientRect(), was = view.zoom;
  view.zoom = bounded(view.zoom * by);
  if (event) {
    const dx = event.clientX - box.left - box.width / 2, dy = event.clientY - box.top - box.height / 2;
    view.x += (dx / was - dx / view.zoom) * turn();
    view.y -= (dy / was - dy / view.zoom) * turn();
  }
  redraw();
}

async function pinAt(x, y) {
  const image = current();
  let id = null, least = 1;
  try {
    // Behind a grism, the light at a pixel belongs to the source whose spectrum passes through it.
    if (image.row.channel === "NISP-S") ({ id } = await api.get(`trace_at/${image.number}?${new URLSearchParams({ x, y })}`));
    if (id) return await pin(id);
    id = null;
    const near = await truthOf(image);
    // If several sources are near, prefer bright ones: measure distances in radii of their marks.
    near.x.forEach((sx, k) => {
      const away = (Math.hypot(sx - x, near.y[k] - y) * view.zoom) / (6 + 2 * radiusOf(near.expected[k]));
      if (away < least) [id, least] = [near.id[k], away];
    });
    if (!id) {
      const [ra, dec] = image.plate.sky(x, y);
      id = (await api.get(`nearest?${new URLSearchParams({ ra, dec, radius: Math.max(3, 8 / view.zoom) * scaleOf(image) })}`)).id;
    }
    if (id) await pin(id);
  } catch (error) {
    api.say(error.message, true);
  }
}

function blink() {
  if (view.two < 0) return api.say("Choose a second image to blink with.");
  clearInterval(blinking);
  blinking = blinking ? null : setInterval(() => {
    other = !other;
    redraw();
  }, BLINK_MS);
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
    // Blink only on key presses if the user prefers reduced motion.
    clearInterval(blinking);
    blinking = null;
    other = !other;
  } else if (!blinking) other = false;
  $("image-blink").setAttribute("aria-pressed", String(Boolean(blinking) || other));
  redraw();
}

export function key(event) {
  if (!opened.has(view.one)) return;
  // With Shift move by one pixel.
  const step = (event.shiftKey ? 1 : 80 / view.zoom) * turn(), move = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
  const isHere = event.target === $("image-canvas") || event.target === document.body;
  if (move) [view.x, view.y] = [view.x + move[0], view.y + move[1]];
  else if (event.key === "+" || event.key === "=") zoom(1.4);
  else if (event.key === "-") zoom(1 / 1.4);
  else if (event.key === "0") whole();
  else if (event.key === "b" || event.key === "B") blink();
  else if (event.key === "o" || event.key === "O") return toSky();
  else if (event.key === "Enter" && isHere) pinAt(...atCentre());
  else if ("cCtT".includes(event.key)) {
    const box = $("cC".includes(event.key) ? "image-mended" : "image-truth");
    box.checked = !box.checked;
  } else return;
  event.preventDefault();
  isByKeys = true;
  redraw();
  toldAtCentre();
}

export const state = () => ({ ...view, zoom: +view.zoom.toPrecision(4), x: +view.x.toFixed(2), y: +view.y.toFixed(2), map: $("image-map").value, stretch: $("image-stretch").value,
  black: $("image-black").value, white: $("image-white").value, mended: $("image-mended").checked, truth: $("image-truth").checked, pin: pinned()?.id });
export function restore(was) {
  for (const name of ["one", "two", "x", "y", "zoom"]) if (Number.isFinite(was[name])) view[name] = was[name];
  if (NAMES.includes(was.map)) {
    $("image-map").value = was.map;
    if (gl) lutTexture(gl, was.map, colours);
  }
  for (const name of ["stretch", "black", "white"]) if (was[name] !== undefined) $(`image-${name}`).value = was[name];
  for (const name of ["mended", "truth"]) if (typeof was[name] === "boolean") $(`image-${name}`).checked = was[name];
  if (was.pin && was.pin !== pinned()?.id) pin(was.pin).catch((error) => api.say(error.message, true));
}
