"use strict";
// The page: what is shown, at which time, and how the user moves through it.

const MAX_SCALE = 60; // pixels per metre
const MIN_SCALE = 0.5;
const SMALL = 680; // pixels of window height below which only the speed is drawn as a curve
const NOISES = [["acceleration", "m/s²", 0.5, 2], ["steering rate", "rad/s", 0.05, 3]];
const SPREADS = ["across", "along"];
const LOW = 44; // height of lesser curves
const CLEAN = [];
const NOISY = [7, 5];
const CLOSE = 14; // pixels per metre at least where a violation is looked at
const AROUND = 15; // m around the path that the page opens with
const NEAR = 6; // m around what is driven from a fork on
const AHEAD = 0.2; // of the height of a view whose ego drives up: how far below its middle
const LENGTH_CLEAR = 4.2; // m that no ego reaches from its rear axle
const TOLD = 2; // s that the words of a violation stay
const FADE = 500; // ms in which whole plans appear once a moment is chosen

const meta = JSON.parse(byId("data-meta").textContent);

const state = {
  t: 0,
  playing: false,
  rate: 1,
  focus: 0,
  shown: meta.rollouts.map(() => true),
  follow: true,
  side: false,
  expert: true,
  plans: true,
  seen: true, // whether what the planner in focus saw is outlined
  up: false, // whether the ego's forward is up
  fork: false, // whether what could have been driven in place of a collision is drawn
  tube: false, // whether the seeds of a planner are drawn together
  scale: 6,
  centre: null,
  told: [], // the words of violations on the canvas
  pins: [], // [x, y, words] of every violation there
  dots: [], // and of those on a tube
};
let chosen = null; // the violation that was jumped to
let zoomed = false; // whether the link said how near
let planned = 0; // how much of the plans beyond their first second is seen, 0 to 1
const rollouts = meta.rollouts.map(() => null); // fields, once decoded
let scene, map, times, strips, waterfall, panels, highlighted = -1;
let tubes = []; // the seeds of each planner together: {planner, noise, colour, dots, area, across, along}

const isNoisy = (rollout) => rollout.noise !== "none";
const dashOf = (rollout) => (isNoisy(rollout) ? NOISY : CLEAN);
const labelOf = (rollout) =>
  rollout.noise === "none" ? rollout.planner : `${rollout.planner} ${rollout.noise} #${rollout.seed}`;

// ---- time ----

function seek(t) {
  state.t = Math.min(Math.max(t, 0), duration());
  byId("time").value = state.t;
  byId("time").setAttribute("aria-valuetext", `${state.t.toFixed(1)} seconds`);
  if (!state.playing) saveState();
  fadePlans();
}

// while it plays the first second of a plan is shown; at a moment chosen the whole of it appears
let fading = 0;
function fadePlans() {
  cancelAnimationFrame(fading);
  const began = performance.now();
  const go = (now) => {
    planned = state.playing ? 0 : Math.min(Math.max((now - began) / FADE, 0), 1);
    draw();
    if (!state.playing && planned < 1) fading = requestAnimationFrame(go);
  };
  go(began);
}

// ---- violations ----

function violations() {
  return meta.rollouts
    .flatMap((rollout, index) => rollout.violations.map((item) => ({ ...item, index })))
    .filter((item) => state.shown[item.index])
    .sort((a, b) => a.t - b.t);
}

function nextViolation() {
  const all = violations();
  if (!all.length) return;
  jumpTo(all.find((item) => item.t > state.t + 1e-6) || all[0]);
}

function jumpTo(violation) {
  pause();
  say(`${violation.t.toFixed(1)} s, ${labelOf(meta.rollouts[violation.index])}: ${violation.words}`);
  setFocus(violation.index);
  highlight(violation);
  [state.follow, state.centre] = [true, null];
  state.scale = Math.max(state.scale, CLOSE);
  syncOptions();
  seek(violation.t);
}

function highlight(violation) {
  const names = tracksOf(violation.index).names;
  chosen = violation;
  highlighted = violation.partner ? names.indexOf(violation.partner) : -1;
}

// what a link that opens at a violation means: its partner, and a view of it
function highlightNow() {
  const weight = (item) => 2 * (item.index === state.focus) + Boolean(item.partner);
  const now = violations().filter((item) => Math.abs(item.t - state.t) < 0.05);
  const [found] = now.sort((a, b) => weight(b) - weight(a));
  if (!found) return;
  highlight(found);
  if (!zoomed) state.scale = Math.max(state.scale, CLOSE);
}

// ---- what is shown ----

function tracksOf(index) {
  return meta.ownTracks
    ? { fields: rollouts[index], names: meta.rollouts[index].tracks }
    : { fields: scene, names: meta.tracks };
}

async function load(index) {
  if (index) await load(0); // which the others are stored from
  rollouts[index] ??= await readSection(`rollout${index}`, rollouts[0]);
}

async function show(index, on) {
  if (on) await load(index);
  state.shown[index] = on;
  if (!state.shown.some(Boolean)) state.shown[index] = true; // something must remain
  if (!state.shown[state.focus]) state.focus = state.shown.indexOf(true);
  if (!rollouts[state.focus]) await show(state.focus, true);
  changed();
}

