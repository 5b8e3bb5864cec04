"use strict";
// The list of rollouts: filtered by a matrix of scores, sorted, each row a link to what went wrong.

const read = (name) => JSON.parse(byId(`data-${name}`).textContent);
const rows = read("rows");
const metrics = read("metrics"); // words by abbreviation, in their order
const { multipliers, noises, styles, scenes } = read("looks");
const PAGE = 100;
const WORST = 10;
const chosen = { planner: "", noise: "" }; // by the matrix
let sorting = { key: "cls", up: true };
let room = PAGE;
const FILTERS = ["city", "type", "violated", "low", "high", "find"];

for (const row of rows) row.first = row.at ?? Infinity;

function options(id, values, words = {}) {
  for (const value of values) byId(id).append(new Option(words[value] || value, value));
}

const sorted = (values) => [...new Set(values)].sort();

function matches(row) {
  for (const name of ["planner", "noise"]) {
    if (chosen[name] && row[name] !== chosen[name]) return false;
  }
  for (const name of ["city", "type"]) {
    if (byId(name).value && row[name] !== byId(name).value) return false;
  }
  const violated = byId("violated").value;
  if (violated && !(violated === "failed" ? row.failed : violated in row.violated)) return false;
  const score = row.cls === null ? 0 : 100 * row.cls;
  if (score < Number(byId("low").value) || score > Number(byId("high").value)) return false;
  const wanted = byId("find").value.trim().toLowerCase();
  return !wanted || row.token.toLowerCase().includes(wanted) || row.type.toLowerCase().includes(wanted);
}

// order of two values; of lists that of their first different values
function order(x, y) {
  if (!Array.isArray(x)) return x === y ? 0 : x === null || x < y ? -1 : 1;
  const at = x.findIndex((value, i) => order(value, y[i]) !== 0);
  return at < 0 ? x.length - y.length : at < y.length ? order(x[at], y[at]) : 1;
}

function compare(a, b) {
  const key = (row) => (sorting.key === "noise" ? noises.indexOf(row.noise) : row[sorting.key]);
  return sorting.up ? order(key(a), key(b)) : order(key(b), key(a));
}

// each scenario by its worst rollout, one per recording and cause, with how many others are like it
function worstOf(found) {
  const place = (r) => [r.cls, r.severity, r.noise !== "none", r.planner, r.noise, r.seed, r.token];
  const worst = new Map();
  const alike = new Map();
  const scored = found.filter((row) => row.cls !== null && row.cls < 1);
  for (const row of scored.sort((a, b) => order(place(a), place(b)))) {
    if (!worst.has(row.token)) worst.set(row.token, row);
  }
  for (const row of worst.values()) {
    const key = JSON.stringify(row.log && row.cause ? [row.log, row.cause] : [row.token]);
    if (alike.has(key)) alike.get(key)[1]++;
    else alike.set(key, [row, 0]);
  }
  return [...alike.values()].slice(0, WORST);
}

function linked(row, content) {
  if (!row.page) return make("span", { title: "no replay" }, content);
  const at = Number.isFinite(row.first) ? `t=${row.first.toFixed(2)}&` : "";
  return make("a", { href: `${row.page}#${at}focus=${row.index + 1}` }, content);
}

function picture(row) {
  if (!row.path) return "";
  const dashed = row.noise === "none" ? "" : " dashed";
  const more = [svgOf("path", { d: row.path, class: `driven${dashed}` })];
  const [cx, cy] = row.mark || [];
  if (row.mark) more.push(svgOf("circle", { cx, cy, r: row.view[2] / 45, class: "moment" }));
  const svg = thumbnail(scenes[row.scene], row.view, ...more);
  svg.style.setProperty("--own", styles[row.planner][0]);
  return svg;
}

function sceneOf(row) {
  const link = linked(row, picture(row));
  link.tabIndex = -1; // the token is the same link
  return link;
}

const noiseOf = (row) => span("chip", row.noise === "none" ? "none" : `${row.noise}, seed ${row.seed}`);

function scoreOf(row) {
  if (row.cls === null) return span("score", row.failed ? "failed" : "–");
  const bar = span("bar");
  bar.style.setProperty("--score", `${100 * row.cls}%`);
  return span(row.cls > 0 ? "score" : "score zero", span("number", (100 * row.cls).toFixed(2)), bar);
}

// what went wrong, by time; what has none in the order of the metrics, as it stands there
function causesOf(row) {
  if (row.failed) return [row.failed];
  const parts = Object.entries(row.violated).sort((a, b) => (a[1] ?? 1e9) - (b[1] ?? 1e9));
  return parts.map(([name, t]) => {
    const words = metrics[name] || name;
    const kind = multipliers.includes(name) ? "chip bad" : "chip";
    return span(kind, t === null ? words : `${words} ${t.toFixed(1)}\u00a0s`);
  });
}

function line(row) {
  const about = span("soft", [row.type, row.city].filter(Boolean).join(" · "));
  const cells = {
    scene: [sceneOf(row)],
    token: [linked(row, row.token), about],
    who: [planner(row.planner, styles[row.planner], row.noise)],
    noise: [noiseOf(row)],
    cls: [scoreOf(row)],
    causes: causesOf(row),
  };
  const cellOf = ([className, content]) => make("td", { className }, ...content);
  return make("tr", {}, ...Object.entries(cells).map(cellOf));
}

function card([row, alike]) {
  const more = alike ? span("soft", `${alike} alike`) : "";
  return make(
    "li",
    {},
    sceneOf(row),
    span("top", scoreOf(row), more),
    linked(row, row.token),
    span("soft", [row.type, row.city].filter(Boolean).join(" · ")),
    span("who", planner(row.planner, styles[row.planner], row.noise), noiseOf(row)),
    span("causes", ...causesOf(row)),
  );
}

