// The axes of a world's action: a slider for each, also moved by sticks, pads and the mouse, in the world's own units.

const DEAD = 0.1, SWEEP_S = 1.5, MOUSE_PX = 28;
const HINTS = [  // which stick moves an axis of that name, and the way that it is positive
  [/forward|throttle|gas|drive|^v?x$|linear/i, 'ly'], [/steer/i, 'lx'], [/turn|yaw|rot|^w?z$|angular|pan/i, 'rx'], [/pitch|tilt|brake/i, 'ry'],
  [/strafe|lateral|side|^v?y$|left/i, 'lx'],
];
const STICKS = ['lx', 'ly', 'rx', 'ry'];
const STICK_NAMES = { lx: 'left stick, sideways,', ly: 'left stick, up and down,', rx: 'right stick, sideways,', ry: 'right stick, up and down,' };

/** What the sticks do: {lx: {plus: [...], minus: [...]}, ...}, the action at either end; from the world's keys where it has some. */
export function stickPlan(axes, keys, pick) {
  const plan = {}, neutral = axes.map((axis) => axis.neutral), free = new Set(STICKS), moved = new Set();
  const towards = (at, end) => neutral.map((value, index) => (index === at ? end : value));
  const take = (stick, plus, minus) => { plan[stick] = { plus, minus }; free.delete(stick); };
  for (const [stick, plus, minus] of [['lx', pick.right, pick.left], ['ly', pick.up, pick.down], ['rx', pick.turnRight, pick.turnLeft]]) {
    if (!plus && !minus) continue;
    take(stick, keys[plus] ?? neutral, keys[minus] ?? neutral);
    axes.forEach((_, at) => { if (plan[stick].plus[at] !== neutral[at] || plan[stick].minus[at] !== neutral[at]) moved.add(at); });
  }
  const assign = (at, stick) => {
    const { name, unit, low, high } = axes[at];
    const leftward = /^rad|^deg/.test(unit) && stick === 'rx' || /^v?y$|left/i.test(name) && stick === 'lx';  // right-handed frames
    take(stick, towards(at, leftward ? low : high), towards(at, leftward ? high : low));
    moved.add(at);
  };
  for (const hinted of [true, false]) {
    axes.forEach(({ name }, at) => {
      if (moved.has(at)) return;
      const stick = hinted ? HINTS.find(([words, where]) => words.test(name) && free.has(where))?.[1] : [...free][0];
      if (stick) assign(at, stick);
    });
  }
  return plan;
}

export class Axes {
  /** `changed(time)` is called whenever a value has changed; the values are in `values`. */
  constructor(root, changed) {
    Object.assign(this, { root, changed, axes: [], set: [], values: [], plan: {}, inputs: {}, rows: [], running: false, led: null });
  }

  setWorld(world, pick) {
    this.axes = world.axes.map((axis, at) => ({ ...axis, name: world.actions.find(({ of }) => of === at)?.name ?? axis.name }));
    this.sweeps = world.action_mode === 'position';  // a stick moves the target, and lets go of it where it is
    this.keys = Object.fromEntries(Object.entries(world.keys).map(([code, place]) => [code, world.actions[place].value]));
    this.plan = stickPlan(this.axes, this.keys, pick);
    this.root.hidden = !world.axes.length;
    this.root.title = [world.action_mode, world.action_frame && `in the frame of the ${world.action_frame}`].filter(Boolean).join(', ');
    this.rows = this.axes.map((axis, at) => this.row(axis, at));
    this.root.replaceChildren(...this.rows.map((row) => row.label));
    this.rest();
  }

  row(axis, at) {
    const make = (tag, text = '') => Object.assign(document.createElement(tag), { textContent: text });
    const { factor, unit } = measure(axis);
    const label = make('label'), name = make('b', axis.name.replaceAll('_', ' ')), value = make('output'), ends = make('i');
    const slider = Object.assign(make('input'), { type: 'range', min: axis.low, max: axis.high, step: axis.whole ? 1 : 'any' });
    ends.append(make('span', digits(factor * axis.low)), make('span', digits(factor * axis.high)));
    const stick = STICKS.find((one) => this.moves(one, at)), by = stick ? `; the ${STICK_NAMES[stick]} moves it` : '';
    label.title = `${axis.name}: ${digits(factor * axis.low)} to ${digits(factor * axis.high)} ${unit}${by}; double click for ${digits(factor * axis.neutral)}`;
    slider.oninput = (event) => { this.lead(); this.set[at] = Number(slider.value); this.merge(event.timeStamp); };
    slider.onchange = () => slider.blur();  // the keys are the world's again
    label.ondblclick = (event) => { this.set[at] = axis.neutral; this.merge(event.timeStamp); };
    label.append(name, value, slider, ends);
    return { label, slider, value };
  }

  /** Whether a stick moves an axis. */
  moves(stick, at) {
    const ends = this.plan[stick];
    return !!ends && (ends.plus[at] !== this.axes[at].neutral || ends.minus[at] !== this.axes[at].neutral);
  }

  /** The names of the axes that these sticks move. */
  movedBy(...sticks) {
    return this.axes.filter((_, at) => sticks.some((stick) => this.moves(stick, at))).map(({ name }) => name).join(' · ');
  }

