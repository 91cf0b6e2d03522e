// A world of frames: what a step makes of the last frames and an action (worlds/frame_history.py, worlds/scroll.py, space/mosaic.py).

const VOTES = { same: 8, most: 20 }, EDGES = { same: 16, textured: 12 }, KEPT = { count: 24, cells: 8, unlike: 0.03 };

export class FlatWorld {
  /** about: "thumbnail", "moves", "over" and "starts", each [frames, actions, known, scroll, place] with slices of `bytes`; "ground". */
  constructor(network, about, bytes) {
    Object.assign(this, { network, about, bytes });
    [this.height, this.width] = network.size;
    this.pixels = this.height * this.width;
    this.moves = about.moves;
    this.scrolls = about.moves.length > 1;
    const part = (slice) => slice && bytes.subarray(slice[0], slice[0] + slice[1]);
    this.over = part(about.over);
    this.ground = about.ground && { bytes: part(about.ground.bytes), size: about.ground.size };
    this.starts = about.starts.map((start) => ({ ...start, frames: part(start.frames), known: part(start.known) }));
    this.wide = { size: [4 * this.height, 5 * this.width] };  // of a mosaic
  }

  /** Where an episode begins. frames: Uint8Array [pixels, 3] each, the newest first; actions: the oldest first. */
  start(number) {
    const { frames, actions, known, scroll, place } = this.starts[number], size = 3 * this.pixels;
    const state = { frames: this.network.slots && Array.from({ length: this.network.slots }, (_, i) => frames.slice(i * size, (i + 1) * size)), actions, scroll, place, kept: [] };
    if (this.scrolls) {
      const [tall, wide] = this.wide.size, top = (tall - this.height) / 2, left = (wide - this.width) / 2;
      state.mosaic = new Uint8Array(4 * tall * wide);
      for (let y = 0; y < this.height; y++)
        state.mosaic.set(known.subarray(4 * y * this.width, 4 * (y + 1) * this.width), 4 * ((top + y) * wide + left));
    }
    return state;
  }

  /** The state after an encoded action, drawn in `steps` steps from `noise` (Float32Array [pixels, 3]). */
  step(state, action, noise, steps) {
    const actions = [...state.actions.slice(1), action], frames = state.frames.map(toSigned), newest = state.frames[0];
    const context = [...this.thumbnail(newest), ...actions.toReversed().flat()];
    let base = frames[0], known = null, more = {};
    if (this.scrolls) {
      const mosaic = this.joinedMosaic(state), scroll = this.predicted(state, context);
      known = cut(mosaic, this.wide.size, this.network.size, this.moves[scroll]);
      for (let p = 0; p < this.pixels; p++) if (this.over[p]) known.fill(0, 4 * p, 4 * p + 4);
      base = this.carried(frames[0], scroll, known);
      const [x, y] = this.moves[scroll];
      more = { mosaic, scroll, place: state.place && [state.place[0] - x, state.place[1] - y] };
    }
    const drawn = this.network.sample(frames, context, base, known, noise, steps, (draft) => this.recalled(state.kept, draft, base));
    const frame = Uint8Array.from(drawn, (value) => Math.min(255, Math.max(0, 128 + 127.5 * value)));
    const kept = this.network.recalls ? this.keep(state.kept, state.frames.at(-1)) : state.kept;
    return { ...state, ...more, kept, actions, frames: [frame, ...state.frames.slice(0, -1)] };
  }

  /** The mean colours in -1..1 of the cells of a frame, colour by colour. */
  thumbnail(frame) {
    const [rows, columns] = this.about.thumbnail;
    return means(frame, this.height, this.width, rows, columns).map((value) => value / 127.5 - 1);
  }

  // -- pictures that scroll

