// The flow network of a world of frames (worlds/flow.py), by the arithmetic of kernels.c. Maps are [height, width, channels].

const SQUARE = 4, DETAIL = 16, HEADS = 4, GROUPS = 8, FREQUENCIES = 8, STAYS = 0.04, RECALLED = 0.15;

/** float16 as float32. */
function single(half) {
  const sign = half & 0x8000 ? -1 : 1, power = (half >> 10) & 31, rest = half & 1023;
  return power ? sign * 2 ** (power - 15) * (1 + rest / 1024) : sign * 2 ** -24 * rest;
}

export class Network {
  /** about: "size", "slots", "channels", "steps", "times" (of one drawing step, of two ...), "recalls", "remembers" and "layers", [name,
   * inputs, outputs] in the order of `weights`, a Uint16Array of float16: of each layer its matrix in panels of eight outputs, and its bias;
   * then its "vectors", [name, length]. */
  constructor(exports, about, weights) {
    Object.assign(this, about);
    this.wasm = exports;
    this.free = (exports.heap() + 15) & ~15;
    this.rooms = new Map();
    const table = Float32Array.from({ length: 65536 }, (_, half) => single(half));
    let at = 0;
    const read = (count) => {
      const to = this.take(count);
      const numbers = this.numbers(to, count);
      for (let i = 0; i < count; i++) numbers[i] = table[weights[at + i]];
      at += count;
      return to;
    };
    this.layer = {};
    for (const [name, inputs, outputs] of about.layers) {
      const wide = Math.ceil(outputs / 8) * 8;
      this.layer[name] = { inputs, outputs, matrix: read(inputs * wide), bias: read(wide) };
    }
    this.vector = Object.fromEntries(about.vectors.map(([name, count]) => [name, read(count)]));
    const [height, width] = about.size, whole = 4 * SQUARE;
    this.tall = Math.ceil(height / whole) * whole;
    this.wide = Math.ceil(width / whole) * whole;
    this.reserve(this.tall * this.wide * 8 * (32 + about.channels.reduce((sum, count) => sum + count)));
  }

  /** Makes room for `bytes` more: views of the memory end when it grows, so it does not grow while a frame is drawn. */
  reserve(bytes) {
    const { memory } = this.wasm, lacks = this.free + bytes - memory.buffer.byteLength;
    if (lacks > 0) memory.grow(Math.ceil(lacks / 65536));
  }

  /** Memory for `count` numbers, which stays. */
  take(count) {
    const at = this.free, size = 4 * count + 64;  // kernels read and write up to four numbers at once
    this.reserve(size);
    this.free = (at + size) & ~15;
    return at;
  }

  /** The memory of this name, which is used again for each frame. */
  room(name, count) {
    const key = `${name} ${count}`;
    if (!this.rooms.has(key)) this.rooms.set(key, this.take(count));
    return this.rooms.get(key);
  }

  numbers(at, count) {
    return new Float32Array(this.wasm.memory.buffer, at, count);
  }

  /** A layer of squares of `side` pixels over maps at x, or of vectors (rows of 1 x 1 pixels). Where its result lies. */
  apply(name, x, height, width, side = 1, stride = 1, pad = 0, out = name) {
    const { inputs, outputs, matrix, bias } = this.layer[name];
    const tall = Math.floor((height + 2 * pad - side) / stride) + 1, wide = Math.floor((width + 2 * pad - side) / stride) + 1;
    const to = this.room(out, tall * wide * outputs);
    this.wasm.convolve(x, height, width, inputs / (side * side), side, stride, pad, matrix, bias, outputs, to);
    return to;
  }

  /** Layers of one vector with SiLU between them, and after the last one if `end`. */
  perceptron(names, vector, end) {
    let x = this.room(`${names[0]} in`, vector.length);
    this.numbers(x, vector.length).set(vector);
    names.forEach((name, number) => {
      x = this.apply(name, x, 1, 1);
      if (end || number + 1 < names.length) this.wasm.silu(x, this.layer[name].outputs);
    });
    return x;
  }

  /** The scale and shift of a block by an embedding. */
  modulation(block, embedding) {
    const at = this.apply(`${block}.embedding`, embedding, 1, 1), channels = this.layer[`${block}.embedding`].outputs / 2;
    const scale = this.numbers(at, channels);
    for (let i = 0; i < channels; i++) scale[i] += 1;
    return [at, at + 4 * channels];
  }

