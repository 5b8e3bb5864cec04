"use strict";
// Draws the scene: a cached picture of the map, and everything that moves on top of it.
// World coordinates are metres, x to the right, y up; the screen's y points down.

// what is drawn has the colours of the page's style, which differ where it is dark
const COLOURS = {};
function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names =
    "ground walkway drivable route crosswalk stop boundary centre vehicle pedestrian bicycle " +
    "object edge edged edited alarm alarm-ink partner paper glass ink soft line recorded link";
  for (const name of names.split(" ")) COLOURS[name] = style.getPropertyValue(`--${name}`).trim();
}
readColours();

const isDark = () => document.documentElement.dataset.theme === "dark";

// the page's `repaint` draws everything in the colours of a theme
function setTheme(dark) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  readColours();
  repaint();
}

function toggleTheme() {
  setTheme(!isDark());
  try {
    localStorage.setItem("shiftsim-theme", isDark() ? "dark" : "light");
  } catch {
    // a page inside a notebook keeps nothing
  }
}

function startTheme() {
  let wanted = null;
  try {
    wanted = localStorage.getItem("shiftsim-theme");
  } catch {
    // nothing is kept here
  }
  const prefersDark = window.matchMedia("(prefers-color-scheme: dark)");
  setTheme(wanted ? wanted === "dark" : prefersDark.matches);
  prefersDark.addEventListener("change", () => setTheme(prefersDark.matches));
}

function luminance(colour) {
  const part = (i) => {
    const value = Number.parseInt(colour.slice(i, i + 2), 16) / 255;
    return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  };
  return 0.2126 * part(1) + 0.7152 * part(3) + 0.0722 * part(5);
}

// a colour #rrggbb, mixed with white until it stands 3 : 1 from a dark road
function lightened(colour) {
  const parts = [1, 3, 5].map((i) => Number.parseInt(colour.slice(i, i + 2), 16));
  for (let share = 0; ; share += 0.05) {
    const mixed = parts.map((value) => Math.round(value + (255 - value) * share));
    const out = `#${mixed.map((value) => value.toString(16).padStart(2, "0")).join("")}`;
    if (luminance(out) >= LIGHT) return out;
  }
}

const agentColour = (kind) => COLOURS[["vehicle", "pedestrian", "bicycle"][kind] || "object"];
const KIND_NAMES = ["vehicle", "pedestrian", "bicycle", "cone", "barrier", "sign", "object"];
const LIGHT_COLOURS = [null, "#1f9d4d", "#d9a400", "#d02a1e", null]; // absent, green, yellow, red, unknown
const LIGHT = 0.31; // luminance of what stands 3 : 1 from the route on a dark page
const SHADE = 0.11; // luminance of what stands 3 : 1 from the route on a light page
const CACHE_MARGIN = 0.35; // share of the view around it that the cached map also covers

// Path2D of a layer in world coordinates; rings of one layer fill by the even-odd rule
function layerPath(fields, name, closed) {
  const path = new Path2D();
  const xy = fields.get(`${name}.xy`).data;
  let vertex = 0;
  for (const count of fields.get(`${name}.count`).data) {
    for (let i = 0; i < count; i++, vertex++) {
      const x = xy[2 * vertex];
      const y = xy[2 * vertex + 1];
      if (i === 0) path.moveTo(x, y);
      else path.lineTo(x, y);
    }
    if (closed) path.closePath();
  }
  return path;
}

class MapPicture {
  constructor(fields) {
    this.areas = ["walkway", "drivable", "route", "stop", "crosswalk"].map((name) => [
      name,
      layerPath(fields, name, true),
    ]);
    this.boundary = layerPath(fields, "boundary", false);
    this.centre = layerPath(fields, "centre", false);
    this.layers = { route: true, lanes: true };
    this.version = 0;
  }

  paint(context, scale) {
    for (const [name, path] of this.areas) {
      if (name === "route" && !this.layers.route) continue;
      context.fillStyle = COLOURS[name];
      context.fill(path, "evenodd");
    }
    if (!this.layers.lanes) return;
    context.strokeStyle = COLOURS.boundary;
    context.lineWidth = 1 / scale;
    context.stroke(this.boundary);
    if (scale < 3) return;
    context.strokeStyle = COLOURS.centre;
    context.setLineDash([1.5, 2.5]);
    context.stroke(this.centre);
    context.setLineDash([]);
  }
}

