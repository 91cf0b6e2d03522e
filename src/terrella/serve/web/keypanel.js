// The panel of keys: what each key does, changed by a click and a key press.

import { keyLabel } from './keycaps.js';

const BROWSERS = /^(Control|Alt|Meta|OS|ContextMenu)/;

/** code -> place without `gone`, with `code` for `place` where one is given. Combinations follow the keys they are made of. */
export function rebound(keys, gone, code, place) {
  const lost = keys[code], kept = Object.entries(keys).filter(([key]) => key !== code && !key.includes('+'));
  const made = kept.flatMap(([key, at]) => (key !== gone ? [[key, at]] : code ? [[code, place]] : []));
  if (code && !code.includes('+') && !(gone in Object.fromEntries(kept))) made.push([code, place]);
  const another = (at) => made.find(([, other]) => other === at)?.[0];
  const moved = (part) => (part === gone ? code ?? another(keys[gone]) : part === code ? another(lost) : part);
  for (const [key, at] of Object.entries(keys)) {
    if (!key.includes('+') || key === code) continue;
    const parts = key === gone ? [] : key.split('+').map(moved);
    if (parts.length && parts.every(Boolean)) made.push([parts.join('+'), at]);
  }
  if (code?.includes('+')) made.push([code, place]);
  return Object.fromEntries(made);
}

export class KeyPanel {
  /** `changed()` is called when keys or names have changed; `pageUse(code)` says what the page itself does with a key, or ''. */
  constructor(root, { changed, pageUse, quiet }) {
    Object.assign(this, { root, changed, pageUse, quiet, world: null, asked: null });
    this.list = root.querySelector('ul');
    this.said = root.querySelector('#keys-said');
    this.reset = root.querySelector('#keys-reset');
    this.reset.onclick = () => this.restore();
    addEventListener('keydown', (event) => this.onDown(event), true);
    addEventListener('keyup', (event) => this.onUp(event), true);
    addEventListener('storage', (event) => { if (event.key === this.place) this.follow(); });  // of another page
    addEventListener('pointerdown', (event) => { if (this.asked && !event.target.closest('.cap.asking')) this.ask(null); }, true);
  }

  get open() { return !this.root.hidden; }

  toggle(open = !this.open) {
    this.root.hidden = !open;
    this.asked = null;
    if (open) { this.say(''); this.draw(); }
  }

  // -- storage -----------------------------------------------------------------------------------------------------

  /** Takes a world as the server tells it, and what this browser keeps of it; says whether that is something to tell the server. */
  take(world) {
    const before = this.world;
    this.world = world;
    this.asked = null;
    this.place = `terrella-keys:${world.name}`;
    this.served = JSON.stringify([world.first_keys, world.actions.map(({ first_name }) => first_name)]);
    const found = world.kept_in ? null : this.stored();
    if (found?.served === this.served) {
      world.keys = found.keys;
      for (const [at, name] of found.names) this.call(at, name);
    } else if (before && !world.kept_in && before.name === world.name && this.lostStore) {
      Object.assign(world, { keys: before.keys, actions: before.actions });  // a browser that keeps nothing, after a reconnection
    }
    if (this.open) this.draw();
    return this.edited && !world.kept_in;
  }

  /** Takes what another page of this browser keeps now. */
  follow() {
    this.asServed();
    this.take(this.world);
    this.changed();
  }

  /** The names that were changed, each with the place of one of its actions. */
  get names() {
    const { actions } = this.world, first = (at) => actions.findIndex(({ of }) => of === actions[at].of) === at;
    return actions.flatMap(({ name, first_name }, at) => (name !== first_name && first(at) ? [[at, name]] : []));
  }

  get edited() { return this.names.length > 0 || JSON.stringify(this.world.keys) !== JSON.stringify(this.world.first_keys); }

  stored() {
    try { return JSON.parse(localStorage.getItem(this.place)); } catch { return null; }
  }

  store() {
    if (this.world.kept_in) return;
    try {
      if (this.edited) localStorage.setItem(this.place, JSON.stringify({ served: this.served, keys: this.world.keys, names: this.names }));
      else localStorage.removeItem(this.place);
    } catch { this.lostStore = true; }
  }

  use(sentence = '') {
    this.store();
    this.say(sentence);
    this.draw();
    this.changed();
  }

  asServed() {
    this.world.keys = { ...this.world.first_keys };
    for (const action of this.world.actions) action.name = action.first_name;
  }

  restore() {
    this.asServed();
    this.asked = null;
    this.use('Keys and names are reset.');
  }

  // -- asking for a key -------------------------------------------------------------------------------------------------

  /** Waits for a key: instead of `code`, or as one more for the action at `place`. null: waits no more. */
  ask(code, place = this.world?.keys[code]) {
    this.asked = place === undefined || place === null ? null : { code, place, pressed: [] };
    if (this.asked) { this.quiet(); this.say('Press the key. Backspace removes it, Escape cancels.'); } else this.say('');
    this.draw();
    this.list.querySelector('.asking')?.scrollIntoView({ block: 'nearest' });
  }

