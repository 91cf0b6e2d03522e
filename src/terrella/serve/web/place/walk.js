// Walking and flying, in the same steps as worlds/splat.py; the eye is interpolated between two steps.

const GRAVITY = 9.81;

export class Walker {
  constructor(world) {
    this.world = world;  // {body, pace, keep, dt_s, starts}
    this.start(0);
  }

  start(number) {
    const { starts } = this.world, [x, y, z, qw, qx, qy, qz] = starts[number % starts.length];
    const heading = Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz));
    const pitch = Math.asin(Math.max(-1, Math.min(1, 2 * (qx * qz - qw * qy))));  // of a picture's camera
    this.set([x, y, z], heading, 0);
    this.look(0, pitch);
  }

  set(place, heading, pitch, flying = false) {
    Object.assign(this, { place, before: place, heading, pitch, speed: [0, 0, 0, 0], falling: 0, flying, left: 0 });
  }

  /** One step under a wish: forward, to the left, turning left, up; each from -1 to 1 (running: to 2). */
  step(solid, wish) {
    const { body, pace, keep, dt_s: dt } = this.world, c = Math.cos(this.heading), s = Math.sin(this.heading);
    const [forward, left, turn, up] = wish.map((part, a) => part * pace[a]);
    const push = [c * forward - s * left, s * forward + c * left, turn, up], speed = this.speed.map((part, a) => part * keep[a] + push[a]);
    let flying = this.flying || wish[3] > 0;
    const from = this.place, place = solid.moved(from, [speed[0], speed[1], flying ? speed[3] : 0], body);
    const stand = solid.floor(place, body) + body.eye_m;
    this.falling = flying ? 0 : this.falling + GRAVITY * dt * dt;
    if (flying && wish[3] < 0 && place[2] <= stand + 0.05) flying = false;
    if (!flying) {
      const climbed = place[2] + Math.min((stand - place[2]) * 0.3, 0.15);
      const walked = stand >= place[2] - 0.2 ? climbed : Math.max(stand, place[2] - this.falling);
      if (walked <= stand + 0.2) this.falling = 0;
      place[2] = walked;
    }
    for (const a of [0, 1]) if (Math.abs(place[a] - from[a]) < 0.5 * Math.abs(speed[a])) speed[a] = place[a] - from[a];  // a wall
    Object.assign(this, { before: from, place, speed, flying });
    this.heading += speed[2];
  }

  /** Advances the time by some seconds; returns whether anything moves. */
  pass(solid, wish, seconds) {
    const { dt_s: dt } = this.world;
    this.left = Math.min(this.left + seconds, 8 * dt);
    for (; this.left >= dt; this.left -= dt) this.step(solid, wish);
    return wish.some(Boolean) || this.speed.some((part) => Math.abs(part) > 1e-4) || Math.hypot(...this.place.map((part, a) => part - this.before[a])) > 1e-4;
  }

  /** The eye now. */
  get eye() {
    const share = this.left / this.world.dt_s, place = this.place.map((part, a) => this.before[a] + share * (part - this.before[a]));
    return { place, heading: this.heading, pitch: this.pitch };
  }

  look(across, up) {
    this.heading += across;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + up));
  }
}
