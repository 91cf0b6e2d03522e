// The agent's goal: a place clicked on the map, a picture that was saved or dropped, or an instruction.

const $ = (id) => document.getElementById(id);
const FORGET_M = 0.6;  // a click so near to the goal takes it away

export class Goal {
  /** send(message); map: the map of places (map.js); say(sentence); quiet() lets go of all controls; go(): play goes on. */
  constructor(hooks) {
    Object.assign(this, hooks, { places: false, pictures: false, words: false, at: null, shown: '', instruction: '' });
    $('goal-keep').onclick = () => { this.keep(); $('goal-keep').blur(); };
    $('goal-forget').onclick = () => this.send({ type: 'goal' });
    this.map.canvas.addEventListener('click', (event) => this.click(event));
    $('words').onkeydown = (event) => {
      if (event.code === 'Enter' || event.code === 'NumpadEnter') this.tell($('words').value.trim());
      if (event.code === 'Enter' || event.code === 'NumpadEnter' || event.code === 'Escape') $('words').blur();
    };
  }

  /** Takes what a greeting says. */
  take({ goals }) {
    Object.assign(this, goals);
    $('goal-keep').hidden = !this.pictures;
    $('goal').classList.toggle('asks', this.words);
    $('map').classList.toggle('walkable', this.places);
    $('drop').classList.toggle('two', this.pictures);
  }

  /** The picture of now is the goal, for when the agent is let to drive. */
  keep() {
    if (!this.pictures) return;
    this.send({ type: 'goal', here: true });
    this.say('This is the goal now: go elsewhere, and let the agent drive (G) to come back.');
  }

  /** An instruction is the goal. */
  tell(words) {
    if (!words) return;
    this.quiet();
    this.send({ type: 'goal', words });
    this.go();
  }

  click(event) {
    const place = this.places && this.map.place(event.offsetX, event.offsetY);
    if (!place) return;
    const near = this.at && Math.hypot(place[0] - this.at[0], place[1] - this.at[1]) < FORGET_M;
    if (!near) this.quiet();
    this.send(near ? { type: 'goal' } : { type: 'goal', at: place });
    if (!near) this.go();
  }

  /** An event `goal` (see serve/protocol.py). */
  async show({ at, image, words }) {
    this.at = at;
    this.instruction = words ?? '';
    this.map.goal = at;
    this.map.draw();
    $('goal').classList.toggle('show', !!image);
    $('goal').classList.toggle('instructed', !!words);
    if (document.activeElement !== $('words')) $('words').value = words ?? '';
    this.shown = image ?? '';
    if (!image) return;
    const picture = await createImageBitmap(new Blob([Uint8Array.from(atob(image), (letter) => letter.charCodeAt(0))], { type: 'image/jpeg' }));
    const canvas = $('goal').querySelector('canvas');
    Object.assign(canvas, { width: picture.width, height: picture.height });
    canvas.getContext('2d').drawImage(picture, 0, 0);
    picture.close();
  }

  /** Whether a picture that is dropped at x is a goal, not a beginning. */
  dropped(x) { return this.pictures && x > innerWidth / 2; }
}
