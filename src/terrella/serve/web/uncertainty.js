// The thin bar under the picture that shows its expected error.

const WORDS = { low: 'Low uncertainty', medium: 'Raised uncertainty', high: 'High uncertainty' };

export class Uncertainty {
  constructor(root, fill) {
    Object.assign(this, { root, fill, value: -1, level: '', shown: '' });
    this.limits = null;
  }

  /** [the error that is usual for this world, the error from which it invents]; null where it does not say. */
  set levels(pair) {
    this.limits = pair;
    this.value = -1;
    this.root.hidden = !pair;
  }

  /** The error to expect of the frame just painted (mean, of intensities 0 to 1). `now`: without easing. */
  show(error, now) {
    if (!this.limits || error < 0) return;
    const [usual, high] = this.limits;
    this.value = now || this.value < 0 ? error : this.value + 0.15 * (error - this.value);
    const bound = this.level === 'high' ? 0.85 : 1;  // a level is left later than it is entered: no flicker
    this.level = this.value >= bound * high ? 'high' : this.value >= usual + bound * 0.4 * (high - usual) ? 'medium' : 'low';
    const share = Math.min(1, this.value / (1.6 * high)).toFixed(3);
    if (share === this.shown) return;
    this.shown = share;
    this.fill.style.transform = `scaleX(${share})`;
    this.root.dataset.level = this.level;
    this.root.ariaValueMax = 1.6 * high;
    this.root.ariaValueNow = this.value;
    this.root.title = `${WORDS[this.level]}: expected error of the picture: ${(100 * this.value).toFixed(1)}% of full brightness`;
  }
}
