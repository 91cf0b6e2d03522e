// Keyboard, touch and gamepad: keys and buttons as the world's spec names them, sticks as its axes where it has some.

import { Axes } from './axes.js';

const UP = ['KeyW', 'ArrowUp'], DOWN = ['KeyS', 'ArrowDown'], LEFT = ['KeyA', 'ArrowLeft'], RIGHT = ['KeyD', 'ArrowRight'];
const PRESSED = 0.35;  // deflection of a stick that counts as a key, in a world with buttons

/** The keys that a stick, a turn pad and buttons stand for in this world, by the keys that it had at first: code -> action. */
export function plan(keys, first = keys) {
  const own = Object.keys(first).length ? first : keys, single = Object.keys(keys).filter((code) => !code.includes('+'));
  const now = (code) => single.find((other) => keys[other] === own[code]);
  const at = (codes) => codes.find((code) => code in own), pick = (codes) => (at(codes) ? now(at(codes)) : undefined);
  const stick = { up: pick(UP), down: pick(DOWN), left: pick(LEFT), right: pick(RIGHT) };
  const turns = at(LEFT) === 'KeyA' && 'ArrowLeft' in own && 'ArrowRight' in own && own.KeyA !== own.ArrowLeft;
  const turn = turns ? { left: now('ArrowLeft'), right: now('ArrowRight') } : null;
  const used = [...Object.values(stick), ...Object.values(turn ?? {})].map((code) => keys[code]);
  const extra = single.filter((code, index) => !used.includes(keys[code]) && single.findIndex((other) => keys[other] === keys[code]) === index);
  return { stick, turn, extra };
}

export class Controls {
  /** `changed(held, time)` is called with the ordered list of held codes whenever it, or a value of the axes, changes. */
  constructor(changed, sliders) {
    this.changed = changed;
    this.axes = new Axes(sliders, (time) => changed(this.held, time));
    this.keys = {};
    this.sources = { keyboard: [], stick: [], turn: [], extra: [], pad: [] };
    this.held = [];
    this.plan = plan({});
    addEventListener('blur', () => this.release());
    addEventListener('gamepadconnected', () => this.pollGamepad());
  }

  setWorld(world) {
    this.keys = world.keys;
    this.plan = plan(world.keys, world.first_keys);
    const { stick, turn } = this.plan;
    this.axes.setWorld(world, { ...stick, turnLeft: turn?.left, turnRight: turn?.right });
    this.release();
  }

  /** Whether anything is asked of the world. */
  get active() { return this.held.length > 0 || this.axes.active; }

  release() {
    for (const name of Object.keys(this.sources)) this.sources[name] = [];
    for (const source of Object.keys(this.axes.inputs)) this.axes.push(source, null, performance.now());
    this.merge(performance.now());
  }

  /** Whether the key belongs to the world. */
  press(code, time) {
    if (!(code in this.keys)) return false;
    if (!this.sources.keyboard.includes(code)) this.set('keyboard', [...this.sources.keyboard, code], time);
    return true;
  }

  lift(code, time) {
    this.set('keyboard', this.sources.keyboard.filter((other) => other !== code), time);
  }

  set(source, codes, time) {
    this.sources[source] = codes.filter((code) => code && code in this.keys);
    this.merge(time);
  }

  merge(time) {
    const all = [...new Set(Object.values(this.sources).flat())];
    const kept = this.held.filter((code) => all.includes(code));
    const next = [...kept, ...all.filter((code) => !kept.includes(code))];
    if (next.length === this.held.length && next.every((code, index) => code === this.held[index])) return;
    this.held = next;
    this.axes.draw(next);
    this.changed(next, time);
  }

  /** A stick or pad moved to x (right) and y (down), -1..1; a world with axes takes it as it is, another as keys. */
  deflect(source, x, y, time) {
    if (this.axes.axes.length) return this.axes.push(source, source === 'turn' ? { rx: x } : { lx: x, ly: -y }, time);
    this.set(source, source === 'turn' ? this.turns(x) : this.moves(x, y), time);
  }

  moves(x, y) {
    const { up, down, left, right } = this.plan.stick;
    return [y < -PRESSED && up, y > PRESSED && down, x < -PRESSED && left, x > PRESSED && right];
  }

  turns(x) {
    const turn = this.plan.turn;
    return turn ? [x < -PRESSED && turn.left, x > PRESSED && turn.right] : [];
  }

  /** A round stick or a turn rail: `element` has a `.nub` that follows the finger. */
  bindPad(element, source) {
    const nub = element.querySelector('.nub');
    let finger = null;
    const move = (event) => {
      const box = element.getBoundingClientRect(), reach = Math.min(box.width, box.height) / 2;
      let x = (event.clientX - box.left - box.width / 2) / reach, y = (event.clientY - box.top - box.height / 2) / reach;
      if (source === 'turn') y = 0;
      const far = Math.hypot(x, y), cap = source === 'turn' ? box.width / box.height - 0.4 : 1;
      if (far > cap) { x *= cap / far; y *= cap / far; }
      nub.style.transform = `translate(${x * reach * 0.62}px, ${y * reach * 0.62}px)`;
      this.deflect(source, x, y, event.timeStamp);
    };
    element.addEventListener('pointerdown', (event) => {
      event.preventDefault();
      finger = event.pointerId;
      element.setPointerCapture(finger);
      element.classList.add('on');
      move(event);
    });
    element.addEventListener('pointermove', (event) => { if (event.pointerId === finger) move(event); });
    const end = (event) => {
      if (event.pointerId !== finger) return;
      finger = null;
      element.classList.remove('on');
      nub.style.transform = '';
      this.deflect(source, 0, 0, event.timeStamp);
    };
    for (const name of ['pointerup', 'pointercancel', 'lostpointercapture']) element.addEventListener(name, end);
  }

  bindButton(element, code) {
    const down = (event) => { event.preventDefault(); element.setPointerCapture(event.pointerId); this.set('extra', [...this.sources.extra, code], event.timeStamp); };
    const up = (event) => this.set('extra', this.sources.extra.filter((other) => other !== code), event.timeStamp);
    element.addEventListener('pointerdown', down);
    for (const name of ['pointerup', 'pointercancel']) element.addEventListener(name, up);
  }

  pollGamepad() {
    if (this.polling) return;
    this.polling = true;
    const poll = () => {
      const pad = navigator.getGamepads().find((one) => one?.connected);
      if (!pad) {
        this.polling = false;
        this.set('pad', [], performance.now());
        this.axes.push('pad', null, performance.now());
        return;
      }
      const down = (index) => (pad.buttons[index]?.pressed ? 1 : 0);
      const x = (pad.axes[0] ?? 0) + down(15) - down(14), y = (pad.axes[1] ?? 0) + down(13) - down(12);
      const buttons = this.plan.extra.slice(0, 4).map((code, index) => down(index) && code);
      if (this.axes.axes.length) this.axes.push('pad', { lx: x, ly: -y, rx: pad.axes[2] ?? 0, ry: -(pad.axes[3] ?? 0) }, performance.now());
      else this.set('pad', [...this.moves(x, y), ...this.turns(pad.axes[2] ?? 0), ...buttons], performance.now());
      requestAnimationFrame(poll);
    };
    requestAnimationFrame(poll);
  }
}
