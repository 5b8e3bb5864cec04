"use strict";
// The review page: walks through scenarios, keeps every decision at once, edits routes by clicking.

const secret = new URLSearchParams(location.search).get("token") || "";
const CHANGED = "rgba(224, 138, 0, 0.45)";
const NUMBERS = { // results of the filter, in words
  max_outside_m: (value) => `${value.toFixed(2)} m off the road`,
  path_m: (value) => `${value.toFixed(1)} m path`,
  progress_m: (value) => `${value.toFixed(1)} m along the route`,
  first_violation_s: (value) => `first violation ${value.toFixed(1)} s`,
  partner_token: (value) => `with ${value}`,
};

let listing, current, fields, scene, map, panel, blocks;
let times = [0];
const state = { t: 0, playing: false, rate: 1, scale: 4, centre: [0, 0] };
const undone = []; // {token, values} that bring back what was before

async function ask(path, body) {
  const options = { headers: { "X-Shiftsim-Token": secret } };
  if (body) {
    options.method = "POST";
    options.body = JSON.stringify(body);
  }
  const answer = await fetch(path, options);
  const value = await answer.json();
  if (!answer.ok) throw new Error(value.error || answer.statusText);
  return value;
}

function say(text, bad = false) {
  byId("kept").textContent = text;
  byId("kept").classList.toggle("bad", bad);
}

// ---- the list ----

const isOpen = (row) => !row.decision;
const WHICH = {
  open: isOpen,
  all: () => true,
  accept: (row) => row.decision === "accept",
  reject: (row) => row.decision === "reject",
  dropped: (row) => row.verdict === "dropped",
};

function rowOf(token) {
  return listing.scenarios.find((row) => row.token === token);
}

function chosen() {
  return listing.scenarios.filter((row) => WHICH[byId("which").value](row) || row.token === current);
}

// thumbnails are asked for when their line comes into view
const pictures = new Map(); // answers by token
const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) if (isIntersecting) fillBox(target);
});

async function fillBox(box) {
  const { token } = box.dataset;
  seen.unobserve(box);
  if (!pictures.has(token)) pictures.set(token, ask(`/api/thumbnail?id=${encodeURIComponent(token)}`));
  try {
    const { scene: shared, view: window } = await pictures.get(token);
    box.replaceChildren(thumbnail(shared, window));
  } catch (error) {
    box.title = `no picture: ${error.message}`;
  }
}

function showList() {
  const count = (decision) => listing.scenarios.filter((row) => row.decision === decision).length;
  byId("counts").textContent =
    `${listing.scenarios.length} scenarios · ${count("accept")} accepted · ` +
    `${count("reject")} rejected · ${count("")} open`;
  const lines = chosen().map((row) => {
    const sign = { accept: "✓", reject: "✗", "": "" }[row.decision] + (row.route ? " ⤳" : "");
    const result = row.reason && `${row.verdict}: ${row.reason}`;
    const about = [row.city, result].filter(Boolean).join(" · ");
    const box = span("box");
    box.dataset.token = row.token;
    seen.observe(box);
    const title = `${row.city} · ${row.type} · filter: ${row.verdict} ${row.reason}`;
    const parts = [box, span("token", row.token), span("sign", sign), span("about", about)];
    const line = make("li", { title, className: row.token === current ? "current" : "" }, ...parts);
    line.addEventListener("click", () => open(row.token));
    return line;
  });
  byId("list").replaceChildren(...lines);
  byId("list").querySelector(".current")?.scrollIntoView({ block: "nearest" });
}

function move(step) {
  const rows = chosen();
  const index = rows.findIndex((row) => row.token === current);
  const next = rows[index + step];
  if (next) open(next.token);
  else say(step > 0 ? "this was the last one of the list" : "this is the first one of the list");
}

// ---- one scenario ----

async function open(token) {
  pause();
  const found = await ask(`/api/scenario?id=${encodeURIComponent(token)}`);
  scene = await unpack(found.scene);
  times = scene.get("time").data;
  fields = await unpack(found.rollout);
  blocks = readBlocks(await unpack(found.blocks), found.blockIds);
  map = new MapPicture(scene);
  map.layers.route = false;
  panel = new Panel(map);
  current = token;
  byId("token").textContent = token;
  byId("about").textContent = [found.meta.type, found.meta.city, found.meta.log].join(" · ");
  const numbers = Object.entries(found.numbers).map(([name, value]) => NUMBERS[name](value));
  const result = [`filter: ${found.verdict}`, found.reason].filter(Boolean).join(", ");
  byId("verdict").textContent = [result, ...numbers].join(" · ");
  Object.assign(open, { found });
  history.replaceState(null, "", `${location.pathname}${location.search}#${encodeURIComponent(token)}`);
  byId("time").max = duration();
  state.t = 0;
  wholeScene();
  showReview(found);
  showList();
  document.documentElement.dataset.ready = token;
}

