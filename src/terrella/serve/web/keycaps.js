// The key hints: caps laid out as on a keyboard, with the world's own names of what they do.

const PLACES = {
  KeyQ: [0, 1, 1], KeyW: [0, 1, 2], KeyE: [0, 1, 3], KeyA: [0, 2, 1], KeyS: [0, 2, 2], KeyD: [0, 2, 3],
  ArrowUp: [1, 1, 2], ArrowLeft: [1, 2, 1], ArrowDown: [1, 2, 2], ArrowRight: [1, 2, 3],
};
const GLYPHS = { ArrowUp: '↑', ArrowDown: '↓', ArrowLeft: '←', ArrowRight: '→', Space: 'Space', Enter: '⏎', ShiftLeft: 'Shift' };

export function keyLabel(code) {
  return GLYPHS[code] ?? code.replace(/^(Key|Digit)/, '').replace(/Left$|Right$/, '');
}

/** What a key does, in a word or two: MOVE_FORWARD is "forward", TURN_LEFT is "turn left". */
export function keyMeaning(world, code) {
  const value = world.keys[code], names = world.action_names;
  const tidy = (name) => String(name).toLowerCase().replaceAll('_', ' ').replace(/^move /, '');
  if (world.action_kind === 'Discrete') return tidy(names[value[0]] ?? value[0]);
  const at = value.map((number, index) => [number, index]).filter(([number]) => number !== 0);
  return at.map(([number, index]) => tidy(names[index] ?? `axis ${index + 1}`) + (world.action_kind === 'Box' ? (number > 0 ? ' +' : ' −') : '')).join(', ') || 'rest';
}

/** Fills `root` with caps; gives a function that lights up the held ones. */
export function drawKeycaps(root, world) {
  root.replaceChildren();
  const groups = [0, 1, 2].map((number) => Object.assign(document.createElement('div'), { className: `cluster cluster-${number}` }));
  const caps = new Map();
  for (const code of Object.keys(world.keys)) {
    if (code.includes('+')) continue; // several keys at once
    const cap = document.createElement('kbd');
    const letter = document.createElement('b'), meaning = document.createElement('i');
    letter.textContent = keyLabel(code);
    meaning.textContent = keyMeaning(world, code);
    cap.title = meaning.textContent;
    cap.append(letter, meaning);
    const [group, row, column] = PLACES[code] ?? [2, 2, 0];
    if (column) { cap.style.gridRow = row; cap.style.gridColumn = column; }
    groups[group].append(cap);
    caps.set(code, cap);
  }
  root.append(...groups.filter((group) => group.childElementCount));
  return (held) => caps.forEach((cap, code) => cap.classList.toggle('held', held.includes(code)));
}
