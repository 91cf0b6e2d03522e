// The pictures: a canvas for each world and camera, as large as fits, and a glow behind them.

const GAP = 14;
const AIM = '<svg class="aim" viewBox="0 0 26 26" aria-hidden="true"><path d="M13 3v6M13 17v6M3 13h6M17 13h6"/><path class="hit" d="M5 5l5 5M16 16l5 5M21 5l-5 5M10 16l-5 5"/></svg>';

export class Screens {
  constructor(root, over, stage, glow) {
    Object.assign(this, { root, over, stage, canvases: new Map(), worlds: [], cameras: [] });
    this.glow = glow.getContext('2d', { alpha: false });
    this.shade = this.glow.createRadialGradient(16, 10, 3, 16, 10, 17);
    this.shade.addColorStop(0, '#0b0c0f70');
    this.shade.addColorStop(1, '#0b0c0f');
  }

  setWorlds(worlds) {
    this.worlds = worlds;
    this.cameras = [...new Map(worlds.flatMap((world) => world.cameras).map((camera) => [camera.channel, camera])).values()];
    this.canvases.clear();
    this.root.replaceChildren();
  }

  /** The canvas of a picture; made when its first picture comes. */
  canvas(image) {
    const key = `${image.world} ${image.camera}`;
    if (!this.canvases.has(key)) {
      const world = this.worlds[image.world], camera = world.cameras[image.camera];
      const figure = document.createElement('figure'), canvas = document.createElement('canvas');
      [canvas.height, canvas.width] = camera.size;
      figure.append(canvas);
      const caption = [world.label, this.cameras.length > 1 && camera.name].filter(Boolean).join(', ');
      if (world.aims && !image.camera) figure.insertAdjacentHTML('beforeend', AIM);
      if (caption) figure.append(Object.assign(document.createElement('figcaption'), { textContent: caption }));
      this.canvases.set(key, { order: image.world * 256 + image.camera, figure, context: canvas.getContext('2d', { alpha: false }) });
    }
    return this.canvases.get(key);
  }

  /** Paints the pictures of a frame, and shows those alone. */
  paint(images, bitmaps) {
    const shown = images.map((image) => this.canvas(image));
    shown.forEach((screen, at) => { screen.context.drawImage(bitmaps[at], 0, 0); bitmaps[at].close(); });
    const figures = [...shown].sort((a, b) => a.order - b.order).map((screen) => screen.figure);
    if (figures.length === this.root.childElementCount && figures.every((figure, at) => figure === this.root.children[at])) return;
    this.root.replaceChildren(...figures);
    this.layout();
  }

  get shown() { return [...this.root.children].map((figure) => figure.firstChild); }

  /** The largest size that fits, in whole screen pixels per picture pixel where that costs little; side by side or stacked. */
  layout() {
    const sizes = this.shown.map((canvas) => canvas.width / canvas.height), count = sizes.length;
    if (!count) return;
    const box = this.stage.getBoundingClientRect(), width = box.width - (innerWidth > 700 ? 40 : 0);
    const across = sizes.reduce((a, b) => a + b), down = sizes.reduce((a, b) => a + 1 / b, 0), tallest = Math.max(...this.shown.map((canvas) => canvas.height));
    let high = Math.min((width - GAP * (count - 1)) / across, box.height);  // of each picture, side by side
    const wide = Math.min(width, (box.height - 8 * (count - 1)) / down);  // of each picture, stacked
    const stacked = wide * wide * down > high * high * across;
    const whole = (size, pixels) => { const even = Math.floor(size / pixels * devicePixelRatio) * pixels / devicePixelRatio; return even / size > 0.88 ? even : size; };
    high = whole(high, tallest);
    const column = whole(wide, Math.max(...this.shown.map((canvas) => canvas.width)));
    this.root.classList.toggle('stacked', stacked);
    [...this.root.children].forEach(({ style }, at) => { [style.width, style.height] = stacked ? [`${column}px`, `${column / sizes[at]}px`] : [`${high * sizes[at]}px`, `${high}px`]; });
    this.over.style.width = `${stacked ? column : high * across + GAP * (count - 1)}px`;
    this.over.style.height = `${stacked ? column * down + 8 * (count - 1) : high}px`;
  }

  /** Something happened where one aims. */
  strike() {
    for (const cross of this.root.querySelectorAll('.aim')) {
      cross.classList.remove('struck');
      void cross.getBoundingClientRect();
      cross.classList.add('struck');
    }
  }

  flash() {
    for (const figure of this.root.children) {
      figure.classList.remove('flash');
      void figure.offsetWidth;
      figure.classList.add('flash');
    }
  }

  /** The picture's light on the wall behind it: few pixels, shaded here, for a mask or a blur in CSS costs every frame. */
  drawGlow() {
    const shown = this.shown, { width, height } = this.glow.canvas;
    if (!shown.length) return;
    this.glow.imageSmoothingQuality = 'high';
    this.glow.globalAlpha = 0.3;
    this.glow.drawImage(shown[shown.length - 1], 0, 0, width, height);
    this.glow.globalAlpha = 1;
    this.glow.fillStyle = this.shade;
    this.glow.fillRect(0, 0, width, height);
  }
}