function readBlocks(packed, ids) {
  const rings = packed.get("blocks.rings").data;
  const counts = packed.get("blocks.count").data;
  const xy = packed.get("blocks.xy").data;
  let ring = 0;
  let vertex = 0;
  return ids.map((id, i) => {
    const path = new Path2D();
    for (let k = 0; k < rings[i]; k++, ring++) {
      for (let j = 0; j < counts[ring]; j++, vertex++) {
        if (j) path.lineTo(xy[2 * vertex], xy[2 * vertex + 1]);
        else path.moveTo(xy[2 * vertex], xy[2 * vertex + 1]);
      }
      path.closePath();
    }
    return { id, path };
  });
}

function showReview(review) {
  Object.assign(open.found, review);
  const { decision, comment, route } = review;
  Object.assign(rowOf(current), { decision, comment, route });
  byId("accept").classList.toggle("on", decision === "accept");
  byId("reject").classList.toggle("on", decision === "reject");
  if (document.activeElement !== byId("comment")) byId("comment").value = comment;
  byId("undo").disabled = !undone.length;
  byId("recorded").disabled = !route;
  const kindOf = (id) => (open.found.recordedRoute.includes(id) ? "" : "corrected");
  const items = review.current.map((id) => make("li", { className: kindOf(id) }, id));
  byId("blocks").replaceChildren(...items);
  const problems = review.problems.length ? review.problems : ["the route is connected"];
  byId("problems").classList.toggle("good", !review.problems.length);
  byId("problems").replaceChildren(...problems.map((text) => make("li", {}, text)));
  draw();
}

async function keep(values, { undo = true, token = current } = {}) {
  const before = rowOf(token);
  const old = Object.fromEntries(Object.keys(values).map((name) => [name, before[name]]));
  try {
    const review = await ask("/api/review", { token, values });
    if (undo) undone.push({ token, values: old });
    if (token === current) showReview(review);
    else Object.assign(before, { decision: review.decision, comment: review.comment, route: review.route });
    say("kept");
    showList();
  } catch (error) {
    say(`not kept: ${error.message}`, true);
  }
}

async function decide(decision) {
  await keepComment();
  await keep({ decision: rowOf(current).decision === decision ? "" : decision });
  if (rowOf(current).decision === decision) move(1);
}

async function keepComment() {
  const comment = byId("comment").value;
  if (current && comment !== rowOf(current).comment) await keep({ comment });
}

async function undo() {
  const last = undone.pop();
  if (!last) return;
  if (last.token !== current) await open(last.token);
  await keep(last.values, { undo: false });
}

// ---- the route ----

// a roadblock of the route is taken out; another one goes where it connects best
async function toggleBlock(id) {
  const route = [...open.found.current];
  const at = route.indexOf(id);
  if (at >= 0) route.splice(at, 1);
  else route.splice(await bestPlace(route, id), 0, id);
  if (route.length) await keep({ route });
}

async function bestPlace(route, id) {
  let best = [Infinity, route.length];
  for (let place = route.length; place >= 0; place--) {
    const values = [...route.slice(0, place), id, ...route.slice(place)];
    const { problems } = await ask("/api/route", { token: current, values });
    if (problems.length < best[0]) best = [problems.length, place];
  }
  return best[1];
}

const bare = document.createElement("canvas").getContext("2d"); // without any transform
function blockAt(px, py) {
  const [x, y] = panel.toWorld(px, py);
  const found = blocks.filter(({ path }) => bare.isPointInPath(path, x, y, "evenodd"));
  const onRoute = found.find(({ id }) => open.found.current.includes(id));
  return (onRoute || found[0] || { id: "" }).id;
}

// ---- drawing and time ----

function seek(t) {
  state.t = Math.min(Math.max(t, 0), duration());
  draw();
}

function wholeScene() {
  const [[x0, x1], [y0, y1]] = boundsOf(fields.get("ego.xy").data, 30);
  const { clientWidth: width, clientHeight: height } = byId("stage");
  state.centre = [(x0 + x1) / 2, (y0 + y1) / 2];
  state.scale = Math.min(width / (x1 - x0), height / (y1 - y0), 12);
  layOut();
}