function setFocus(index) {
  state.focus = index;
  if (!state.shown[index]) show(index, true);
  highlighted = -1;
  changed();
  const card = byId("rollouts").children[index];
  const aside = card.closest("aside");
  if (aside.scrollHeight > aside.clientHeight) card.scrollIntoView({ block: "nearest" });
}

function changed() {
  for (const [index, element] of [...byId("rollouts").children].entries()) {
    element.classList.toggle("focus", index === state.focus);
    element.querySelector("input").checked = state.shown[index];
  }
  byId("violation").disabled = !violations().length;
  showCurves();
  layOut();
  saveState();
}

function visible() {
  return rollouts.map((fields, index) => index).filter((i) => state.shown[i] && rollouts[i]);
}

// the tubes of some rollouts' planners
function tubesOf(members) {
  const planners = new Set(members.map((index) => meta.rollouts[index].planner));
  return state.tube ? tubes.filter((tube) => planners.has(tube.planner)) : [];
}

function readTube(tube, number) {
  const [across, along] = ["across", "along"].map((name) => scene.get(`tube${number}.${name}`).data);
  return { ...tube, across, along, area: layerPath(scene, `tube${number}`, true) };
}

// ---- drawing ----

function layOut() {
  const { width, height, ratio } = sizeCanvas();
  const groups = state.side ? visible().map((i) => [i]) : [visible()];
  const across = panelsAcross(groups.length, width > height);
  const down = Math.ceil(groups.length / across);
  panels = groups.map((members, i) => {
    const panel = (panels && panels[i] && panels[i].panel) || new Panel(map);
    const left = ((i % across) * width) / across;
    const top = (Math.floor(i / across) * height) / down;
    panel.place(left, top, width / across, height / down, state.scale, ratio);
    return { panel, members };
  });
  draw();
}

// 2 x 2 of four, 3 x 2 of six; two or three stand in one row, or below one another
function panelsAcross(count, isWide) {
  if (count === 4) return 2;
  return isWide ? Math.min(count, 3) : Math.ceil(count / 3);
}

function egoPose(index, at) {
  return poseAt(rollouts[index], "ego", 1, 0, at);
}

function draw() {
  if (!panels) return;
  const at = sampleAt(state.t);
  [state.told, state.pins, state.dots] = [[], [], []];
  const ratio = window.devicePixelRatio || 1;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.imageSmoothingEnabled = !(state.playing && state.up); // a turned map is drawn in time
  context.fillStyle = COLOURS.paper;
  context.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  for (const { panel, members } of panels) {
    const leading = members.includes(state.focus) ? state.focus : members[0];
    const pose = egoPose(leading, at);
    panel.scale = state.scale;
    panel.turn = state.up ? Math.PI / 2 - pose[2] : 0;
    panel.centre = state.follow || !state.centre ? followed(panel, pose) : state.centre;
    context.save();
    context.beginPath();
    context.rect(panel.left, panel.top, panel.width, panel.height);
    context.clip();
    drawPanel(panel, members, leading, at);
    context.restore();
  }
  strips.draw(state.t);
  waterfall.point(strips.x(state.t));
  byId("clock").textContent = `${state.t.toFixed(2)} s of ${duration().toFixed(1)} s`;
  showScale();
}

// the middle of a view that goes with the ego: itself, or ahead of it where forward is up
function followed(panel, [x, y, heading]) {
  const ahead = state.up ? (AHEAD * panel.height) / panel.scale : 0;
  return [x + ahead * Math.cos(heading), y + ahead * Math.sin(heading)];
}

