// Held keys as an action, and an action as the numbers that the network sees (serve/actions.py, worlds/controls.py).

const GLYPHS = { ArrowUp: '↑', ArrowDown: '↓', ArrowLeft: '←', ArrowRight: '→' };

/** What is printed on a key. */
export const labelOf = (code) => GLYPHS[code] ?? code.replace(/^(Key|Digit)/, '');

/** The action of the keys held, oldest first: `keys` has the row of each code, or of several, "ArrowUp+Space". */
export function actionOf({ kind, low, high }, rest, keys, held) {
  const together = Object.keys(keys).filter((codes) => codes.includes('+') && codes.split('+').every((code) => held.includes(code)));
  together.sort((one, other) => one.split('+').length - other.split('+').length);
  const rows = [...held, ...together].filter((code) => keys[code]).map((code) => keys[code]);
  if (!rows.length) return rest;
  if (kind === 'buttons') return rest.map((_, i) => Math.max(...rows.map((row) => row[i])));
  if (kind === 'choice') return rest.length === 1 ? rows.at(-1) : rows.reduce((all, row) => all.map((value, i) => (row[i] === rest[i] ? value : row[i])), rest);
  rows.sort((one, other) => Math.max(...other) - Math.max(...one));  // of two opposites, the positive
  return rest.map((value, i) => {
    const pressed = rows.reduce((most, row) => (Math.abs(row[i]) > Math.abs(most) ? row[i] : most), 0);
    return Math.min(high[i], Math.max(low[i], pressed || value));
  });
}

/** Buttons as they are, choices one-hot, axes scaled to -1..1. */
export function encode({ kind, low, high }, action) {
  if (kind === 'buttons') return action;
  if (kind === 'choice') return action.flatMap((value, i) => Array.from({ length: high[i] - low[i] + 1 }, (_, option) => Number(low[i] + option === value)));
  return action.map((value, i) => Math.min(1, Math.max(-1, 2 * (value - low[i]) / Math.max(1e-6, high[i] - low[i]) - 1)));
}