function layOut() {
  if (!panel) return;
  const { width, height, ratio } = sizeCanvas();
  panel.place(0, 0, width, height, state.scale, ratio);
  draw();
}

function draw() {
  if (!panel) return;
  const at = sampleAt(state.t);
  const ratio = window.devicePixelRatio || 1;
  panel.scale = state.scale;
  panel.centre = state.centre;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  panel.drawMap(context);
  panel.inWorld(context, fillRoute);
  drawLights(context, scene, panel, at);
  drawAgents(context, scene, panel, at, -1);
  drawPath(context, scene.get("expert.xy").data, at, panel, COLOURS.link, [], 2);
  drawTicks();
  drawEgo(context, poseAt(fields, "ego", 1, 0, at), open.found.meta.vehicle, panel, COLOURS.link, true);
  byId("clock").textContent = `${state.t.toFixed(1)} s of ${duration().toFixed(1)} s`;
  byId("time").value = state.t;
}

function repaint() {
  if (map) map.version++;
  draw();
}

function fillRoute() {
  for (const { id, path } of blocks.filter((block) => open.found.current.includes(block.id))) {
    context.fillStyle = open.found.recordedRoute.includes(id) ? COLOURS.route : CHANGED;
    context.fill(path, "evenodd");
  }
}

function drawTicks() {
  const xy = scene.get("expert.xy").data;
  context.fillStyle = COLOURS.link;
  context.font = "10px system-ui, sans-serif";
  times.forEach((t, i) => {
    if (Math.abs(t - Math.round(t)) > 0.02 || Math.round(t) % 5) return;
    const [px, py] = panel.toScreen(xy[2 * i], xy[2 * i + 1]);
    context.fillRect(px - 2, py - 2, 4, 4);
    context.fillText(`${Math.round(t)} s`, px + 5, py - 4);
  });
}

// ---- controls ----

function zoom(factor, px, py) {
  const [x, y] = panel.toWorld(px, py);
  state.scale = panel.scale = Math.min(Math.max(state.scale * factor, 0.3), 60);
  const [after, aside] = panel.toWorld(px, py);
  state.centre = [state.centre[0] + x - after, state.centre[1] + y - aside];
  draw();
}

function press(event) {
  drag(event, panel, () => {}, (moved, up) => {
    const id = moved ? "" : blockAt(...pointer(up));
    if (id) toggleBlock(id);
  });
}

function hover(event) {
  const id = panel && event.buttons === 0 ? blockAt(...pointer(event)) : "";
  const verb = id && open.found.current.includes(id) ? "take out" : "add";
  showTip(id && `${id} · click to ${verb}`, pointer(event));
}

const KEYS = {
  n: () => move(1),
  b: () => move(-1),
  a: () => decide("accept"),
  r: () => decide("reject"),
  u: undo,
  c: () => byId("comment").focus(),
  o: () => keep({ route: null }),
  f: wholeScene,
  d: toggleTheme,
  " ": play,
  ArrowLeft: () => stepBy(-1),
  ArrowRight: () => stepBy(1),
  "+": () => zoom(1.25, canvas.clientWidth / 2, canvas.clientHeight / 2),
  "-": () => zoom(0.8, canvas.clientWidth / 2, canvas.clientHeight / 2),
};

function onKey(event) {
  if (event.target === byId("comment")) {
    if (event.key === "Escape") byId("comment").blur();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  if (!KEYS[event.key] || !current) return;
  event.preventDefault();
  KEYS[event.key]();
}

async function start() {
  listing = await ask("/api/scenarios");
  const wanted = decodeURIComponent(location.hash.slice(1));
  const first = listing.scenarios.find((row) => row.token === wanted) ||
    listing.scenarios.find(isOpen) || listing.scenarios[0];
  byId("which").value = isOpen(first) ? "open" : "all";
  for (const [id, key] of [["accept", "a"], ["reject", "r"], ["undo", "u"], ["recorded", "o"], ["play", " "], ["theme", "d"]]) {
    byId(id).addEventListener("click", KEYS[key]);
  }
  byId("which").addEventListener("change", showList);
  byId("comment").addEventListener("change", keepComment);
  byId("time").addEventListener("input", (e) => {
    pause();
    seek(Number(e.target.value));
  });
  connectCanvas();
  window.addEventListener("keydown", onKey);
  window.addEventListener("resize", layOut);
  startTheme();
  await open(first.token);
}

start().catch((error) => say(error.message, true));