  /** By which of the moves most of the picture goes on. */
  predicted({ frames }, context) {
    const { network, height, width, moves } = this, tall = height >> 1, wide = width >> 1;
    const small = network.room('glance', tall * wide * 3), to = network.numbers(small, tall * wide * 3);
    for (let y = 0; y < tall; y++)
      for (let x = 0; x < wide; x++)
        for (let i = 0; i < 3; i++) {
          const at = (2 * y * width + 2 * x) * 3 + i, below = at + 3 * width;
          to[(y * wide + x) * 3 + i] = (frames[0][at] + frames[0][at + 3] + frames[0][below] + frames[0][below + 3]) / 510 - 1;
        }
    let x = network.apply('scrolling.glance.1', small, tall, wide, 4, 4);
    const rows = Math.floor((tall - 4) / 4) + 1, columns = Math.floor((wide - 4) / 4) + 1;
    network.wasm.silu(x, rows * columns * network.layer['scrolling.glance.1'].outputs);
    x = network.apply('scrolling.glance.3', x, rows, columns, 2, 2);
    const layer = network.layer['scrolling.glance.6'], glance = [...network.numbers(x, layer.inputs)].map((value) => value / (1 + Math.exp(-value)));
    const seen = network.numbers(network.perceptron(['scrolling.glance.6'], glance, true), layer.outputs);
    const went = frames.slice(1).flatMap((before, number) => {
      const shares = this.edgeShares(before, frames[number]), most = Math.max(0.01, ...shares);
      return shares.map((share) => (share / most) ** 4);
    });
    const votes = network.numbers(network.perceptron(['scrolling.known', 'scrolling.votes'], [...seen, ...context, ...went], false), moves.length);
    const top = Math.max(...votes), shares = [...votes].map((vote) => Math.exp(vote - top));
    const off = moves.map(([x, y]) => shares.reduce((sum, share, other) => sum + share * (Math.abs(x - moves[other][0]) + Math.abs(y - moves[other][1])), 0));
    return off.indexOf(Math.min(...off));
  }

  /** The share of the edges of `after` that each move brings from `before`. */
  edgeShares(before, after) {
    const { height, width, moves } = this, same = moves.map(() => 0);
    let edges = 0;
    for (let y = 1; y < height; y += 2)
      for (let x = 1; x < width; x += 2) {
        const at = 3 * (y * width + x), up = at - 3 * width, left = at - 3;
        if (apart(after, at, after, up) <= EDGES.textured && apart(after, at, after, left) <= EDGES.textured) continue;
        edges++;
        moves.forEach(([dx, dy], number) => {
          const [column, row] = [x - dx, y - dy];
          if (column < 1 || row < 1 || column >= width || row >= height) return;
          const from = 3 * (row * width + column);
          if (Math.max(apart(before, from, after, at), apart(before, from - 3 * width, after, up), apart(before, from - 3, after, left)) <= EDGES.same) same[number]++;
        });
      }
    return same.map((count) => count / Math.max(1, edges));
  }

