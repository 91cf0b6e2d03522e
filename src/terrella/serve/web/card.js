// The cards of the worlds as lists of facts.

/** A fact for people: few digits, no braces. */
function say(value) {
  if (value === null || value === '') return '–';
  if (Array.isArray(value)) return value.map(say).join(', ');
  if (typeof value !== 'number') return String(value);
  return Number.isInteger(value) ? value.toLocaleString('en') : String(Number(value.toPrecision(4)));
}

function fill(list, name, value) {
  if (value && typeof value === 'object' && !Array.isArray(value)) {
    for (const [inner, deeper] of Object.entries(value)) fill(list, name ? `${name}, ${inner}` : inner, deeper);
    return;
  }
  const term = document.createElement('dt'), fact = document.createElement('dd');
  term.textContent = name.replaceAll('_', ' ');
  fact.textContent = say(value);
  list.append(term, fact);
}

export function drawCard(root, worlds) {
  root.replaceChildren();
  for (const world of worlds) {
    const [title, what, list] = ['h2', 'p', 'dl'].map((tag) => document.createElement(tag));
    const { what: words = '', ...facts } = world.card;
    title.textContent = world.label ? `${world.name}, the ${world.label}` : world.name;
    what.textContent = words;
    fill(list, '', { ...Object.fromEntries(world.cameras.map(({ name, size }) => [world.cameras.length > 1 ? `picture, ${name}` : 'picture', `${size[1]} × ${size[0]}`])), pace: `${Math.round(1 / world.dt_s)} steps/s`, ...facts });
    root.append(title, what, list);
  }
}
