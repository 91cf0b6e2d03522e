// The collider of a place whose walls are known: axis-aligned boxes, as in space/solids.py.

import { slide } from './solid.js';

const FOOT = 0.1, DEEPEST = 8;

export class Boxes {
  /** boxes: low and high corners, 6 numbers each. */
  constructor(boxes) { this.boxes = boxes; }

  /** How deep, in metres sideways, a body whose eye is there is in something; 0 for free. */
  depth([x, y, z], { radius_m: radius, eye_m: eye, step_m: step, head_m: head }) {
    let most = 0;
    for (const [x0, y0, z0, x1, y1, z1] of this.boxes) {
      if (z - eye + step >= z1 || z + head <= z0) continue;
      const dx = Math.max(x0 - x, x - x1), dy = Math.max(y0 - y, y - y1);
      most = Math.max(most, radius - Math.hypot(Math.max(dx, 0), Math.max(dy, 0)) - Math.min(Math.max(dx, dy), 0));
    }
    return most;
  }

  /** Whether a box overlaps another one by more than `slack` metres. */
  meets([x0, y0, z0, x1, y1, z1], slack) {
    const over = (low, high, from, to) => low + slack < to && high - slack > from;
    return this.boxes.some(([a, b, c, d, e, f]) => over(x0, x1, a, d) && over(y0, y1, b, e) && over(z0, z1, c, f));
  }

  /** How high the floor under a body is: the highest top up to a step above its feet; its feet where there is none. */
  floor([x, y, z], { eye_m: eye, step_m: step }) {
    const feet = z - eye;
    let highest = -Infinity;
    for (const [x0, y0, , x1, y1, top] of this.boxes) {
      if (Math.max(x0 - x, x - x1, y0 - y, y - y1) < FOOT && top <= feet + step && top > feet - DEEPEST) highest = Math.max(highest, top);
    }
    return highest > -Infinity ? highest : feet;
  }

  /** Where a body comes that wishes to go by `wish`. */
  moved(place, wish, body) { return slide((there) => this.depth(there, body), place, wish); }
}
