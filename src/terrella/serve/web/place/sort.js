// The Gaussians that a camera sees, nearest first, small ones thinned out: a counting sort in a worker.

/**
 * The worker's whole program: it is sent as text. It gets {means, scales, opacities, seen} once and after edits, then one view after another.
 * Of more than `most` in sight, one Gaussian is drawn for each cube of a grid, whose size grows with the distance: so small things go
 * first, and no surface is left open. `coarse` is the size of the cubes, in metres for each metre away.
 */
function sorting() {
  const BINS = 65536, RINGS = 256, NEAREST = 0.05, FARTHEST = 2000, octave = (RINGS - 1) / Math.log(FARTHEST / NEAREST);
  const ASIDE = 1.12, FINEST = 0.01, LEVELS = 14, STEPS = 64, MOST_COARSE = 1;
  const ringOf = (metres) => Math.max(0, Math.min(RINGS - 1, Math.floor(octave * Math.log(metres / NEAREST))));
  let ring = new Uint8Array(0), means = new Float32Array(0), reach = new Float32Array(0), depth = new Float32Array(0), levels = null, scales, opacities, known;
  const counts = new Uint32Array(BINS + 1), rings = new Uint32Array(RINGS * (LEVELS + 1));

  /** Of each Gaussian the number of the largest cubes (FINEST, twice that, ...) for which it may stand, those that were seen and are larger first; 0: none. */
  function levelled() {
    const many = depth.length, size = 2 ** Math.ceil(Math.log2(2 * many + 2)), keys = new Float64Array(size), used = new Uint8Array(size), level = new Uint8Array(many);
    const bins = new Uint32Array(258), order = new Uint32Array(many), bin = (k) => (opacities[k] < 0.3 || !known[k] ? 256 : 255 - Math.max(0, Math.min(255, Math.round((Math.log(reach[k]) + 10) * 16))));
    for (let k = 0; k < many; k += 1) bins[bin(k) + 1] += 1;
    for (let k = 0; k < 257; k += 1) bins[k + 1] += bins[k];
    for (let k = 0; k < many; k += 1) order[bins[bin(k)]++] = k;
    /** Whether the cube of a Gaussian was free; it is not from now on. */
    const claim = (k, cell) => {
      const x = Math.floor(means[3 * k] / cell) & 131071, y = Math.floor(means[3 * k + 1] / cell) & 131071, z = Math.floor(means[3 * k + 2] / cell) & 131071;
      const key = x + 131072 * (y + 131072 * z);
      let at = (Math.imul(x, 73856093) ^ Math.imul(y, 19349663) ^ Math.imul(z, 83492791)) >>> 0 & (size - 1);
      for (; used[at]; at = (at + 1) & (size - 1)) if (keys[at] === key) return false;
      used[at] = 1;
      keys[at] = key;
      return true;
    };
    for (let at = LEVELS; at > 0; at -= 1) {
      const cell = FINEST * 2 ** (at - 1);
      used.fill(0);
      for (let k = 0; k < many; k += 1) if (level[k]) claim(k, cell);
      for (const k of order) if (!level[k] && claim(k, cell)) level[k] = at;
    }
    return level;
  }

  /** The level that is drawn in a ring of distances. */
  const levelAt = (of, coarse) => Math.max(0, Math.min(LEVELS, 1 + Math.floor(Math.log2((coarse * NEAREST * Math.exp(of / octave)) / FINEST))));

  /** The finest cubes with which no more than `most` Gaussians are drawn. */
  function coarseFor(most) {
    for (let step = 0; step < STEPS; step += 1) {
      const coarse = 0.001 * (MOST_COARSE / 0.001) ** (step / (STEPS - 1));
      let drawn = 0;
      for (let of = 0; of < RINGS; of += 1) for (let at = levelAt(of, coarse); at <= LEVELS; at += 1) drawn += rings[of * (LEVELS + 1) + at];
      if (drawn <= most) return coarse;
    }
    return MOST_COARSE;
  }

  onmessage = ({ data }) => {
    if (data.means) {
      ({ means, scales, opacities, seen: known } = data);
      depth = new Float32Array(means.length / 3);
      ring = new Uint8Array(depth.length);
      reach = new Float32Array(depth.length);
      levels = null;
      for (let k = 0; k < reach.length; k += 1) reach[k] = 3.34 * Math.max(scales[3 * k], scales[3 * k + 1], scales[3 * k + 2]);
      return;
    }
    const { eye, ahead, right, up, wide, tall, near, most = Infinity, id } = data, [ex, ey, ez] = eye, [ax, ay, az] = ahead, [rx, ry, rz] = right, [ux, uy, uz] = up;
    const across = Math.hypot(1, wide), upright = Math.hypot(1, tall);
    let low = Infinity, high = -Infinity, shown = 0, all = 0;
    if (most < Infinity) levels ??= levelled();
    rings.fill(0);
    for (let k = 0; k < depth.length; k += 1) {
      const x = means[3 * k] - ex, y = means[3 * k + 1] - ey, z = means[3 * k + 2] - ez, d = x * ax + y * ay + z * az;
      depth[k] = -1;
      if (!opacities[k] || d < near || Math.abs(x * rx + y * ry + z * rz) - wide * ASIDE * d > reach[k] * across || Math.abs(x * ux + y * uy + z * uz) - tall * ASIDE * d > reach[k] * upright) continue;
      depth[k] = d;
      all += 1;
      if (most < Infinity) rings[(ring[k] = ringOf(Math.sqrt(x * x + y * y + z * z))) * (LEVELS + 1) + levels[k]] += 1;
    }
    const coarse = all > most ? coarseFor(most) : 0, least = Uint8Array.from({ length: RINGS }, (_, of) => (coarse ? levelAt(of, coarse) : 0));
    for (let k = 0; k < depth.length; k += 1) {
      if (depth[k] < 0) continue;
      if (coarse && levels[k] < least[ring[k]]) { depth[k] = -1; continue; }
      shown += 1;
      if (depth[k] < low) low = depth[k];
      if (depth[k] > high) high = depth[k];
    }
    const step = (BINS - 1) / Math.max(high - low, 1e-6), order = new Uint32Array(shown);
    counts.fill(0);
    for (let k = 0; k < depth.length; k += 1) if (depth[k] >= 0) counts[Math.floor((depth[k] - low) * step) + 1] += 1;
    for (let bin = 0; bin < BINS; bin += 1) counts[bin + 1] += counts[bin];
    for (let k = 0; k < depth.length; k += 1) if (depth[k] >= 0) order[counts[Math.floor((depth[k] - low) * step)]++] = k;
    postMessage({ order, coarse, all, id }, [order.buffer]);
  };
}

export class Sorter {
  constructor(onOrder) {
    const program = URL.createObjectURL(new Blob([`(${sorting})()`], { type: 'text/javascript' }));
    Object.assign(this, { onOrder, worker: new Worker(program), busy: false, waiting: null, id: 0, oldest: 0 });
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      if (data.id >= this.oldest) this.onOrder({ ...data, view: this.view });
      if (this.waiting) this.ask(this.waiting);
    };
  }

  set(scene) {
    const means = scene.means.slice();
    this.oldest = this.id + 1;  // orders of the scene before are not drawn
    this.worker.postMessage({ means, scales: scene.scales, opacities: scene.opacities, seen: scene.seen }, [means.buffer]);
  }

  ask(view) {
    this.waiting = this.busy ? view : null;
    if (this.busy) return;
    Object.assign(this, { busy: true, view });
    this.worker.postMessage({ ...view, id: ++this.id });
  }
}
