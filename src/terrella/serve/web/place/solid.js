// The occupancy grid of a place, and how a walker moves in it, as in space/occupancy.py.

import { axesOf } from './draw.js';

const SOLID = 0.3, FEWEST = 6, PARTS = 6, DEEPEST = 8, MOST_CELLS = 24e6, LEFT_OUT = [0.001, 0.005, 0.02];

const between = (sorted, at) => sorted[Math.floor(at)] + (at % 1) * (sorted[Math.ceil(at)] - sorted[Math.floor(at)]);

export class Solid {
  /** solid: 1 or 0 for each cube, the last axis fastest; top: how high the surface in it is. */
  constructor(origin, cell, size, solid, top) { Object.assign(this, { origin, cell, size, solid, top }); }

  /** Bits of the cubes, and for each solid one a byte: where in it its surface is. */
  static unpack(reader, { origin, cell, size, filled }) {
    const total = size[0] * size[1] * size[2], bits = reader.take(Math.ceil(total / 8)), heights = reader.take(filled);
    const solid = new Uint8Array(total), top = new Float32Array(total);
    for (let k = 0, next = 0; k < total; k += 1) {
      if (!(bits[k >> 3] & (128 >> (k & 7)))) continue;
      solid[k] = 1;
      top[k] = origin[2] + cell * ((k % size[2]) + heights[next++] / 255);
    }
    return new Solid(origin, cell, size, solid, top);
  }

  /** This after an edit: where what Gaussians fill has changed between two scenes, as after it. */
  edited(before, after, samples) {
    const [was, is] = [before, after].map((scene) => Solid.of(scene, samples, this.cell, this)), solid = this.solid.slice(), top = this.top.slice();
    for (let k = 0; k < solid.length; k += 1) if (was.solid[k] !== is.solid[k]) [solid[k], top[k]] = [is.solid[k], is.top[k]];
    return new Solid(this.origin, this.cell, this.size, solid, top);
  }

