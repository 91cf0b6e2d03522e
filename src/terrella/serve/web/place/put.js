// Puts furniture that words name where the pointer shows: the server builds it, and an edit merges it.

import { axesOf } from './draw.js';
import { axes } from './camera.js';
import { placed } from './edits.js';
import { pick } from './pick.js';
import { reach } from './reach.js';
import { decoded, inflate, Reader, unpackScene } from './scene.js';

const NEAR = 16, STEP = 0.05, SLACK = 0.02, TALL = 1.5;  // how far a thing makes way for walls and other things, in steps; metres
const SHIFTS = Array.from({ length: (2 * NEAR + 1) ** 2 }, (_, k) => [(k % (2 * NEAR + 1)) - NEAR, Math.floor(k / (2 * NEAR + 1)) - NEAR])
  .sort((one, other) => Math.hypot(...one) - Math.hypot(...other)).map((by) => by.map((part) => part * STEP));
const UPRIGHT = 0.5, BEFORE = 0.3, AHEAD = 2, ABOVE = 0.3;

/** What a ray from `eye` along `way` meets, as the server reads it: at, floor, ceiling, wall, degrees; metres. */
export function spotAt(scene, solid, body, eye, way) {
  const hit = pick(scene, eye, way), level = Math.hypot(way[0], way[1]) || 1;
  const at = hit ? hit.place : eye.map((part, a) => part + (a < 2 ? (AHEAD * way[a]) / level : 0));
  const normal = hit ? normalOf(scene, hit.number, way) : [0, 0, 1], wall = Math.abs(normal[2]) < UPRIGHT;
  const off = at.map((part, a) => part + (a < 2 && wall ? BEFORE * normal[a] : 0)), below = (z) => solid.floor([off[0], off[1], z + body.eye_m], body);
  const floor = hit && normal[2] >= UPRIGHT ? at[2] : below(wall ? at[2] : eye[2] - body.eye_m);
  const faces = wall ? Math.atan2(normal[1], normal[0]) : Math.atan2(eye[1] - at[1], eye[0] - at[0]);
  const degrees = (Math.round((faces * 180) / Math.PI / 90) * 90 + 450) % 360;  // 0 looks south
  return { at, floor, wall, degrees, ceiling: pick(scene, [off[0], off[1], floor + ABOVE], [0, 0, 1])?.place[2] ?? null };
}

/** The direction in which a flat Gaussian is thin, towards the eye. */
function normalOf(scene, k, way) {
  const thin = [0, 1, 2].reduce((least, a) => (scene.scales[3 * k + a] < scene.scales[3 * k + least] ? a : least), 0);
  const axis = axesOf(scene, k).slice(3 * thin, 3 * thin + 3), long = Math.hypot(...axis) || 1, side = axis[0] * way[0] + axis[1] * way[1] + axis[2] * way[2] > 0 ? -1 : 1;
  return axis.map((part) => (side * part) / long);
}

/** The shortest way over the floor towards the eye, not through walls, by which boxes come free of what stops walkers; null: none is short. */
export function wayOut(solid, boxes, eye) {
  if (!boxes.length) return [0, 0];
  const meets = ([x0, y0, z0, x1, y1, z1], [dx, dy]) => solid.meets([x0 + dx, y0 + dy, z0, x1 + dx, y1 + dy, z1], SLACK);
  const [x, y, z] = [0, 1, 2].map((a) => boxes.reduce((sum, box) => sum + (a < 2 ? (box[a] + box[a + 3]) / 2 : box[a]) / boxes.length, 0)), probe = [x - STEP, y - STEP, z, x + STEP, y + STEP, z + TALL];
  const passes = (by) => {  // it may begin in a wall
    const free = Array.from({ length: NEAR + 1 }, (_, k) => !meets(probe, by.map((part) => (part * k) / NEAR)));
    return !free.slice(free.indexOf(true)).includes(false);
  };
  const nearer = ([dx, dy]) => dx * (eye[0] - x) + dy * (eye[1] - y) >= 0;
  return SHIFTS.find((by) => nearer(by) && !boxes.some((box) => meets(box, by)) && (by.every((part) => !part) || passes(by))) ?? null;
}

export class Put {
  /** form: its field and its button; on: scene(), solid(), eye(), body, address, command, key, say(text), put(edits, scenes by sha256). */
  constructor(form, on) {
    Object.assign(this, { form, on, spot: null });
    form.onsubmit = (event) => { event.preventDefault(); this.ask(); };
  }

  /** Chooses the spot along a ray; without one, in the middle of the view. */
  choose(way = axes(this.on.eye()).ahead) {
    this.spot = spotAt(this.on.scene(), this.on.solid(), this.on.body, this.on.eye().place, way);
  }

  async ask() {
    const field = this.form.querySelector('input'), button = this.form.querySelector('button'), words = field.value.trim() || field.placeholder;
    if (!this.spot) this.choose();
    button.disabled = true;
    try {
      const body = JSON.stringify({ words, spot: this.spot, key: this.on.key }), answer = await reach(this.on.address + location.search, this.on.command, { method: 'POST', body });
      const { things, unknown } = await answer.json(), scenes = new Map();
      for (const { edit, about, data } of things) if (!scenes.has(edit.sha256)) scenes.set(edit.sha256, unpackScene(new Reader(await inflate(decoded(data))), about));
      const boxes = things.filter(({ stands }) => stands).flatMap(({ edit, about }) => placed(about.boxes, edit.by, edit.degrees / 90)), way = wayOut(this.on.solid(), boxes, this.on.eye().place);
      this.on.put(things.map((thing) => (way && thing.stands ? { ...thing.edit, by: thing.edit.by.map((part, a) => Math.round(1000 * (part + (way[a] ?? 0))) / 1000) } : thing.edit)), scenes);
      this.spot = null;
      field.value = '';
      field.blur();
      if (unknown.length) this.on.say(`Not understood: ${unknown.join(', ')}.`);
      else if (!way) this.on.say('It overlaps something, for nothing near is free; move it.');
    } catch (error) { this.on.say(error.message); }
    button.disabled = false;
  }
}
