// One source: its rows, its spectrum with lines and passbands, its cutouts, and the images that contain it.

import * as api from "/static/api.js";
import { ink, stretched } from "/static/colour.js";
import { dispersed, use } from "/static/trace.js";

const $ = (id) => document.getElementById(id);
const SIDE = 64, SHOWN = ["ra", "dec", "ra_true", "dec_true", "z_obs", "z_true", "mag_r01", "abs_mag_r01", "color_gr_01", "log_stellar_mass", "log_sfr",
  "bulge_fraction", "bulge_half_light_radius", "disk_half_light_radius", "inclination", "position_angle", "kappa", "gamma1", "gamma2", "a_v", "mag_h", "distance"];
let source = null, drawings = [], pins = 0;
const listeners = [];

export const pinned = () => source;
use({ line: named });
export const onPin = (listener) => listeners.push(listener);

export async function pin(id) {
  // If two requests are running, show the later one, whichever is answered first.
  const mine = ++pins, found = await api.get(`source/${id}`);
  if (mine !== pins) return;
  source = found;
  const panel = $("pin");
  drawings = [];
  panel.replaceChildren(api.h("h2", {}, `${source.kind} ${source.id}`));
  if (source.request) panel.append(api.h("p", { class: "quiet" }, `Values of request ${source.request}.`));
  if (source.place) panel.append(api.h("p", { class: "quiet" }, api.place(...source.place)));
  // If several requests have this table, use the table of the request that is shown.
  const table = Object.keys(source.tables)[0] ?? "rendered_truth", { request } = source.tables[table] ? source : source.drawn[0];
  const from = api.sqlName(request ? `${request}.${table}` : table);
  panel.append(api.h("div", { class: "bar" },
    api.h("button", { onclick: () => api.copy(source.id, "Identifier") }, "Copy id"),
    api.h("button", { onclick: () => api.copy(`SELECT * FROM ${from} WHERE id = ${source.id}`, "SQL") }, "Copy as SQL")));
  const spectrum = api.h("div", {}), pictures = api.h("div", { class: "cutouts" }), grism = api.h("div", {});
  panel.append(spectrum, api.h("h3", {}, "Image cutouts, north up"), pictures);
  if (api.lake.tables.some((table) => table.name.endsWith("rendered_spectra"))) panel.append(api.h("h3", {}, "Through the grism"), grism);
  for (const [name, rows] of Object.entries(source.tables)) {
    const first = rows.filter((row) => SHOWN.includes(row.name) || row.name.startsWith("f_nu_"));
    panel.append(api.h("h3", {}, name), facts(first.length ? first : rows.slice(0, 12)));
    panel.append(api.h("details", {}, api.h("summary", {}, `all ${rows.length} columns`), facts(rows, true)));
  }
  panel.append(api.h("h3", {}, "Images with this source"), source.drawn.length ? api.requested(source.drawn,
    [{ name: "exposure" }, { name: "detector", text: 1 }, { name: "x", unit: "pix" }, { name: "y", unit: "pix" }, { name: "expected", unit: "electron" }, { name: "drawn", unit: "electron" }],
    (d) => [d.exposure_id, d.detector, +d.x.toFixed(2), +d.y.toFixed(2), +d.expected.toPrecision(5), +d.drawn.toPrecision(5)])
    : api.h("p", { class: "quiet" }, "No image."));
  listeners.forEach((listener) => listener());
  const own = source;
  api.get(`spectrum/${id}`).then((found) => own === source && (found.said ? spectrum.append(api.h("p", { class: "quiet" }, `No spectrum: ${found.said}`)) : drawSpectrum(spectrum, found)),
    (error) => own === source && spectrum.append(api.h("p", { class: "quiet" }, error.message)));
  const failed = (error) => own === source && api.say(error.message, true);
  cutouts(pictures, own).catch(failed);
  dispersed(grism, own, () => own === source, drawings).catch(failed);
}