function drawPanel(panel, members, leading, at) {
  panel.drawMap(context);
  drawLights(context, scene, panel, at);
  const { fields, names } = tracksOf(leading);
  const edited = new Set(meta.edited.map((name) => names.indexOf(name)));
  drawAgents(context, fields, panel, at, highlighted, edited);
  const own = rollouts[leading];
  if (state.seen && own.has("seen.size")) {
    drawSeen(context, own, meta.vehicle, panel, at, meta.rollouts[leading].colour);
  }
  if (state.expert) {
    drawPath(context, scene.get("expert.xy").data, at, panel, COLOURS.recorded, [2, 3], 1.5);
    drawEgo(context, poseAt(scene, "expert", 1, 0, at), meta.vehicle, panel, COLOURS.recorded, false);
  }
  const fork = state.fork && meta.rollouts[leading].fork;
  const order = fork ? [leading] : members.filter((i) => i !== leading).concat(leading);
  const drawn = tubesOf(members);
  const isHeld = (index) => drawn.some((tube) => holds(tube, meta.rollouts[index]));
  const inTube = new Set(order.filter((index) => index !== leading && isHeld(index)));
  for (const tube of drawn) drawTube(context, tube, panel, tube.colour);
  for (const index of order) {
    const rollout = meta.rollouts[index];
    const xy = rollouts[index].get("ego.xy").data;
    const width = index === leading ? 2.6 : inTube.has(index) ? 1 : 1.8;
    drawPath(context, xy, at, panel, rollout.colour, dashOf(rollout), width);
  }
  for (const tube of drawn) drawDots(panel, tube);
  for (const index of order) {
    const rollout = meta.rollouts[index];
    const pose = egoPose(index, at);
    const reach = meta.vehicle[2];
    const where = [pose[0] + reach * Math.cos(pose[2]), pose[1] + reach * Math.sin(pose[2])];
    const place = panel.toScreen(...where);
    if (inTube.has(index)) {
      drawMarker(context, rollout.marker, ...place, 4, rollout.colour, true);
      continue;
    }
    if (state.plans && !fork) drawPlan(context, rollouts[index], panel, at, rollout.colour, planned);
    const dash = isNoisy(rollout) ? [4, 3] : [];
    drawEgo(context, pose, meta.vehicle, panel, rollout.colour, index === leading, dash);
    drawDisc(context, ...place, 7.5); // so that the marker looks as in the list
    drawMarker(context, rollout.marker, ...place, 5, rollout.colour, isNoisy(rollout));
  }
  const labels = fork ? drawFork(panel, leading, fork, at) : [];
  const violated = order.reverse().flatMap((index) => violatedNow(panel, index));
  // what words may not cover: [left, top, right, bottom]
  const taken = [...labels, ...violated.map(({ x, y }) => [x - 10, y - 10, x + 10, y + 10])];
  const told = toldOf(violated.filter(({ index }) => index === leading));
  for (const one of violated.filter((item) => item !== told)) {
    drawMarker(context, "burst", one.x, one.y, 6, COLOURS.alarm);
  }
  if (told) tellViolation(panel, told, taken);
  state.pins.push(...violated.map(({ item, index, x, y }) => [x, y, `${labelOf(meta.rollouts[index])}: ${item.words}`]));
  if (state.side) captionPanel(panel, meta.rollouts[leading], rollouts[leading], at);
}

// what is driven from a fork on, up to a collision; returns the boxes of the words at the ends
function drawFork(panel, index, { t, row, branches }, at) {
  const fields = rollouts[index];
  const boxes = [];
  branches.forEach(({ name, colour, marker, hit }, number) => {
    const xy = fields.get(`branch${number}.xy`).data;
    const ink = colour || COLOURS.ink;
    const last = xy.length / 2 - 1;
    context.lineWidth = 3;
    strokeLine(context, xy, 0, last + 1, panel, ink);
    const rowNow = Math.min(Math.max(at.row - row, 0), last);
    const now = { row: rowNow, next: Math.min(rowNow + 1, last), share: state.t > t ? at.share : 0 };
    drawEgo(context, poseAt(fields, `branch${number}`, 1, 0, now), meta.vehicle, panel, ink, false);
    const [x, y] = panel.toScreen(xy[2 * last], xy[2 * last + 1]);
    if (hit === null) drawMarker(context, marker || "s", x, y, 5, ink);
    else drawMarker(context, "burst", x, y, 7, COLOURS.alarm);
    boxes.push(nameBranch(panel, hit === null ? `${name}: clear` : `${name}: hits`, x, y, ink, boxes));
  });
  const xy = fields.get("branch0.xy").data;
  if (branches.length) drawMarker(context, "o", ...panel.toScreen(xy[0], xy[1]), 6, COLOURS.ink, true);
  return boxes;
}

// the name of a branch beside its end, below those that are there
function nameBranch(panel, words, x, y, colour, taken) {
  context.font = "600 12px system-ui, sans-serif";
  const width = context.measureText(words).width + 10;
  const right = x + 12 + width < panel.left + panel.width;
  const left = right ? x + 12 : x - 12 - width;
  const boxAt = (k) => [left, y - 9 + 20 * k, left + width, y + 9 + 20 * k];
  const meets = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
  const box = [0, -1, 1, -2, 2, -3, 3].map(boxAt).find((one) => !taken.some((other) => meets(one, other)));
  const [, top] = box || boxAt(4);
  context.fillStyle = COLOURS.glass;
  context.fillRect(left, top, width, 18);
  context.fillStyle = colour;
  context.fillRect(right ? left : left + width - 3, top, 3, 18);
  context.fillStyle = COLOURS.ink;
  context.fillText(words, left + 6, top + 13);
  return [left, top, left + width, top + 18];
}

const holds = (tube, { planner, noise }) => tube.planner === planner && tube.noise === noise;

// what the seeds of a tube ever violate
function drawDots(panel, tube) {
  for (const [x, y, words] of tube.dots) {
    const place = panel.toScreen(x, y);
    drawMarker(context, "o", ...place, 4.5, COLOURS.alarm);
    state.dots.push([...place, words]);
  }
}

// what a rollout has just violated, and where on the screen
function violatedNow(panel, index) {
  return meta.rollouts[index].violations
    .filter((item) => state.t >= item.t - 1e-6 && state.t < item.t + TOLD)
    .map((item) => {
      const [x, y] = panel.toScreen(...egoPose(index, sampleAt(item.t)).slice(0, 2));
      return { item, index, x, y };
    });
}

// the one of them that is told in words: that which was jumped to, else the latest
function toldOf(violated) {
  const latest = Math.max(...violated.map(({ item }) => item.t));
  const isChosen = ({ item }) => chosen && item.t === chosen.t && item.metric === chosen.metric;
  return violated.find(isChosen) || violated.find(({ item }) => item.t === latest);
}

