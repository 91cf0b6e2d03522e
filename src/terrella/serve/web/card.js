// The cards of the worlds: who draws, what was learned from what, how large and how quick, in words; all facts behind a fold.

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

const time = (seconds) => (seconds < 90 ? `${Math.round(seconds)} seconds` : seconds < 5400 ? `${Math.round(seconds / 60)} minutes` : `${(seconds / 3600).toFixed(1)} hours`);
const large = (count) => (count >= 1e6 ? `${(count / 1e6).toPrecision(2)} million` : count.toLocaleString('en'));

/** Names, each once, with how many there are. */
function counted(names) {
  const many = new Map();
  names.filter(Boolean).forEach((name) => many.set(name, (many.get(name) ?? 0) + 1));
  return [...many].map(([name, count]) => (count > 1 ? `${count} × ${name}` : name)).join(', ');
}

/** The steps for which it is trusted: those that were measured, and its own forecast. */
function trusted({ trust_steps_measured: measured, trust_measured: how, trust_steps_forecast: forecast }, dt) {
  const words = (steps) => `${(steps * dt).toFixed(1)} seconds (${steps} steps)`;
  if (!measured) return forecast ? `${words(forecast)}, by its own forecast` : null;
  return `${words(measured)}, measured ${how ?? ''}${forecast ? `; by its own forecast ${forecast} steps` : ''}`;
}

/** What a person asks first, as [word, sentence]. */
function plainly({ card, dt_s: dt, cameras, mapped }) {
  const frames = Number(String(card.data ?? '').match(/^([\d,]+) frames/)?.[1].replaceAll(',', ''));
  const [height, width] = cameras[0].size, learned = card.kind === 'learned' || card.kind === 'latent';
  return [
    ['Trained on', frames ? `${card.data}: ${time(frames * dt)} of play` : card.data],
    ['Trained for', card.hours ? `${time(3600 * card.hours)}${/CPU/.test(card.hardware ?? '') ? ' on a CPU' : ''}` : null],
    ['Its network', card.parameters ? `${large(card.parameters)} weights` : null],
    ['Pictures', `${width} × ${height} pixels, ${Math.round(1 / dt)} steps a second`],
    ['Memory', card.keyframes ? `${large(card.keyframes)} views of the recording, and what you see on your way` : learned && !mapped ? 'its last pictures' : null],
    ['Never seen', card.keep_out ? 'A part of the map was kept out of training. What you see there is invented.' : null],
    ['Built from', card.text ? `the words “${card.text}”` : card.kind === 'splat' ? card.file : null],
    ['In it', counted(card.kind === 'splat' && Array.isArray(card.objects) ? card.objects : [])],
    ['Usual error', card.uncertainty?.sure && card.kind !== 'splat' ? `${(100 * card.uncertainty.sure).toFixed(1)}% of full brightness, in a picture that it is sure of` : null],
    ['Trusted for', trusted(card, dt)],
    ['A picture costs', card.joules_per_frame_estimated ? `about ${card.joules_per_frame_estimated} joules, estimated` : null],
    ['A session holds', card.session_kib ? `${(card.session_kib / 1024).toFixed(1)} MiB of memory` : null],
    ['Laws of physics', card.laws_passed],
    ['Physics', card.physics],
  ].filter(([, words]) => words);
}

export function drawCard(root, worlds) {
  root.replaceChildren();
  for (const world of worlds) {
    const [title, drawn, what, short, fold, all, list] = ['h2', 'p', 'p', 'dl', 'details', 'summary', 'dl'].map((tag) => document.createElement(tag));
    const { what: words = '', kind, seed, ...facts } = world.card;
    title.textContent = world.label ? `${world.name}, the ${world.label}` : world.name;
    [drawn.textContent, drawn.className, what.textContent] = [world.drawn, 'drawn', words && `${words.replace(/\.$/, '')}.`];
    for (const [word, sentence] of plainly(world)) fill(short, word, sentence);
    all.textContent = 'All facts on its card';
    const sizes = Object.fromEntries(world.cameras.map(({ name, size }) => [world.cameras.length > 1 ? `picture, ${name}` : 'picture', `${size[1]} × ${size[0]}`]));
    fill(list, '', { ...sizes, pace: `${Math.round(1 / world.dt_s)} steps/s`, ...facts });
    fold.append(all, list);
    root.append(title, ...[drawn, what].filter((one) => one.textContent), short, fold);
  }
}