/** Draw again after a change of theme or page size; hidden elements have no size. */
export const redraw = () => $("pin").checkVisibility() && drawings.forEach((draw) => draw());

function facts(rows, isWhole = false) {
  const value = (row) => {
    if (Array.isArray(row.value)) return `[${row.value.length}]`;
    return typeof row.value === "number" && row.unit === "deg" && /^(ra|dec)(_|$)/.test(row.name) ? api.degrees(row.value) : row.value;
  };
  const columns = [{ name: "column", text: 1 }, { name: "value" }, { name: "unit", text: 1 }, ...(isWhole ? [{ name: "meaning", text: 1 }] : [])];
  return api.table(columns, rows.map((row) => [row.name, value(row), row.unit, ...(isWhole ? [row.meaning] : [])]));
}

async function cutouts(panel, own) {
  const list = await api.get("images");
  for (const { number, x, y, is_north_up: up } of own.images ?? []) {
    const about = list[number];
    // Skip dispersed images, in which a source does not appear at its position.
    if (!["science", "noise_free"].includes(about.content) || about.channel === "NISP-S") continue;
    const pixels = new Float32Array(await api.bytes(`cutout/${number}?${new URLSearchParams({ x, y })}`));
    if (own !== source) return;
    const canvas = api.h("canvas", { width: SIDE, height: SIDE, role: "img", "aria-label": `${about.band}, ${about.content}` });
    canvas.getContext("2d").putImageData(stretched(up ? pixels : pixels.reverse(), SIDE, SIDE), 0, 0);
    panel.append(api.h("figure", {}, canvas, api.h("figcaption", { class: "quiet" }, `${api.of(about)}${about.band} ${about.content.replace("_", " ")}`)));
  }
  if (!panel.childElementCount) panel.append(api.h("p", { class: "quiet" }, "No image contains its position."));
}

/** Format the name of a line: halpha, nii_2 -> Hα, [N II]. */
function named(name) {
  return { halpha: "Hα", hbeta: "Hβ", hgamma: "Hγ", hdelta: "Hδ", paalpha: "Paα", pabeta: "Paβ", pagamma: "Paγ", padelta: "Paδ", oii: "[O II]", oiii: "[O III]",
    nii: "[N II]", sii: "[S II]", siii: "[S III]", hei: "He I" }[name.split("_")[0]] ?? name;
}

/** Plot f_lambda against wavelength with passbands and lines. */
function drawSpectrum(panel, found) {
  const canvas = api.h("canvas", { class: "spectrum", role: "img", tabindex: 0 });
  const data = api.h("div", { class: "data", hidden: true });
  panel.replaceChildren(api.h("h3", {}, "Observed spectrum"), canvas, api.h("button", { onclick: () => (data.hidden = !data.hidden) }, "Show bands and lines as a table"), data);
  data.append(api.table([{ name: "band", text: 1 }, { name: "pivot", unit: "nm" }, { name: "f_nu", unit: "µJy" }, { name: "AB", unit: "mag" }], found.bands.map((b) =>
    [b.name, b.wavelength / 10, b.f_nu, b.f_nu > 0 ? +(23.9 - 2.5 * Math.log10(b.f_nu)).toFixed(3) : null])));
  if (found.lines.length) data.append(api.table([{ name: "line", text: 1 }, { name: "wavelength", unit: "nm" }], found.lines.map((l) => [named(l.name), (l.wavelength / 10).toFixed(1)])));
  canvas.setAttribute("aria-label", `Spectrum${found.z === undefined ? "" : ` at redshift ${found.z.toFixed(3)}`}; lines ${found.lines.map((l) => `${named(l.name)} at ${(l.wavelength / 10).toFixed(0)} nm`).join(", ")}`);
  const ends = ceiling(found);
  if (ends.most > ends.top) canvas.after(api.h("div", { class: "range" }, `cut at ${ends.top.toExponential(1)}; the highest line reaches ${ends.most.toExponential(1)} erg s⁻¹ cm⁻² Å⁻¹`));
  drawings.push(() => drawCurve(canvas, found));
  drawCurve(canvas, found);
}