// One view of the scene. Several share a canvas when rollouts stand side by side.
class Panel {
  constructor(map) {
    this.map = map;
    this.cache = document.createElement("canvas");
    this.cached = null;
    this.centre = [0, 0];
    this.turn = 0; // by which the world is turned on the screen, counter-clockwise [rad]
  }

  place(left, top, width, height, scale, ratio) {
    Object.assign(this, { left, top, width, height, scale, ratio });
  }

  toScreen(x, y) {
    const [c, s] = [Math.cos(this.turn) * this.scale, Math.sin(this.turn) * this.scale];
    const [dx, dy] = [x - this.centre[0], y - this.centre[1]];
    return [
      this.left + this.width / 2 + dx * c - dy * s,
      this.top + this.height / 2 - dx * s - dy * c,
    ];
  }

  toWorld(px, py) {
    const [c, s] = [Math.cos(this.turn) / this.scale, Math.sin(this.turn) / this.scale];
    const [dx, dy] = [px - this.left - this.width / 2, this.top + this.height / 2 - py];
    return [this.centre[0] + dx * c + dy * s, this.centre[1] - dx * s + dy * c];
  }

  // the map is painted again only when the view leaves the cached picture
  drawMap(context) {
    const spare = CACHE_MARGIN * Math.max(this.width, this.height);
    // half of what is seen across and down: all round where it is turned
    const around = this.turn ? Math.hypot(this.width, this.height) / 2 : 0;
    const half = [Math.max(this.width / 2, around) + spare, Math.max(this.height / 2, around) + spare];
    const key = [...half, this.scale, this.ratio, this.map.version].join();
    const moved = this.cached && [0, 1].map((i) => Math.abs(this.centre[i] - this.cached.centre[i]));
    const stale = !this.cached || this.cached.key !== key || Math.max(...moved) * this.scale > spare;
    if (stale) this.repaint(key, half);
    const [x, y] = this.toScreen(...this.cached.centre);
    context.save();
    context.translate(x, y);
    context.rotate(-this.turn);
    const { cache, ratio } = this;
    context.drawImage(cache, -half[0], -half[1], cache.width / ratio, cache.height / ratio);
    context.restore();
  }

  repaint(key, half) {
    const { cache, ratio, scale } = this;
    cache.width = Math.ceil(2 * half[0] * ratio);
    cache.height = Math.ceil(2 * half[1] * ratio);
    const context = cache.getContext("2d", { alpha: false });
    context.fillStyle = COLOURS.ground;
    context.fillRect(0, 0, cache.width, cache.height);
    const zoom = scale * ratio;
    context.setTransform(
      zoom, 0, 0, -zoom,
      half[0] * ratio - this.centre[0] * zoom, half[1] * ratio + this.centre[1] * zoom,
    );
    this.map.paint(context, scale);
    this.cached = { key, centre: [...this.centre] };
  }

  // runs a drawing in world coordinates [m]
  inWorld(context, draw) {
    const [x, y] = this.toScreen(0, 0);
    context.save();
    context.translate(x, y);
    context.rotate(-this.turn);
    context.scale(this.scale, -this.scale);
    draw();
    context.restore();
  }
}

// corners of a box as a closed sub-path
function addBox(context, x, y, heading, front, rear, halfWidth, panel) {
  const c = Math.cos(heading + panel.turn) * panel.scale;
  const s = -Math.sin(heading + panel.turn) * panel.scale;
  const [px, py] = panel.toScreen(x, y);
  context.moveTo(px + front * c - halfWidth * s, py + front * s + halfWidth * c);
  context.lineTo(px + front * c + halfWidth * s, py + front * s - halfWidth * c);
  context.lineTo(px - rear * c + halfWidth * s, py - rear * s - halfWidth * c);
  context.lineTo(px - rear * c - halfWidth * s, py - rear * s + halfWidth * c);
  context.closePath();
}

// everything is kept at samples; between two of them positions are interpolated
function poseAt(fields, name, count, index, at) {
  const xy = fields.get(`${name}.xy`).data;
  const heading = fields.get(`${name}.heading`).data;
  const low = at.row * count + index;
  const high = at.next * count + index;
  const mix = (a, b) => a + (b - a) * at.share;
  return [
    mix(xy[2 * low], xy[2 * high]),
    mix(xy[2 * low + 1], xy[2 * high + 1]),
    mix(heading[low], heading[high]),
  ];
}

