"use strict";
// Reads the sections that pack.py writes: a Map from field name to {shape, data}.

const MISSING = -2147483648;

function readSection(id) {
  return unpack(document.getElementById(`data-${id}`).textContent);
}

async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return readFields(new Uint8Array(await new Response(stream).arrayBuffer()));
}

function readFields(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const headerEnd = 4 + view.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, headerEnd)));
  const fields = new Map();
  let at = headerEnd;
  for (const { name, shape, step } of header) {
    const count = shape.reduce((a, b) => a * b, 1);
    const size = step ? 4 * count : count;
    const part = bytes.subarray(at, at + size);
    const data = step ? dequantise(part, count, shape, step) : part;
    fields.set(name, { shape, data });
    at += size;
  }
  return fields;
}

// four byte planes of int32 differences along the first axis
function dequantise(planes, count, shape, step) {
  const whole = new Int32Array(count);
  const out = new Float32Array(count);
  const row = shape.length ? count / Math.max(shape[0], 1) : 1;
  for (let i = 0; i < count; i++) {
    const difference =
      planes[i] |
      (planes[count + i] << 8) |
      (planes[2 * count + i] << 16) |
      (planes[3 * count + i] << 24);
    whole[i] = i < row ? difference : (whole[i - row] + difference) | 0;
    out[i] = whole[i] === MISSING ? NaN : whole[i] * step;
  }
  return out;
}