/** Upper end of the axis of a spectrum, so that one line does not flatten the rest; and the maximum of the spectrum. */
function ceiling(found) {
  const sorted = [...found.f_lambda].sort((a, b) => a - b), most = sorted.at(-1);
  return { top: Math.min(most, 3 * sorted[Math.floor(0.99 * sorted.length)]) * 1.05 || 1, most };
}

function drawCurve(canvas, found) {
  const [width, height, ratio] = api.fit(canvas), c = canvas.getContext("2d"), x0 = 44, x1 = width - 6, y0 = height - 32, y1 = 14;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  c.font = "11px DejaVu Sans, sans-serif";
  const bright = found.f_lambda.reduce((a, b) => Math.max(a, b), 0), begin = Math.max(0, found.f_lambda.findIndex((f) => f > 1e-3 * bright));
  const low = Math.log(found.wavelength[begin]), high = Math.log(found.wavelength.at(-1)), x = (l) => x0 + ((Math.log(l) - low) / (high - low)) * (x1 - x0);
  const { top } = ceiling(found);
  const y = (f) => y0 - Math.min(1, f / top) * (y0 - y1);
  for (const band of found.bands) {
    c.fillStyle = `color-mix(in srgb, ${ink("second")} 14%, transparent)`;
    const a = x(band.wavelength - band.width / 2), b = x(band.wavelength + band.width / 2);
    c.fillRect(a, y1, b - a, y0 - y1);
    c.fillStyle = ink("second");
    // Convert f_nu in microjansky to f_lambda in erg s-1 cm-2 A-1.
    const f = (band.f_nu * 1e-29 * 2.99792458e18) / band.wavelength ** 2;
    c.beginPath();
    c.arc((a + b) / 2, y(f), 3, 0, 7);
    c.fill();
    c.save();
    c.translate((a + b) / 2 + 3, y0 - 4);
    c.rotate(-Math.PI / 2);
    c.fillText(band.name, 0, 0);
    c.restore();
  }
  c.strokeStyle = ink("accent");
  c.lineWidth = 1;
  c.beginPath();
  found.wavelength.forEach((l, k) => k >= begin && (k > begin ? c.lineTo(x(l), y(found.f_lambda[k])) : c.moveTo(x(l), y(found.f_lambda[k]))));
  c.stroke();
  c.fillStyle = c.strokeStyle = ink("quiet");
  // Label only the first of lines that are close to each other.
  const taken = [];
  for (const line of found.lines) {
    const at = x(line.wavelength);
    if (at < x0 || at > x1) continue;
    c.fillRect(at, y1 - 2, 1, 5);
    if (taken.every((other) => Math.abs(other - at) > 36)) {
      c.textAlign = "center";
      c.fillText(named(line.name), at, y1 - 4);
      taken.push(at);
    }
  }
  c.textAlign = "center";
  for (const l of [2000, 3000, 5000, 10000, 20000]) if (x(l) > x0 && x(l) < x1) c.fillText(String(l / 10), x(l), y0 + 13);
  c.fillText("wavelength / nm", (x0 + x1) / 2, y0 + 27);
  c.textAlign = "left";
  c.fillText(top.toExponential(1), 0, y1 + 8);
  c.fillText("0", x0 - 11, y0 + 2);
  c.save();
  c.translate(11, (y0 + y1) / 2 + 50);
  c.rotate(-Math.PI / 2);
  c.fillText("erg s⁻¹ cm⁻² Å⁻¹", 0, 0);
  c.restore();
  c.strokeStyle = ink("line");
  c.strokeRect(x0, y1, x1 - x0, y0 - y1);
}