// the mark of a violation, and its words beside it in a place of their own
function tellViolation(panel, { item, index, x, y }, taken) {
  context.font = "600 13px system-ui, sans-serif";
  const width = context.measureText(item.words).width + 16;
  const [left, top] = placeWords(panel, x, y, width, partnerSide(panel, index, item, x), taken);
  taken.push([left, top, left + width, top + 24]);
  context.strokeStyle = meta.rollouts[index].colour;
  context.lineWidth = 1.2;
  context.beginPath();
  context.moveTo(left > x ? left : left + width, top + 10);
  context.lineTo(x, y);
  context.stroke();
  drawMarker(context, "burst", x, y, 9, COLOURS.alarm);
  context.strokeStyle = meta.rollouts[index].colour;
  context.fillStyle = COLOURS.glass;
  context.fillRect(left, top, width, 20);
  context.strokeRect(left, top, width, 20);
  context.fillStyle = COLOURS["alarm-ink"];
  context.fillText(item.words, left + 8, top + 15);
  state.told.push(item.words);
}

// -1 where the partner of a violation is left of it, 1 where it is right or there is none
function partnerSide(panel, index, item, x) {
  const { fields, names } = tracksOf(index);
  const partner = names.indexOf(item.partner);
  if (partner < 0) return -1;
  const pose = poseAt(fields, "tracks", names.length, partner, sampleAt(item.t));
  return panel.toScreen(pose[0], pose[1])[0] < x ? -1 : 1;
}

// left and top of words of a width, on the side away from the partner, clear of the ego's box and
// of other words, within the panel
function placeWords(panel, x, y, width, side, taken) {
  const clear = Math.max(LENGTH_CLEAR * state.scale, 24);
  const wanted = side < 0 ? x + clear : x - clear - width;
  const most = panel.left + panel.width - width - 8;
  const left = Math.max(Math.min(wanted, most), panel.left + 8);
  const [least, lowest] = [panel.top + (state.side ? 34 : 10), panel.top + panel.height - 34];
  const away = left === wanted ? 46 : clear + 22; // where it does not fit beside, above or below
  const steps = [...Array(10).keys()].map((k) => away + 24 * k);
  const places = [...steps.map((step) => y - step), ...steps.map((step) => y + step - 22)];
  const inside = places.map((top) => Math.max(Math.min(top, lowest), least));
  const free = (top) => taken.every((t) => t[1] >= top + 24 || t[3] <= top || t[0] >= left + width || t[2] <= left);
  return [left, inside.find(free) ?? least];
}

function captionPanel(panel, rollout, fields, at) {
  const text = `${labelOf(rollout)}  ${fields.get("speed").data[at.row].toFixed(1)} m/s`;
  context.strokeStyle = COLOURS.edged;
  context.lineWidth = 1;
  context.strokeRect(panel.left, panel.top, panel.width, panel.height);
  context.font = "600 12px system-ui, sans-serif";
  const width = context.measureText(text).width;
  context.fillStyle = COLOURS.glass;
  context.fillRect(panel.left + 6, panel.top + 6, width + 26, 20);
  drawMarker(context, rollout.marker, panel.left + 16, panel.top + 16, 5, rollout.colour, isNoisy(rollout));
  context.fillStyle = COLOURS.ink;
  context.fillText(text, panel.left + 26, panel.top + 20);
}

function showScale() {
  const metres = [1, 2, 5, 10, 20, 50, 100].find((m) => m * state.scale >= 60) || 200;
  byId("scale").style.width = `${metres * state.scale}px`;
  byId("scale").textContent = `${metres} m`;
}

function showCurves() {
  const members = visible();
  const order = [...members].sort((a, b) => (b === state.focus) - (a === state.focus));
  const lines = (name) => order.map((index) => lineOf(index, rollouts[index].get(name).data));
  const values = scene.get("expert.speed").data.slice(0, times.length);
  const expert = { values, colour: COLOURS.recorded, dash: [2, 2] };
  const curves = [{ label: "speed", unit: "m/s", least: 2, lines: [...lines("speed"), expert] }];
  if (window.innerHeight >= SMALL) {
    curves.push({ label: "acceleration", unit: "m/s²", least: 1, lines: lines("accel") });
    curves.push(...noiseCurves(order));
  }
  for (const name of SPREADS.slice(0, window.innerHeight < SMALL ? 1 : 2)) {
    const noisy = { hollow: true, dash: [5, 3] };
    const lines = tubesOf(members).map((tube) => ({ ...tube, ...noisy, values: tube[name] }));
    const about = { label: `seeds apart, ${name}`, unit: "m", least: 1, height: LOW };
    if (lines.length) curves.push({ ...about, lines });
  }
  const rows = members.filter((i) => meta.rollouts[i].violations.length);
  strips.show(curves, rows.flatMap(marksOf), times);
  const rollout = meta.rollouts[state.focus];
  const x = strips.x.bind(strips);
  waterfall.show({ ...rollout, name: labelOf(rollout), duration: duration(), x });
}

