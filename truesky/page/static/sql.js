// A query editor with a list of names, and the result as table, plot or file.

import * as api from "/static/api.js";
import { usePlot } from "/static/plots.js";

const $ = (id) => document.getElementById(id);
// Bytes of a download that are collected before the browser takes over a large one.
const MOST_HELD = 32e6;
// The editor is loaded when the view is first shown; until then, `text` is the query.
let page, ran = null, runs = 0, editor = null, opening = null, text = "";

export function start(given) {
  page = given;
  text = first();
  for (const table of api.lake.tables) {
    const columns = table.columns.map((column) => api.h("button", { onclick: () => insert(column.name) },
      column.name, api.h("small", {}, ` ${[column.unit, column.type].filter(Boolean).join(", ")}${column.meaning ? `: ${column.meaning}` : ""}`), column.ucd ? api.h("small", { class: "ucd" }, ` ${column.ucd}`) : null));
    $("sql-schema").append(api.h("details", {}, api.h("summary", {}, api.h("strong", {}, table.name), ` ${api.number(table.rows)} rows`),
      api.h("p", { class: "quiet" }, table.meaning), ...columns));
  }
  $("sql-run").addEventListener("click", run);
  $("sql-plot").addEventListener("click", plot);
  for (const button of document.querySelectorAll("#sql [data-format]")) button.addEventListener("click", () => download(button.dataset.format));
  $("sql-python").addEventListener("click", () => api.copy(api.python(query()), "Python"));
  $("sql-command").addEventListener("click", () => api.copy(
    `truesky sql ${quoted(api.lake.lake)} ${quoted(query())}`, "Command"));
  $("sql-tap").addEventListener("click", () => api.copy(
    `import pyvo\npyvo.dal.TAPService(${JSON.stringify(api.lake.tap)}).search(${JSON.stringify(query())}).to_table()\n`, "Python"));
}

const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;

function first() {
  const names = api.lake.tables.map((table) => table.name);
  if (names.includes("galaxies")) return "SELECT id, ra, dec, z_obs, mag_r01, log_stellar_mass\nFROM galaxies\nWHERE z_obs < 0.5\nORDER BY mag_r01\nLIMIT 100";
  return names.length ? `SELECT * FROM ${api.sqlName(names[0])} LIMIT 100` : "SELECT 1";
}

const query = () => editor?.text() ?? text;

async function openEditor() {
  const { open } = await import("/static/codemirror.js");
  editor = open($("sql-editor"), { text, id: "sql-text", label: $("sql-hint").textContent, tables: api.lake.tables, run, changed: page.remember });
}

function insert(name) {
  editor?.insert(name);
}

function showError(error) {
  $("sql-state").className = "bad-text";
  $("sql-state").textContent = error.message;
}

async function run() {
  // If queries overlap, show the last one, whichever is answered first.
  const mine = ++runs;
  $("sql-state").className = "quiet busy";
  $("sql-state").textContent = "Running…";
  $("sql-result").setAttribute("aria-busy", "true");
  try {
    const found = await api.post("sql", { sql: query() });
    if (mine !== runs) return;
    ran = found;
  } catch (error) {
    if (mine !== runs) return;
    // A result of an earlier query below this message would be taken for the result of this query.
    ran = null;
    $("sql-result").replaceChildren();
    return showError(error);
  } finally {
    if (mine === runs) $("sql-result").setAttribute("aria-busy", "false");
  }
  $("sql-state").className = "quiet";
  const more = ran.more ? `first ${ran.rows.length} rows; downloads contain all rows` : `${ran.rows.length} rows`;
  $("sql-state").textContent = `${more}, ${(ran.seconds * 1000).toFixed(0)} ms`;
  const columns = ran.columns.map((c) => ({ ...c, text: c.type === "string" }));
  $("sql-result").replaceChildren(api.table(columns, ran.rows.map((row) => row.map((value) => Array.isArray(value) ? `[${value.length} values]` : value))));
  page.remember();
}

/** Plot the first two columns of numbers against each other. */
async function plot() {
  if (!ran) await run();
  const numbers = (ran?.columns ?? []).filter((c) => /int|float|double/.test(c.type) && c.name !== "id").map((c) => api.sqlQuoted(c.name));
  if (!numbers.length) return api.say("The result has no numeric column.", true);
  const text = query().trim().replace(/;$/, "");
  usePlot(`(${text}\n) AS result`, numbers.length > 1 ? [[numbers[0]], [numbers[1]], [numbers[0], numbers[1]]] : [[numbers[0]]]);
  page.show("plots");
}

/** Save a small response as a file and show errors; let the browser download a large one. */
async function download(format) {
  const address = api.downloadAddress(format, query()), stop = new AbortController();
  $("sql-state").className = "quiet";
  $("sql-state").textContent = `${format} …`;
  try {
    const pieces = await api.begun(address, MOST_HELD, stop.signal);
    save(pieces ? URL.createObjectURL(new Blob(pieces)) : address, format);
    $("sql-state").textContent = `${format}: download started`;
  } catch (error) {
    showError(error);
  } finally {
    stop.abort();
  }
}

function save(address, format) {
  const link = api.h("a", { href: address, download: `result.${format}` });
  document.body.append(link);
  link.click();
  link.remove();
  if (address.startsWith("blob:")) setTimeout(() => URL.revokeObjectURL(address), 60000);
}

export async function show() {
  if (!ran) run();
  await (opening ??= openEditor());
}
export const state = () => ({ text: query() });
export function restore(was) {
  if (typeof was.text !== "string") return;
  text = was.text;
  editor?.replace(text);
}