  get active() { return this.values.some((value, at) => value !== this.axes[at].neutral); }

  /** Shows what an agent does; null: it does nothing any more. */
  follow(values) {
    this.led = values;
    this.draw();
  }

  /** A person takes over: positions go on from where the agent left them. */
  lead() {
    if (this.led && this.sweeps) this.set = this.set.map((value, at) => this.led[at] ?? value);
    this.led = null;
  }

  /** Lets go of sticks and sliders. */
  rest() {
    this.inputs = {};
    this.set = this.axes.map((axis) => axis.neutral);
    this.merge(performance.now());
  }

  /** Deflections of a source, -1..1, right and up positive: {lx, ly, rx, ry}; null lets go. */
  push(source, deflections, time) {
    const quiet = !deflections || STICKS.every((stick) => Math.abs(deflections[stick] ?? 0) < DEAD);
    if (quiet && !(source in this.inputs)) return;
    if (!quiet) this.lead();
    if (quiet) delete this.inputs[source]; else this.inputs[source] = deflections;
    if (this.sweeps) this.run(); else this.merge(time);
  }

  /** What the sticks ask for beyond rest, per axis. */
  pushed() {
    const sum = this.axes.map(() => 0);
    for (const deflections of Object.values(this.inputs)) for (const stick of STICKS) {
      const raw = deflections[stick] ?? 0, size = Math.max(0, Math.abs(raw) - DEAD) / (1 - DEAD), ends = this.plan[stick];
      if (size && ends) this.axes.forEach((axis, at) => { sum[at] += size * ((raw > 0 ? ends.plus : ends.minus)[at] - axis.neutral); });
    }
    return sum;
  }

  /** While a stick is held, a position goes on moving. */
  run() {
    if (this.running) return;
    this.running = true;
    let last = performance.now();
    const tick = (time) => {
      const pushed = this.pushed(), dt = Math.min(0.1, (time - last) / 1000);
      last = time;
      this.set = this.set.map((value, at) => value + pushed[at] * dt / SWEEP_S);
      this.merge(time);
      this.running = Object.keys(this.inputs).length > 0;
      if (this.running) requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  merge(time) {
    const pushed = this.sweeps ? [] : this.pushed();
    const clamp = (value, { low, high }) => Math.min(high, Math.max(low, value));
    this.set = this.set.map((value, at) => clamp(value, this.axes[at]));
    const next = this.set.map((value, at) => clamp(value + (pushed[at] ?? 0), this.axes[at]));
    const same = next.length === this.values.length && next.every((value, at) => value === this.values[at]);
    this.values = next;
    this.draw();
    if (!same) this.changed(time);
  }

  /** Shows what the world is given, held keys and all (see serve/actions.py). */
  draw(held = this.held ?? []) {
    this.held = held;
    this.rows.forEach(({ slider, value }, at) => {
      const pressed = held.map((code) => this.keys[code]?.[at] ?? 0).reduce((a, b) => (Math.abs(b) > Math.abs(a) ? b : a), 0);
      const shown = this.led?.[at] ?? (pressed || this.values[at]), { factor, unit } = measure(this.axes[at]), text = `${digits(factor * shown)} ${unit}`.trim();
      if (document.activeElement !== slider || slider.value !== String(shown)) slider.value = shown;
      if (value.textContent !== text) value.textContent = text;
    });
  }

  /** The mouse looks around while the picture holds it: a click takes it, Escape lets it go. */
  bindMouse(element) {
    let x = 0, y = 0;
    element.addEventListener('click', () => { if (this.axes.length && Object.keys(this.plan).length) element.requestPointerLock?.(); });
    element.addEventListener('mousemove', (event) => { if (document.pointerLockElement === element) { x += event.movementX; y -= event.movementY; } });
    document.addEventListener('pointerlockchange', () => {
      if (document.pointerLockElement !== element) return this.push('mouse', null, performance.now());
      let now = [0, 0];
      const tick = (time) => {
        if (document.pointerLockElement !== element) return;
        const squash = (old, moved) => { const next = 0.5 * old + 0.5 * Math.min(1, Math.max(-1, moved / MOUSE_PX)); return Math.abs(next) < 0.01 ? 0 : next; };
        now = [squash(now[0], x), squash(now[1], y)];
        x = y = 0;
        const across = this.plan.rx ? 'rx' : 'lx', along = this.plan.ry ? 'ry' : '';
        const lift = (value) => value && Math.sign(value) * (DEAD + (1 - DEAD) * Math.abs(value));  // a mouse has no dead zone
        this.push('mouse', { [across]: lift(now[0]), ...(along && { [along]: lift(now[1]) }) }, time);
        requestAnimationFrame(tick);
      };
      requestAnimationFrame(tick);
    });
  }
}

/** A control of 1 may stand for more: "150 N m" is a factor of 150 and the unit "N m". */
function measure({ unit }) {
  const [, factor, rest] = /^([\d.]+) (.+)$/.exec(unit) ?? [null, 1, unit];
  return { factor: Number(factor), unit: rest };
}

const digits = (value) => String(+value.toFixed(Math.abs(value) >= 100 ? 0 : Math.abs(value) >= 10 ? 1 : 2)).replace('-', '−');