function drawAgents(context, fields, panel, at, highlighted, edited = new Set()) {
  const kinds = fields.get("tracks.kind").data;
  const size = fields.get("tracks.size").data;
  const valid = fields.get("tracks.valid").data;
  const count = kinds.length;
  const marked = [];
  const made = [];
  for (let kind = 0; kind < KIND_NAMES.length; kind++) {
    context.beginPath();
    for (let i = 0; i < count; i++) {
      if (kinds[i] !== kind || !valid[at.row * count + i]) continue;
      const there = valid[at.next * count + i] ? at : { ...at, next: at.row };
      const [x, y, heading] = poseAt(fields, "tracks", count, i, there);
      const [px, py] = panel.toScreen(x, y);
      const reach = (size[2 * i] + 2) * panel.scale;
      if (px < panel.left - reach || px > panel.left + panel.width + reach) continue;
      if (py < panel.top - reach || py > panel.top + panel.height + reach) continue;
      const half = size[2 * i] / 2;
      addBox(context, x, y, heading, half, half, size[2 * i + 1] / 2, panel);
      if (edited.has(i)) made.push([x, y, heading, half, size[2 * i + 1] / 2]);
      if (i === highlighted) marked.push([x, y, heading, half, size[2 * i + 1] / 2]);
    }
    context.fillStyle = agentColour(kind);
    context.fill();
    context.lineWidth = 1;
    context.strokeStyle = COLOURS.edge;
    context.stroke();
  }
  outline(context, made, panel, 1.5, COLOURS.edited);
  outline(context, marked, panel, 3, COLOURS.partner);
}

// what the planner saw: outlines of boxes, and of the ego where it believed to be
function drawSeen(context, fields, vehicle, panel, at, colour) {
  const size = fields.get("seen.size").data;
  const valid = fields.get("seen.valid").data;
  const count = size.length / 2;
  const now = { ...at, next: at.row };
  context.beginPath();
  for (let i = 0; i < count; i++) {
    if (!valid[at.row * count + i]) continue;
    const half = size[2 * i] / 2;
    addBox(context, ...poseAt(fields, "seen", count, i, now), half, half, size[2 * i + 1] / 2, panel);
  }
  context.lineWidth = 1.5;
  context.strokeStyle = colour;
  context.stroke();
  drawEgo(context, poseAt(fields, "believed", 1, 0, now), vehicle, panel, colour, false, [2, 2]);
}

// boxes drawn around agents
function outline(context, boxes, panel, width, colour) {
  for (const [x, y, heading, half, halfWidth] of boxes) {
    context.beginPath();
    addBox(context, x, y, heading, half + 0.4, half + 0.4, halfWidth + 0.4, panel);
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.stroke();
  }
}

function drawLights(context, fields, panel, at) {
  const { shape, data } = fields.get("lights.status");
  const counts = fields.get("lights.count").data;
  const xy = fields.get("lights.xy").data;
  let vertex = 0;
  context.lineWidth = Math.max(2, 0.5 * panel.scale);
  context.globalAlpha = 0.75;
  for (let i = 0; i < shape[1]; i++) {
    const colour = LIGHT_COLOURS[data[at.row * shape[1] + i]];
    context.strokeStyle = colour;
    if (colour) traceLine(context, xy, vertex, vertex + counts[i], panel);
    if (colour) context.stroke();
    vertex += counts[i];
  }
  context.globalAlpha = 1;
}

function traceLine(context, xy, first, stop, panel) {
  context.beginPath();
  for (let i = first; i < stop; i++) {
    const [px, py] = panel.toScreen(xy[2 * i], xy[2 * i + 1]);
    if (i === first) context.moveTo(px, py);
    else context.lineTo(px, py);
  }
}

// the line that was traced; on a light page a bright colour, which the road would swallow, is edged
// unless it is drawn faint
function strokeEdged(context, colour) {
  const width = context.lineWidth;
  if (!isDark() && context.globalAlpha === 1 && luminance(colour) > SHADE) {
    context.lineWidth = width + 3;
    context.strokeStyle = COLOURS.edge;
    context.stroke();
  }
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke();
}

