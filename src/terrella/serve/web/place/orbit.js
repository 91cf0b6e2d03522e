// Turning around a point: drags go around it, the wheel and two fingers come nearer.

import { axes } from './camera.js';

const NEAREST = 0.4, FARTHEST = 60, STEEPEST = 1.45;

export class Orbit {
  constructor(walker) { Object.assign(this, { walker, target: null, far: 0 }); }

  get on() { return !!this.target; }

  /** Begins to turn around a point; null: ends, and hovers where it is. */
  around(target) {
    this.target = target;
    if (!target) return;
    const { place } = this.walker.eye, off = target.map((part, a) => part - place[a]), far = Math.hypot(...off);
    this.far = Math.min(FARTHEST, Math.max(NEAREST, far));
    if (far > NEAREST / 2) Object.assign(this.walker, { heading: Math.atan2(off[1], off[0]), pitch: Math.asin(off[2] / far) });
    this.turn(0, 0);
  }

  /** The eye for a heading and a pitch. */
  eye(heading, pitch) {
    const { ahead } = axes({ heading, pitch });
    return { place: this.target.map((part, a) => part - this.far * ahead[a]), heading, pitch };
  }

  turn(across, up) {
    const pitch = Math.max(-STEEPEST, Math.min(STEEPEST, this.walker.pitch + up)), { place, heading } = this.eye(this.walker.heading + across, pitch);
    this.walker.set(place, heading, pitch, true);
  }

  zoom(factor) {
    this.far = Math.min(FARTHEST, Math.max(NEAREST, this.far / factor));
    this.turn(0, 0);
  }
}
