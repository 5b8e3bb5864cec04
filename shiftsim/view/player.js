"use strict";
// Time and view of a page that plays a scenario. The page has `times` of samples [s], a `state` of
// {t, playing, rate, scale, centre}, `seek` and `draw`, `zoom`, `press` and `hover`.

const CLICK = 4; // pixels a pointer may move between down and up to count as a click
const canvas = byId("scene");
const context = canvas.getContext("2d", { alpha: false });
const duration = () => times[times.length - 1];

function sampleAt(t) {
  let row = Math.min(Math.floor((t / duration()) * (times.length - 1)), times.length - 1);
  while (row > 0 && times[row] > t + 1e-6) row--;
  while (row + 1 < times.length && times[row + 1] <= t + 1e-6) row++;
  const next = Math.min(row + 1, times.length - 1);
  const span = times[next] - times[row];
  return { row, next, share: span > 0 ? Math.min(Math.max((t - times[row]) / span, 0), 1) : 0 };
}

function stepBy(samples) {
  pause();
  const { row } = sampleAt(state.t);
  seek(times[Math.min(Math.max(row + samples, 0), times.length - 1)]);
}

let lastFrame = 0;
function frame(now) {
  if (!state.playing) return;
  const t = state.t + (state.rate * (now - lastFrame)) / 1000;
  lastFrame = now;
  if (t >= duration()) pause();
  seek(t);
  if (state.playing) requestAnimationFrame(frame);
}

function play() {
  if (state.playing) return pause();
  if (state.t >= duration() - 1e-6) state.t = 0;
  state.playing = true;
  byId("play").textContent = "❚❚";
  lastFrame = performance.now();
  requestAnimationFrame(frame);
}

function pause() {
  state.playing = false;
  byId("play").textContent = "▶";
  seek(state.t);
}

function sizeCanvas() {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = byId("stage");
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  return { width, height, ratio };
}

// lowest and highest x, and y, of places x, y, x, y, … and some metres around them
function boundsOf(xy, around) {
  return [0, 1].map((axis) => {
    const values = xy.filter((value, i) => i % 2 === axis && Number.isFinite(value));
    return [Math.min(...values) - around, Math.max(...values) + around];
  });
}

// place of the pointer on the canvas
function pointer(event) {
  const box = canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

// moves the view of a panel with the pointer: `begin` is called first, `end` with whether it moved
function drag(event, panel, begin, end) {
  const start = [event.clientX, event.clientY];
  const from = [...panel.centre];
  let moved = false;
  const move = (e) => {
    const [dx, dy] = [e.clientX - start[0], e.clientY - start[1]];
    if (!moved && Math.hypot(dx, dy) <= CLICK) return;
    if (!moved) begin();
    moved = true;
    state.centre = [from[0] - dx / state.scale, from[1] + dy / state.scale];
    draw();
  };
  const up = (e) => {
    window.removeEventListener("pointermove", move);
    window.removeEventListener("pointerup", up);
    end(moved, e);
  };
  window.addEventListener("pointermove", move);
  window.addEventListener("pointerup", up);
}

function showTip(text, [px, py]) {
  const tip = byId("tip");
  tip.hidden = !text;
  tip.textContent = text;
  tip.style.left = `${Math.min(px + 14, canvas.clientWidth - 160)}px`;
  tip.style.top = `${py + 12}px`;
}

function connectCanvas() {
  canvas.addEventListener("pointerdown", press);
  canvas.addEventListener("pointermove", hover);
  canvas.addEventListener("pointerleave", () => (byId("tip").hidden = true));
  const wheel = (event) => {
    event.preventDefault();
    zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15, ...pointer(event));
  };
  canvas.addEventListener("wheel", wheel, { passive: false });
}