  /** The mosaic with the newest frame in its middle, the ground of the recordings first. */
  joinedMosaic({ mosaic, frames, scroll, place }) {
    const { height, width, over, wide: { size } } = this, after = cut(mosaic, size, size, this.moves[scroll]);
    const top = (size[0] - height) / 2, left = (size[1] - width) / 2, frame = frames[0];
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++) {
        const p = y * width + x, at = 4 * ((top + y) * size[1] + left + x);
        if (over[p]) continue;
        const same = apart(after, at, frame, 3 * p) <= VOTES.same;
        const votes = after[at + 3];
        if (!(votes + same > 1)) for (let i = 0; i < 3; i++) after[at + i] = frame[3 * p + i];
        after[at + 3] = Math.min(VOTES.most + 1, Math.max(2, votes + 2 * same)) - 1;
      }
    if (!this.ground) return after;
    const ground = this.ground.size, middle = [Math.floor((ground[1] - size[1]) / 2), Math.floor((ground[0] - size[0]) / 2)];
    const shown = cut(this.ground.bytes, ground, size, [middle[0] - (place[0] - left), middle[1] - (place[1] - top)]);
    const whole = new Uint32Array(after.buffer), under = new Uint32Array(shown.buffer);
    for (let p = 0; p < whole.length; p++) if (shown[4 * p + 3]) whole[p] = under[p];
    return after;
  }

  /** A frame in -1..1 that went on by a move; what lies over it stays, and what comes in is as remembered, else as at the nearest edge. */
  carried(last, scroll, known) {
    const { height, width, over } = this, [dx, dy] = this.moves[scroll], to = new Float32Array(last.length);
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++) {
        const p = y * width + x, column = Math.min(width - 1, Math.max(0, x - dx)), row = Math.min(height - 1, Math.max(0, y - dy));
        const from = row * width + column, inside = column === x - dx && row === y - dy;
        for (let i = 0; i < 3; i++)
          to[3 * p + i] = over[p] ? last[3 * p + i] : (over[from] || !inside) && known[4 * p + 3] ? known[4 * p + i] / 127.5 - 1 : last[3 * from + i];
      }
    return to;
  }

  // -- pictures that change as a whole (space/recall.py)

  /** Earlier frames after one more, the newest first: it is kept if it is unlike all of them. */
  keep(kept, frame) {
    const key = means(frame, this.height, this.width, KEPT.cells, KEPT.cells).map((value) => value / 255);
    return kept.some((one) => difference(one.key, key) <= KEPT.unlike) ? kept : [{ frame, key }, ...kept].slice(0, KEPT.count);
  }

  /** The kept frame that is most like a draft, as memory relative to the base; null where nothing is kept. */
  recalled(kept, draft, base) {
    if (!kept.length) return null;
    const key = means(draft, this.height, this.width, KEPT.cells, KEPT.cells).map((value) => value / 2 + 0.5);
    const off = kept.map((one) => difference(one.key, key)), { frame } = kept[off.indexOf(Math.min(...off))];
    const known = new Uint8Array(4 * this.pixels);
    for (let p = 0; p < this.pixels; p++) known.set([frame[3 * p], frame[3 * p + 1], frame[3 * p + 2], 255], 4 * p);
    return this.network.relative(known, base);
  }
}

const toSigned = (frame) => Float32Array.from(frame, (value) => value / 127.5 - 1);
const apart = (one, at, other, to) => Math.max(Math.abs(one[at] - other[to]), Math.abs(one[at + 1] - other[to + 1]), Math.abs(one[at + 2] - other[to + 2]));
const difference = (one, other) => one.reduce((sum, value, i) => sum + Math.abs(value - other[i]), 0) / one.length;

/** The middle `size` of maps [pixels, 4] displaced by a move; 0 where nothing is. */
function cut(maps, whole, size, [dx, dy]) {
  const top = Math.floor((whole[0] - size[0]) / 2) - dy, left = Math.floor((whole[1] - size[1]) / 2) - dx, to = new Uint8Array(4 * size[0] * size[1]);
  const first = Math.max(0, -left), last = Math.min(size[1], whole[1] - left);
  for (let y = Math.max(0, -top); y < Math.min(size[0], whole[0] - top) && last > first; y++) {
    const from = (top + y) * whole[1] + left;
    to.set(maps.subarray(4 * (from + first), 4 * (from + last)), 4 * (y * size[1] + first));
  }
  return to;
}

/** The means of cells of a frame [pixels, 3]: colour by colour, row by row (adaptive average pooling). */
function means(frame, height, width, rows, columns) {
  const cells = [];
  for (let i = 0; i < 3; i++)
    for (let row = 0; row < rows; row++)
      for (let column = 0; column < columns; column++) {
        const [top, low] = [Math.floor(row * height / rows), Math.ceil((row + 1) * height / rows)];
        const [left, right] = [Math.floor(column * width / columns), Math.ceil((column + 1) * width / columns)];
        let sum = 0;
        for (let y = top; y < low; y++) for (let x = left; x < right; x++) sum += frame[3 * (y * width + x) + i];
        cells.push(sum / ((low - top) * (right - left)));
      }
  return cells;
}
