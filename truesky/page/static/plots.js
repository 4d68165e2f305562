// Linked histograms and maps: the brush of a chart selects rows for all other charts. A move counts all charts in one
// pass. While a brush is held, the other charts are counted once per bin of the brush, and moves only add these counts.

import * as api from "/static/api.js";
import { BOTTOM, LEFT, RIGHT, TOP, draw as drawChart } from "/static/chart.js";
import { columnsOf, sources, suggested } from "/static/suggestions.js";

const $ = (id) => document.getElementById(id);
const BINS = 120, MAP_BINS = 96, CUBE_BINS = 256, CUBE_MAP_BINS = 32;
const MOST_POINTS = 20000;
// Largest number of bins of all charts in one request.
const MOST_CELLS = 8e6;
// All rows are counted if no brush has moved for this time (ms).
const IDLE = 400;
// A computation that takes longer than this time (ms) is announced.
const NOTICED = 250;
// Largest number of rows of the table of a map, and the time (ms) without changes after which it is updated.
const MOST_ROWS = 500, STILL = 120;
// charts: {axes: [{expression, log}], spans, brush: [[lo, hi], ...] | null, points, counts, whole, places, element ...}
let page, source = "", where = "", charts = [], part = null, head = null, cube = null, drag = null, idle = 0, waiting = 0;

export function start(given) {
  page = given;
  $("plot-sources").append(...sources().map((name) => api.h("option", { value: name })));
  if (!source) usual();
  $("plot-source").addEventListener("change", () => usePlot($("plot-source").value, suggested($("plot-source").value)));
  $("plot-where").addEventListener("change", () => {
    where = $("plot-where").value;
    for (const chart of charts) chart.spans = null;
    sampled();
  });
  $("plot-add-button").addEventListener("click", add);
  $("plot-add").addEventListener("keydown", (event) => event.key === "Enter" && add());
  $("plot-clear").addEventListener("click", () => {
    for (const chart of charts) chart.brush = null;
    sampled();
  });
  $("plot-python").addEventListener("click", () => charts.length ? api.copy(python(), "Python") : api.say("There is no chart.", true));
  $("plot-sql").addEventListener("click", () => api.copy(query(), "SQL"));
}

/** Show charts of other rows; `lists` contains the expressions of the axes of each chart. */
export function usePlot(rows, lists) {
  source = rows;
  where = "";
  part = null;
  charts = lists.map((axes) => ({ axes: axes.map((expression) => ({ expression, log: false })), spans: null, brush: null }));
  built = false;
  if (!$("plots").hidden) show();
}

let built = false;

function usual() {
  const name = ["galaxies", "stars"].find((own) => api.lake.tables.some((table) => table.name === own)) ?? api.lake.tables[0]?.name;
  if (name) usePlot(api.sqlName(name), suggested(name));
}

function facts(expression) {
  const name = /^"(.*)"$/s.test(expression) ? expression.slice(1, -1).replaceAll('""', '"') : expression;
  const found = columnsOf(source).find((column) => column.name === name);
  return found ?? { name, unit: expression.startsWith("mag_ab(") ? "mag" : "", meaning: "" };
}

function label(axis) {
  const about = facts(axis.expression);
  return `${axis.log ? "log10 " : ""}${about.name}${about.unit ? ` / ${about.unit}` : ""}`;
}

const sqlOf = (axis) => axis.log ? `CASE WHEN (${axis.expression}\n) > 0 THEN log10(${axis.expression}\n) END` : axis.expression;

function add() {
  const one = $("plot-add").value.trim(), other = $("plot-against").value.trim();
  if (!one) return;
  charts.push({ axes: [one, other].filter(Boolean).map((expression) => ({ expression, log: false })), spans: null, brush: null });
  $("plot-add").value = $("plot-against").value = "";
  built = false;
  show();
}

// ---------------------------------------------------------------------------------------------- requests

/** All different axes in the order of the charts. */
function axes() {
  return [...new Set(charts.flatMap((chart) => chart.axes.map(sqlOf)))];
}

