// One chart: a histogram, a map of counts or of points, with axes and brush.

import * as api from "/static/api.js";
import { ink, lut } from "/static/colour.js";

export const LEFT = 52, BOTTOM = 36, TOP = 8, RIGHT = 10;

/** Draw a chart; `label` returns the name of an axis, `scale` is the number of rows per counted row. */
export function draw(chart, label, scale) {
  const [width, height, ratio] = api.fit(chart.canvas), context = chart.canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "11px DejaVu Sans, sans-serif";
  const f = { context, x0: LEFT, x1: width - RIGHT, y0: height - BOTTOM, y1: TOP };
  if (chart.axes.length < 2) drawAxes(chart, f, label, ...drawBars(chart, f, scale));
  else {
    if (chart.points && chart.places) drawPoints(chart, f);
    else drawMap(chart, f);
    drawAxes(chart, f, label, chart.spans[1], label(chart.axes[1]));
  }
  if (chart.brush) drawBrush(chart, f);
}

function drawBars(chart, f, scale) {
  // Both may be samples with different fractions of the rows.
  const behind = chart.whole ? Float64Array.from(chart.whole, (count) => (count * chart.wholePart) / scale) : chart.counts, most = Math.max(...behind, 1);
  const step = (f.x1 - f.x0) / chart.counts.length, y = (n) => f.y0 - ((f.y0 - f.y1) * n) / most;
  for (const [counts, colour] of [[behind, ink("bar-off")], [chart.counts, ink("bar")]]) {
    f.context.fillStyle = colour;
    counts.forEach((n, k) => n && f.context.fillRect(f.x0 + k * step, y(n), Math.max(step - 0.5, 0.5), f.y0 - y(n)));
  }
  return [[0, most * scale], "number"];
}

function drawMap(chart, f) {
  const size = Math.round(Math.sqrt(chart.counts.length)), image = new ImageData(size, size), colours = lut("cividis");
  const most = Math.max(...chart.counts, 1), top = Math.log1p(most), isLight = document.documentElement.dataset.theme === "light";
  for (let i = 0; i < size; i++) {
    for (let j = 0; j < size; j++) {
      const n = chart.counts[i * size + j];
      if (!n) continue;
      // On a light background the fullest bins are the darkest.
      const share = Math.log1p(n) / top, c = 4 * Math.round(isLight ? 215 * (1 - share) : 40 + 215 * share), at = 4 * ((size - 1 - j) * size + i);
      image.data.set(colours.subarray(c, c + 4), at);
    }
  }
  const small = new OffscreenCanvas(size, size);
  small.getContext("2d").putImageData(image, 0, 0);
  f.context.imageSmoothingEnabled = false;
  f.context.drawImage(small, f.x0, f.y1, f.x1 - f.x0, f.y0 - f.y1);
}

/** Draw single rows as points, fainter if there are more. */
function drawPoints(chart, f) {
  const place = places(chart, f), n = chart.places.length / 2, size = n > 2000 ? 1.5 : n > 200 ? 2 : 3;
  f.context.fillStyle = ink("bar");
  f.context.globalAlpha = Math.min(1, Math.max(0.35, 40 / Math.sqrt(n)));
  for (let k = 0; k < n; k++) f.context.fillRect(place(chart.places[2 * k], 0) - size / 2, place(chart.places[2 * k + 1], 1) - size / 2, size, size);
  f.context.globalAlpha = 1;
}

function drawAxes(chart, f, label, ySpan, yLabel) {
  const c = f.context, [span] = chart.spans;
  c.strokeStyle = ink("line");
  c.fillStyle = ink("quiet");
  c.lineWidth = 1;
  c.stroke(new Path2D(`M${f.x0} ${f.y1}V${f.y0}H${f.x1}`));
  c.textAlign = "center";
  for (const tick of api.ticks(...span, (f.x1 - f.x0) / 70)) {
    const x = f.x0 + ((tick - span[0]) / (span[1] - span[0])) * (f.x1 - f.x0);
    c.fillText(api.number(tick), x, f.y0 + 13);
    c.fillRect(x, f.y0, 1, 3);
  }
  c.textAlign = "right";
  for (const tick of api.ticks(...ySpan, (f.y0 - f.y1) / 40)) {
    const y = f.y0 - ((tick - ySpan[0]) / (ySpan[1] - ySpan[0])) * (f.y0 - f.y1);
    c.fillText(Math.abs(tick) >= 1e5 ? tick.toExponential().replace("e+", "e") : api.number(tick), f.x0 - 5, y + 4);
    c.fillRect(f.x0 - 3, y, 3, 1);
  }
  c.fillStyle = ink("ink");
  c.textAlign = "center";
  c.fillText(label(chart.axes[0]), (f.x0 + f.x1) / 2, f.y0 + 29);
  c.save();
  c.translate(11, (f.y0 + f.y1) / 2);
  c.rotate(-Math.PI / 2);
  c.fillText(yLabel, 0, 0);
  c.restore();
}

/** (value, axis) -> position on the canvas. */
const places = (chart, f) => (value, k) => {
  const [lo, hi] = chart.spans[k], share = (value - lo) / (hi - lo);
  return k ? f.y0 - share * (f.y0 - f.y1) : f.x0 + share * (f.x1 - f.x0);
};

function drawBrush(chart, f) {
  const place = places(chart, f), [a, b] = chart.brush[0].map((value) => place(value, 0));
  const [bottom, top] = chart.brush[1] ? chart.brush[1].map((value) => place(value, 1)) : [f.y0, f.y1];
  f.context.strokeStyle = ink("accent");
  f.context.lineWidth = 1.5;
  f.context.strokeRect(a, top, b - a, bottom - top);
}