function lineOf(index, values) {
  const { colour, marker } = meta.rollouts[index];
  const hollow = isNoisy(meta.rollouts[index]);
  return { values, colour, marker, hollow, dash: hollow ? [5, 3] : [] };
}

// each noise once: with the same seed all planners have the same
function noiseCurves(members) {
  const found = []; // {data, of: rollouts}
  for (const index of members.filter((i) => isNoisy(meta.rollouts[i]))) {
    const { data } = rollouts[index].get("noise");
    if (!data.some(Boolean)) continue; // what is seen drifts, or plans are late: nothing is added
    const same = found.find((one) => one.data.every((value, i) => value === data[i]));
    if (same) same.of.push(index);
    else found.push({ data, of: [index] });
  }
  const inFocus = (one) => one.of.includes(state.focus);
  const { noise, seed } = meta.rollouts[state.focus];
  const which = found.some(inFocus) ? `${noise} #${seed}` : `${found.length} realisations`;
  const curveOf = ([name, unit, least, digits], column) => ({
    label: `noise on ${name} (${which})`,
    unit,
    least,
    digits,
    height: LOW,
    lines: found.sort((a, b) => inFocus(a) - inFocus(b)).map((one) => ({
      values: one.data.filter((_, i) => i % 2 === column),
      colour: inFocus(one) ? COLOURS.ink : COLOURS.edged,
      dash: [],
      marker: inFocus(one) ? "o" : "",
    })),
  });
  return found.length ? NOISES.map(curveOf) : [];
}

// one mark per moment: what is first violated at the same time shares it
function marksOf(index, row) {
  const { colour, marker, violations: all } = meta.rollouts[index];
  const hollow = isNoisy(meta.rollouts[index]);
  const moments = [...new Set(all.map((item) => item.t))];
  const { fork } = meta.rollouts[index];
  const marks = moments.map((t) => {
    const here = all.filter((item) => item.t === t);
    const [text, words] = [here.map((item) => item.short).join(" "), here.map((item) => item.words).join("; ")];
    return { t, row, text, words, colour, marker, hollow };
  });
  if (!fork?.branches.length) return marks;
  const style = { colour: COLOURS.ink, marker: "o", hollow: true };
  marks.push({ t: fork.t, row, text: "last chance", words: forkWords(fork), ...style });
  return marks.sort((a, b) => a.t - b.t);
}

function forkWords({ t, branches }) {
  if (!branches.length) return `no braking and no PDM-Closed avoids the collision, from ${t.toFixed(1)} s on`;
  const told = branches.map(({ name, words }) => `${name} ${words}`);
  return `last chance to avoid the collision at ${t.toFixed(1)} s: ${told.join("; ")}`;
}

// the moment at which the rollout in focus forks, else the first that does
async function showFork() {
  const forks = (index) => meta.rollouts[index].fork?.branches.length;
  const index = [state.focus, ...rollouts.keys()].find(forks);
  if (index === undefined) return;
  if (index === state.focus && state.fork) return setOption("fork", false);
  const { fork } = meta.rollouts[index];
  pause();
  if (!state.shown[index]) await show(index, true);
  setFocus(index);
  state.fork = true;
  say(forkWords(fork));
  const paths = fork.branches.map((_, number) => rollouts[index].get(`branch${number}.xy`).data);
  showAround(paths.flatMap((xy) => [...xy]), NEAR);
  seek(fork.t);
}

// ---- controls ----

function listRollouts() {
  for (const { losses } of meta.rollouts) tellLosses(losses);
  byId("rollouts").replaceChildren();
  for (const [index, rollout] of meta.rollouts.entries()) {
    const check = make("input", { type: "checkbox", ariaLabel: `show ${labelOf(rollout)}` });
    check.addEventListener("click", (event) => event.stopPropagation());
    check.addEventListener("change", () => show(index, check.checked));
    const parts = rollout.planner.split(/(?<=[:/._-])/).flatMap((part) => [part, make("wbr")]);
    const label = make("span", { className: "label", title: labelOf(rollout) }, ...parts);
    const cls = span("cls", rollout.cls === null ? "–" : (100 * rollout.cls).toFixed(1));
    const name = make("div", { className: "name" }, check, swatch(rollout), label, cls);
    const buttons = rollout.violations.map((item) => violationButton(item, index));
    const undated = rollout.losses.filter((loss) => loss.t === null);
    const lines = undated.map((loss) => smallLine(`${loss.words} ${loss.told}`));
    const lists = [...buttons, ...lines, ...forkLines(rollout, index)];
    const box = make("div", { className: "rollout" }, name, noiseOf(rollout), scoresOf(rollout), ...lists);
    box.addEventListener("click", () => setFocus(index));
    byId("rollouts").append(box);
  }
}

const smallLine = (words) => make("div", { className: "scores" }, words);

// from where on a collision could not be avoided, and what is driven from there
function forkLines({ fork }, index) {
  if (!fork) return [];
  if (!fork.branches.length) return [smallLine(forkWords(fork))];
  const button = make("button", {}, `${fork.t.toFixed(1)}\u00a0s  last chance to avoid the collision`);
  button.addEventListener("click", (event) => {
    event.stopPropagation();
    [state.focus, state.fork] = [index, false];
    showFork();
  });
  return [button, ...fork.branches.map(({ name, words }) => smallLine(`${name}: ${words}`))];
}