  onDown(event) {
    if (!this.asked) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (event.repeat) return;
    if (event.code === 'Escape') return this.ask(null);
    if (event.code === 'Backspace') return this.drop();
    if (!event.code || BROWSERS.test(event.code)) return this.say('Ctrl, Alt and similar keys belong to the browser; press another key.');
    this.asked.pressed.push(event.code);
    if (this.world.resting === null || this.asked.pressed.length > 3) this.bind();  // keys of buttons add up by themselves
  }

  onUp(event) {
    if (!this.asked?.pressed.includes(event.code)) return;
    event.stopImmediatePropagation();
    this.bind();
  }

  bind() {
    const { code: gone, place, pressed } = this.asked, { keys, actions } = this.world;
    const code = pressed.join('+'), other = keys[code], meant = this.words(place);
    this.asked = null;
    if (code === gone || other === place) return this.ask(null);
    this.world.keys = rebound(keys, gone, code, place);
    this.use(this.conflict(code, meant, other));
  }

  words(place) {
    const { name, sign } = this.world.actions[place];
    return name + sign;
  }

  /** What else a key did until now, in a sentence; '' where it did nothing. */
  conflict(code, meant, other) {
    const label = keyLabel(code), use = this.pageUse(code);
    if (other !== undefined) {
      const bare = !Object.values(this.world.keys).includes(other);
      return `${label} was “${this.words(other)}” and is now “${meant}”${bare ? '; “' + this.words(other) + '” has no key any more' : ''}.`;
    }
    return use ? `${label} also ${use} on this page. The world’s keys come first; use the button for that.` : '';
  }

  drop() {
    const { code, place } = this.asked;
    this.asked = null;
    if (!code) return this.ask(null);
    this.world.keys = rebound(this.world.keys, code, null, place);
    this.use(Object.values(this.world.keys).includes(place) ? '' : `“${this.words(place)}” has no key.`);
  }

  /** Names an action, and what else has that name: the other end of an axis. */
  call(place, name) {
    const { actions } = this.world;
    for (const action of actions) if (action.of === actions[place].of) action.name = name;
  }

  rename(place, input) {
    const name = input.value.trim(), { actions } = this.world;
    if (name === actions[place].name) return;
    const twice = actions.some((action) => action.of !== actions[place].of && action.name.toLowerCase() === name.toLowerCase());
    if (!name || twice) {
      input.value = actions[place].name;
      return this.say(name ? `“${name}” is the name of another action.` : 'An action has a name of one letter or more.');
    }
    this.call(place, name);
    this.use();
  }

  // -- display -------------------------------------------------------------------------------------------------------

  say(sentence) {
    const clashes = this.world ? Object.keys(this.world.keys).filter((code) => this.pageUse(code)) : [];
    const standing = clashes.length ? `${clashes.map(keyLabel).join(', ')}: the world’s keys come first; use the page’s buttons instead of ${clashes.length > 1 ? 'these keys' : 'this key'}.` : '';
    this.said.textContent = sentence || standing;
    this.said.classList.toggle('warn', !!sentence && !sentence.startsWith('Press'));
  }

  draw() {
    const { actions, keys, kept_in: kept } = this.world, make = (tag, fields) => Object.assign(document.createElement(tag), fields);
    this.root.querySelector('#keys-kept').textContent = kept ? `Kept ${kept}: they are the world’s from now on.` : this.lostStore ? 'This browser keeps nothing: they last until the page is closed.' : 'Kept in this browser, for this world.';
    this.reset.hidden = !this.edited;
    this.list.replaceChildren(...actions.map(({ name, of, sign }, place) => {
      const row = make('li'), caps = make('span', { className: 'caps' });
      const title = of === null ? make('b', { textContent: name }) : make('input', { value: name, maxLength: 40, spellcheck: false, title: 'Click to rename' });
      if (of !== null) {
        title.setAttribute('aria-label', `Name of ${name + sign}`);
        title.onchange = () => this.rename(place, title);
        title.onkeydown = (event) => { if (event.code === 'Enter' || event.code === 'Escape') { if (event.code === 'Escape') title.value = name; title.blur(); } };
      }
      const cap = (code, text) => {
        const asking = this.asked?.place === place && this.asked.code === code;
        const button = make('button', { className: `cap${asking ? ' asking' : ''}${code ? '' : ' add'}`, textContent: asking ? 'press a key' : text });
        button.setAttribute('aria-label', code ? `Change ${text}, ${name + sign}` : `Add a key for ${name + sign}`);
        button.onclick = () => { this.ask(asking ? null : code, asking ? null : place); document.activeElement?.blur(); };
        return button;
      };
      const own = Object.keys(keys).filter((code) => keys[code] === place);
      if (place === this.world.resting) caps.append(make('em', { textContent: 'no key held' }));
      caps.append(...own.map((code) => cap(code, keyLabel(code))), cap(null, own.length || place === this.world.resting ? '+' : 'set a key'));
      const fitted = make('span', { className: 'fitted' });  // as wide as the name, so that the sign stands right behind it
      if (sign) { title.size = 1; fitted.append(make('span', { textContent: name }), title); }
      row.append(...(sign ? [fitted, make('span', { className: 'sign', textContent: sign })] : [title]), caps);
      return row;
    }));
  }
}
