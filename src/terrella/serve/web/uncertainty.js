// The thin bar under the picture that shows how much of it is invented, and the words "invented" and "position drifted".

const WORDS = { low: 'Little is invented', medium: 'Parts are invented', high: 'Most is invented' };

export class Uncertainty {
  constructor(root, fill) {
    Object.assign(this, { root, fill, value: -1, level: '', drifted: 0, shown: '' });
    this.limits = null;
    this.measure = '';  // what the error is of, and in which unit
  }

  /** [the error that is usual for this world, that from which it invents, that by drift from which the position is lost, that beyond
   *  which it is not to be trusted]; null where it does not say. */
  set levels(limits) {
    this.limits = limits;
    this.value = -1;
    this.root.hidden = !limits;
  }

  /** The error to expect of the frame just painted (mean, of intensities 0 to 1), and the part of it by a position that has drifted;
   *  the rest is invention. `now`: without easing. `late`: it has imagined longer than it was measured to be trusted. */
  show(error, drifted, now, late) {
    if (!this.limits || error < 0) return;
    const [usual, high, lost, trusted] = this.limits, first = now || this.value < 0, ease = (from, to) => first ? to : from + 0.15 * (to - from);
    this.value = ease(this.value, error - drifted);
    this.drifted = ease(this.drifted, drifted);
    const bound = this.level === 'high' ? 0.85 : 1;  // a level is left later than it is entered: no flicker
    this.level = this.value >= bound * high ? 'high' : this.value >= usual + bound * 0.4 * (high - usual) ? 'medium' : 'low';
    const away = this.drifted >= lost * (this.root.dataset.drifted === 'true' ? 0.85 : 1);
    const far = this.value + this.drifted >= trusted * (this.root.dataset.beyond === 'true' ? 0.9 : 1), beyond = far || late;
    const share = Math.min(1, this.value / (1.6 * high)).toFixed(3), percent = (part) => `${(100 * part).toFixed(1)}%`;
    const shown = `${share} ${percent(this.drifted)} ${beyond} ${far}`;
    if (shown === this.shown) return;
    this.shown = shown;
    this.fill.style.transform = `scaleX(${share})`;
    this.root.dataset.level = this.level;
    this.root.dataset.drifted = away;
    this.root.dataset.beyond = beyond;
    this.root.ariaValueMax = 1.6 * high;
    this.root.ariaValueNow = this.value;
    this.root.title = `${WORDS[this.level]}. ${this.measure}: ${percent(this.value)} by invention, `
      + `${percent(this.drifted)} by a position that has drifted. `
      + (far ? 'Beyond trust: nearer to a random one than to the truth'
        : late ? 'Beyond trust: it was measured to be nearer to a random one than to the truth after fewer steps' : 'Within trust');
  }
}