// a loss leads to its violation; one without a moment to the end
function showLoss(loss) {
  const { violations: all } = meta.rollouts[state.focus];
  const found = all.find((item) => item.metric === loss.metric);
  if (found) return jumpTo({ ...found, index: state.focus });
  pause();
  say(loss.words);
  seek(loss.t ?? duration());
}

function swatch(rollout) {
  const picture = make("canvas", { width: 56, height: 28, style: "width: 28px; height: 14px" });
  const pen = picture.getContext("2d");
  pen.scale(2, 2);
  pen.setLineDash(dashOf(rollout).length ? [4, 3] : []);
  pen.strokeStyle = rollout.colour;
  pen.lineWidth = 2.5;
  pen.beginPath();
  pen.moveTo(0, 7);
  pen.lineTo(28, 7);
  pen.stroke();
  pen.setLineDash([]);
  drawMarker(pen, rollout.marker, 14, 7, 4.5, rollout.colour, isNoisy(rollout));
  return picture;
}

function noiseOf({ noise, seed }) {
  return make("div", { className: "noise" }, noise === "none" ? "" : `${noise} · seed ${seed}`);
}

function scoresOf(rollout) {
  const line = make("div", { className: "scores" });
  for (const [name, value] of Object.entries(rollout.scores).filter(([, score]) => score < 1)) {
    const title = meta.metrics[name] || name;
    line.append(make("abbr", { title }, `${name} ${(100 * value).toFixed(0)}`), " ");
  }
  if (rollout.degraded) line.append(`${rollout.degraded} degraded steps`);
  return line;
}

function violationButton(violation, index) {
  const words = violation.words.replace(/(\d) (?=m|s|rad)/g, "$1\u00a0"); // a number keeps its unit
  const limit = violation.threshold === null ? "" : `, bound ${violation.threshold}`;
  const title = `${violation.metric} (${violation.short})${limit}`;
  const button = make("button", { title }, `${violation.t.toFixed(1)}\u00a0s  ${words}`);
  const loss = meta.rollouts[index].losses.find((one) => one.metric === violation.metric);
  if (loss) button.append(" ", make("b", {}, loss.told));
  button.addEventListener("click", (event) => {
    event.stopPropagation();
    jumpTo({ ...violation, index });
  });
  return button;
}

function listLegend() {
  const used = new Set((meta.ownTracks ? rollouts[state.focus] : scene).get("tracks.kind").data);
  const entries = [...used].sort().map((kind) => [agentColour(kind), KIND_NAMES[kind]]);
  if (meta.edited.length) entries.push([COLOURS.edited, "edited"]);
  entries.push([COLOURS.route, "route"], [COLOURS.crosswalk, "crosswalk"]);
  const items = entries.map(([colour, text]) =>
    make("span", {}, make("i", { style: `background: ${colour}` }), text),
  );
  byId("legend").replaceChildren(...items);
}

const LINKED = ["side", "up", "tube", "fork"]; // of them, what the link says
const OPTIONS = ["follow", "side", "expert", "plans", "seen", "up", "tube", "fork"];
function syncOptions() {
  for (const name of OPTIONS) byId(name).checked = state[name];
  byId("route").checked = map.layers.route;
  byId("lanes").checked = map.layers.lanes;
}

function setOption(name, on) {
  if (name === "follow") state.centre = on ? null : [...panels[0].panel.centre];
  if (name === "up" && on) state.follow = true;
  if (name === "follow" && !on) state.up = false;
  if (OPTIONS.includes(name)) state[name] = on;
  else {
    map.layers[name] = on;
    map.version++;
  }
  syncOptions();
  if (name === "tube") showCurves();
  layOut();
  saveState();
}

function repaint() {
  const branches = meta.rollouts.flatMap(({ fork }) => fork?.branches || []);
  for (const item of [...meta.rollouts, ...tubes, ...branches].filter(({ colour }) => colour)) {
    item.given ??= item.colour;
    item.colour = isDark() ? lightened(item.given) : item.given;
  }
  if (!map) return;
  map.version++;
  listRollouts();
  listLegend();
  changed();
}

// a scale within its bounds, as the link has it
function rounded(scale) {
  return Number(Math.min(Math.max(scale, MIN_SCALE), MAX_SCALE).toFixed(2));
}

const fit = () => showAround(rollouts[state.focus].get("ego.xy").data, AROUND);

// the view of places x, y, x, y, … and some metres around them
function showAround(xy, around) {
  const ends = boundsOf(xy, around);
  const { width, height } = panels[0].panel;
  const scale = Math.min(width / (ends[0][1] - ends[0][0]), height / (ends[1][1] - ends[1][0]));
  state.scale = rounded(scale);
  state.centre = ends.map(([low, high]) => Number(((low + high) / 2).toFixed(1)));
  [state.follow, state.up] = [false, false];
  syncOptions();
  draw();
}

