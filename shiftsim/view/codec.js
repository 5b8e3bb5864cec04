"use strict";
// Reads the sections that scene.py packs: a Map from field name to {shape, data, whole}, whose data
// are whole steps times a step; `base` is the section that some fields are stored from.

const MISSING = -2147483648;

function readSection(id, base) {
  return unpack(document.getElementById(`data-${id}`).textContent, base);
}

async function unpack(text, base) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return readFields(new Uint8Array(await new Response(stream).arrayBuffer()), base);
}

function readFields(bytes, base) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const headerEnd = 4 + view.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, headerEnd)));
  const fields = new Map();
  let at = headerEnd;
  for (const { name, shape, step, base: isBased } of header) {
    const count = shape.reduce((a, b) => a * b, 1);
    const part = bytes.subarray(at, (at += step ? 4 * count : count));
    const whole = step ? wholeSteps(part, count, shape[0], isBased && base.get(name).whole) : part;
    const data = step ? Float32Array.from(whole, (n) => (n === MISSING ? NaN : n * step)) : part;
    fields.set(name, { shape, data, whole });
  }
  return fields;
}

// four byte planes of int32, second differences of one series after the other
function wholeSteps(planes, count, rows, base) {
  const out = new Int32Array(count);
  const series = count / rows;
  for (let i = 0, value, slope; i < count; i++) {
    const bits =
      planes[i] | (planes[count + i] << 8) | (planes[2 * count + i] << 16) | (planes[3 * count + i] << 24);
    const difference = (bits >>> 1) ^ -(bits & 1);
    const row = i % rows;
    if (row < 2) slope = difference;
    else slope = (slope + difference) | 0;
    value = row ? (value + slope) | 0 : difference;
    const place = row * series + Math.floor(i / rows);
    out[place] = base ? value + base[place] : value;
  }
  return out;
}
