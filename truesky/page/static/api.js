// Questions to the server, each of the lake as it was opened; and small helpers of the page.

export const lake = { key: "", tables: [], tap: "", limits: {} };

/** Say something in the corner; what went wrong stays longer. */
export function say(text, bad = false) {
  const line = document.getElementById("said").appendChild(document.createElement("p"));
  line.textContent = text;
  line.className = bad ? "bad" : "";
  setTimeout(() => line.remove(), bad ? 12000 : 3000);
}

async function answered(address, options) {
  const answer = await fetch(address, { credentials: "same-origin", ...options });
  if (answer.ok) return answer;
  let said = answer.statusText;
  try {
    said = (await answer.json()).error;
  } catch { /* no JSON: the status says it */ }
  if (answer.status === 409) document.getElementById("changed").hidden = false;
  throw new Error(said);
}

const address = (path) => `/api/${lake.key}/${path}`;

/** Learn what the lake holds. What is shown belongs to the key that was learnt first: of another only the news is told. */
export async function open(again = false) {
  const answer = again ? await answered("/api/reopen", { method: "POST" }) : await answered("/api/lake");
  const told = await answer.json();
  if (lake.key && told.key !== lake.key) {
    document.getElementById("changed").hidden = false;
    return lake;
  }
  Object.assign(lake, told);
  document.getElementById("changed").hidden = !lake.is_changed;
  return lake;
}

export async function get(path, signal) {
  return (await answered(address(path), { signal })).json();
}

export async function bytes(path, signal) {
  return (await answered(address(path), { signal })).arrayBuffer();
}

export async function post(path, question, signal) {
  const answer = await answered(address(path), { method: "POST", body: JSON.stringify(question), signal });
  return answer.headers.get("Content-Type").startsWith("application/json") ? answer.json() : answer.arrayBuffer();
}

/** The head of a binary answer, and where its numbers begin. */
export function headed(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  return [JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length))), 4 + length];
}

export function downloadAddress(format, sql) {
  return `${address("export")}?${new URLSearchParams({ format, sql })}`;
}

/** The pieces of an answer of at most so many bytes; null of a larger one, which is given up.  Errors: a refusal, in words */
export async function begun(address, most, signal) {
  const reader = (await answered(address, { signal })).body.getReader(), pieces = [];
  for (let size = 0; ; ) {
    const { done, value } = await reader.read();
    if (done) return pieces;
    pieces.push(value);
    size += value.length;
    if (size > most) return null;
  }
}

/** An element: h("td", {class: "text"}, "x", child). Texts become text, never markup. */
export function h(tag, facts = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(facts)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== null && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** A number as people read it. */
export function number(value, digits = 5) {
  if (value === null || value === undefined) return "";
  if (typeof value !== "number") return String(value);
  if ((Number.isInteger(value) || Math.abs(value) >= 1e5) && Math.abs(value) < 1e12) return Math.round(+value.toPrecision(Math.max(digits, Number.isInteger(value) ? 15 : 3))).toLocaleString("en-US").replace(/,/g, "\u202f");
  // An identifier is a whole number too: what JSON holds exactly is shown to its last digit.
  if (Number.isSafeInteger(value)) return String(value);
  const size = Math.abs(value);
  return size !== 0 && (size >= 1e12 || size < 1e-3) ? (+value.toPrecision(digits)).toExponential() : String(+value.toPrecision(digits));
}

/** An angle of a place on the sky, deg, to better than 0.001 arcsec. */
export const degrees = (value) => value.toFixed(7);

/** Right ascension and declination, sexagesimal beside degrees, to better than 0.01 arcsec. */
export function place(ra, dec) {
  const two = (x) => String(Math.floor(x)).padStart(2, "0");
  const split = (value, last, most) => {
    const unit = 10 ** last, all = Math.round(value * 3600 * unit) % (most * 3600 * unit);
    const seconds = ((all % (60 * unit)) / unit).toFixed(last).padStart(3 + last, "0");
    return [two(all / (3600 * unit)), two((all / (60 * unit)) % 60), seconds];
  };
  const turned = (((ra % 360) + 360) % 360), hours = split(turned / 15, 3, 24), angles = split(Math.abs(dec), 2, 180);
  return `${hours.join(":")} ${dec < 0 ? "\u2212" : "+"}${angles.join(":")}   ${(+turned.toFixed(6) % 360).toFixed(6)} ${dec.toFixed(6)} deg`;
}

/** Tell those who do not see it what has come of their keys, when nothing has changed for a moment; `text` may be a function. */
export function tell(text) {
  clearTimeout(telling);
  telling = setTimeout(() => (document.getElementById("told").textContent = typeof text === "string" ? text : text()), 700);
}
let telling = 0;

/** What a table leaves out: "the first 500 of 12 288 cells"; nothing where it has all. */
export const cut = (shown, all, what) => (shown < all ? `${number(shown)} of ${number(all)} ${what}` : null);

/** A table's name in a query: what is no plain word of SQL stands in quotes. */
export const sqlName = (name) => name.split(".").map((part) => (/^[a-z_][a-z0-9_]*$/.test(part) ? part : `"${part}"`)).join(".");

/** A query as Python. */
export const python = (sql) => `from truesky.explore.explorer import Explorer\n\nwith Explorer(${JSON.stringify(lake.lake)}) as lake:\n    rows = lake.sql(${JSON.stringify(sql)}, into="astropy")\n`;

export async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    say(`${what} copied`);
  } catch {
    say(text);
  }
}

export function table(columns, rows, caption) {
  const head = h("tr", {}, ...columns.map((c) => h("th", { scope: "col", title: c.meaning || null, class: c.text ? "text" : null },
    c.name, c.unit ? h("small", {}, ` ${c.unit}`) : null, c.ucd ? h("small", { class: "ucd" }, c.ucd) : null)));
  const body = rows.map((row) => h("tr", {}, ...row.map((value, k) =>
    h("td", { class: columns[k].text ? "text" : null }, value instanceof Node ? value : number(value, columns[k].type === "double" ? 12 : 7)))));
  return h("table", {}, caption ? h("caption", {}, caption) : null, h("thead", {}, head), h("tbody", {}, ...body));
}

/** A table of what is of requests, which stand first where the lake has several; `row`: the cells of one. */
export function requested(ones, columns, row) {
  const several = ones.some((one) => one.request);
  return several ? table([{ name: "request", text: 1 }, ...columns], ones.map((one) => [one.request, ...row(one)])) : table(columns, ones.map(row));
}

/** Before the name of what is of a request: its name, where the lake has several. */
export const of = (one) => (one.request ? `${one.request}: ` : "");

/** Run the newest question; while one is under way only the last of the others waits. */
export function newest(ask) {
  let busy = false, waiting = null;
  return async function run(...given) {
    if (busy) {
      waiting = given;
      return;
    }
    busy = true;
    try {
      await ask(...given);
    } catch (error) {
      if (error.name !== "AbortError") say(error.message, true);
    } finally {
      busy = false;
      if (waiting) {
        const next = waiting;
        waiting = null;
        run(...next);
      }
    }
  };
}

/** Make a canvas as fine as the screen; returns its size in the page's pixels. */
export function fit(canvas) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return [box.width, box.height, ratio];
}

/** Ticks at round numbers. */
export function ticks(low, high, about) {
  const step0 = (high - low) / Math.max(about, 1), power = 10 ** Math.floor(Math.log10(step0));
  const step = power * [1, 2, 5, 10].find((m) => m * power >= step0 * 0.999), out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) out.push(+(k * step).toPrecision(12));
  return out;
}
