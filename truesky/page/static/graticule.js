// Coordinate grid on the sky.

import { ink } from "/static/colour.js";

/** Draw a line through points; a missing point interrupts it. */
export function line(c, points) {
  c.beginPath();
  let on = false;
  for (const point of points) {
    if (point && on) c.lineTo(...point);
    else if (point) c.moveTo(...point);
    on = Boolean(point);
  }
  c.stroke();
}

/** Draw meridians and parallels at round degrees with labels; `at`: RA, Dec -> screen. */
export function graticule(c, view, at, [width, height]) {
  const step = [30, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005].find((s) => s <= view.height / 3.5) ?? 0.0005;
  const near = Math.min(89.9, view.dec > 0 ? view.dec : -view.dec), wide = Math.min(180, (view.height * Math.max(1, width / height)) / Math.cos((near * Math.PI) / 180));
  const raStep = step * Math.max(1, 2 ** Math.round(Math.log2(1 / Math.max(0.02, Math.cos((near * Math.PI) / 180)))));
  const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
  c.strokeStyle = `color-mix(in srgb, ${ink("line")} 55%, transparent)`;
  c.fillStyle = ink("quiet");
  c.font = "11px DejaVu Sans, sans-serif";
  c.lineWidth = 1;
  const decs = [], ras = [];
  for (let d = Math.ceil((view.dec - view.height) / step) * step; d <= view.dec + view.height; d += step) if (Math.abs(d) <= 90) decs.push(d);
  for (let a = Math.ceil((view.ra - wide) / raStep) * raStep; a < view.ra + Math.min(wide, 180) - 1e-9; a += raStep) ras.push(a);
  const steps = 48;
  for (const dec of decs) {
    line(c, Array.from({ length: steps + 1 }, (_, k) => at(view.ra - wide + (2 * wide * k) / steps, dec)));
    const label = at(view.ra, dec);
    if (label) c.fillText(`Dec ${dec < -1e-9 ? "−" : "+"}${Math.abs(dec).toFixed(digits)}°`, 4, label[1] - 3);
  }
  for (const ra of ras) {
    line(c, Array.from({ length: steps + 1 }, (_, k) => at(ra, Math.max(-89.99, Math.min(89.99, view.dec - view.height + (2 * view.height * k) / steps)))));
    const label = at(ra, view.dec);
    if (label && label[0] > 45 && label[0] < width - 45) c.fillText(`RA ${(((ra % 360) + 360) % 360).toFixed(digits)}°`, label[0] + 3, 13);
  }
}