  /** Maps normalised, scaled and shifted, after SiLU. */
  normalised(name, x, pixels, channels, scale, shift) {
    const out = this.room(`inner ${channels}`, pixels * channels);
    this.wasm.normalise(x, pixels, channels, GROUPS, this.vector[`${name}.weight`], this.vector[`${name}.bias`], scale, shift, out);
    return out;
  }

  /** The maps at x as the last layers see them: normalised, but in worlds of earlier releases. */
  settled(x, pixels, channels) {
    if (!this.vector['norm.weight']) return x;
    const scale = this.room('ones', channels), shift = this.room('zeros', channels);
    this.numbers(scale, channels).fill(1);
    this.numbers(shift, channels).fill(0);
    return this.normalised('norm', x, pixels, channels, scale, shift);
  }

  /** AdaptiveBlock: changes the maps at x. */
  block(name, x, height, width, embedding) {
    const channels = this.layer[`${name}.first`].outputs, pixels = height * width;
    const inner = this.normalised(`${name}.norm`, x, pixels, channels, ...this.modulation(name, embedding));
    const first = this.apply(`${name}.first`, inner, height, width, 3, 1, 1, `first ${channels}`);
    this.wasm.silu(first, pixels * channels);
    this.wasm.add(x, this.apply(`${name}.second`, first, height, width, 3, 1, 1, `second ${channels}`), pixels * channels);
    return x;
  }

  /** Maps, [pixels, channels] each, side by side as one, with edges repeated to `tall` x `wide`. */
  joined(name, parts, tall = this.size[0], wide = this.size[1]) {
    const [height, width] = this.size, channels = parts.reduce((sum, [, count]) => sum + count, 0);
    const at = this.room(name, tall * wide * channels), to = this.numbers(at, tall * wide * channels);
    let first = 0;
    for (const [part, count, row = width] of parts) {
      for (let y = 0; y < tall; y++)
        for (let x = 0; x < wide; x++) {
          const from = (Math.min(y, height - 1) * row + Math.min(x, width - 1)) * count, into = (y * wide + x) * channels + first;
          for (let i = 0; i < count; i++) to[into + i] = part[from + i];
        }
      first += count;
    }
    return at;
  }

  /** What the first half makes of frames (Float32Array [pixels, 3] in -1..1 each, the newest first) and a context. */
  encode(frames, context, base, remembered) {
    const { tall, wide } = this, [fine, middle, coarse] = this.channels;
    const embedding = this.perceptron(['actions.0', 'actions.2'], context, true);
    const sizes = [[tall / 4, wide / 4], [tall / 8, wide / 8], [tall / 16, wide / 16]];
    let x = this.apply('enter', this.joined('history', frames.map((frame) => [frame, 3]), tall, wide), tall, wide, SQUARE, SQUARE);
    const maps = [this.block('before.0', x, ...sizes[0], embedding)];
    for (const level of [0, 1]) {
      x = this.apply(`down.${level}`, x, ...sizes[level], 2, 2);
      maps.push(this.block(`before.${level + 1}`, x, ...sizes[level + 1], embedding));
    }
    const tokens = sizes[2][0] * sizes[2][1], seen = this.room('attended', tokens * coarse);
    this.wasm.attend(this.apply('attention.in', x, 1, tokens), tokens, coarse, HEADS, this.room('scores', tokens), seen);
    this.wasm.add(x, this.apply('attention.out', seen, 1, tokens), tokens * coarse);
    return { maps, sizes, counts: [fine, middle, coarse], embedding, base, older: frames[Math.min(1, frames.length - 1)], remembered };
  }

