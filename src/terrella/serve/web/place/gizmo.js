// Handles around what is selected: a disc moves it over the floor, a ring turns it, an arrow lifts it; arrow keys and brackets do too.

import { axes, project, ray } from './camera.js';

const PARTS = 72, SNAP = 5, NUDGE = 0.1, FINE = 0.01, TURN = 15, PAUSE_MS = 700, LEAST = 0.3, CLEAR = 0.1;
const KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [1, 1], ArrowRight: [1, -1], PageUp: [2, 1], PageDown: [2, -1], BracketLeft: [3, 1], BracketRight: [3, -1] };
const round = (value) => Math.round(value * 1000) / 1000;

export class Gizmo {
  /** svg: its parts are named by data-part; on: eye(), lens(), preview(change), act(action). */
  constructor(svg, on) {
    Object.assign(this, { svg, on, bounds: null, drag: null, wish: null });
    this.parts = Object.fromEntries([...svg.querySelectorAll('[data-part]')].map((part) => [part.dataset.part, part]));
    for (const name of ['disc', 'ring', 'lift']) {
      const handle = this.parts[name];
      handle.onpointerdown = (event) => { handle.setPointerCapture(event.pointerId); event.preventDefault(); this.begin(name, event); };
      handle.onpointermove = (event) => this.drag && handle.hasPointerCapture(event.pointerId) && this.pull(event);
      handle.onpointerup = handle.onpointercancel = () => { this.drag = null; this.commit(); };
    }
  }

  /** Around these ends {low, high} of what is selected; null: around nothing. */
  around(bounds) {
    clearTimeout(this.timer);
    Object.assign(this, { bounds, drag: null, wish: null });
    this.place();
  }

  get middle() { return [0, 1, 2].map((a) => (this.bounds.low[a] + this.bounds.high[a]) / 2); }

  /** What the handles were dragged to so far. */
  get shift() { return this.wish?.move ?? [0, 0, 0]; }

  begin(does, event) {
    clearTimeout(this.timer);
    this.wish ??= { move: [0, 0, 0], degrees: 0 };
    this.drag = { does, from: this.level(event), y: event.clientY, begun: { move: [...this.wish.move], degrees: this.wish.degrees } };
  }

  /** Where the pointer meets the plane of the foot; null where it does not. */
  level(event) {
    const { place } = this.on.eye(), way = ray(this.on.eye(), this.on.lens(), (2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight);
    const far = (this.bounds.low[2] - place[2]) / way[2];
    return far > 0 && far < 100 ? place.map((part, a) => part + far * way[a]) : null;
  }

  pull(event) {
    const { does, from, y, begun } = this.drag, here = this.level(event), wish = { move: [...begun.move], degrees: begun.degrees };
    if (does === 'lift') {
      const { depth } = project(this.on.eye(), this.on.lens(), this.middle);
      wish.move[2] = round(begun.move[2] + (2 * this.on.lens().tall * Math.max(depth, CLEAR) * (y - event.clientY)) / innerHeight);
    } else if (!here || !from) return;
    else if (does === 'disc') [0, 1].forEach((a) => { wish.move[a] = round(begun.move[a] + here[a] - from[a]); });
    else {
      const angle = (at) => (Math.atan2(at[1] - this.middle[1] - begun.move[1], at[0] - this.middle[0] - begun.move[0]) * 180) / Math.PI;
      const turned = ((angle(here) - angle(from) + 540) % 360) - 180;
      wish.degrees = begun.degrees + (event.shiftKey ? Math.round(turned) : Math.round(turned / SNAP) * SNAP);
    }
    this.show(wish);
  }

  /** A key that moves or turns what is selected; whether it was one. Presses in a row become one edit. */
  key(event) {
    if (!this.bounds || !(event.code in KEYS)) return false;
    const [axis, sign] = KEYS[event.code], wish = { move: [...this.shift], degrees: this.wish?.degrees ?? 0 }, step = event.shiftKey ? FINE : NUDGE;
    if (axis === 3) wish.degrees += sign * (event.shiftKey ? 1 : TURN);
    else if (axis === 2) wish.move[2] = round(wish.move[2] + sign * step);
    else {
      const { ahead } = axes(this.on.eye()), along = Math.abs(ahead[0]) > Math.abs(ahead[1]) ? 0 : 1, forward = Math.sign(ahead[along]) || 1;
      if (axis === 0) wish.move[along] = round(wish.move[along] + sign * forward * step);
      else wish.move[1 - along] = round(wish.move[1 - along] + sign * (along ? -forward : forward) * step);
    }
    this.show(wish);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.commit(), PAUSE_MS);
    return true;
  }

  show(wish) {
    this.wish = wish;
    this.on.preview({ move: wish.move, turn: (wish.degrees * Math.PI) / 180 });
  }

  /** Makes edits of what was dragged, or moved by keys a moment ago. */
  commit() {
    const { wish } = this;
    this.wish = null;
    if (!wish || !this.bounds) return;
    if (wish.degrees % 360) this.on.act({ do: 'turn', degrees: wish.degrees });
    if (wish.move.some(Boolean)) this.on.act({ do: 'move', by: wish.move });
    if (!(wish.degrees % 360) && !wish.move.some(Boolean)) this.on.preview({});
  }

  /** Draws the handles where they are now. */
  place() {
    const { svg, parts, bounds } = this;
    svg.toggleAttribute('hidden', !bounds);
    if (!bounds) return;
    const [x, y] = this.middle.map((part, a) => part + this.shift[a]), z = bounds.low[2] + this.shift[2], top = bounds.high[2] + this.shift[2] + 0.12;
    const wide = Math.max(LEAST, 1.15 * Math.hypot(bounds.high[0] - bounds.low[0], bounds.high[1] - bounds.low[1]) / 2);
    const pixel = (at) => { const { u, v, depth } = project(this.on.eye(), this.on.lens(), at); return depth > CLEAR ? [((u + 1) * innerWidth) / 2, ((1 - v) * innerHeight) / 2] : null; };
    const circle = (radius) => {
      let path = '', pen = 'M';
      for (let k = 0; k <= PARTS; k += 1) {
        const at = pixel([x + radius * Math.cos((2 * Math.PI * k) / PARTS), y + radius * Math.sin((2 * Math.PI * k) / PARTS), z]);
        path += at ? `${pen}${at[0].toFixed(1)} ${at[1].toFixed(1)}` : '';
        pen = at ? 'L' : 'M';
      }
      return path;
    };
    for (const part of ['ring', 'ring-line']) parts[part].setAttribute('d', circle(wide));
    for (const part of ['disc', 'disc-line']) parts[part].setAttribute('d', circle(0.4 * wide));
    const tip = pixel([x, y, top]), label = pixel([x, y, z]);
    parts.lift.toggleAttribute('hidden', !tip);
    if (tip) parts.lift.setAttribute('transform', `translate(${tip[0].toFixed(1)} ${tip[1].toFixed(1)})`);
    const { move, degrees } = this.wish ?? { move: [0, 0, 0], degrees: 0 };
    const words = [degrees ? `${degrees}°` : '', move.some(Boolean) ? `${move.map((part) => part.toFixed(2)).join('  ')} m` : ''].filter(Boolean).join('   ');
    parts.label.textContent = words;
    if (label) { parts.label.setAttribute('x', label[0]); parts.label.setAttribute('y', label[1] + 34); }
  }
}
