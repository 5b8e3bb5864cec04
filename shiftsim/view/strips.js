"use strict";
// Curves over time below the scene: speed, acceleration, noise, and the first violations.
// They are painted once; moving in time only moves the cursor.

const STRIP_HEIGHT = 70;
const STRIP_HEAD = 16; // of it, for the words
const STRIP_LEFT = 46;
const STRIP_RIGHT = 10;
const VIOLATION_ROW = 13;

class Strips {
  constructor(canvas, duration) {
    this.canvas = canvas;
    this.duration = Math.max(duration, 1e-6);
    this.picture = document.createElement("canvas");
    this.rows = [];
  }

  // curves: [{label, unit, lines: [{times, values, colour, dash}]}], marks: [{t, colour, marker, row}]
  show(curves, marks) {
    this.curves = curves;
    this.marks = marks;
    this.paint();
  }

  height() {
    const rows = this.marks.length ? 1 + Math.max(...this.marks.map((mark) => mark.row)) : 1;
    return this.curves.length * STRIP_HEIGHT + rows * VIOLATION_ROW + 22;
  }

  x(t) {
    return STRIP_LEFT + ((this.width - STRIP_LEFT - STRIP_RIGHT) * t) / this.duration;
  }

  timeAt(px) {
    const share = (px - STRIP_LEFT) / (this.width - STRIP_LEFT - STRIP_RIGHT);
    return Math.min(Math.max(share, 0), 1) * this.duration;
  }

  paint() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.parentElement.clientWidth;
    const height = this.height();
    for (const canvas of [this.canvas, this.picture]) {
      canvas.width = Math.round(this.width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    this.canvas.style.height = `${height}px`;
    const context = this.picture.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = "#ffffff";
    context.fillRect(0, 0, this.width, height);
    context.font = "11px system-ui, sans-serif";
    this.curves.forEach((curve, i) => this.paintCurve(context, curve, i * STRIP_HEIGHT));
    this.paintMarks(context, this.curves.length * STRIP_HEIGHT);
    this.paintAxis(context, height);
    this.draw(this.now || 0);
  }

  paintCurve(context, curve, top) {
    const values = curve.lines.flatMap((line) => Array.from(line.values).filter(Number.isFinite));
    const low = Math.min(0, ...values);
    const high = Math.max(curve.least, ...values);
    const y = (value) => top + STRIP_HEIGHT - 6 - ((STRIP_HEIGHT - STRIP_HEAD - 6) * (value - low)) / (high - low);
    context.strokeStyle = "#e4e4e0";
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(STRIP_LEFT, y(0));
    context.lineTo(this.width - STRIP_RIGHT, y(0));
    context.stroke();
    context.fillStyle = "#4c4c4c";
    context.textAlign = "right";
    context.fillText(high.toFixed(high < 10 ? 1 : 0), STRIP_LEFT - 5, top + STRIP_HEAD + 4);
    context.fillText(low < 0 ? low.toFixed(1) : "0", STRIP_LEFT - 5, top + STRIP_HEIGHT - 3);
    context.textAlign = "left";
    for (const line of curve.lines) {
      context.beginPath();
      line.values.forEach((value, i) => {
        if (i) context.lineTo(this.x(line.times[i]), y(value));
        else context.moveTo(this.x(line.times[i]), y(value));
      });
      context.strokeStyle = line.colour;
      context.lineWidth = 1.4;
      context.setLineDash(line.dash);
      context.stroke();
    }
    context.setLineDash([]);
    context.fillStyle = "#4c4c4c";
    context.fillText(`${curve.label} [${curve.unit}]`, STRIP_LEFT + 4, top + 11);
  }

  // what the mark at a place on the canvas says in words
  wordsAt(px, py) {
    const top = this.curves.length * STRIP_HEIGHT + 8;
    const near = (mark) =>
      Math.hypot(this.x(mark.t) - px, top + mark.row * VIOLATION_ROW - py) < VIOLATION_ROW / 2 + 2;
    return this.marks.filter(near).map((mark) => mark.words).join("; ");
  }

  paintMarks(context, top) {
    context.textAlign = "left";
    if (!this.marks.length) context.fillText("no violations", STRIP_LEFT + 4, top + 11);
    const ends = []; // of what is written so far, by row: nothing is written over another
    for (const mark of this.marks) {
      const [x, y] = [this.x(mark.t), top + mark.row * VIOLATION_ROW + 8];
      const others = this.marks.filter((other) => other.row === mark.row && other.t > mark.t);
      const stop = Math.min(this.width, ...others.map((other) => this.x(other.t) - 6));
      const width = context.measureText(mark.text).width;
      const left = x + 8 + width <= stop ? x + 8 : x - 8 - width;
      const free = left >= (ends[mark.row] || 0);
      ends[mark.row] = Math.max(x + 6, free ? left + width + 4 : 0);
      drawMarker(context, mark.marker, x, y, 4.5, mark.colour, mark.hollow);
      context.fillStyle = "#3a3a3a";
      if (free) context.fillText(mark.text, left, y + 4);
    }
  }

  paintAxis(context, height) {
    context.fillStyle = "#4c4c4c";
    context.strokeStyle = "#c8c8c4";
    context.textAlign = "center";
    const spacing = this.duration > 30 ? 5 : 1;
    const labels = this.width < 700 ? 5 * spacing : spacing;
    for (let t = 0; t <= this.duration + 1e-9; t += spacing) {
      context.beginPath();
      context.moveTo(this.x(t), height - 20);
      context.lineTo(this.x(t), height - 15);
      context.stroke();
      if (t % labels === 0) context.fillText(`${t} s`, this.x(t), height - 4);
    }
    context.textAlign = "left";
  }

  draw(now) {
    this.now = now;
    const context = this.canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.picture, 0, 0);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.beginPath();
    context.moveTo(this.x(now), 0);
    context.lineTo(this.x(now), this.canvas.height / ratio - 16);
    context.strokeStyle = "#111111";
    context.lineWidth = 1.5;
    context.stroke();
  }
}
