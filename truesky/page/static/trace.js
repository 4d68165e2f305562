// A source through a grism: the positions of its orders on a detector, and the straightened pixels of an order.

import * as api from "/static/api.js";
import { ink, stretched } from "/static/colour.js";

const PLACES = 48, COLOUR = "#9be0a8";
const said = { line: (name) => name, show: null };

/** Set functions of other modules: names of lines, and the display of an image (number, x, y). */
export const use = (given) => Object.assign(said, given);

const poly = (c, t) => c.reduceRight((sum, a) => sum * t + a, 0);
const nm = (angstrom) => String(+(angstrom / 10).toFixed(1));
/** Path parameter t of a wavelength; it is linear in the wavelength. */
const at = (trace, wavelength) => (wavelength - trace.wavelength_first) / (trace.wavelength_last - trace.wavelength_first);

/** Draw the orders of a source on the visible image, with lines along the first order; `place`: pixels -> screen. */
export function drawTraces(c, source, image, place) {
  const { request, row: { exposure_id: exposure, detector } } = image;
  c.font = "12px DejaVu Sans, sans-serif";
  c.textAlign = "left";
  c.strokeStyle = c.fillStyle = COLOUR;
  for (const trace of source.spectra.filter((one) => one.request === request && one.exposure_id === exposure && one.detector === detector)) {
    const on = (t) => place(poly(trace.trace_x, t), poly(trace.trace_y, t));
    c.lineWidth = trace.order === 1 ? 1.5 : 1;
    c.setLineDash(trace.order === 1 ? [] : [4, 4]);
    // Draw a line above and a line below, so that the spectrum between them stays visible.
    for (const side of [-7, 7]) {
      c.beginPath();
      for (let k = 0; k <= PLACES; k++) {
        const [x, y] = on(k / PLACES);
        if (k) c.lineTo(x, y + side);
        else c.moveTo(x, y + side);
      }
      c.stroke();
    }
    c.setLineDash([]);
    const [x0, y0] = on(0), [x1, y1] = on(1);
    c.fillText(`order ${trace.order}`, Math.min(x0, x1), Math.min(y0, y1) - 11);
    for (const line of trace.lines) {
      const [x, y] = on(at(trace, line.wavelength));
      c.fillRect(x, y - 14, 1, 7);
      c.fillText(said.line(line.name), x + 3, y - 11);
    }
  }
}

/** Fill the panel of a source: pixels of each first order, and a table of all orders and their lines. */
export async function dispersed(panel, source, isStill, drawings) {
  if (!source.spectra.length) return panel.append(api.h("p", { class: "quiet" }, "No grism image contains this source."));
  for (const trace of source.spectra.filter((one) => one.order === 1 && one.images.science !== undefined)) {
    const number = trace.images.science, middle = [poly(trace.trace_x, 0.5), poly(trace.trace_y, 0.5)];
    const canvas = api.h("canvas", { class: "strip", role: "img" }), scale = api.h("canvas", { class: "scale", "aria-hidden": "true" });
    const name = `${api.of(trace)}${trace.channel} ${trace.band}, exposure ${trace.exposure_id}, ${trace.detector}`;
    const overlap = trace.contaminants.length ? `, ${api.number(100 * trace.overlapped, 3)} % overlaps with ${trace.contaminants.length} other sources` : ", no overlap with other sources";
    panel.append(api.h("figure", {}, api.h("figcaption", {}, api.h("span", { class: "grow" }, name),
      api.h("button", { onclick: () => said.show?.(number, ...middle) }, "Show in the image")), canvas, scale,
      api.h("div", { class: "range" }, `${api.number(trace.expected, 4)} electrons expected, ${api.number(trace.drawn, 4)} on the detector${overlap}`)));
    const buffer = await api.bytes(`trace/${number}/${source.id}?order=1`), [head, from] = api.headed(buffer);
    if (!isStill()) return;
    // Short wavelengths are on the left for every orientation of the grism.
    Object.assign(canvas, { width: head.columns, height: head.rows });
    canvas.getContext("2d").putImageData(stretched(new Float32Array(buffer, from), head.columns, head.rows), 0, 0);
    drawings.push(() => drawScale(scale, trace));
    drawScale(scale, trace);
    canvas.setAttribute("aria-label", `Pixels along order 1, ${nm(trace.wavelength_first)} to ${nm(trace.wavelength_last)} nm`);
  }
  panel.append(api.h("details", {}, api.h("summary", {}, `${source.spectra.length} orders as a table`), orders(source.spectra), lines(source.spectra)));
}

/** Draw the scale of wavelengths below the pixels, with lines. */
function drawScale(canvas, trace) {
  const [width, height, ratio] = api.fit(canvas), c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  c.font = "11px DejaVu Sans, sans-serif";
  c.textAlign = "center";
  c.fillStyle = ink("quiet");
  for (const l of api.ticks(trace.wavelength_first / 10, trace.wavelength_last / 10, width / 60)) {
    const x = at(trace, 10 * l) * width;
    c.fillRect(x, 0, 1, 4);
    if (x > 14 && x < width - 14) c.fillText(String(l), x, 15);
  }
  c.fillText("wavelength / nm", width / 2, 29);
  c.fillStyle = ink("good");
  const taken = [];
  for (const line of [...trace.lines].sort((a, b) => b.expected - a.expected)) {
    const x = at(trace, line.wavelength) * width;
    c.fillRect(x, 0, 2, 7);
    if (taken.some((other) => Math.abs(other - x) < 44)) continue;
    taken.push(x);
    c.fillText(said.line(line.name), Math.min(width - 20, Math.max(20, x)), 43);
  }
}

function orders(traces) {
  return api.requested(traces, [{ name: "exposure" }, { name: "detector", text: 1 }, { name: "order" }, { name: "from", unit: "nm" }, { name: "to", unit: "nm" },
    { name: "x", unit: "pix" }, { name: "y", unit: "pix" }, { name: "to x", unit: "pix" }, { name: "to y", unit: "pix" }, { name: "expected", unit: "electron" }, { name: "overlapped" }],
  (one) => [one.exposure_id, one.detector, one.order, nm(one.wavelength_first), nm(one.wavelength_last),
    ...[one.x_first, one.y_first, one.x_last, one.y_last].map((pixel) => pixel.toFixed(2)), +one.expected.toPrecision(4), one.overlapped === null ? "–" : +one.overlapped.toPrecision(3)]);
}

function lines(traces) {
  const rows = traces.flatMap((one) => one.lines.map((line) => ({ ...line, request: one.request, exposure: one.exposure_id })));
  return rows.length ? api.requested(rows, [{ name: "exposure" }, { name: "line", text: 1 }, { name: "wavelength", unit: "nm" }, { name: "expected", unit: "electron" }, { name: "signal to noise" }],
    (line) => [line.exposure, said.line(line.name), nm(line.wavelength), +line.expected.toPrecision(4), +Number(line.snr).toPrecision(3)])
    : api.h("p", { class: "quiet" }, "No emission lines in the first order.");
}
