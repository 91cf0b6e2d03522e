// The futures that the agent considers: a strip of small pictures for each plan, the chosen one first, the others faded.

const $ = (id) => document.getElementById(id);
const NAMES = { 1: ['chosen'], 2: ['chosen', 'worst'], 3: ['chosen', 'middling', 'worst'] };

export class Futures {
  /** change(on): asks the server for them, or no longer. */
  constructor(change) {
    Object.assign(this, { change, open: false, there: false, considers: false, count: 0, driving: false, latest: 0 });
    this.list = $('futures-plans');
    $('futures-open').onclick = () => { this.toggle(); $('futures-open').blur(); };
  }

  /** Takes what a greeting says; what was open stays open. */
  take({ agent }) {
    this.there = !!agent;
    $('futures-open').hidden = !agent;
    this.set(this.there && (this.open || localStorage.getItem('terrella-futures') === 'open'));
  }

  toggle() {
    if (!this.there) return;
    this.set(!this.open);
    localStorage.setItem('terrella-futures', this.open ? 'open' : 'closed');
  }

  set(open) {
    this.open = open;
    $('futures').hidden = !open;
    $('futures-open').setAttribute('aria-pressed', open);
    this.change(open);
    this.tell();
  }

  /** An event `agent`. */
  follow({ driving, considers, name }) {
    Object.assign(this, { driving, considers, name });
    if (!driving || !considers) this.clear();
    this.tell();
  }

  clear() {
    this.latest += 1;
    this.list.replaceChildren();
  }

  tell() {
    const { driving, considers, name } = this, waits = driving && considers && !this.list.childElementCount;
    $('futures-said').textContent = !driving ? 'The futures that the agent considers appear here while it drives.'
      : waits ? 'Imagining futures …' : considers ? '' : `${name ? name[0].toUpperCase() + name.slice(1) : 'The agent'} does not plan, so it considers no futures.`;
  }

  /** An event `futures` (see serve/protocol.py). */
  async show({ plans, frames }) {
    if (!this.open) return;
    const turn = ++this.latest;
    const pictures = await Promise.all(plans.map(({ image }) => decoded(image)));
    if (turn !== this.latest) return;
    this.count += 1;
    this.list.replaceChildren(...plans.map(({ cost }, at) => {
      const row = document.createElement('li'), words = document.createElement('p'), strip = document.createElement('canvas');
      row.className = ['chosen', 'ghost', 'ghost far'][plans.length > 2 ? at : at && 2];
      words.append(Object.assign(document.createElement('b'), { textContent: NAMES[plans.length]?.[at] ?? `plan ${at + 1}` }),
        Object.assign(document.createElement('span'), { textContent: cost === null ? 'no cost' : `cost ${+cost.toPrecision(3)}` }));
      paint(strip, pictures[at], frames);
      row.append(words, strip);
      return row;
    }));
    this.tell();
  }
}

/** The frames of a strip, with a gap between them, later ones fainter: they are further from what is known. */
function paint(canvas, picture, frames) {
  const wide = picture.width / frames, gap = 3, context = canvas.getContext('2d');
  Object.assign(canvas, { width: picture.width + gap * (frames - 1), height: picture.height });
  for (let at = 0; at < frames; at++) {
    const x = at * (wide + gap);
    context.globalAlpha = 1 - (0.45 * at) / Math.max(1, frames - 1);
    context.beginPath();
    context.roundRect(x, 0, wide, picture.height, 4);
    context.save();
    context.clip();
    context.drawImage(picture, at * wide, 0, wide, picture.height, x, 0, wide, picture.height);
    context.restore();
  }
  picture.close();
}

function decoded(base64) {
  return createImageBitmap(new Blob([Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0))], { type: 'image/jpeg' }));
}