  /** Fills in the corners of a grid around some of the means, and its size; returns the side of its cells. */
  static #bounds(some, means, low, high, size, cell) {
    const sorted = [0, 1, 2].map((a) => Float32Array.from(some, (k) => means[3 * k + a]).sort()), last = some.length - 1;
    let side = cell;
    for (const share of LEFT_OUT) {
      for (let a = 0; a < 3; a += 1) [low[a], high[a]] = [between(sorted[a], share * last) - 0.5, between(sorted[a], (1 - share) * last) + 0.5];
      side = Math.cbrt(((high[0] - low[0]) * (high[1] - low[1]) * (high[2] - low[2])) / MOST_CELLS);
      if (side <= cell) break;
    }
    side = Math.max(cell, side);
    for (let a = 0; a < 3; a += 1) size.push(Math.max(1, Math.ceil((high[a] - low[a]) / side)));
    return side;
  }

  /** Read off Gaussians: `samples` [n][3] are points of each that are looked at; on the cells of another, `grid`, if it is given. */
  static of(scene, samples, cell = 0.1, grid = null) {
    const some = [];
    for (let k = 0; k < scene.length; k += 1) if (scene.opacities[k] > SOLID) some.push(k);
    if (!some.length && !grid) return new Solid([0, 0, 0], cell, [1, 1, 1], new Uint8Array(1), new Float32Array(1));
    const { means } = scene, [low, size] = grid ? [grid.origin, grid.size] : [[], []], high = [];
    if (!grid) cell = Solid.#bounds(some, means, low, high, size, cell);
    const count = new Float32Array(size[0] * size[1] * size[2]), top = new Float32Array(count.length);
    for (const k of some) {
      const m = axesOf(scene, k), s = [0, 1, 2].map((a) => Math.min(scene.scales[3 * k + a], 1)).sort((x, y) => x - y);
      const shrink = [0, 1, 2].map((a) => Math.min(1, 1 / scene.scales[3 * k + a]));
      const weight = Math.max(1, (2.4 * s[1]) / cell) * Math.max(1, (2.4 * s[2]) / cell);
      for (const [x, y, z] of samples) {
        const p = [0, 1, 2].map((a) => means[3 * k + a] + x * shrink[0] * m[a] + y * shrink[1] * m[3 + a] + z * shrink[2] * m[6 + a]);
        const [i, j, l] = p.map((part, a) => Math.floor((part - low[a]) / cell));
        if (i < 0 || j < 0 || l < 0 || i >= size[0] || j >= size[1] || l >= size[2]) continue;
        const at = (i * size[1] + j) * size[2] + l;
        count[at] += weight;
        top[at] += weight * p[2];
      }
    }
    const solid = Uint8Array.from(count, (many) => (many >= FEWEST ? 1 : 0));
    for (let k = 0; k < top.length; k += 1) top[k] /= Math.max(count[k], 1e-3);
    return new Solid(low, cell, size, solid, top);
  }

  /** The number of the cube in which a place is, -1 outside. */
  at(x, y, z) {
    const { origin, cell, size } = this, i = Math.floor((x - origin[0]) / cell), j = Math.floor((y - origin[1]) / cell), k = Math.floor((z - origin[2]) / cell);
    return i < 0 || j < 0 || k < 0 || i >= size[0] || j >= size[1] || k >= size[2] ? -1 : (i * size[1] + j) * size[2] + k;
  }

  holds(x, y, z) { const k = this.at(x, y, z); return k >= 0 && this.solid[k] === 1; }

  /** Whether a body whose eye is there stands in something. */
  blocked([x, y, z], { radius_m: wide, eye_m: eye, step_m: step, head_m: head }) {
    const radius = Math.max(wide - 0.25 * this.cell, 0.5 * wide), low = -eye + step, levels = Math.max(2, Math.ceil((head - low) / this.cell) + 1);
    for (let turn = 0; turn < 9; turn += 1) {
      const dx = turn < 8 ? radius * Math.cos((turn * Math.PI) / 4) : 0, dy = turn < 8 ? radius * Math.sin((turn * Math.PI) / 4) : 0;
      for (let level = 0; level < levels; level += 1) if (this.holds(x + dx, y + dy, z + low + ((head - low) * level) / (levels - 1))) return true;
    }
    return false;
  }

  /** Whether a box that stands on a floor overlaps anything by more than `slack` metres. */
  meets([x0, y0, z0, x1, y1, z1], slack) {
    const { cell } = this;
    for (let x = x0 + slack; x < x1; x += Math.min(cell, Math.max(x1 - slack - x, slack))) {
      for (let y = y0 + slack; y < y1; y += Math.min(cell, Math.max(y1 - slack - y, slack))) {
        for (let z = z0 + 2.5 * cell; z < z1; z += cell) if (this.holds(x, y, z)) return true;
      }
    }
    return false;
  }

  /** How high the floor under a body is: the highest surface up to a step above its feet; its feet where there is none. */
  floor([x, y, z], { eye_m: eye, step_m: step }) {
    const { cell } = this, feet = z - eye, deep = Math.ceil((DEEPEST + step) / cell), levels = [];
    for (const dx of [-cell, 0, cell]) for (const dy of [-cell, 0, cell]) {
      for (let k = 0; k < deep; k += 1) {
        const at = this.at(x + dx, y + dy, feet + step - k * cell);
        if (at >= 0 && this.solid[at]) { levels.push(this.top[at]); break; }
      }
    }
    if (!levels.length) return feet;
    levels.sort((one, other) => one - other);
    const middle = levels[(levels.length - 1) >> 1], near = levels.filter((level) => Math.abs(level - middle) < cell);
    return near.reduce((sum, level) => sum + level, 0) / near.length;
  }

  /** Where a body comes that wishes to go by `wish`. Who stands in something may leave it. */
  moved(place, wish, body) {
    const stuck = this.blocked(place, body);
    return slide((there) => (!stuck && this.blocked(there, body) ? 1 : 0), place, wish);
  }
}

/** A place moved by `wish` in short steps, none of which goes deeper into anything: the whole step, or along one axis after another. */
export function slide(depth, place, wish) {
  let here = depth(place);
  place = [...place];
  for (let part = 0; part < PARTS; part += 1) {
    let step = wish.map((by) => by / PARTS);
    for (const way of [[1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
      const there = place.map((p, a) => p + step[a] * way[a]), deep = depth(there);
      if (deep > here) continue;
      [place, here] = [there, deep];
      step = step.map((by, a) => by * (1 - way[a]));
    }
  }
  return place;
}