function strokeLine(context, xy, first, stop, panel, colour) {
  traceLine(context, xy, first, stop, panel);
  strokeEdged(context, colour);
}

// the driven path: what is past strong, what is to come faint
function drawPath(context, xy, at, panel, colour, dash, width) {
  context.setLineDash(dash);
  context.lineWidth = width;
  strokeLine(context, xy, 0, at.row + 1, panel, colour);
  context.globalAlpha = 0.35;
  strokeLine(context, xy, at.row, xy.length / 2, panel, colour);
  context.globalAlpha = 1;
  context.setLineDash([]);
}

// the ground between the paths of a planner's seeds
function drawTube(context, { area }, panel, colour) {
  context.globalAlpha = 0.35;
  context.fillStyle = colour;
  panel.inWorld(context, () => context.fill(area, "evenodd"));
  context.globalAlpha = 1;
}

// the plan from the rear axle on: its first second, and as far as `shown` (0 to 1) the rest of it,
// with a dot at every second
function drawPlan(context, fields, panel, at, colour, shown) {
  const first = planPoints(fields, "plan", panel, at);
  const rest = planPoints(fields, "rest", panel, at);
  context.strokeStyle = context.fillStyle = colour;
  context.lineCap = "round";
  context.globalAlpha = 0.45;
  strokePoints(context, first, 5);
  context.globalAlpha = 0.75 * shown;
  strokePoints(context, rest, 2.5);
  for (const [px, py] of rest) {
    context.beginPath();
    context.arc(px, py, 3, 0, 2 * Math.PI);
    context.fill();
  }
  context.globalAlpha = 1;
  context.lineCap = "butt";
}

// poses of a plan on the screen, as far as it reaches
function planPoints(fields, name, panel, at) {
  const { shape, data } = fields.get(name);
  const xy = fields.get("ego.xy").data;
  const points = [];
  const base = at.row * shape[1];
  for (let i = base; i < base + shape[1] && !Number.isNaN(data[2 * i]); i++) {
    points.push(panel.toScreen(xy[2 * at.row] + data[2 * i], xy[2 * at.row + 1] + data[2 * i + 1]));
  }
  return points;
}

function strokePoints(context, points, width) {
  context.beginPath();
  points.forEach(([px, py], i) => (i ? context.lineTo(px, py) : context.moveTo(px, py)));
  context.lineWidth = width;
  context.stroke();
}

// the box of an ego: filled when it leads, with a dashed edge where its rollout is disturbed
function drawEgo(context, pose, vehicle, panel, colour, filled, dash = []) {
  const [length, width, toCentre] = vehicle;
  const front = toCentre + length / 2;
  context.beginPath();
  addBox(context, ...pose, front, length / 2 - toCentre, width / 2, panel);
  context.lineWidth = 2;
  context.strokeStyle = colour;
  if (filled) {
    context.fillStyle = colour;
    context.globalAlpha = dash.length ? 0.3 : 0.8;
    context.fill();
    context.globalAlpha = 1;
  }
  context.setLineDash(dash);
  strokeEdged(context, colour);
  context.setLineDash([]);
  const [x, y, heading] = pose;
  const tip = panel.toScreen(x + front * Math.cos(heading), y + front * Math.sin(heading));
  const tail = panel.toScreen(x + toCentre * Math.cos(heading), y + toCentre * Math.sin(heading));
  context.beginPath();
  context.moveTo(...tail);
  context.lineTo(...tip);
  context.strokeStyle = filled && !dash.length ? COLOURS.paper : colour;
  context.stroke();
}

const MARKER = 7; // of the shapes, drawn as large as a radius

function drawDisc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = COLOURS.paper;
  context.fill();
}

// full for a clean rollout, hollow for a disturbed one
function drawMarker(context, marker, x, y, radius, colour, hollow = false) {
  context.save();
  context.translate(x, y);
  context.scale(radius / MARKER, radius / MARKER);
  const path = new Path2D(SHAPES[marker] || SHAPES.o);
  context.fillStyle = hollow ? COLOURS.paper : colour;
  context.fill(path);
  context.lineWidth = (1.2 * MARKER) / radius;
  context.strokeStyle = hollow ? colour : COLOURS.paper;
  context.stroke(path);
  context.restore();
}
