// The thin bar that says how far to trust the picture: quiet while the world is sure.

export class Doubt {
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
    const [sure, invents] = this.limits;
    this.value = now || this.value < 0 ? error : this.value + 0.15 * (error - this.value);
    const bound = this.level === 'inventing' ? 0.85 : 1;  // a level is left later than it is entered: no flicker
    this.level = this.value >= bound * invents ? 'inventing' : this.value >= sure + bound * 0.4 * (invents - sure) ? 'unsure' : 'sure';
    const share = Math.min(1, this.value / (1.6 * invents)).toFixed(3);
    if (share === this.shown) return;
    this.shown = share;
    this.fill.style.transform = `scaleX(${share})`;
    this.root.dataset.level = this.level;
    this.root.ariaValueMax = 1.6 * invents;
    this.root.ariaValueNow = this.value;
    this.root.title = `${{ sure: 'It knows this place', unsure: 'It is less sure here', inventing: 'It trusts this little' }[this.level]}: the picture is expected to be off by ${(100 * this.value).toFixed(1)}% of full brightness`;
  }
}
