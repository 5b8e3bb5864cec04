"use strict";
// The list of scenarios: sorted, filtered, each row a link into its replay at the violation that counts most.

const byId = (id) => document.getElementById(id);
const rows = JSON.parse(byId("data-rows").textContent);
const metrics = JSON.parse(byId("data-metrics").textContent); // words by abbreviation, in their order
const worst = JSON.parse(byId("data-worst").textContent); // [number of a row, how many are like it]
const PAGE = 200;
let sorting = { key: "cls", up: true };
let room = PAGE;

for (const row of rows) row.first = row.at ?? Infinity;

function options(id, values, words = {}) {
  for (const value of values) {
    const option = document.createElement("option");
    option.value = value;
    option.textContent = words[value] ? `${words[value]} (${value})` : value;
    byId(id).append(option);
  }
}

const sorted = (values) => [...new Set(values)].sort();

function matches(row) {
  for (const name of ["city", "planner", "noise"]) {
    if (byId(name).value && row[name] !== byId(name).value) return false;
  }
  const violated = byId("violated").value;
  if (violated && !(violated === "failed" ? row.failed : violated in row.violated)) return false;
  const score = row.cls === null ? 0 : 100 * row.cls;
  if (score < Number(byId("low").value) || score > Number(byId("high").value)) return false;
  const wanted = byId("find").value.trim().toLowerCase();
  return !wanted || row.token.toLowerCase().includes(wanted) || row.type.toLowerCase().includes(wanted);
}

function compare(a, b) {
  const [x, y] = [a[sorting.key], b[sorting.key]];
  const order = x === y ? 0 : x === null || x < y ? -1 : 1;
  return sorting.up ? order : -order;
}

// violations in words, each with its first time
function words(violated) {
  return violated.map(([name, t]) => {
    const said = metrics[name] || name;
    return t === null ? said : `${said} ${t.toFixed(1)}\u00a0s`;
  });
}

function violatedText(row) {
  if (row.failed) return row.failed;
  // by time; what has none in the order of the metrics, as it stands there
  const parts = Object.entries(row.violated).sort((a, b) => (a[1] ?? 1e9) - (b[1] ?? 1e9));
  return words(parts).join(" · ");
}

function scenarioOf(row) {
  const link = document.createElement(row.page ? "a" : "span");
  const at = Number.isFinite(row.first) ? `t=${row.first.toFixed(2)}&` : "";
  if (row.page) link.href = `${row.page}#${at}focus=${row.index + 1}`;
  else link.title = "no replay";
  link.textContent = row.token;
  return link;
}

function lineOf(score, cells, place) {
  const tr = document.createElement("tr");
  for (const content of cells) tr.insertCell().append(content);
  const td = tr.insertCell(place);
  td.className = "number";
  td.append(score);
  return tr;
}

function line(row) {
  const score = row.failed ? "failed" : row.cls === null ? "–" : (100 * row.cls).toFixed(2);
  const seed = row.noise === "none" ? "" : row.seed;
  const cells = [scenarioOf(row), row.type, row.city, row.planner, row.noise, seed, violatedText(row)];
  return lineOf(score, cells, 6);
}

function worstLine([number, alike]) {
  const row = rows[number];
  const noise = row.noise === "none" ? row.noise : `${row.noise}, seed ${row.seed}`;
  const violated = Object.keys(metrics).filter((name) => name in row.violated);
  const wrong = words(violated.map((name) => [name, row.violated[name]])).join(", ");
  const cells = [scenarioOf(row), row.type, row.planner, noise, wrong, alike || ""];
  return lineOf((100 * row.cls).toFixed(2), cells, 0);
}

function showWorst() {
  const section = byId("worst");
  const count = new Set(rows.map((row) => row.token)).size;
  const title = `The worst ${worst.length} of ${count} scenarios`;
  section.querySelector("h2").textContent = section.querySelector("div").ariaLabel = title;
  section.querySelector("tbody").replaceChildren(...worst.map(worstLine));
  section.hidden = !worst.length;
}

function show() {
  const found = rows.filter(matches).sort(compare);
  byId("list").tBodies[0].replaceChildren(...found.slice(0, room).map(line));
  const drawn = found.length > room ? `${room} shown of ` : "";
  byId("count").textContent = `${drawn}${found.length} of ${rows.length} rollouts`;
  byId("more").hidden = found.length <= room;
  for (const th of byId("list").tHead.rows[0].cells) {
    if (th.dataset.key === sorting.key) th.ariaSort = sorting.up ? "ascending" : "descending";
    else th.ariaSort = null;
  }
}

options("city", sorted(rows.map((row) => row.city)));
options("planner", sorted(rows.map((row) => row.planner)));
options("noise", sorted(rows.map((row) => row.noise)));
const violated = new Set(rows.flatMap((row) => Object.keys(row.violated)));
options("violated", Object.keys(metrics).filter((name) => violated.has(name)), metrics);
for (const id of ["city", "planner", "noise", "violated", "low", "high", "find"]) {
  byId(id).addEventListener("input", () => {
    room = PAGE;
    show();
  });
}
for (const th of byId("list").tHead.rows[0].cells) {
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
showWorst();
show();
document.documentElement.dataset.ready = "1";