function limits(except = null) {
  const names = axes(), found = new Map();
  for (const chart of charts) {
    if (!chart.brush || chart === except) continue;
    chart.axes.forEach((axis, k) => {
      const at = names.indexOf(sqlOf(axis)), [lo, hi] = chart.brush[k], was = found.get(at);
      found.set(at, was ? [Math.max(was[0], lo), Math.min(was[1], hi)] : [lo, hi]);
    });
  }
  return [...found].map(([at, [lo, hi]]) => [at, lo, hi]);
}

/** Axes whose limits do not apply to a chart, because only its brush sets them. */
function own(chart) {
  const names = axes(), of = (one) => (one.brush ? one.axes.map((axis) => names.indexOf(sqlOf(axis))) : []);
  const others = charts.filter((one) => one !== chart).flatMap(of);
  return of(chart).filter((axis) => !others.includes(axis));
}

function bins(chart) {
  return chart.axes.length > 1 ? [MAP_BINS, MAP_BINS] : [BINS];
}

const ask = api.newest(async () => {
  if (!charts.length) return;
  const shown = charts;
  busy(true);
  try {
    await count(shown);
  } catch (error) {
    if (shown === charts) failed(error);
  } finally {
    if (shown === charts) busy(false);
  }
});

/** Show that charts are being computed, unless the answer comes at once. */
function busy(isBusy) {
  clearTimeout(waiting);
  $("plot-grid").setAttribute("aria-busy", String(isBusy));
  if (isBusy) waiting = setTimeout(() => {
    $("plot-grid").className = "slow";
    $("plot-state").className = "quiet busy";
    $("plot-state").textContent = "Computing…";
    api.tell("Computing the charts");
  }, NOTICED);
  else $("plot-grid").className = "";
}

/** Show an error in place of all charts, because they would be taken for the charts of the current settings. */
function failed(error) {
  head = null;
  for (const chart of charts) {
    chart.counts = chart.whole = chart.places = null;
    if (!chart.canvas) continue;
    const [width, height] = api.fit(chart.canvas), context = chart.canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, width * devicePixelRatio, height * devicePixelRatio);
    chart.range.textContent = "";
    chart.data.replaceChildren();
    chart.canvas.setAttribute("aria-label", "no chart: see the message");
  }
  $("plot-state").className = "bad-text";
  $("plot-state").textContent = error.message;
  api.tell(error.message);
}

async function count(shown) {
  const started = performance.now(), names = axes();
  const buffer = await api.post("charts", {
    source, where: where || "true", axes: names, part, limits: limits(),
    charts: shown.map((chart) => ({ axes: chart.axes.map((axis) => names.indexOf(sqlOf(axis))), bins: bins(chart), spans: chart.spans, own: own(chart), points: chart.points ? MOST_POINTS : 0 })),
  });
  if (shown !== charts) return;
  let at;
  [head, at] = api.headed(buffer);
  shown.forEach((chart, k) => {
    const about = head.charts[k], size = about.bins.reduce((a, b) => a * b);
    chart.counts = new Uint32Array(buffer, at, size);
    chart.spans = about.spans;
    // Count missing values per axis, because a row may lack only one of them.
    chart.missing = chart.axes.map((axis) => head.missing[names.indexOf(sqlOf(axis))]);
    chart.outside = about.outside;
    chart.part = head.part;
    if (!charts.some((other) => other.brush)) Object.assign(chart, { whole: chart.counts, wholePart: head.part });
    at += 4 * size;
  });
  shown.forEach((chart, k) => {
    const { points = 0, points_part: step = 1 } = head.charts[k];
    chart.places = points || chart.points ? new Float32Array(buffer, at, 2 * points) : null;
    chart.placesPart = step;
    at += 8 * points;
  });
  drawAll();
  tell(performance.now() - started);
  clearTimeout(idle);
  // Count all rows after the sample.
  if (head.part > 1) idle = setTimeout(() => {
    if (drag) return;
    part = 1;
    ask();
  }, IDLE);
  page.remember();
}

/** Count after a move: first a sample if there are many rows, then all rows when nothing moves. */
function sampled() {
  clearTimeout(idle);
  part = null;
  ask();
}

