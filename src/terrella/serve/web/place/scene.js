// The Gaussians of a place as columns, unpacked from what serve/place_page.py packed.

const UNPACKED = { means: 3, quats: 4, scales: 3, colours: 3, opacities: 1 };

/**
 * N Gaussians: means, quats (w x y z), scales, colours and opacities as float32, metres; seen 1 or 0, objects: numbers, 0 for none and -k
 * for what is hidden beneath k, whose names 1, 2, ... `names` lists; boxes, as boxes.js has them, where they are what stops bodies, else null;
 * before: how many of them, the first ones, were there before all edits.
 */
export class Scene {
  constructor(columns, names = [], boxes = null, before = columns.opacities.length) {
    Object.assign(this, columns, { names, boxes, before });
    this.length = this.opacities.length;
  }

  /** Its columns copied, for an edit to write into. */
  copy() {
    return new Scene(Object.fromEntries(Scene.columns.map((name) => [name, this[name].slice()])), this.names, null, this.before);
  }

  /** Those whose numbers `keep` lists, in its order; a number may come twice. */
  at(keep) {
    const columns = {};
    for (const name of Scene.columns) {
      const from = this[name], wide = from.length / this.length, to = new from.constructor(keep.length * wide);
      for (let at = 0; at < keep.length; at += 1) for (let part = 0; part < wide; part += 1) to[at * wide + part] = from[keep[at] * wide + part];
      columns[name] = to;
    }
    return new Scene(columns, this.names, null, keep.reduce((sum, k) => sum + (k < this.before), 0));
  }
}
Scene.columns = [...Object.keys(UNPACKED), 'seen', 'objects'];

/** All of one scene, then all of another. */
export function joined(one, other) {
  return new Scene(Object.fromEntries(Scene.columns.map((name) => {
    const both = new one[name].constructor(one[name].length + other[name].length);
    both.set(one[name]);
    both.set(other[name], one[name].length);
    return [name, both];
  })), one.names, one.boxes, one.before);
}

/** base64 as bytes. */
export const decoded = (text) => Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));

/** What gzip packed. */
export async function inflate(packed) {
  return new Uint8Array(await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer());
}

/** Reads columns one after another; numbers of several bytes lie byte by byte: all first bytes, then all second ones. */
export class Reader {
  constructor(bytes) { Object.assign(this, { bytes, at: 0 }); }

  take(count, Kind = Uint8Array) {
    const wide = Kind.BYTES_PER_ELEMENT, out = new Uint8Array(count * wide);
    for (let byte = 0; byte < wide; byte += 1) for (let k = 0; k < count; k += 1) out[k * wide + byte] = this.bytes[this.at++];
    return new Kind(out.buffer);
  }
}

export function unpackScene(reader, { count, objects, boxes, closed }) {
  const means = reader.take(3 * count, Float32Array), packed = reader.take(count, Uint32Array);
  const scales = Float32Array.from(reader.take(3 * count), (byte) => Math.exp(byte / 16 - 10));
  const colours = Float32Array.from(reader.take(3 * count), (byte) => byte / 204);
  const opacities = Float32Array.from(reader.take(count), (byte) => byte / 255);
  const columns = { means, quats: unpackQuats(packed), scales, colours, opacities, seen: reader.take(count), objects: reader.take(count, Int32Array) };
  return Object.assign(new Scene(columns, objects, boxes?.length ? boxes : null), { closed });
}

/** Which of w, x, y, z is largest in 2 bits, the three others in 10 each. */
function unpackQuats(packed) {
  const quats = new Float32Array(packed.length * 4);
  for (let k = 0; k < packed.length; k += 1) {
    const which = packed[k] >>> 30;
    let left = 1;
    for (let part = 0, shift = 20; part < 4; part += 1) {
      if (part === which) continue;
      const value = (((packed[k] >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2;
      quats[4 * k + part] = value;
      left -= value * value;
      shift -= 10;
    }
    quats[4 * k + which] = Math.sqrt(Math.max(left, 0));
  }
  return quats;
}
