"use strict";
// The score of one rollout over time: it begins at 100 and falls where something is lost of it.
// A loss can be clicked, and chosen with the keyboard, and leads to its moment.

const FALL_TOP = 18; // below the words
const FALL_HEIGHT = 36; // of a score of 100
const FALL_WIDTH = 8; // of a loss

function svgElement(name, attributes, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

class Waterfall {
  // `choose` is called with a loss
  constructor(element, choose) {
    this.element = element;
    this.choose = choose;
  }

  // name: of the rollout; cls: its score in [0, 1]; losses: [{t, points, reason, words}] in order of
  // time, those without a moment last; x: place of a time
  show({ name, colour, cls, losses, duration, x }) {
    const y = (score) => FALL_TOP + (1 - score / 100) * FALL_HEIGHT;
    const parts = [];
    const corners = [[x(0), y(0)], [x(0), y(100)]];
    let score = 100;
    for (const loss of losses) {
      const at = x(loss.t ?? duration);
      corners.push([at, y(score)], [at, y(score - loss.points)]);
      parts.push({ loss, at, top: y(score), bottom: y(score - loss.points) });
      score -= loss.points;
    }
    corners.push([x(duration), y(score)], [x(duration), y(0)]);
    const result = cls === null ? "no score" : `score ${(100 * cls).toFixed(1)}`;
    const words = svgElement("text", { class: "name", x: x(0) + 4, y: 11 }, `${result} of ${name}`);
    const axis = [100, 0].map((value) =>
      svgElement("text", { x: x(0) - 5, y: y(value) + 4, "text-anchor": "end" }, `${value}`),
    );
    const path = corners.map((corner) => corner.join(" ")).join(" L ");
    const area = svgElement("path", { class: "left", d: `M ${path} Z`, fill: colour, stroke: colour });
    this.element.setAttribute("aria-label", `${words.textContent}, and what it lost`);
    this.cursor = svgElement("line", { y1: 0, y2: "100%", stroke: "var(--ink)", "stroke-width": 1.5 });
    const shown = cls === null ? [] : [...axis, area, ...parts.map((part) => this.part(part))];
    this.element.replaceChildren(words, this.cursor, ...shown);
    this.label(parts, x(duration));
  }

  // shows a time by its place
  point(x) {
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
  }

  part(one) {
    const { loss, at, top, bottom } = one;
    const when = loss.t === null ? "at the end" : `at ${loss.t.toFixed(1)} s`;
    const words = `${lostWords(loss)} ${when}: ${loss.words}`;
    const height = Math.max(bottom - top, 2);
    const box = { x: at - FALL_WIDTH / 2, y: Math.min(top, bottom - height), width: FALL_WIDTH, height };
    const reach = { class: "reach", x: at - 12, y: FALL_TOP - 4, width: 24, height: FALL_HEIGHT + 8 };
    one.element = svgElement(
      "g", { class: "loss", role: "button", tabindex: 0, "aria-label": words },
      svgElement("title", {}, words), svgElement("rect", reach), svgElement("rect", box),
    );
    one.element.addEventListener("click", () => this.choose(loss));
    one.element.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.stopPropagation();
      event.preventDefault();
      this.choose(loss);
    });
    return one.element;
  }

  // words beside the losses, where there is room: right of them, else left
  label(parts, end) {
    let free = 0; // up to where is written
    parts.forEach(({ loss, at, top, bottom, element }, i) => {
      const y = Math.min(Math.max((top + bottom) / 2 + 4, FALL_TOP + 9), FALL_TOP + FALL_HEIGHT);
      const text = svgElement("text", { y }, `${lostWords(loss)} ${loss.reason}`);
      element?.append(text);
      const width = element ? text.getComputedTextLength() + 8 : 0;
      const next = parts.slice(i + 1).find((other) => other.at > at);
      const [right, left] = [at + width <= (next ? next.at - 6 : end), at - width >= free];
      if (right || left) text.setAttribute("x", right ? at + 8 : at - width);
      else text.remove();
      free = Math.max(free, right ? at + width : at + 8);
    });
  }
}

// what a loss takes, as "−31.2"
function lostWords(loss) {
  return loss.points < 0.05 ? "−0" : `−${loss.points.toFixed(1)}`;
}