function tell(ms) {
  const sample = head.part > 1 ? ` sample of 1 row in ${head.part}, counts scaled, with Poisson errors;` : "";
  const brushed = charts.some((chart) => chart.brush) ? "drag to brush, Escape clears a brush" : "drag in a chart to brush; the other charts show the selected rows";
  $("plot-state").className = "quiet";
  $("plot-state").textContent = `${api.number(head.rows)} rows;${sample} counted and drawn in ${ms.toFixed(0)} ms; ${brushed}.`;
}

/** While a brush is held, load the counts of the other charts for each of its bins. */
async function hold(chart) {
  cube = null;
  const names = axes(), axis = names.indexOf(sqlOf(chart.axes[0])), others = charts.filter((one) => one !== chart);
  if (chart.axes.length > 1 || !others.length || !chart.spans) return;
  const asked = others.map((one) => {
    const places = one.axes.map((a) => names.indexOf(sqlOf(a)));
    return { axes: [axis, ...places], own: own(one), spans: [chart.spans[0], ...one.spans],
      bins: [CUBE_BINS, ...(places.length > 1 ? [CUBE_MAP_BINS * 3, CUBE_MAP_BINS * 3] : [BINS])] };
  });
  if (asked.reduce((sum, one) => sum + one.bins.reduce((a, b) => a * b), 0) > MOST_CELLS) return;
  const held = drag;
  clearTimeout(idle);
  part = null;
  const buffer = await api.post("charts", { source, where: where || "true", axes: names, part, limits: limits(chart), charts: asked });
  if (drag !== held) return;
  let [about, at] = api.headed(buffer);
  cube = { chart, part: about.part, parts: others.map((one, k) => {
    const size = about.charts[k].bins.reduce((a, b) => a * b), inner = size / CUBE_BINS, counts = new Uint32Array(buffer, at, size);
    at += 4 * size;
    const sums = new Float64Array(size + inner);
    for (let i = 0; i < size; i++) sums[i + inner] = sums[i] + counts[i];
    return { one, inner, sums };
  }) };
}

/** Update the other charts from these counts without a request to the server. */
function moveHeld() {
  const [[lo, hi]] = cube.chart.brush, [[low, high]] = cube.chart.spans;
  const bin = (x) => Math.min(CUBE_BINS, Math.max(0, Math.round(((x - low) / (high - low)) * CUBE_BINS)));
  const a = bin(lo), b = bin(hi);
  for (const { one, inner, sums } of cube.parts) {
    const out = new Uint32Array(inner);
    for (let i = 0; i < inner; i++) out[i] = sums[b * inner + i] - sums[a * inner + i];
    one.counts = out;
    one.part = cube.part;
    // These counts have no points and no outside rows; the next request brings them.
    one.outside = 0;
    one.places = null;
  }
  drawAll();
}

// ---------------------------------------------------------------------------------------------- drawing

export function show() {
  $("plot-source").value = source;
  $("plot-where").value = where;
  $("plot-columns").replaceChildren(...columnsOf(source).map((c) => api.h("option", { value: c.name }, [c.unit, c.meaning].filter(Boolean).join(", "))));
  if (!built) {
    $("plot-grid").replaceChildren(...charts.map(figure));
    built = true;
  }
  ask();
}

function figure(chart) {
  const canvas = api.h("canvas", { tabindex: 0, role: "img" });
  const range = api.h("div", { class: "range" }), data = api.h("div", { class: "data", tabindex: 0, role: "region", "aria-label": "The chart as a table", hidden: true });
  const names = chart.axes.map((axis) => facts(axis.expression));
  const logs = chart.axes.map((axis, k) => api.h("button", { "aria-pressed": String(axis.log), onclick: () => {
    axis.log = !axis.log;
    chart.spans = chart.brush = chart.whole = null;
    built = false;
    show();
  } }, chart.axes.length > 1 ? `log ${"xy"[k]}` : "log"));
  const points = chart.axes.length > 1 ? api.h("button", { "aria-pressed": String(Boolean(chart.points)), title: "Show rows as points", onclick: (event) => {
    chart.points = !chart.points;
    event.target.setAttribute("aria-pressed", String(chart.points));
    ask();
  } }, "points") : null;
  const toTable = api.h("button", { onclick: () => {
    data.hidden = !data.hidden;
    if (!data.hidden) data.replaceChildren(asTable(chart));
  } }, "Table");
  const gone = api.h("button", { "aria-label": `Remove ${names.map((n) => n.name).join(" against ")}`, onclick: () => {
    charts = charts.filter((one) => one !== chart);
    built = false;
    show();
  } }, "×");
  const caption = api.h("figcaption", {}, api.h("strong", { title: names.map((n) => n.meaning).filter(Boolean).join("; ") || null },
    names.map((n) => n.name).reverse().join(" against ")), api.h("span", { class: "quiet grow" }, names.length > 1 ? "" : names[0].meaning), ...logs, points, toTable, gone);
  Object.assign(chart, { canvas, range, data });
  canvas.addEventListener("pointerdown", (event) => grab(chart, event));
  canvas.addEventListener("pointermove", (event) => drag?.chart === chart && pull(event));
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => drag?.chart === chart && release());
  canvas.addEventListener("keydown", (event) => nudge(chart, event));
  return api.h("figure", { class: chart.axes.length > 1 ? "map" : null }, caption, canvas, range, data);
}

