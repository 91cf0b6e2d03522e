// Keys, mouse and fingers: the motion that they ask for (forward, left, turn, up), and drags.

const KEYS = { KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1], KeyA: [1, 1], KeyD: [1, -1], ArrowLeft: [2, 1], ArrowRight: [2, -1], Space: [3, 1], KeyC: [3, -1] };
const STICK = 60;  // pixels from a thumb's rest to full speed

export class Hands {
  /** on: look(dx, dy in pixels), zoom(factor of two fingers), tool(event name, pointer event) -> whether it takes it, key(event) -> likewise,
   * still() -> whether no thumb walks, moved(). */
  constructor(canvas, stick, on) {
    Object.assign(this, { held: new Set(), fingers: new Map(), thumb: [0, 0], on, fast: false });
    addEventListener('keydown', (event) => {
      this.fast = event.shiftKey;
      const slider = event.target.closest?.('[type=range]') && /^(Arrow|Page|Home|End)/.test(event.code);  // it takes these keys alone
      if (slider || event.target.closest?.('input:not([type=range]), textarea') || event.ctrlKey || event.metaKey || event.altKey) return;
      if (on.key(event)) { event.preventDefault(); return; }
      if (!(event.code in KEYS)) return;
      if (event.target.closest?.('button') && event.code === 'Space') return;
      event.preventDefault();
      this.held.add(event.code);
      on.moved();
    });
    addEventListener('keyup', (event) => { this.fast = event.shiftKey; this.held.delete(event.code); on.moved(); });
    addEventListener('blur', () => { this.held.clear(); on.moved(); });
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('pointerdown', (event) => this.down(event, canvas, stick));
    canvas.addEventListener('pointermove', (event) => this.drag(event, stick));
    for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, (event) => this.up(event, stick));
  }

  get wish() {
    const wish = [this.thumb[1], -this.thumb[0], 0, 0], pace = this.fast ? 2 : 1;
    for (const code of this.held) wish[KEYS[code][0]] += KEYS[code][1];
    return wish.map((part, a) => Math.max(-1, Math.min(1, part)) * (a < 2 ? pace : 1));
  }

  down(event, canvas, stick) {
    document.activeElement?.blur?.();
    canvas.setPointerCapture(event.pointerId);
    const tool = event.button === 0 && this.on.tool('down', event);
    const walks = !tool && event.pointerType === 'touch' && !this.on.still() && event.clientX < innerWidth * 0.45;
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY, does: tool ? 'tool' : walks ? 'walk' : 'look' });
    if (walks) Object.assign(stick, { hidden: false }) && Object.assign(stick.style, { left: `${event.clientX}px`, top: `${event.clientY}px` });
  }

  drag(event, stick) {
    const finger = this.fingers.get(event.pointerId);
    if (!finger) { this.on.tool('over', event); return; }
    const dx = event.clientX - finger.x, dy = event.clientY - finger.y;
    if (finger.does === 'tool') this.on.tool('drag', event);
    else if (finger.does === 'walk') {
      const long = Math.max(STICK, Math.hypot(dx, dy));
      this.thumb = [dx / long, -dy / long];
      stick.firstElementChild.style.transform = `translate(${(dx / long) * STICK}px, ${(dy / long) * STICK}px)`;
      this.on.moved();
    } else {
      const other = [...this.fingers.values()].find((one) => one !== finger && one.does === 'look'), apart = (x, y) => Math.hypot(x - other.x, y - other.y);
      if (other) this.on.zoom(apart(event.clientX, event.clientY) / Math.max(apart(finger.x, finger.y), 1));
      else this.on.look(dx, dy);
      Object.assign(finger, { x: event.clientX, y: event.clientY });
    }
  }

  up(event, stick) {
    const finger = this.fingers.get(event.pointerId);
    this.fingers.delete(event.pointerId);
    if (finger?.does === 'tool') this.on.tool('up', event);
    if (finger?.does === 'walk') {
      this.thumb = [0, 0];
      stick.hidden = true;
      stick.firstElementChild.style.transform = '';
      this.on.moved();
    }
  }
}
