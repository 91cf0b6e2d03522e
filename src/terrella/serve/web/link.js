// The connection: one WebSocket, frames decoded off the main thread, acknowledged, and reconnection.

const VERSION = 4, HEADER = 56;
export const DONE = 1, FRESH = 2, REPLAY = 4, BEYOND = 8;

/** A frame message (see serve/protocol.py) as its numbers and its JPEG bytes. */
export function readFrame(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(0) !== VERSION) throw new Error('this page and the server have different versions; reload it');
  const frame = {
    flags: view.getUint8(1), seq: view.getUint32(4, true), step: view.getUint32(8, true), oldest: view.getUint32(12, true),
    newest: view.getUint32(16, true), actionId: view.getUint32(20, true), generationMs: view.getFloat32(24, true),
    score: view.getFloat32(28, true), clientMs: view.getFloat64(32, true), uncertainty: view.getFloat32(48, true),
    drifted: view.getFloat32(52, true), images: [],
  };
  let at = HEADER;
  for (let left = view.getUint16(2, true); left > 0; left--) {
    const length = view.getUint32(at + 4, true);
    frame.images.push({ world: view.getUint8(at), camera: view.getUint8(at + 1), jpeg: new Uint8Array(buffer, at + 8, length) });
    at += 8 + length;
  }
  frame.vitals = [];
  for (; at + 4 <= buffer.byteLength; at += 4) frame.vitals.push(view.getFloat32(at, true));
  return frame;
}

export class Link {
  /** hooks: frame(frame, bitmaps), event(body), state(name, text). */
  constructor(hooks) {
    this.hooks = hooks;
    this.query = new URLSearchParams(location.search);
    this.session = sessionStorage.getItem('terrella-session');
    this.lastSeq = 0;
    this.attempt = 0;
    this.connected = false;
    this.everConnected = false;
    this.bytes = 0;
  }

  params() {
    const query = new URLSearchParams();
    if (this.query.has('token')) query.set('token', this.query.get('token'));
    return query;
  }

  connect() {
    const query = this.params();
    if (this.session) query.set('session', this.session);
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    const socket = new WebSocket(`${scheme}://${location.host}/play?${query}`);
    this.socket = socket;
    this.refused = '';
    socket.binaryType = 'arraybuffer';
    if (this.attempt <= 2) this.hooks.state(this.everConnected ? 'reconnecting' : 'connecting');
    socket.onmessage = ({ data }) => (typeof data === 'string' ? this.onEvent(JSON.parse(data)) : this.onFrame(data));
    socket.onclose = (event) => this.onClose(event);
  }

  onEvent(body) {
    if (body.type === 'hello') {
      this.session = body.session;
      sessionStorage.setItem('terrella-session', body.session);
      this.connected = this.everConnected = true;
      this.attempt = 0;
      this.lastSeq = 0;
      this.order = Promise.resolve();
    }
    if (body.type === 'error') this.refused = body.text;
    this.hooks.event(body);
  }

  async onFrame(buffer) {
    const socket = this.socket, frame = readFrame(buffer);
    this.bytes += buffer.byteLength;
    let bitmaps = null;
    try {
      bitmaps = await Promise.all(frame.images.map(({ jpeg }) => createImageBitmap(new Blob([jpeg], { type: 'image/jpeg' }))));
    } catch (error) {
      console.error('a frame could not be decoded', error);
    }
    if (socket !== this.socket) return;
    this.send({ type: 'ack', seq: frame.seq });
    if (!bitmaps || frame.seq <= this.lastSeq) return;
    this.lastSeq = frame.seq;
    this.hooks.frame(frame, bitmaps);
  }

  async onClose(event) {
    this.connected = false;
    if (event.code === 4001) return this.hooks.state('elsewhere', 'This world was opened in another page.');
    if (event.code === 1013 || event.code === 1008) return this.hooks.state('refused', this.refused || event.reason);
    this.attempt += 1;
    if (!this.everConnected || this.attempt > 2) {
      const why = await this.whyNot();
      if (why) return this.hooks.state('refused', why);
    }
    this.hooks.state(this.attempt > 2 && this.everConnected ? 'away' : this.everConnected ? 'reconnecting' : 'connecting');
    this.timer = setTimeout(() => this.connect(), Math.min(4000, 250 * 2 ** this.attempt));
  }

  /** The server's own words for refusing this page; empty where it is merely away. */
  async whyNot() {
    try {
      const answer = await fetch(`/check?${this.params()}`);
      return answer.ok ? '' : await answer.text();
    } catch {
      return '';
    }
  }

  send(message) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  /** The bytes of an image file (at most 64 kB): a new episode begins with it, or it is the agent's goal. */
  sendPicture(bytes, asGoal = false) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(asGoal ? new Blob([new Uint8Array(1), bytes]) : bytes);
  }

  clipAddress() {
    return `/clip/${this.session}.mp4?${this.params()}`;
  }
}
