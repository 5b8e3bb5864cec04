"use strict";
// The score of one rollout over time: it begins at 100 and falls where something is lost of it.
// A loss can be clicked, and chosen with the keyboard, and leads to its moment.

const FALL_TOP = 18; // below the words
const FALL_HEIGHT = 36; // of a score of 100
const FALL_WIDTH = 8; // of a loss

class Waterfall {
  // `choose` is called with a loss
  constructor(element, choose) {
    this.element = element;
    this.choose = choose;
  }

  // name: of the rollout; cls: its score in [0, 1]; losses: [{t, points, told, reason, words}] in order of
  // time, those without a moment last; x: place of a time
  show({ name, colour, cls, losses, duration, x }) {
    const y = (score) => FALL_TOP + (1 - score / 100) * FALL_HEIGHT;
    const parts = [];
    const corners = [[x(0), y(0)], [x(0), y(100)]];
    let score = 100;
    for (const loss of losses) {
      const at = x(loss.t ?? duration);
      corners.push([at, y(score)], [at, y(score - loss.points)]);
      const others = losses.map((other) => Math.abs(x(other.t ?? duration) - at) / 2);
      const reach = Math.min(12, ...others.filter(Boolean)); // up to where it can be clicked
      parts.push({ loss, at, reach, top: y(score), bottom: y(score - loss.points) });
      score -= loss.points;
    }
    corners.push([x(duration), y(score)], [x(duration), y(0)]);
    const result = cls === null ? "no score" : `score ${Number((100 * cls).toFixed(2))}`;
    const words = svgOf("text", { class: "name", x: x(0) + 4, y: 11 }, `${result} of ${name}`);
    const axis = [100, 0].map((value) =>
      svgOf("text", { x: x(0) - 5, y: y(value) + 4, "text-anchor": "end" }, `${value}`),
    );
    const path = corners.map((corner) => corner.join(" ")).join(" L ");
    const area = svgOf("path", { class: "left", d: `M ${path} Z`, fill: colour, stroke: colour });
    this.element.setAttribute("aria-label", `${words.textContent}, and what it lost`);
    this.cursor = svgOf("line", { y1: 0, y2: "100%", stroke: "var(--ink)", "stroke-width": 1.5 });
    const shown = cls === null ? [] : [...axis, area, ...parts.map((part) => this.part(part))];
    this.element.replaceChildren(words, this.cursor, ...shown);
    this.label(cls === null ? [] : parts, x(duration));
  }

  // shows a time by its place
  point(x) {
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
  }

  part(one) {
    const { loss, at, top, bottom, reach } = one;
    const when = loss.t === null ? "at the end" : `at ${loss.t.toFixed(1)} s`;
    const words = `${loss.told} ${when}: ${loss.words}`;
    const height = Math.max(bottom - top, 3);
    const box = { x: at - FALL_WIDTH / 2, y: bottom - height, width: FALL_WIDTH, height };
    const around = { x: at - reach, y: 0, width: 2 * reach, height: FALL_TOP + FALL_HEIGHT + 4 };
    one.element = svgOf(
      "g", { class: "loss", role: "button", tabindex: 0, "aria-label": words },
      svgOf("title", {}, words),
      svgOf("rect", { ...around, class: "reach" }),
      svgOf("rect", box),
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

  // words beside the losses where there is room: right of them, else left
  label(parts, end) {
    const taken = parts.map(({ at, top, bottom }) => [at - 5, Math.min(top, bottom - 3), at + 5, bottom]);
    for (const { loss, at, top, bottom, element } of parts) {
      const y = Math.min(Math.max((top + bottom) / 2 + 4, FALL_TOP + 10), FALL_TOP + FALL_HEIGHT - 4);
      const text = svgOf("text", { y }, `${loss.told} ${loss.reason}`);
      element.append(text);
      const width = text.getComputedTextLength();
      const boxAt = (left) => [left, y - 9, left + width, y + 2];
      const fits = ([left, , right]) => left > 0 && right <= end;
      const free = (a) => taken.every((b) => a[2] <= b[0] || b[2] <= a[0] || a[3] <= b[1] || b[3] <= a[1]);
      const box = [at + 8, at - 8 - width].map(boxAt).find((one) => fits(one) && free(one));
      if (!box) {
        text.remove();
        continue;
      }
      text.setAttribute("x", box[0]);
      taken.push(box);
    }
  }
}

// what each loss takes, in words; told are the steps of the score to two digits, so that they add up
function tellLosses(losses) {
  const rounded = (value) => Math.round(100 * value) / 100;
  let score = 100;
  for (const loss of losses) {
    const step = rounded(score) - rounded(score - loss.points);
    loss.told = `−${rounded(step)}`;
    score -= loss.points;
  }
}
