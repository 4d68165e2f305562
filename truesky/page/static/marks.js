// Overlays of the sky and of images: marks of sources, a compass, a scale bar.

/** Radius of the mark of a source in pixels of the screen, by its electrons. */
export const radiusOf = (electrons) => Math.min(28, 3 + 1.6 * Math.log10(1 + Math.max(0, electrons)));

export const colourOf = (kind) => ({ star: "#9fd3ff", QSO: "#d9a7ff", "strong lens": "#9be0a8", "moving body": "#ff9a8d" })[kind] ?? "#ffd27d";

/** Mark the centre of the view, which keyboard commands refer to. */
export function cross(c, [x, y], colour) {
  c.strokeStyle = colour;
  c.lineWidth = 1;
  c.beginPath();
  for (const [u, v] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    c.moveTo(x + 4 * u, y + 4 * v);
    c.lineTo(x + 12 * u, y + 12 * v);
  }
  c.stroke();
}

/** Size of an image pixel in deg. */
export function scaleOf(image) {
  const a = image.plate.plane(image.nx / 2, image.ny / 2), b = image.plate.plane(image.nx / 2 + 1, image.ny / 2);
  return Math.hypot(a[0] - b[0], a[1] - b[1]);
}

/** Draw north and east at the centre of the view, and a scale bar of a round angle; `at`: pixels -> screen. */
export function compass(c, image, view, at, [width, height]) {
  const x = view.x, y = view.y, [a0, d0] = image.plate.sky(x, y), pixel = scaleOf(image) * 3600, o = at(x, y);
  c.font = "12px DejaVu Sans, sans-serif";
  c.lineWidth = 1.5;
  c.strokeStyle = c.fillStyle = "#e8e6df";
  c.textAlign = "center";
  for (const [name, da, dd] of [["N", 0, 1], ["E", 1, 0]]) {
    const q = image.plate.pixel(a0 + (da * 0.001) / Math.cos((d0 * Math.PI) / 180), d0 + dd * 0.001);
    const p = at(...q), size = Math.hypot(p[0] - o[0], p[1] - o[1]) || 1, u = [(p[0] - o[0]) / size, (p[1] - o[1]) / size], from = [width - 58, height - 58];
    c.beginPath();
    c.moveTo(...from);
    c.lineTo(from[0] + 30 * u[0], from[1] + 30 * u[1]);
    c.stroke();
    c.fillText(name, from[0] + 40 * u[0], from[1] + 40 * u[1] + 4);
  }
  const nice = [0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200].filter((s) => (s / pixel) * view.zoom < width / 4).pop() ?? 0.5;
  const long = (nice / pixel) * view.zoom;
  c.fillRect(width - 110 - long, height - 22, long, 2);
  c.fillText(nice >= 60 ? `${nice / 60}′` : `${nice}″`, width - 110 - long / 2, height - 28);
}

/** Describe the order of sources: smallest magnitudes first, or largest masses first. */
export const firstOf = (dots) => (dots.sense < 0 ? "most massive" : "brightest");

/** Draw the sources of a field, the first ones larger; `at`: RA, Dec -> screen. */
export function drawDots(c, dots, at, colour) {
  const mags = dots.mag.map((mag) => mag && mag * dots.sense), told = mags.filter((mag) => mag !== null);
  const faint = told.reduce((a, b) => Math.max(a, b), -Infinity), bright = told.reduce((a, b) => Math.min(a, b), faint - 1);
  c.fillStyle = colour;
  dots.ra.forEach((ra, k) => {
    const point = at(ra, dots.dec[k]);
    if (!point) return;
    const share = mags[k] === null ? 0.3 : (faint - mags[k]) / (faint - bright);
    c.globalAlpha = 0.35 + 0.6 * share;
    c.beginPath();
    c.arc(...point, 0.9 + 4.5 * share ** 2, 0, 7);
    c.fill();
  });
  c.globalAlpha = 1;
}
