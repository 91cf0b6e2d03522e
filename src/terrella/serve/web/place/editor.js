// The editing panel: the selection, the actions, and the edits so far.

import { describe, endsOf, middleOf, select } from './edits.js';
import { Gizmo } from './gizmo.js';
import { Put } from './put.js';
import { Selecting } from './selecting.js';
import { marker, wiresOf } from './wires.js';

const $ = (id) => document.getElementById(id);
const NAMES = { box: ['x', 'y', 'z', 'to x', 'to y', 'to z'], sphere: ['x', 'y', 'z', 'r'], plane: ['a', 'b', 'c', 'd'] };
const SAID = {
  box: 'Press on a point and drag: a box around it. The wheel changes its size.', sphere: 'Press on a point and drag: a sphere around it. The wheel changes its size.',
  put: 'Press where it shall stand, and say what: "a red chair", "two small plants".',
  brush: 'Paint over a part. The wheel changes the size of the brush; Shift adds to the selection.', object: 'Click an object.',
  plane: 'Press on a point to select all that is higher. In general: a x + b y + c z > d.',
};
const MOVES = ' Drag what is selected to move it, with Shift up and down.';

export class Editor {
  /** on: changed(scene), marked(mask), redraw(), eye(), lens(), solid(), body, say(text), keep(lines) -> promise, look(dx, dy), orbits(); put,
   * command and key: the address that builds things, what starts its server, and what goes with a request. */
  constructor(story, drawing, on) {
    Object.assign(this, { story, drawing, on, chosen: null, mask: null, open: false });
    this.selecting = new Selecting({
      scene: () => story.scene, eye: on.eye, lens: on.lens, mask: () => this.mask, choose: (chosen) => this.choose(chosen), say: on.say,
      dabs: () => [...(this.chosen?.brush ?? [])], preview: (shift) => this.preview({ move: shift }), move: (by) => this.act({ do: 'move', by }),
      spot: (way) => { this.put.choose(way); on.redraw(); }, write: () => $('put-words').focus(), look: on.look, orbits: on.orbits,
    });
    this.gizmo = new Gizmo($('gizmo'), { eye: on.eye, lens: on.lens, preview: (change) => this.preview(change), act: (action) => this.act(action) });
    this.put = new Put($('putting'), {
      scene: () => story.scene, solid: on.solid, eye: on.eye, body: on.body, address: on.put, command: on.command, key: on.key, say: on.say, put: (edits, scenes) => this.merge(edits, scenes),
    });
    document.querySelector('[data-tool=put]').hidden = !on.put;
    document.querySelectorAll('[data-tool]').forEach((button) => { button.onclick = () => this.take(button.dataset.tool); });
    document.querySelectorAll('[data-do]').forEach((button) => { button.onclick = () => this.act(this.action(button.dataset.do)); });
    document.querySelectorAll('[data-preview]').forEach((fields) => {
      fields.oninput = () => this.preview(this.wished(fields.dataset.preview));
      fields.onchange = () => this.preview({});
      fields.onkeydown = (event) => { if (event.code === 'Enter') document.querySelector(`[data-do=${fields.dataset.preview}]`).click(); };
    });
    $('numbers').onchange = () => this.typed();
    $('drop-chosen').onclick = () => this.choose(null);
    $('undo').onclick = () => this.change(() => story.undo());
    $('redo').onclick = () => this.change(() => story.redo());
    $('save').onclick = () => this.save();
    $('open').onchange = () => this.read($('open').files[0]);
    this.take(story.scene.objects.some((number) => number > 0) ? 'object' : 'sphere');
    this.show();
  }

  toggle() {
    this.gizmo.commit();
    this.open = !this.open;
    $('editor').hidden = !this.open;
    $('edit').setAttribute('aria-pressed', this.open);
    $('place').classList.toggle('editing', this.open);
    this.on.marked(this.open ? this.mask : null);
    this.hold();
  }

  /** Adds what was built by words, and selects the last of it. */
  merge(edits, scenes) {
    for (const [sha256, scene] of scenes) this.story.others.set(sha256, scene);
    this.change(() => edits.forEach((edit) => this.story.add(edit)));
    this.take('object');
    this.choose({ object: this.story.scene.objects.reduce((most, number) => Math.max(most, number), 0) });
  }

  /** The handles around what is selected. */
  hold() {
    this.gizmo.around(this.open && this.mask && !('all' in this.chosen || 'plane' in this.chosen) ? endsOf(this.story.scene, this.mask) : null);
  }

  take(tool) {
    this.selecting.tool = tool;
    this.put.spot = null;
    $('putting').hidden = tool !== 'put';
    this.on.redraw();
    document.querySelectorAll('[data-tool]').forEach((button) => { button.setAttribute('role', 'radio'); button.setAttribute('aria-checked', button.dataset.tool === tool); });
    $('tool-said').textContent = SAID[tool];
  }

  choose(chosen) {
    this.gizmo.commit();
    const mask = chosen && select(this.story.scene, chosen);
    Object.assign(this, { chosen, mask: mask?.count ? mask : null });
    this.hold();
    this.preview({});
    this.on.marked(this.mask);
    this.show();
  }

