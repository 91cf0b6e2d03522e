// The edits of a place: those in force, those undone, and the scene after them.

import { edited } from './edits.js';

export class Story {
  /** others: a Map of the scenes that edits merge, by their sha256. */
  constructor(source, edits, others = new Map()) {
    Object.assign(this, { edits: [], undone: [], scene: source, others });
    this.begin(source, edits);
  }

  /** Another source, with the edits that were saved of it. */
  begin(source, edits) {
    this.source = source;
    this.replay(edits);
    this.saved = this.lines;
  }

  get lines() { return this.edits.map((edit) => `${JSON.stringify(edit)}\n`).join(''); }

  get unsaved() { return this.lines !== this.saved; }

  /** Takes these edits in place of those in force; an Error leaves all as it was. */
  replay(edits, undone = []) {
    const scene = edits.reduce((before, edit) => edited(before, edit, this.others), this.source);
    Object.assign(this, { edits: [...edits], undone, scene });
  }

  add(edit) {
    this.scene = edited(this.scene, edit, this.others);
    this.edits.push(edit);
    this.undone = [];
  }

  undo() {
    if (this.edits.length) this.replay(this.edits.slice(0, -1), [...this.undone, this.edits.at(-1)]);
  }

  redo() {
    if (this.undone.length) this.replay([...this.edits, this.undone.at(-1)], this.undone.slice(0, -1));
  }
}
