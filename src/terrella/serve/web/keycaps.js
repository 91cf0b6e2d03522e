// The key hints: caps laid out as on a keyboard, with the world's own names of what they do.

const PLACES = {
  KeyQ: [0, 1, 1], KeyW: [0, 1, 2], KeyE: [0, 1, 3], KeyA: [0, 2, 1], KeyS: [0, 2, 2], KeyD: [0, 2, 3],
  ArrowUp: [1, 1, 2], ArrowLeft: [1, 2, 1], ArrowDown: [1, 2, 2], ArrowRight: [1, 2, 3],
};
const GLYPHS = {
  ArrowUp: '↑', ArrowDown: '↓', ArrowLeft: '←', ArrowRight: '→', Space: 'Space', Enter: '⏎', Backspace: '⌫', Minus: '-', Equal: '=',
  BracketLeft: '[', BracketRight: ']', Semicolon: ';', Quote: "'", Backquote: '`', Comma: ',', Period: '.', Slash: '/', Backslash: '\\',
};
let layout = null;  // what is printed on the keys of this keyboard, where the browser tells

/** Asks the browser what this keyboard's keys are called; then calls `redraw`. */
export async function learnLayout(redraw) {
  try {
    layout = await navigator.keyboard.getLayoutMap();
    redraw();
  } catch { /* Firefox and Safari do not tell: keys are named as on an American keyboard */ }
}

/** What is printed on a key, or on several ("ArrowUp+Space"). */
export function keyLabel(code) {
  if (code.includes('+')) return code.split('+').map(keyLabel).join(' + ');
  if (layout?.has(code)) return layout.get(code).toUpperCase();
  return GLYPHS[code] ?? code.replace(/^(Key|Digit)/, '').replace(/^Numpad/, 'Num ').replace(/Left$|Right$/, '');
}

/** What a key does, in the world's words. */
export function keyMeaning(world, code) {
  const { name, sign } = world.actions[world.keys[code]];
  return name + sign;
}

const MOVES = new Set(['forward', 'backward', 'back', 'left', 'right', 'up', 'down', 'north', 'south', 'east', 'west']);

/** One word for what several keys do: "turn" of "turn left" and "turn right", "move" of directions alone. */
function together(meanings) {
  const rest = meanings.map((meaning) => meaning.split(/[\s:+−-]+/).filter((word) => word && !MOVES.has(word.toLowerCase())).join(' '));
  return rest.every((words) => words === rest[0]) ? rest[0] || 'move' : meanings.length < 3 ? meanings.join(', ') : 'move';
}

/** What a person presses first: [[codes, word], ...]; deeds such as "attack", then what moves. */
export function hintsOf(world) {
  const single = Object.keys(world.keys).filter((code) => !code.includes('+')), groups = [[], []], deeds = [];
  for (const code of single) if (PLACES[code]) groups[PLACES[code][0]].push(code); else deeds.push(code);
  const place = (code) => PLACES[code][1] * 10 + PLACES[code][2], done = new Set();
  const moves = groups.map((codes) => codes.sort((a, b) => place(a) - place(b)).filter((code) => !done.has(world.keys[code]) && done.add(world.keys[code])));
  const spoken = deeds.sort((a, b) => (b === 'Space') - (a === 'Space')).slice(0, 3).map((code) => [[code], keyMeaning(world, code)]);
  const either = groups[1].length && !moves[1].length ? ' (or arrow keys)' : '';
  const words = moves.filter((codes) => codes.length).map((codes) => [codes, together(codes.map((code) => keyMeaning(world, code))) + either]);
  const way = ([, word]) => MOVES.has(word.toLowerCase());  // up and down are moves, not deeds
  return [...spoken.filter((one) => !way(one)), ...words, ...spoken.filter(way)];
}

/** Fills `root` with caps, as many as there is room for; a click on one calls `chosen(code)`, on the last, which is for all others, `chosen()`. Gives a function that lights up the held ones. */
export function drawKeycaps(root, world, chosen) {
  root.replaceChildren();
  const groups = [0, 1, 2].map((number) => Object.assign(document.createElement('div'), { className: `cluster cluster-${number}` }));
  const caps = new Map(), single = Object.keys(world.keys).filter((code) => !code.includes('+'));  // not several keys at once
  for (const code of single.sort((one, other) => /^Arrow/.test(one) - /^Arrow/.test(other))) {
    const same = [...caps.keys()].find((other) => PLACES[other]?.[0] === 0 && world.keys[other] === world.keys[code]);
    if (same && PLACES[code]?.[0] === 1) { caps.set(code, caps.get(same)); continue; }  // an arrow that does the same as a letter
    const cap = document.createElement('kbd');
    const letter = document.createElement('b'), meaning = document.createElement('i');
    letter.textContent = keyLabel(code);
    meaning.textContent = keyMeaning(world, code);
    cap.title = `${meaning.textContent}: click to change`;
    cap.onclick = () => chosen(code);
    cap.append(letter, meaning);
    const [group, row, column] = PLACES[code] ?? [2, 2, 0];
    if (column) { cap.style.gridRow = row; cap.style.gridColumn = column; }
    cap.classList.toggle('space', code === 'Space');
    if (code === 'Space') groups[group].prepend(cap); else groups[group].append(cap);
    caps.set(code, cap);
  }
  for (const { children } of groups.slice(0, 2)) {  // left and right alone stand side by side
    if (![...children].some((cap) => cap.style.gridColumn.startsWith('2'))) for (const cap of children) if (cap.style.gridColumn.startsWith('3')) cap.style.gridColumn = 2;
  }
  const beside = groups.slice(0, 2).filter((group) => group.childElementCount).length, most = [18, 10, 6][beside], rest = groups[2];
  if (rest.childElementCount > most) {
    while (rest.childElementCount >= most) rest.lastChild.remove();
    const more = Object.assign(document.createElement('kbd'), { className: 'more', title: 'All keys', innerHTML: '<b>⋯</b><i>all keys</i>' });
    more.onclick = () => chosen();
    rest.append(more);
  }
  rest.style.setProperty('--rows', rest.childElementCount > 2 ? 2 : 1);
  root.append(...[rest, groups[0], groups[1]].filter((group) => group.childElementCount));
  return (held) => { const lit = held.map((code) => caps.get(code)); for (const cap of caps.values()) cap.classList.toggle('held', lit.includes(cap)); };
}
