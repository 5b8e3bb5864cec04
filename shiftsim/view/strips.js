"use strict";
// Curves over time below the scene: speed, acceleration, noise, and the first violations.
// They are painted once; moving in time only moves the cursor and the values at it.

const STRIP_HEIGHT = 60; // of a curve that says nothing else
const STRIP_HEAD = 16; // of it, for the words
const STRIP_LEFT = 46;
const STRIP_RIGHT = 10;
const VIOLATION_ROW = 13;
const STRIP_FONT = "11px system-ui, sans-serif";

class Strips {
  constructor(canvas, duration) {
    this.canvas = canvas;
    this.duration = Math.max(duration, 1e-6);
    this.picture = document.createElement("canvas");
    this.rows = [];
  }

  // curves: [{label, unit, least, height, lines: [{values, colour, dash, marker, hollow}]}], whose
  // values at the cursor are told where a line has a marker; marks: [{t, colour, marker, row}]
  show(curves, marks, times) {
    Object.assign(this, { curves, marks, times });
    this.tops = [0];
    for (const { height = STRIP_HEIGHT } of curves) this.tops.push(this.tops.at(-1) + height);
    this.paint();
  }

  // where the marks of violations begin
  below() {
    return this.tops.at(-1);
  }

  height() {
    const rows = this.marks.length ? 1 + Math.max(...this.marks.map((mark) => mark.row)) : 1;
    return this.below() + rows * VIOLATION_ROW + 22;
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
    context.fillStyle = COLOURS.paper;
    context.fillRect(0, 0, this.width, height);
    context.font = STRIP_FONT;
    for (const curve of this.curves) this.paintCurve(context, curve);
    this.paintMarks(context, this.below());
    this.paintAxis(context, height);
    this.draw(this.now || 0);
  }

  // y of a value of a curve, and the ends of its axis
  axisOf(curve) {
    const index = this.curves.indexOf(curve);
    const bottom = this.tops[index + 1] - 6;
    const room = bottom - this.tops[index] - STRIP_HEAD;
    const values = curve.lines.flatMap((line) => Array.from(line.values).filter(Number.isFinite));
    const low = Math.min(0, ...values);
    const high = Math.max(curve.least, ...values);
    return { low, high, y: (value) => bottom - (room * (value - low)) / (high - low) };
  }

  paintCurve(context, curve) {
    const { low, high, y } = (curve.axis = this.axisOf(curve));
    context.strokeStyle = COLOURS.line;
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(STRIP_LEFT, y(0));
    context.lineTo(this.width - STRIP_RIGHT, y(0));
    context.stroke();
    context.fillStyle = COLOURS.soft;
    context.textAlign = "right";
    context.fillText(high.toFixed(high < 10 ? 1 : 0), STRIP_LEFT - 5, y(high) + 4);
    context.fillText(low < 0 ? low.toFixed(1) : "0", STRIP_LEFT - 5, y(low) + 3);
    context.textAlign = "left";
    for (const line of curve.lines) {
      context.beginPath();
      line.values.forEach((value, i) => {
        if (i) context.lineTo(this.x(this.times[i]), y(value));
        else context.moveTo(this.x(this.times[i]), y(value));
      });
      context.strokeStyle = line.colour;
      context.lineWidth = 1.4;
      context.setLineDash(line.dash);
      context.stroke();
    }
    context.setLineDash([]);
    context.fillStyle = COLOURS.soft;
    context.fillText(`${curve.label} [${curve.unit}]`, STRIP_LEFT + 4, y(high) - 5);
    curve.told = STRIP_LEFT + 18 + context.measureText(`${curve.label} [${curve.unit}]`).width;
  }

  // what the mark at a place on the canvas says in words
  wordsAt(px, py) {
    const top = this.below() + 8;
    const near = (mark) =>
      Math.hypot(this.x(mark.t) - px, top + mark.row * VIOLATION_ROW - py) < VIOLATION_ROW / 2 + 2;
    return this.marks.filter(near).map((mark) => mark.words).join("; ");
  }

  paintMarks(context, top) {
    context.textAlign = "left";
    context.fillStyle = COLOURS.soft;
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
      context.fillStyle = COLOURS.ink;
      if (free) context.fillText(mark.text, left, y + 4);
    }
  }

  paintAxis(context, height) {
    context.fillStyle = COLOURS.soft;
    context.strokeStyle = COLOURS.soft;
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
    context.strokeStyle = COLOURS.ink;
    context.lineWidth = 1.5;
    context.stroke();
    if (!this.times) return;
    const row = Math.max(this.times.findLastIndex((t) => t <= now + 1e-6), 0);
    context.font = STRIP_FONT;
    for (const curve of this.curves) this.tellValues(context, curve, this.times[row], row);
  }

  // the values of a curve at the cursor: marks on its lines, numbers beside its name
  tellValues(context, curve, t, row) {
    const told = curve.lines.filter((line) => line.marker && Number.isFinite(line.values[row]));
    let left = curve.told;
    for (const { values, marker, colour, hollow } of told) {
      drawMarker(context, marker, this.x(t), curve.axis.y(values[row]), 3.5, colour, hollow);
      const text = values[row].toFixed(curve.digits ?? 1).replace(/^-(?=[0.]+$)/, "");
      const width = context.measureText(text).width;
      if (left + 10 + width > this.width) continue;
      context.fillStyle = COLOURS.paper; // over the cursor
      context.fillRect(left - 2, curve.axis.y(curve.axis.high) - 14, 16 + width, 12);
      drawMarker(context, marker, left + 4, curve.axis.y(curve.axis.high) - 9, 4, colour, hollow);
      context.fillStyle = COLOURS.ink;
      context.fillText(text, left + 11, curve.axis.y(curve.axis.high) - 5);
      left += 24 + width;
    }
  }
}