  /** The clean frame by `noisy` at a flow time: Float32Array [pixels, 3], used again by the next call. */
  clean(seen, noisy, time) {
    const { tall, wide, size: [height, width] } = this, { maps, sizes, counts, base, older, remembered } = seen;
    const waves = Array.from({ length: 2 * FREQUENCIES }, (_, i) => {
      const angle = time * 2 ** (i % FREQUENCIES) * Math.PI / 2;
      return i < FREQUENCIES ? Math.sin(angle) : Math.cos(angle);
    });
    const width128 = this.layer['actions.2'].outputs, embedding = this.room('embedding', width128);
    this.numbers(embedding, width128).set(this.numbers(this.perceptron(['time.0', 'time.2'], waves, false), width128));
    this.wasm.add(embedding, seen.embedding, width128);
    const change = noisy.map((value, i) => value - base[i]);
    const memory = remembered ? [[remembered, 4]] : [];
    const entering = this.joined('entering', [[change, 3], [base, 3], ...memory], tall, wide);
    const pixels = sizes.map(([rows, columns]) => rows * columns);
    const sum = (level, x) => { this.wasm.add(x, maps[level], pixels[level] * counts[level]); return x; };
    const fine = this.block('drawn', sum(0, this.apply('enter_drawn', entering, tall, wide, SQUARE, SQUARE)), ...sizes[0], embedding);
    const middle = sum(1, this.apply('down_drawn.0', fine, ...sizes[0], 2, 2));
    let x = this.block('after.0', sum(2, this.apply('down_drawn.1', middle, ...sizes[1], 2, 2)), ...sizes[2], embedding);
    [[1, middle], [0, fine]].forEach(([level, skip], number) => {
      const up = this.apply(`up.${number}`, x, ...sizes[level + 1]);
      x = this.room(`upper ${level}`, pixels[level] * counts[level]);
      this.wasm.unfold(up, ...sizes[level + 1], 2, counts[level], x);
      this.wasm.add(x, skip, pixels[level] * counts[level]);
      this.block(`after.${number + 1}`, x, ...sizes[level], embedding);
    });
    this.block('after.3', x, ...sizes[0], embedding);
    const detail = this.room('fine detail', tall * wide * DETAIL);
    this.wasm.unfold(this.apply('detail', this.settled(x, pixels[0], counts[0]), ...sizes[0]), ...sizes[0], SQUARE, DETAIL, detail);
    const parts = [[this.numbers(detail, tall * wide * DETAIL), DETAIL, wide], [change, 3], [base, 3], [older, 3]];
    const near = this.apply('near', this.joined('nearby', [...parts, ...(this.recalls ? memory : [])]), height, width, 3, 1, 1);
    this.wasm.silu(near, height * width * this.layer.near.outputs);
    const drawn = this.numbers(this.apply('output', near, height, width, 3, 1, 1), height * width * 3);
    return drawn.map((value, i) => value + base[i]);
  }

  /** The next frame, Float32Array [pixels, 3] in -1..1: drawn from `noise` in `steps` steps. known: memory, Uint8Array [pixels, 4], or null;
   * recall(draft): memory of an earlier frame that is like it, relative to the base, or null. */
  sample(frames, context, base, known, noise, steps, recall) {
    const relative = known ? this.relative(known, base) : this.remembers ? new Float32Array(base.length / 3 * 4) : null;
    const seen = this.encode(frames, context, base, relative);
    let x = base;
    for (const [step, time] of this.times[steps - 1].entries()) {
      if (step === 1 && this.recalls) seen.remembered = recall(x) ?? relative;
      const noisy = time ? x.map((value, i) => noise[i] + time * (Math.min(1, Math.max(-1, value)) - noise[i])) : base;
      x = this.clean(seen, noisy, time);
    }
    keepAlike(x, base, STAYS);
    if (known) keepAlike(x, Float32Array.from({ length: x.length }, (_, i) => known[4 * Math.floor(i / 3) + i % 3] / 127.5 - 1), RECALLED, known);
    return x;
  }

  /** Memory as maps [pixels, 4]: colours relative to the base, 0 where unknown, and whether known. */
  relative(known, base) {
    const maps = new Float32Array(known.length);
    for (let p = 0; p < known.length / 4; p++) {
      if (!known[4 * p + 3]) continue;
      for (let i = 0; i < 3; i++) maps[4 * p + i] = known[4 * p + i] / 127.5 - 1 - base[3 * p + i];
      maps[4 * p + 3] = 1;
    }
    return maps;
  }
}

/** Pixels of x whose colours differ by less than `most` from those of `other` become these; of `known` pixels alone, if given. */
function keepAlike(x, other, most, known = null) {
  for (let p = 0; p < x.length; p += 3) {
    if (known && !known[p / 3 * 4 + 3]) continue;
    if (Math.max(Math.abs(x[p] - other[p]), Math.abs(x[p + 1] - other[p + 1]), Math.abs(x[p + 2] - other[p + 2])) < most)
      for (let i = 0; i < 3; i++) x[p + i] = other[p + i];
  }
}
