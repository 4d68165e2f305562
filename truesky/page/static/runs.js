// Runs of the lake: jobs with forecasts, tasks, failures, changed mission parameters, and the provenance of each image.

import * as api from "/static/api.js";

export async function show() {
  const [found, images] = await Promise.all([api.get("runs"), api.get("images")]);
  const parts = [api.h("h2", {}, "Jobs")];
  if (found.said) parts.push(api.h("p", { class: "quiet" }, found.said));
  else parts.push(jobs(found.jobs));
  for (const task of found.tasks) {
    parts.push(api.h("h2", {}, `${api.of(task)}Images`), api.h("p", {}, api.h("progress", { max: task.all, value: task.done, "aria-label": "detectors done" }),
      ` ${task.done} of ${task.all} detectors done`, task.done < task.all ? `, ${api.number(task.seconds_left, 3)} s of CPU time remaining` : ""));
  }
  const lost = Object.entries(api.lake.damaged);
  if (lost.length) parts.push(api.h("h2", {}, "Tables that cannot be read"), api.table([{ name: "table", text: 1 }, { name: "reason", text: 1 }], lost));
  parts.push(api.h("h2", {}, "Failures"), found.failures.length ? api.requested(found.failures,
    [{ name: "part", text: 1 }, { name: "error", text: 1 }, { name: "attempt" }, { name: "run", text: 1 }],
    (f) => [f.part, f.error, f.attempt, f.run]) : api.h("p", { class: "quiet" }, "None."));
  parts.push(api.h("h2", {}, "Mission values that differ from the default"), found.mission.length ? api.requested(found.mission,
    [{ name: "name", text: 1 }, { name: "value" }, { name: "default" }, { name: "unit", text: 1 }],
    (m) => [m.name, m.value, m.usual, m.unit]) : api.h("p", { class: "quiet" }, "None."));
  parts.push(api.h("h2", {}, "Provenance of images"));
  for (const image of images) {
    const details = api.h("details", { class: "tree" }, api.h("summary", {}, `${api.of(image)}${image.path.split("/").pop()}`));
    details.addEventListener("toggle", () => details.open && details.childElementCount === 1 && api.get(`provenance/${image.number}`).then(
      (found) => details.childElementCount === 1 && details.append(tree(found)), (error) => api.say(error.message, true)));
    parts.push(details);
  }
  document.getElementById("runs-content").replaceChildren(...parts);
}

function jobs(rows) {
  const columns = [{ name: "job", text: 1 }, { name: "runs" }, { name: "failed" }, { name: "parts" }, { name: "rows" },
    { name: "elapsed", unit: "s" }, { name: "CPU", unit: "s" }, { name: "forecast", unit: "s" }, { name: "written", unit: "GB" },
    { name: "forecast", unit: "GB" }, { name: "peak memory", unit: "GB" }];
  return api.table(columns, rows.map((r) => [r.job, r.runs, r.failed + r.failed_runs, r.parts, r.rows,
    ...[r.seconds, r.cpu_s, r.forecast_s, r.gb, r.forecast_gb, r.peak_gb].map((value) => value === null ? "–" : +value.toPrecision(3))]));
}

function tree(node) {
  return api.h("ul", {}, api.h("li", {}, api.h("strong", {}, node.name), api.h("span", { class: "quiet" }, ` ${node.about}`), ...node.from.map(tree)));
}