/** Rows in no bin: beyond the ends of the axes, which omit the tails of a distribution, or without a value. */
function leftOut(chart) {
  const ends = chart.outside ? `${api.number(chart.outside * chart.part)} outside the range of the ${chart.axes.length > 1 ? "axes" : "axis"}` : "";
  return [ends, ...chart.axes.map((axis, k) => (chart.missing[k] ? `${api.number(chart.missing[k] * head.part)} of all rows without ${facts(axis.expression).name}` : ""))];
}

/** Update the table of a chart if it is open, but not while a brush moves. */
function tabulate(chart) {
  if (chart.data.hidden) return;
  clearTimeout(chart.waiting);
  chart.waiting = setTimeout(() => chart.data.hidden || chart.data.replaceChildren(asTable(chart)), STILL);
}

function asTable(chart) {
  const [span] = chart.spans, n = bins(chart)[0], scale = chart.part;
  const edge = (k) => span[0] + ((span[1] - span[0]) * k) / n;
  if (chart.axes.length === 1) {
    return api.table([{ name: "from" }, { name: "to", unit: facts(chart.axes[0].expression).unit }, { name: "number" }],
      [...chart.counts].map((count, k) => [edge(k), edge(k + 1), count * scale]));
  }
  const size = Math.round(Math.sqrt(chart.counts.length)), [x, y] = chart.spans, at = (s, k) => s[0] + ((s[1] - s[0]) * (k + 0.5)) / size;
  const rows = [];
  chart.counts.forEach((count, k) => count && rows.push([at(x, Math.floor(k / size)), at(y, k % size), count * scale]));
  return api.table([{ name: label(chart.axes[0]) }, { name: label(chart.axes[1]) }, { name: "number" }], rows.sort((a, b) => b[2] - a[2]).slice(0, MOST_ROWS),
    api.cut(Math.min(rows.length, MOST_ROWS), rows.length, "non-empty bins, the fullest first"));
}

function drawAll() {
  for (const chart of charts) if (chart.canvas && chart.counts) draw(chart);
}

function draw(chart) {
  drawChart(chart, label, chart.part);
  const shown = chart.brush ? chart.brush.map(([lo, hi], k) => `${label(chart.axes[k])} ${api.number(lo, 4)} to ${api.number(hi, 4)}`).join(", ") : "";
  const sum = chart.counts.reduce((a, b) => a + b, 0), scale = chart.part;
  const error = scale > 1 ? ` ± ${api.number(Math.round(Math.sqrt(sum) * scale))}` : "";
  const points = chart.points && chart.places ? `${api.number(chart.places.length / 2)} points${chart.placesPart * scale > 1 ? `, sample of 1 row in ${chart.placesPart * scale}` : ""}` : "";
  const most = chart.axes.length > 1 && !points ? `colours from 0 to ${api.number(chart.counts.reduce((a, b) => Math.max(a, b), 0) * scale)} per bin, logarithmic` : "";
  chart.range.textContent = [`${api.number(sum * scale)}${error} rows`, ...leftOut(chart), most, points, shown].filter(Boolean).join("; ");
  tabulate(chart);
  chart.canvas.setAttribute("aria-label", `${label(chart.axes[0])}${chart.axes[1] ? ` and ${label(chart.axes[1])}` : ""}: ${chart.range.textContent}`);
}

