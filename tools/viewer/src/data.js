// The page's data: JSON with typed arrays as base64.
const DECODERS = { f4: Float32Array, i4: Int32Array, i2: Int16Array, u1: Uint8Array };

function decoded(value) {
  if (value && value.b64 !== undefined) {
    const bytes = Uint8Array.from(atob(value.b64), (c) => c.charCodeAt(0));
    return new DECODERS[value.type](bytes.buffer);
  }
  return value;
}

export function read(element) {
  const raw = JSON.parse(element.textContent);
  const walk = (v) => {
    if (Array.isArray(v)) return v.map(walk);
    if (v && typeof v === 'object') return v.b64 !== undefined ? decoded(v) : Object.fromEntries(Object.entries(v).map(([k, x]) => [k, walk(x)]));
    return v;
  };
  return walk(raw);
}

export function bounds(arrays) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const [xs, ys] of arrays) {
    for (let i = 0; i < xs.length; i++) {
      if (xs[i] < box[0]) box[0] = xs[i];
      if (xs[i] > box[2]) box[2] = xs[i];
      if (ys[i] < box[1]) box[1] = ys[i];
      if (ys[i] > box[3]) box[3] = ys[i];
    }
  }
  return Number.isFinite(box[0]) ? box : [-10, -10, 10, 10];
}
