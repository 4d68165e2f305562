// The page: views, address, theme and keyboard.

import * as api from "/static/api.js";
import * as image from "/static/image.js";
import { redraw as redrawPin } from "/static/pin.js";
import * as plots from "/static/plots.js";
import * as runs from "/static/runs.js";
import * as sky from "/static/sky.js";
import * as sql from "/static/sql.js";

const VIEWS = { sky, plots, sql, images: image, runs };
const $ = (id) => document.getElementById(id);
let shown = null, writing = 0, last = "";

/** Show a view; `state` is its state from the address. */
export async function show(name, state) {
  const view = VIEWS[name] ?? sky;
  shown = name in VIEWS ? name : "sky";
  for (const other of Object.keys(VIEWS)) {
    $(other).hidden = other !== shown;
    $(`tab-${other}`).setAttribute("aria-selected", String(other === shown));
    $(`tab-${other}`).tabIndex = other === shown ? 0 : -1;
  }
  try {
    await view.show(state);
  } catch (error) {
    api.say(error.message, true);
  }
  remember();
}

/** Store the view in the address, shortly after its last change. */
export function remember() {
  clearTimeout(writing);
  writing = setTimeout(() => {
    const held = { view: shown, lake: api.lake.key, theme: document.documentElement.dataset.theme };
    for (const [name, view] of Object.entries(VIEWS)) if (view.state) held[name] = view.state();
    last = `#${encodeURIComponent(JSON.stringify(held))}`;
    history.replaceState(null, "", last);
  }, 120);
}

function held() {
  try {
    return JSON.parse(decodeURIComponent(location.hash.slice(1))) ?? {};
  } catch {
    return {};
  }
}

async function restore() {
  const was = held();
  if (was.lake && was.lake !== api.lake.key) api.say("The address belongs to another version of this lake. The page shows the current version.");
  theme(was.theme === "light" ? "light" : "dark");
  for (const [name, view] of Object.entries(VIEWS)) if (was[name] && view.restore) view.restore(was[name]);
  await show(was.view ?? "sky", was[was.view]);
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = name === "dark" ? "Light" : "Dark";
  for (const view of Object.values(VIEWS)) view.redraw?.();
  redrawPin();
}

function keys(event) {
  // The editor of queries is in a shadow root, for which `event.target` is the host.
  const [target] = event.composedPath();
  if (target.isContentEditable || target.matches?.("input, textarea, select") || event.ctrlKey || event.metaKey || event.altKey) return;
  const number = "12345".indexOf(event.key);
  if (number >= 0) show(Object.keys(VIEWS)[number]);
  else VIEWS[shown].key?.(event);
}

async function start() {
  await api.open();
  $("lake-name").textContent = api.lake.lake;
  $("version").textContent = `truesky ${api.lake.version}, lake ${api.lake.key}. Limits of a query: ${api.lake.limits.rows_shown} rows shown, ${api.lake.limits.seconds} s.`;
  $("tap-address").textContent = "";
  $("tap-address").append(api.h("button", { onclick: () => api.copy(api.lake.tap, "Address of the TAP service") }, "Copy TAP address"));
  for (const [name, why] of Object.entries(api.lake.damaged)) api.say(`${name}: ${why}`, true);
  for (const [name, view] of Object.entries(VIEWS)) view.start?.({ show, remember, name, toSky: sky.goToPlace });
  await restore();
  document.body.dataset.ready = "1";
}

$("tabs").addEventListener("click", (event) => event.target.dataset.view && show(event.target.dataset.view));
$("tabs").addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const names = Object.keys(VIEWS), next = names[(names.indexOf(shown) + step + names.length) % names.length];
  show(next);
  $(`tab-${next}`).focus();
  event.stopPropagation();
});
$("theme").addEventListener("click", () => {
  theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  remember();
});
$("help-button").addEventListener("click", () => {
  $("help").hidden = !$("help").hidden;
  $("help-button").setAttribute("aria-expanded", String(!$("help").hidden));
});
$("copy-address").addEventListener("click", () => api.copy(location.href, "Address"));
$("reopen").addEventListener("click", () => api.open(true).then(() => location.reload(), (error) => api.say(error.message, true)));
document.addEventListener("keydown", keys);
addEventListener("hashchange", () => document.body.dataset.ready && location.hash !== last && restore());
addEventListener("resize", () => {
  VIEWS[shown]?.redraw?.();
  redrawPin();
});
setInterval(() => document.hidden || api.open().catch(() => {}), 30000);
start().catch((error) => api.say(error.message, true));
