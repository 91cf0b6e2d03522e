// Draws where the browser cannot: frames come from the server that showed the page. It stands in for Drawing.

import { reach } from './reach.js';

const SMALL = 400, LARGE = 960;  // pixels of a frame's longer side, on the way and at rest

export class Remote {
  /** command: what starts the server; failed(text): a frame did not come. */
  constructor(canvas, address, command, failed) {
    Object.assign(this, { canvas, address, command, failed, context: canvas.getContext('2d'), remote: true, ready: true, count: 0, tint: 0, still: {}, busy: false, next: null });
  }

  set() {}

  mark() {}

  clear() {}

  /** Asks for the view of an eye through a lens; of several that are wished for while one comes, the last is drawn. */
  paint({ eye, lens, moves }) {
    this.next = { eye, lens, moves };
    if (!this.busy) this.fetch();
  }

  async fetch() {
    this.busy = true;
    while (this.next) {
      const { eye: { place, heading, pitch }, lens: { wide, tall }, moves } = this.next, { width, height } = this.canvas, query = new URLSearchParams(location.search);
      const share = Math.min(1, (moves ? SMALL : LARGE) / Math.max(width, height));
      this.next = null;
      const view = { x: place[0], y: place[1], z: place[2], heading, pitch, wide, tall, width: Math.round(share * width), height: Math.round(share * height) };
      Object.entries(view).forEach(([name, value]) => query.set(name, value));
      const frame = await this.frame(`${this.address}?${query}`).catch((error) => { this.failed(error.message); return null; });
      if (frame) this.context.drawImage(frame, 0, 0, this.canvas.width, this.canvas.height);
      if (frame) this.count += 1;
    }
    this.busy = false;
  }

  async frame(address) {
    return createImageBitmap(await (await reach(address, this.command)).blob());
  }
}