function zoom(factor, px, py) {
  const { panel } = panels.find(({ panel: p }) => inside(p, px, py)) || panels[0];
  const [x, y] = panel.toWorld(px, py);
  state.scale = rounded(state.scale * factor);
  if (!state.follow) {
    panel.scale = state.scale;
    const [after, aside] = panel.toWorld(px, py);
    state.centre = [panel.centre[0] + x - after, panel.centre[1] + y - aside];
  }
  draw();
  saveState();
}

function inside(panel, px, py) {
  const [dx, dy] = [px - panel.left, py - panel.top];
  return dx >= 0 && dy >= 0 && dx <= panel.width && dy <= panel.height;
}

function press(event) {
  drag(event, panels[0].panel, () => setOption("follow", false), saveState);
}

function hover(event) {
  const [px, py] = pointer(event);
  const found = panels.find(({ panel }) => inside(panel, px, py));
  showTip(found && event.buttons === 0 ? describeAt(found, px, py) : "", [px, py]);
}

function describeAt({ panel, members }, px, py) {
  const pins = [...state.pins, ...state.dots].filter(([x, y]) => Math.hypot(x - px, y - py) < 10);
  if (pins.length) return pins.map((pin) => pin[2]).join("; ");
  const leading = members.includes(state.focus) ? state.focus : members[0];
  const { fields, names } = tracksOf(leading);
  const [x, y] = panel.toWorld(px, py);
  const at = sampleAt(state.t);
  const kinds = fields.get("tracks.kind").data;
  const size = fields.get("tracks.size").data;
  const valid = fields.get("tracks.valid").data;
  for (let i = 0; i < kinds.length; i++) {
    if (!valid[at.row * kinds.length + i]) continue;
    const [cx, cy] = poseAt(fields, "tracks", kinds.length, i, { ...at, next: at.row });
    if (Math.hypot(cx - x, cy - y) < Math.max(size[2 * i] / 2, 1)) {
      return `${KIND_NAMES[kinds[i]]} ${names[i]} · ${trackSpeed(fields, i, at).toFixed(1)} m/s`;
    }
  }
  return "";
}

function trackSpeed(fields, index, at) {
  const count = fields.get("tracks.kind").data.length;
  const row = Math.max(at.row, 1);
  const valid = fields.get("tracks.valid").data;
  if (!valid[(row - 1) * count + index]) return 0;
  const here = poseAt(fields, "tracks", count, index, { row, next: row, share: 0 });
  const before = poseAt(fields, "tracks", count, index, { row: row - 1, next: row - 1, share: 0 });
  return Math.hypot(here[0] - before[0], here[1] - before[1]) / (times[row] - times[row - 1]);
}

const KEYS = {
  " ": play,
  ArrowLeft: (e) => stepBy(e.shiftKey ? -10 : -1),
  ArrowRight: (e) => stepBy(e.shiftKey ? 10 : 1),
  Home: () => seek(0),
  End: () => seek(duration()),
  v: nextViolation,
  f: () => setOption("follow", !state.follow),
  b: () => setOption("side", !state.side),
  e: () => setOption("expert", !state.expert),
  p: () => setOption("plans", !state.plans),
  o: () => setOption("seen", !state.seen),
  u: () => setOption("up", !state.up),
  n: () => tubes.length && setOption("tube", !state.tube),
  k: showFork,
  d: toggleTheme,
  r: () => setOption("route", !map.layers.route),
  l: () => setOption("lanes", !map.layers.lanes),
  "?": () => (byId("keys").open ? byId("keys").close() : byId("keys").showModal()),
  0: fit,
  c: copyLink,
  s: savePicture,
  a: () => setFocus((state.focus + 1) % rollouts.length),
  "+": () => zoom(1.25, canvas.clientWidth / 2, canvas.clientHeight / 2),
  "=": () => zoom(1.25, canvas.clientWidth / 2, canvas.clientHeight / 2),
  "-": () => zoom(0.8, canvas.clientWidth / 2, canvas.clientHeight / 2),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  if (event.key === " " && event.target.matches("button, input[type=checkbox]")) return;
  const digit = "123456".indexOf(event.key);
  const action = KEYS[event.key];
  if (action) action(event);
  else if (event.key.length === 1 && digit >= 0 && digit < rollouts.length) {
    show(digit, !state.shown[digit]);
  } else return;
  event.preventDefault();
}

function connect() {
  byId("play").addEventListener("click", KEYS[" "]);
  byId("back1").addEventListener("click", () => stepBy(-1));
  byId("next1").addEventListener("click", () => stepBy(1));
  byId("violation").addEventListener("click", nextViolation);
  byId("help").addEventListener("click", KEYS["?"]);
  byId("copy").addEventListener("click", copyLink);
  byId("save").addEventListener("click", savePicture);
  byId("theme").addEventListener("click", toggleTheme);
  document.addEventListener("click", (e) => {
    const pressed = e.detail && e.target.closest("button, input[type=checkbox]");
    if (pressed) pressed.blur(); // who uses the mouse plays with the space key
  });
  byId("time").max = duration();
  byId("time").addEventListener("input", (e) => seek(Number(e.target.value)));
  byId("time").addEventListener("pointerdown", pause);
  byId("rate").addEventListener("change", (e) => (state.rate = Number(e.target.value)));
  for (const name of [...OPTIONS, "route", "lanes"]) {
    byId(name).addEventListener("change", (e) => {
      if (name === "fork") showFork();
      else setOption(name, e.target.checked);
    });
  }
  connectCanvas();
  const scrub = (e) => seek(strips.timeAt(e.clientX - byId("curves").getBoundingClientRect().left));
  byId("curves").addEventListener("pointerdown", (e) => {
    pause();
    scrub(e);
    byId("curves").setPointerCapture(e.pointerId);
  });
  byId("curves").addEventListener("pointermove", (e) => {
    byId("curves").title = strips.wordsAt(e.offsetX, e.offsetY);
    if (e.buttons) scrub(e);
  });
  window.addEventListener("keydown", onKey);
  window.addEventListener("resize", () => {
    showCurves();
    layOut();
  });
  window.addEventListener("hashchange", async () => {
    if (location.hash.slice(1) !== written) {
      await loadState();
      highlightNow();
      changed();
    }
  });
}