// ---------------------------------------------------------------------------------------------- brushes

function valueAt(chart, event) {
  const box = chart.canvas.getBoundingClientRect(), share = [(event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT),
    (box.bottom - BOTTOM - event.clientY) / (box.height - TOP - BOTTOM)];
  return chart.spans.map(([lo, hi], k) => lo + Math.min(1, Math.max(0, share[k])) * (hi - lo));
}

function grab(chart, event) {
  if (!chart.spans || event.button) return;
  chart.canvas.setPointerCapture(event.pointerId);
  const from = valueAt(chart, event), inside = chart.brush?.every(([lo, hi], k) => from[k] > lo && from[k] < hi);
  drag = { chart, from, moved: inside ? chart.brush.map((pair) => [...pair]) : null, far: false };
  hold(chart).catch((error) => api.say(error.message, true));
}

function pull(event) {
  const { chart, from, moved } = drag, to = valueAt(chart, event);
  drag.far ||= to.some((value, k) => Math.abs(value - from[k]) > 0.005 * (chart.spans[k][1] - chart.spans[k][0]));
  if (!drag.far) return;
  chart.brush = moved ? moved.map(([lo, hi], k) => [lo + to[k] - from[k], hi + to[k] - from[k]])
    : from.map((value, k) => [Math.min(value, to[k]), Math.max(value, to[k])]);
  if (cube?.chart === chart) moveHeld();
  else {
    draw(chart);
    sampled();
  }
}

function release() {
  if (!drag.far) drag.chart.brush = null;
  drag = cube = null;
  sampled();
}

/** Move a brush by arrow keys in steps of 1/50 of the axis; with Shift change its width. */
function nudge(chart, event) {
  const step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowUp: [1, 1], ArrowDown: [1, -1] }[event.key];
  if (event.key === "Escape") chart.brush = null;
  else if (!step || !chart.spans || !chart.spans[step[0]]) return;
  else {
    const size = chart.spans.map(([lo, hi]) => (hi - lo) / 50);
    chart.brush ??= chart.spans.map(([lo, hi]) => [lo + 0.4 * (hi - lo), lo + 0.6 * (hi - lo)]);
    const pair = chart.brush[step[0]], by = step[1] * size[step[0]];
    chart.brush[step[0]] = event.shiftKey ? [pair[0] - by, pair[1] + by].sort((a, b) => a - b) : [pair[0] + by, pair[1] + by];
  }
  event.preventDefault();
  event.stopPropagation();
  draw(chart);
  sampled();
  api.tell(() => chart.canvas.getAttribute("aria-label"));
}

// ---------------------------------------------------------------------------------------------- as text

function conditions() {
  const brushed = charts.filter((chart) => chart.brush).flatMap((chart) => chart.axes.map((axis, k) =>
    `(${sqlOf(axis)}\n)::FLOAT BETWEEN ${chart.brush[k][0]} AND ${chart.brush[k][1]}`));
  return [...(where ? [`(${where}\n)`] : []), ...brushed].join("\n  AND ") || "true";
}

function query() {
  return `SELECT *\nFROM ${source}\nWHERE ${conditions()}\n`;
}

function python() {
  const [x, y] = charts.find((chart) => chart.axes.length > 1)?.axes ?? charts[0].axes;
  const call = y ? `heatmap(${[source, sqlOf(x), sqlOf(y)].map((text) => JSON.stringify(text)).join(", ")}` : `hist(${JSON.stringify(source)}, ${JSON.stringify(sqlOf(x))}`;
  return `from truesky.explore import plots\nfrom truesky.explore.explorer import Explorer\n\nwith Explorer(${JSON.stringify(api.lake.lake)}) as lake:\n    plots.${y ? "heatmap" : "hist"}(*lake.${call}, where=${JSON.stringify(conditions())}))\n`;
}

export const redraw = () => head && drawAll();
export const state = () => ({ source, where, charts: charts.map(({ axes: own, spans, brush, points }) => ({ axes: own, spans, brush, points })) });
export function restore(was) {
  if (typeof was.source !== "string" || !Array.isArray(was.charts)) return;
  ({ source, where } = was);
  charts = was.charts.map((chart) => ({ ...chart }));
  built = false;
}