  typed() {
    const kind = Object.keys(this.chosen)[0], values = [...$('numbers').querySelectorAll('input')].map((input) => Number(input.value));
    if (values.every(Number.isFinite)) this.choose({ [kind]: values });
    else this.on.say('Coordinates are in metres, such as 1.25.');
  }

  /** What the fields of a action say, as a preview. */
  wished(name) {
    const values = this.fields(name);
    return { move: { move: values }, turn: { turn: (values[0] * Math.PI) / 180 }, scale: { factor: values[0] > 0 ? values[0] : 1 } }[name];
  }

  fields(name) { return [...document.querySelectorAll(`[data-preview=${name}] input`)].map((input) => Number(input.value) || 0); }

  preview(change) {
    const none = this.drawing.still, middle = this.mask && (change.turn || change.factor) ? middleOf(this.story.scene, this.mask) : none.middle;
    this.drawing.preview = { ...none, ...change, middle };
    this.on.redraw();
  }

  action(name) {
    const values = { move: 'move', duplicate: 'move', turn: 'turn', scale: 'scale' }[name], given = values ? this.fields(values) : [];
    const colour = [1, 3, 5].map((at) => Math.round((parseInt($('colour').value.slice(at, at + 2), 16) / 255) * 1000) / 1000);
    return { do: name, ...{ move: { by: given }, duplicate: { by: given }, turn: { degrees: given[0] }, scale: { factor: given[0] }, recolour: { colour }, delete: {} }[name] };
  }

  act(action) {
    if (!this.mask) return;
    if (action.do === 'scale' && !(action.factor > 0)) { this.on.say('The factor must be above 0.'); return; }
    const { chosen } = this;
    this.change(() => this.story.add({ select: chosen, ...action }), { ...action, chosen });
  }

  /** Does something to the story, and shows what came of it. */
  change(does, { by, chosen, do: action } = {}) {
    this.gizmo.commit();
    try { does(); } catch (error) { this.on.say(error.message); return; }
    this.preview({});
    this.on.changed(this.story.scene);
    const copied = action === 'duplicate' && chosen.object ? { object: this.story.scene.objects.at(-1) } : chosen;
    const next = action === 'delete' ? null : by ? shifted(copied, by) : this.chosen;
    this.choose(next && select(this.story.scene, next).count ? next : null);
  }

  async save() {
    this.gizmo.commit();
    const { lines } = this.story;
    await this.on.keep(lines, this.story.saved).then(() => { this.story.saved = lines; }, (error) => this.on.say(error.message));
    this.show();
  }

  async read(file) {
    if (!file) return;
    try {
      const edits = (await file.text()).split('\n').filter((line) => line.trim()).map((line) => JSON.parse(line));
      if (!edits.length) throw new Error();
      this.change(() => this.story.replay(edits));
    } catch { this.on.say(`There are no edits in ${file.name}; choose a world.edits.jsonl.`); }
    $('open').value = '';
  }

  get wires() { return this.open ? [...wiresOf(this.chosen), ...(this.put.spot ? marker(this.put.spot) : [])] : []; }

  show() {
    const { story, chosen, mask } = this, kind = chosen && Object.keys(chosen)[0];
    const any = story.scene.objects.some((number) => number > 0), object = document.querySelector('[data-tool=object]');
    object.disabled = !any;
    object.title = any ? '' : 'This place has no separate objects';
    $('count').textContent = !chosen ? 'Nothing selected' : `${(mask?.count ?? 0).toLocaleString('en')} selected${kind === 'object' ? `: ${story.scene.names[chosen.object - 1] || `object ${chosen.object}`}` : ''}`;
    $('tool-said').textContent = SAID[this.selecting.tool] + (mask ? MOVES : '');
    $('drop-chosen').hidden = !chosen;
    $('actions').disabled = !mask;
    $('numbers').replaceChildren(...(NAMES[kind] ?? []).map((name, at) => {
      const label = Object.assign(document.createElement('label'), { textContent: name });
      label.append(Object.assign(document.createElement('input'), { value: chosen[kind][at], ariaLabel: name }));
      return label;
    }));
    $('edits-count').textContent = story.edits.length ? `${story.edits.length} edit${story.edits.length > 1 ? 's' : ''}` : 'No edits';
    $('undo').disabled = !story.edits.length;
    $('redo').disabled = !story.undone.length;
    $('save').disabled = !story.unsaved;
    $('edits').replaceChildren(...story.edits.map((edit, at) => Object.assign(document.createElement('li'), { textContent: describe(edit, story.scene.names), title: JSON.stringify(edit) })));
    [...$('edits').children].forEach((item, at) => { item.dataset.number = at + 1; });
    $('edits').scrollTop = 1e6;
  }
}

/** A selection that went along with what it selects. */
function shifted(chosen, by) {
  const [kind, n] = Object.entries(chosen)[0], every = { box: 3, sphere: 4, brush: 4 }[kind];
  const round = (value) => Math.round(value * 1000) / 1000;
  return every ? { [kind]: n.map((part, at) => round(part + (by[at % every] ?? 0))) } : chosen;
}
