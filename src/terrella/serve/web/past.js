// The timeline below the picture: the range of the past, and the moment shown.

const $ = (id) => document.getElementById(id);

/** Writes a figure where it has changed. */
export function write(id, value, unit = '') {
  const node = $(id), text = `${value}${unit}`;
  if (node.dataset.text === text) return;
  node.dataset.text = text;
  node.replaceChildren(String(value));
  if (unit) node.append(Object.assign(document.createElement('small'), { textContent: unit }));
}

export class Past {
  /** now: the newest figures of a frame (step, oldest, newest); `send(message)` tells the server; `toast(text)` a person. */
  constructor(now, send, toast) {
    Object.assign(this, { now, send, toast, why: '', dt_s: 0, ticks: [], aim: 0, rewinding: null, dirty: true, scrubbing: false, scrubbed: 0 });
    $('rewind').onpointerdown = (event) => { event.target.closest('button').setPointerCapture(event.pointerId); this.startRewind(); };
    for (const name of ['pointerup', 'pointercancel', 'lostpointercapture']) $('rewind').addEventListener(name, () => this.stopRewind());
    $('rewind').oncontextmenu = (event) => event.preventDefault();
    $('timeline').onpointerdown = (event) => { if (this.why) return; this.scrubbing = true; $('timeline').setPointerCapture(event.pointerId); this.scrub(event); };
    $('timeline').onpointermove = (event) => { if (this.scrubbing) this.scrub(event); };
    $('timeline').onpointerup = $('timeline').onpointercancel = (event) => { if (this.scrubbing && event.type === 'pointerup') { this.scrubbed = 0; this.scrub(event); } this.scrubbing = false; };
  }

  /** A slider's keys: a tenth of a second, a second, and the ends; says whether the key was one of them. */
  key(code) {
    const { now } = this, second = Math.max(1, Math.round(1 / this.dt_s)), tenth = Math.max(1, Math.round(second / 10));
    const to = { ArrowLeft: now.step - tenth, ArrowDown: now.step - tenth, ArrowRight: now.step + tenth, ArrowUp: now.step + tenth, PageDown: now.step - second, PageUp: now.step + second, Home: now.oldest, End: now.newest }[code];
    if (to === undefined) return false;
    if (this.why) this.toast(this.why); else this.seek(to);
    return true;
  }

  /** Takes a world; `why` it knows no way back, '' where it does. */
  take(world, why) {
    this.dt_s = world.dt_s;
    this.why = $('timeline').title = why;
    $('app').classList.toggle('no-rewind', !!why);
  }

  /** Takes a frame before its figures are those of now; `fresh`: an episode begins with it. */
  pass(frame, fresh) {
    if (frame.step < this.now.oldest || frame.newest < this.now.newest) this.ticks = this.ticks.filter((step) => step <= frame.newest);
    if (fresh) this.ticks.push(frame.step);
    this.dirty = true;
  }

  draw() {
    const { now } = this, span = now.newest - now.oldest, part = span ? (now.step - now.oldest) / span : 1;
    this.dirty = false;
    $('fill').style.transform = `scaleX(${part})`;
    $('thumb').style.left = `${part * 100}%`;
    const shown = this.ticks.filter((step) => step > now.oldest && step <= now.newest);
    while ($('ticks').childElementCount < shown.length) $('ticks').append(document.createElement('i'));
    while ($('ticks').childElementCount > shown.length) $('ticks').lastChild.remove();
    shown.forEach((step, index) => { $('ticks').children[index].style.left = `${((step - now.oldest) / span) * 100}%`; });
    write('time-left', this.why ? this.why : !span ? '' : `−${(span * this.dt_s).toFixed(0)} s`);
    write('time-right', this.why || !span ? '' : 'now');
    write('past-time', `−${((now.newest - now.step) * this.dt_s).toFixed(1)} s`);
    const line = $('timeline');
    line.ariaValueMin = now.oldest; line.ariaValueMax = now.newest; line.ariaValueNow = now.step;
    line.ariaValueText = now.step === now.newest ? 'now' : `${((now.newest - now.step) * this.dt_s).toFixed(1)} seconds ago`;
  }

  seek(step) {
    this.aim = Math.min(this.now.newest, Math.max(this.now.oldest, Math.round(step)));
    this.send({ type: 'seek', step: this.aim });
  }

  scrub(event) {
    const { now } = this, box = $('timeline').getBoundingClientRect(), part = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    if (event.timeStamp - this.scrubbed < 25 && event.type === 'pointermove') return;
    this.scrubbed = event.timeStamp;
    this.seek(now.oldest + part * (now.newest - now.oldest));
  }

  startRewind() {
    if (this.why) return this.toast(this.why);
    if (this.rewinding !== null) return;
    const begun = performance.now(), rate = 1 / this.dt_s / 30;
    this.aim = this.now.step;
    $('rewind').classList.add('on');
    this.rewinding = setInterval(() => this.seek(this.aim - Math.max(1, rate * (1 + Math.min(4, (performance.now() - begun) / 900)))), 33);
    this.seek(this.aim - 1);
  }

  stopRewind() {
    clearInterval(this.rewinding);
    this.rewinding = null;
    $('rewind').classList.remove('on');
  }
}
