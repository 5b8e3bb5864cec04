"use strict";
// A run under way: asks for its state twice a second, and keeps the last one when it has ended.

const key = new URLSearchParams(location.search).get("token") || "";
const EVERY = 500; // ms between two questions
const SILENT = 6; // questions without an answer after which nothing more is asked
const WORDS = {
  running: "running",
  finished: "finished",
  interrupted: "interrupted; the same command with --resume goes on",
  stopped: "stopped by an error; the terminal says why",
};

function minutes(seconds) {
  const whole = Math.round(seconds);
  const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return parts.slice(parts[0] ? 0 : 1).map((part, i) => (i ? `${part}`.padStart(2, "0") : part)).join(":");
}

const cell = (content, className = "") => make("td", { className }, content ?? "–");

function fillRows(id, rows, empty) {
  const body = byId(id).tBodies[0];
  const colSpan = byId(id).tHead.rows[0].cells.length;
  if (!rows.length) rows = [[make("td", { className: "none", colSpan }, empty)]];
  body.replaceChildren(...rows.map((cells) => make("tr", {}, ...cells)));
}

// mean and interval on a scale from 0 to 100
function range({ mean, interval: [low = mean, high = mean] }, colour) {
  const line = make("i", { style: `left: ${low}%; width: ${high - low}%` });
  const dot = make("b", { style: `left: ${mean}%` });
  return make("div", { className: "range", style: `--own: ${colour}` }, line, dot);
}

function scenario(row, ended) {
  if (row.replay === null || ended) return row.token;
  const at = row.at === null ? "" : `#t=${row.at.toFixed(2)}`;
  const href = `/replay?id=${row.replay}&token=${encodeURIComponent(key)}${at}`;
  return make("a", { href, target: "_blank" }, row.token);
}

function seedOf(row) {
  return row.noise === "none" ? "" : `${row.seed}`;
}

function show(state) {
  const ended = state.state !== "running";
  document.title = `${Math.floor((100 * state.done) / Math.max(state.total, 1))} % · ${state.title}`;
  byId("title").textContent = state.title;
  byId("bar").firstChild.style.width = `${(100 * state.done) / Math.max(state.total, 1)}%`;
  byId("state").textContent = `${WORDS[state.state]}:`;
  byId("count").textContent = `${state.done} of ${state.total} rollouts`;
  const left = state.left === null ? "" : `, about ${minutes(state.left)} left`;
  const so = ended ? `in ${minutes(state.elapsed)}` : `after ${minutes(state.elapsed)}${left}`;
  const next = ended ? `; replays of all: shiftsim view ${state.title}` : "";
  byId("time").textContent = so + next;
  document.body.className = state.state === "finished" ? "ended" : ended ? "stopped" : "";
  const ends = (row) => row.interval.map((end) => end.toFixed(2)).join(" – ") || "–";
  const who = (row) => cell(planner(row.planner, state.styles[row.planner], row.noise));
  fillRows(
    "scores",
    state.groups.map((row) => [
      who(row), cell(row.noise), cell(row.mean.toFixed(2), "n"), cell(ends(row), "n"),
      cell(range(row, state.styles[row.planner][0]), "scale"),
      cell(`${row.done}${row.failed ? `, ${row.failed} failed` : ""}`, "n"), cell(row.traffic),
    ]),
    "nothing has finished yet",
  );
  fillRows(
    "worst",
    state.worst.map((row) => [
      cell(row.score.toFixed(2), "n"), cell(scenario(row, ended)), who(row),
      cell(row.noise), cell(seedOf(row), "n"), cell(row.why, "why"),
    ]),
    "no rollout below 100 yet",
  );
  byId("failed").textContent = state.num_failures
    ? `(${state.failures.length} of ${state.num_failures} shown)` : "";
  fillRows(
    "failures",
    state.failures.map((row) => [
      cell(row.token), who(row), cell(row.noise), cell(seedOf(row), "n"),
      cell(`${row.status}: ${[row.error, row.hint].filter(Boolean).join(" – ")}`, "why"),
    ]),
    "nothing",
  );
}

let silent = 0;
async function ask() {
  try {
    const answer = await fetch("/api/state", { headers: { "X-Shiftsim-Token": key } });
    const state = await answer.json();
    if (!answer.ok) throw new Error(state.error);
    silent = 0;
    show(state);
    document.documentElement.dataset.ready = "1";
    if (state.state !== "running") return;
  } catch {
    if (++silent >= SILENT) {
      byId("state").textContent = "no answer any more: the run has ended, this was its last state";
      document.body.className = "stopped";
      return;
    }
  }
  setTimeout(ask, EVERY);
}
ask();
