// The sun of a place that was built: the server bakes another light, and the page opens the place anew.

import { reach } from './reach.js';

const EYE = 'terrella-eye';

/** Keeps where one stands while the page is loaded again. */
export function keepEye(text) { try { sessionStorage.setItem(EYE, text); } catch { /* it begins where others do */ } }

/** What `keepEye` kept, once; null: nothing. */
export function keptEye() {
  try { const text = sessionStorage.getItem(EYE); sessionStorage.removeItem(EYE); return text; } catch { return null; }
}

export class Light {
  /** panel: its parts are named by data-light; on: light {time, sun, times}, address, command, key, unsaved(), say(text), leave(). */
  constructor(panel, on) {
    if (!on.address || !on.light) return;
    panel.hidden = false;
    const part = (name) => panel.querySelector(`[data-light=${name}]`);
    Object.assign(this, { on, time: part('time'), bake: part('bake'), dials: ['heading', 'height'].map((name) => [part(name), part(`${name}-said`)]) });
    this.time.append(...Object.keys(on.light.times).map((name) => Object.assign(document.createElement('option'), { value: name, textContent: name })));
    this.time.value = on.light.time;
    this.time.onchange = () => this.turn(on.light.times[this.time.value]);
    for (const [dial] of this.dials) { dial.oninput = () => this.say(); dial.onpointerup = () => dial.blur(); }
    this.bake.onclick = () => this.relight();
    this.turn(on.light.sun ?? on.light.times[on.light.time]);
  }

  /** Shows a sun; null: there is none. */
  turn(sun) {
    this.dials.forEach(([dial], k) => { dial.disabled = !sun; if (sun) dial.value = sun[k]; });
    this.say();
  }

  say() { for (const [dial, said] of this.dials) said.textContent = dial.disabled ? '–' : `${dial.value}°`; }

  async relight() {
    const { on, time, bake } = this;
    if (on.unsaved()) { on.say('A new light is of the saved place; save the edits first.'); return; }
    const sun = this.dials.map(([dial]) => Number(dial.value)), usual = on.light.times[time.value];
    const light = { time: time.value, sun: usual && sun.some((part, k) => Math.abs(part - usual[k]) > 0.5) ? sun : null, key: on.key };
    Object.assign(bake, { disabled: true, textContent: 'Baking …' });
    try {
      await reach(on.address + location.search, on.command, { method: 'POST', body: JSON.stringify(light) });
      if (on.unsaved()) throw new Error('The new light is baked. Save your edits, then load the page again to see it.');
      on.leave();
      location.reload();
    } catch (error) {
      on.say(error.message);
      Object.assign(bake, { disabled: false, textContent: 'Relight' });
    }
  }
}
