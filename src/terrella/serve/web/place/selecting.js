// The tools of the pointer: box, sphere, brush and object select; a drag of what is selected moves it.

import { pick } from './pick.js';
import { axes, ray } from './camera.js';

const round = (value) => Math.round(value * 1000) / 1000, dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const LEAST = 0.05, CLICK = 6;  // metres of a selection; pixels that a click may move

export class Selecting {
  /** on: scene(), eye(), lens(), mask(), choose(selection), preview(shift), move(shift), say(text), spot(direction), write(), look(dx, dy),
   * orbits() -> whether drags turn around what is selected. */
  constructor(on) { Object.assign(this, { on, tool: 'sphere', doing: null, radius: 0.25 }); }

  way(event) {
    return ray(this.on.eye(), this.on.lens(), (2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight);
  }

  handle(name, event) {
    if (name === 'down') return this.down(event);
    if (name === 'drag' && this.doing?.does === 'nothing') {
      this.doing.looked = (this.doing.looked ?? 0) + Math.hypot(event.movementX, event.movementY);
      this.on.look(event.movementX, event.movementY);
    }
    else if (name === 'drag' && this.doing) this.drag(event);
    if (name === 'up' && this.doing) this.up();
    if (name === 'up' && this.tool === 'put') this.on.write();  // a press itself takes the focus away
    return false;
  }

  down(event) {
    const way = this.way(event), hit = pick(this.on.scene(), this.on.eye().place, way);
    if (!hit) return false;
    const from = hit.place, brushes = this.tool === 'brush';
    if (this.tool === 'put') {
      this.on.spot(way);
      this.doing = { does: 'nothing' };
    } else if (this.on.mask()?.[hit.number] && !brushes) this.doing = this.on.orbits() ? { does: 'nothing' } : { does: 'move', from, shift: [0, 0, 0] };
    else if (this.tool === 'object') {
      this.doing = { does: 'nothing', object: Math.max(0, this.on.scene().objects[hit.number]) };  // who drags on looks around
    } else if (this.tool === 'plane') {
      this.on.choose({ plane: [0, 0, 1, round(from[2])] });
      this.doing = { does: 'nothing' };
    } else {
      this.doing = { does: this.tool, from, dabs: event.shiftKey && brushes ? this.on.dabs() : [] };
      if (brushes) this.dab(from);
      else this.grow(2 * LEAST);
    }
    return true;
  }

  drag(event) {
    const { does, from } = this.doing, way = this.way(event), eye = this.on.eye(), { ahead } = axes(eye);
    const facing = dot(from.map((part, a) => part - eye.place[a]), ahead) / dot(way, ahead), there = eye.place.map((part, a) => part + facing * way[a]);
    if (does === 'move') {
      const level = (from[2] - eye.place[2]) / way[2], flat = level > 0 && level < 3 * facing ? eye.place.map((part, a) => part + level * way[a]) : there;
      this.doing.shift = event.shiftKey ? [0, 0, round(there[2] - from[2])] : [round(flat[0] - from[0]), round(flat[1] - from[1]), 0];
      this.on.preview(this.doing.shift);
    } else if (does === 'brush') {
      const hit = pick(this.on.scene(), eye.place, way), last = this.doing.dabs.slice(-4);
      if (hit && Math.hypot(...hit.place.map((part, a) => part - last[a])) > 0.4 * this.radius) this.dab(hit.place);
    } else this.grow(Math.max(LEAST, Math.hypot(...there.map((part, a) => part - from[a]))));
  }

  up() {
    const { does, shift, object, looked } = this.doing;
    this.doing = null;
    if (object > 0 && !(looked > CLICK)) this.on.choose({ object });
    else if (object === 0 && !(looked > CLICK)) this.on.say('This belongs to no object; select it with a box, a sphere or the brush.');
    if (does === 'move' && shift.some(Boolean)) this.on.move(shift);
  }

  grow(size) {
    const { does, from } = this.doing;
    this.on.choose(does === 'sphere' ? { sphere: [...from, size].map(round) } : { box: [...from.map((part) => part - size), ...from.map((part) => part + size)].map(round) });
  }

  dab(place) {
    this.doing.dabs.push(...[...place, this.radius].map(round));
    this.on.choose({ brush: [...this.doing.dabs] });
  }

  /** The wheel: what is selected, or the brush, grows by a factor; whether there was something to grow. */
  wheel(chosen, factor) {
    if (this.tool === 'brush') {
      this.radius = Math.min(5, Math.max(LEAST, round(this.radius * factor)));
      return true;
    }
    if (chosen?.sphere) this.on.choose({ sphere: [...chosen.sphere.slice(0, 3), round(Math.max(LEAST, chosen.sphere[3] * factor))] });
    else if (chosen?.box) {
      const middle = [0, 1, 2].map((a) => (chosen.box[a] + chosen.box[a + 3]) / 2);
      this.on.choose({ box: chosen.box.map((part, a) => round(middle[a % 3] + (part - middle[a % 3]) * factor)) });
    }
    return !!(chosen?.sphere || chosen?.box);
  }
}
