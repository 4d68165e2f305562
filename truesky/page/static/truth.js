// True sources on an image: asked for once an image, marked, and told of under the cursor.

import * as api from "/static/api.js";
import { colourOf, radiusOf } from "/static/marks.js";

const $ = (id) => document.getElementById(id);
const TOLD = ["z_obs", "mag_r01", "log_stellar_mass", "disk_half_light_radius", "mag_h", "teff"];
// Pixels of the screen that what is told of a source may take.
const TALLEST = 150;
const truths = new Map();
let hovered = null;

/** The sources of an image; while they are under way null, and `come` is called when they are there. */
export function sourcesOf(image, come) {
  if (!truths.has(image.number)) {
    truths.set(image.number, null);
    api.get(`truth/${image.number}`).then((found) => {
      truths.set(image.number, found);
      come();
    }, (error) => {
      // Whoever asks again may be answered.
      truths.delete(image.number);
      api.say(error.message, true);
    });
  }
  return truths.get(image.number);
}

/** The same, waited for. */
export async function asked(image) {
  if (!truths.get(image.number)) truths.set(image.number, await api.get(`truth/${image.number}`));
  return truths.get(image.number);
}

/** How many of all are marked: of very many the brightest. */
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

/** What is true of the source at a pixel, at a place [x, y] of the screen; `reach`: pixels. */
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
  // Of the same source what has come stays.
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
