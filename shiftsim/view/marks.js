"use strict";
// What all pages share: elements, planners with their markers, as in all figures, and thumbnails.

const byId = (id) => document.getElementById(id);

function make(name, properties, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

const span = (kind, ...content) => make("span", { className: kind }, ...content);

// markers of about 9 units around their middle
const SHAPES = {
  o: "M-8 0a8 8 0 1 0 16 0a8 8 0 1 0-16 0z",
  s: "M-7-7h14v14h-14z",
  "^": "M0-9L9 7H-9z",
  v: "M0 9L9-7H-9z",
  D: "M0-9L9 0L0 9L-9 0z",
  P: "M-3-9h6v6h6v6h-6v6h-6v-6h-6v-6h6z",
  X: "M-5-9L0-4L5-9L9-5L4 0L9 5L5 9L0 4L-5 9L-9 5L-4 0L-9-5z",
  "<": "M-9 0L9-9V9z",
  ">": "M9 0L-9-9V9z",
  p: "M0-10L9.4-3L5.8 8H-5.8L-9.4-3z",
  h: "M0-10L8.6-5V5L0 10L-8.6 5V-5z",
  H: "M-5-8.6H5L10 0L5 8.6H-5L-10 0z",
  d: "M0-11L6 0L0 11L-6 0z",
  "*": "M0-10L2.6-3.1L10-3.1L4 1.6L6.2 9L0 4.6L-6.2 9L-4 1.6L-10-3.1L-2.6-3.1z",
  burst: "M0-10L1.7-4.2L7.1-7.1L4.2-1.7L10 0L4.2 1.7L7.1 7.1L1.7 4.2L0 10L-1.7 4.2L-7.1 7.1L-4.2 1.7L-10 0L-4.2-1.7L-7.1-7.1L-1.7-4.2z", // where something went wrong; of no planner
};

// the address that names SVG, of what the parser makes
const SVG = Object.assign(document.createElement("template"), { innerHTML: "<svg>" }).content
  .firstChild.namespaceURI;

function svgOf(name, attributes, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// name of a planner behind its marker, hollow under noise
function planner(name, [colour, shape], noise = "none") {
  const mark = svgOf("path", { d: SHAPES[shape] || SHAPES.o });
  const kind = noise === "none" ? "mark" : "mark hollow";
  const picture = svgOf("svg", { viewBox: "-12-12 24 24", class: kind, "aria-hidden": "true" }, mark);
  picture.style.setProperty("--own", colour);
  return span("planner", picture, name);
}

// the road and the recorded path as thumbnails.py gives them, and more on top
function thumbnail([road, expert], view, ...more) {
  const layers = [svgOf("path", { d: road, class: "road" }), svgOf("path", { d: expert, class: "expert" })];
  const frame = { viewBox: view.join(" "), class: "thumbnail", "aria-hidden": "true" };
  return svgOf("svg", frame, ...layers, ...more);
}
