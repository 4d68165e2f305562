// True sources on an image: loaded once per image, marked, and described under the cursor.

import * as api from "/static/api.js";
import { colourOf, radiusOf } from "/static/marks.js";

const $ = (id) => document.getElementById(id);
const TOLD = ["z_obs", "mag_r01", "log_stellar_mass", "disk_half_light_radius", "mag_h", "teff"];
// Largest height of the box that describes a source, in pixels of the screen.
const TALLEST = 150;
const truths = new Map();
let hovered = null;

/** The sources of an image; null while they are loading, then `come` is called. */
export function sourcesOf(image, come) {
  if (!truths.has(image.number)) {
    truths.set(image.number, null);
    api.get(`truth/${image.number}`).then((found) => {
      truths.set(image.number, found);
      come();
    }, (error) => {
      // Allow another attempt after an error.
      truths.delete(image.number);
      api.say(error.message, true);
    });
  }
  return truths.get(image.number);
}

/** The sources of an image as a promise. */
export async function asked(image) {
  if (!truths.get(image.number)) truths.set(image.number, await api.get(`truth/${image.number}`));
  return truths.get(image.number);
}

/** Number of marked sources; only the brightest are marked if there are many. */
export const caption = (truth) => truth.id.length < truth.total
  ? `true sources: the brightest ${api.number(truth.id.length)} of ${api.number(truth.total)}` : `${api.number(truth.id.length)} true sources`;

export function drawSources(c, truth, at, [width, height]) {
  c.lineWidth = 1.3;
  truth.x.forEach((x, k) => {
    const p = at(x, truth.y[k]);
    if (p[0] < -20 || p[1] < -20 || p[0] > width + 20 || p[1] > height + 20) return;
    c.strokeStyle = colourOf(truth.kind[k]);
    c.beginPath();
    c.arc(...p, radiusOf(truth.expected[k]), 0, 7);
    c.stroke();
  });
}

/** Show the source near a pixel in a box at [x, y] of the screen; `reach` is the largest distance in image pixels. */
export function tip(image, pixel, reach, [left, top]) {
  const near = $("image-truth").checked && truths.get(image.number);
  let best = -1, least = reach;
  if (near) near.x.forEach((x, k) => {
    const away = Math.hypot(x - pixel[0], near.y[k] - pixel[1]);
    if (away < least) [best, least] = [k, away];
  });
  $("image-tip").hidden = best < 0;
  if (best < 0) return (hovered = null);
  $("image-tip").style.left = `${Math.min(left + 14, $("image-canvas").clientWidth - 240)}px`;
  $("image-tip").style.top = `${Math.max(0, Math.min(top + 14, $("image-canvas").clientHeight - TALLEST))}px`;
  // Keep the text if the source is the same.
  if (hovered?.id === near.id[best] && hovered.number === image.number) return;
  const mine = (hovered = { id: near.id[best], number: image.number });
  const text = `${near.kind[best]} ${mine.id}\n${api.number(near.expected[best])} electrons expected, ${api.number(near.drawn[best])} drawn`;
  $("image-tip").textContent = text;
  api.get(`source/${mine.id}`).then((found) => {
    if (hovered !== mine) return;
    const values = Object.fromEntries(Object.values(found.tables).flat().map((row) => [row.name, row]));
    const told = TOLD.filter((name) => values[name]).map((name) => `${name} ${api.number(values[name].value, 4)} ${values[name].unit}`);
    $("image-tip").textContent = [text, ...told].join("\n");
  }, () => {});
}