// for those who hear the page
function say(words) {
  byId("said").textContent = words;
}

// ---- the link carries the state ----

async function copyLink() {
  saveState();
  try {
    await navigator.clipboard.writeText(location.href);
    say("link copied");
  } catch {
    return window.prompt("the link to this moment", location.href); // no clipboard here
  }
  byId("copy").textContent = "copied";
  setTimeout(() => (byId("copy").textContent = "copy link"), 1500);
}

function savePicture() {
  const download = `${meta.token}-${state.t.toFixed(2)}s.png`;
  make("a", { download, href: canvas.toDataURL("image/png") }).click();
}

let written = "";
let linked = false; // whether the address says what to show
function saveState() {
  const shown = state.shown.map((on, i) => (on ? i + 1 : 0)).filter(Boolean);
  const parts = [`t=${state.t.toFixed(2)}`, `on=${shown}`, `focus=${state.focus + 1}`];
  parts.push(`zoom=${state.scale.toFixed(2)}`);
  for (const name of LINKED) if (state[name]) parts.push(`${name}=1`);
  if (!state.follow && state.centre) parts.push(`at=${state.centre.map((v) => v.toFixed(1))}`);
  written = parts.join("&");
  try {
    history.replaceState(null, "", `#${written}`);
  } catch {
    // a page inside a notebook has no address of its own
  }
}

async function loadState() {
  const given = new URLSearchParams(location.hash.slice(1));
  linked = ["t", "zoom", "at", "up"].some((name) => given.has(name));
  const number = (name, fallback) => {
    const value = Number.parseFloat(given.get(name));
    return Number.isFinite(value) ? value : fallback;
  };
  const on = (given.get("on") || "").split(",").map(Number);
  const known = meta.rollouts.map((_, i) => on.includes(i + 1));
  if (known.some(Boolean)) state.shown = known;
  const focus = number("focus", 1) - 1;
  state.focus = state.shown[focus] ? focus : state.shown.indexOf(true);
  zoomed = given.has("zoom");
  state.scale = Math.min(Math.max(number("zoom", state.scale), MIN_SCALE), MAX_SCALE);
  for (const name of LINKED) state[name] = given.get(name) === "1";
  state.tube &&= tubes.length > 0;
  const at = (given.get("at") || "").split(",").map(Number.parseFloat);
  state.follow = !(at.length === 2 && at.every(Number.isFinite));
  if (!state.follow) [state.centre, state.up] = [at, false];
  for (const [index, shown] of state.shown.entries()) {
    if (shown) await load(index);
  }
  state.t = Math.min(Math.max(number("t", 0), 0), duration());
}

async function start() {
  byId("token").textContent = meta.token;
  byId("about").textContent = [meta.type, meta.city, meta.log].filter(Boolean).join(" · ");
  byId("settings").textContent = meta.settings || "";
  byId("edits").append(...meta.edits.map((line) => make("li", {}, line)));
  byId("edits").hidden = !meta.edits.length;
  byId("shown").textContent = meta.shown || "";
  for (const [index, [words, href]] of (meta.parts || []).entries()) {
    byId("shown").append(" ", make(index === meta.part ? "b" : "a", { href }, words));
  }
  if (meta.back) {
    byId("back").hidden = false;
    byId("back").href = meta.back;
  }
  scene = await readSection("scene");
  times = scene.get("time").data;
  strips = new Strips(byId("curves"), duration());
  waterfall = new Waterfall(byId("waterfall"), showLoss);
  tubes = meta.tubes.map(readTube);
  startTheme();
  map = new MapPicture(scene);
  byId("tube").parentElement.hidden = !tubes.length;
  byId("seen").parentElement.hidden = !meta.rollouts.some((rollout) => rollout.seen);
  byId("fork").parentElement.hidden = !meta.rollouts.some(({ fork }) => fork?.branches.length);
  listRollouts();
  await loadState();
  listLegend();
  connect();
  syncOptions();
  byId("time").value = state.t;
  highlightNow();
  changed();
  if (!linked) fit();
  fadePlans();
  window.firstFrame = performance.now(); // ms since the page was opened
  document.documentElement.dataset.ready = "1";
}

window.replay = { seek, state, draw };
start().catch((error) => {
  byId("about").textContent = `this replay cannot be read: ${error.message}`;
  throw error;
});