function choose(wanted) {
  const same = chosen.planner === wanted.planner && chosen.noise === wanted.noise;
  Object.assign(chosen, same ? { planner: "", noise: "" } : wanted);
  refilter();
}

function button(content, wanted, label) {
  const made = make("button", { type: "button", title: label, ariaLabel: label }, content);
  Object.assign(made.dataset, wanted);
  made.addEventListener("click", () => choose(wanted));
  return made;
}

const groupOf = (name, noise) => rows.filter((row) => row.planner === name && row.noise === noise);

// of windows of several lengths, whose scores are not averaged: which ones
function windowsOf(group) {
  const lengths = new Set(group.filter((row) => row.cls !== null).map((row) => row.window));
  return lengths.size > 1 ? [...lengths].sort((a, b) => parseFloat(a) - parseFloat(b)).join(", ") : "";
}

function meanOf(group) {
  if (!group.length || group.some((row) => row.cls === null) || windowsOf(group)) return null;
  return group.reduce((sum, row) => sum + 100 * row.cls, 0) / group.length;
}

function cellOf(name, noise, best) {
  const group = groupOf(name, noise);
  if (!group.length) return "";
  const mean = meanOf(group);
  const done = group.filter((row) => row.cls !== null).length;
  const text = mean === null ? "–" : mean.toFixed(2);
  const windows = windowsOf(group);
  const where = `${name}, noise ${noise}: ${text}, ${done} of ${group.length} rollouts scored${windows && `, windows of ${windows}`}`;
  const made = button(text, { planner: name, noise }, where);
  if (mean === null) made.append(" ", span("soft", done === group.length ? windows : `${done}/${group.length}`));
  else made.style.setProperty("--loss", `${0.4 * (100 - mean)}%`);
  made.classList.toggle("best", text === best);
  return made;
}

const headingOf = (scope, ...parts) => make("th", { scope }, button(...parts));

function makeMatrix() {
  const [head, body] = [byId("matrix").tHead.insertRow(), byId("matrix").tBodies[0]];
  const names = Object.keys(styles);
  const heads = noises.map((noise) => headingOf("col", noise, { planner: "", noise }, `noise ${noise}`));
  head.append(headingOf("col", "all", { planner: "", noise: "" }, "all rollouts"), ...heads);
  const best = noises.map((noise) => {
    const means = names.map((name) => meanOf(groupOf(name, noise))).filter((mean) => mean !== null);
    return means.length > 1 ? Math.max(...means).toFixed(2) : "";
  });
  for (const name of names) {
    const tr = body.insertRow();
    tr.append(headingOf("row", planner(name, styles[name]), { planner: name, noise: "" }, name));
    noises.forEach((noise, i) => tr.insertCell().append(cellOf(name, noise, best[i])));
  }
}

function showWorst(found) {
  const section = byId("worst");
  const worst = worstOf([...found]);
  const count = new Set(found.map((row) => row.token)).size;
  const only = [chosen.planner, chosen.noise && `noise ${chosen.noise}`].filter(Boolean).join(", ");
  const title = `The worst ${worst.length} of ${count} scenarios${only && `: ${only}`}`;
  section.querySelector("h2").textContent = section.querySelector("ol").ariaLabel = title;
  section.querySelector("ol").replaceChildren(...worst.map(card));
  section.hidden = !worst.length;
}

function show() {
  const found = rows.filter(matches).sort(compare);
  byId("list").tBodies[0].replaceChildren(...found.slice(0, room).map(line));
  const drawn = found.length > room ? `, the first ${room} shown` : "";
  byId("count").textContent = `${found.length} of ${rows.length} rollouts${drawn}`;
  byId("more").hidden = found.length <= room;
  for (const th of byId("list").tHead.rows[0].cells) {
    if (th.dataset.key === sorting.key) th.ariaSort = sorting.up ? "ascending" : "descending";
    else th.ariaSort = null;
  }
  for (const one of byId("matrix").querySelectorAll("button")) {
    const { planner: name, noise } = one.dataset;
    one.ariaPressed = name === chosen.planner && noise === chosen.noise;
  }
  return found;
}

function refresh() {
  room = PAGE;
  showWorst(show());
}

// of another filter, which the address keeps
function refilter() {
  refresh();
  const filters = [...Object.entries(chosen), ...FILTERS.map((id) => [id, byId(id).value])];
  const set = filters.filter(([id, value]) => value !== (byId(id)?.defaultValue ?? ""));
  history.replaceState(null, "", `#${new URLSearchParams(set)}`);
}

for (const name of ["city", "type"]) options(name, sorted(rows.map((row) => row[name])).filter(Boolean));
const violated = new Set(rows.flatMap((row) => Object.keys(row.violated)));
const named = Object.fromEntries(Object.entries(metrics).map(([short, words]) => [short, `${words} (${short})`]));
options("violated", Object.keys(metrics).filter((name) => violated.has(name)), named);
for (const id of FILTERS) byId(id).addEventListener("input", refilter);
for (const [id, value] of new URLSearchParams(location.hash.slice(1))) {
  if (id in chosen) chosen[id] = value;
  else if (FILTERS.includes(id)) byId(id).value = value;
}
for (const th of byId("list").tHead.querySelectorAll("[data-key]")) {
  th.tabIndex = 0;
  const sort = () => {
    sorting = { key: th.dataset.key, up: th.dataset.key === sorting.key ? !sorting.up : true };
    show();
  };
  th.addEventListener("click", sort);
  th.addEventListener("keydown", (event) => event.key === "Enter" && sort());
}
byId("more").addEventListener("click", () => {
  room += PAGE;
  show();
});
makeMatrix();
refresh();
document.documentElement.dataset.ready = "1";
