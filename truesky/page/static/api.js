// Requests to the server, all for the key of the open lake, and small helpers of the page.

export const lake = { key: "", tables: [], tap: "", limits: {} };

/** Show a message in the corner; error messages stay longer. */
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
  } catch { /* the body is not JSON: use the status text */ }
  if (answer.status === 409) document.getElementById("changed").hidden = false;
  throw new Error(said);
}

const address = (path) => `/api/${lake.key}/${path}`;

/** Read the description of the lake. The page keeps the key of the first description; if the key has changed, it only shows a notice. */
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

/** The header of a binary response, and the offset of the data behind it. */
export function headed(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  return [JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length))), 4 + length];
}

export function downloadAddress(format, sql) {
  return `${address("export")}?${new URLSearchParams({ format, sql })}`;
}

/** The chunks of a response of at most `most` bytes, or null if it is larger. Throws an error with the server's message. */
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

/** Create an element: h("td", {class: "text"}, "x", child). Strings become text, never markup. */
export function h(tag, facts = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(facts)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== null && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Format a number for display. */
export function number(value, digits = 5) {
  if (value === null || value === undefined) return "";
  if (typeof value !== "number") return String(value);
  if ((Number.isInteger(value) || Math.abs(value) >= 1e5) && Math.abs(value) < 1e12) return Math.round(+value.toPrecision(Math.max(digits, Number.isInteger(value) ? 15 : 3))).toLocaleString("en-US").replace(/,/g, "\u202f");
  // Show integers that are exact in JSON with all digits, because identifiers are integers too.
  if (Number.isSafeInteger(value)) return String(value);
  const size = Math.abs(value);
  return size !== 0 && (size >= 1e12 || size < 1e-3) ? (+value.toPrecision(digits)).toExponential() : String(+value.toPrecision(digits));
}

/** Format an angle in degrees with a resolution better than 0.001 arcsec. */
export const degrees = (value) => value.toFixed(7);

/** Format RA and Dec, sexagesimal and in degrees, with a resolution better than 0.01 arcsec. */
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

/** Announce the result of a key press to screen readers after a short pause without changes; `text` may be a function. */
export function tell(text) {
  clearTimeout(telling);
  telling = setTimeout(() => (document.getElementById("told").textContent = typeof text === "string" ? text : text()), 700);
}
let telling = 0;

/** Describe what a table omits, for example "500 of 12 288 cells"; null if it is complete. */
export const cut = (shown, all, what) => (shown < all ? `${number(shown)} of ${number(all)} ${what}` : null);

/** The name of a column in a query, in quotes. */
export const sqlQuoted = (name) => `"${name.replaceAll('"', '""')}"`;

/** The name of a column in a query, in quotes if it is not a plain SQL identifier. */
export const sqlWord = (name) => (/^[a-z_][a-z0-9_]*$/.test(name) ? name : sqlQuoted(name));

/** The name of a table in a query, which may follow the name of its request and a dot. */
export const sqlName = (name) => name.split(".").map(sqlWord).join(".");

/** A query as Python code. */
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

/** A table of items that belong to requests, with a column of the request if there are several; `row` returns the cells of an item. */
export function requested(ones, columns, row) {
  const several = ones.some((one) => one.request);
  return several ? table([{ name: "request", text: 1 }, ...columns], ones.map((one) => [one.request, ...row(one)])) : table(columns, ones.map(row));
}

/** Prefix for the label of an item: the name of its request if the lake has several. */
export const of = (one) => (one.request ? `${one.request}: ` : "");

/** Run only the latest call: while one is running, only the last of the following calls waits. */
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

/** Match the resolution of a canvas to the screen; return its size in CSS pixels and the ratio. */
export function fit(canvas) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return [box.width, box.height, ratio];
}

/** Tick marks at round numbers. */
export function ticks(low, high, about) {
  const step0 = (high - low) / Math.max(about, 1), power = 10 ** Math.floor(Math.log10(step0));
  const step = power * [1, 2, 5, 10].find((m) => m * power >= step0 * 0.999), out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) out.push(+(k * step).toPrecision(12));
  return out;
}
