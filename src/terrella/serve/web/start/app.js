// The start page: cards of what can be opened. A click opens it on the server, and the page of it follows.

const query = new URLSearchParams(location.search), token = query.has('token') ? `&token=${encodeURIComponent(query.get('token'))}` : '';
const $ = (id) => document.getElementById(id), make = (tag, fields = {}) => Object.assign(document.createElement(tag), fields);
const WORD = { place: 'Walk', recording: 'Look' };

function card({ name, title, section, text }) {
  const button = make('button', { className: 'card', type: 'button' }), figure = make('figure');
  const image = make('img', { alt: '', loading: 'lazy', src: `/start/thumbnail?name=${encodeURIComponent(name)}${token}` });
  image.onload = () => image.classList.add('there');
  figure.append(image, make('span', { textContent: WORD[section] ?? 'Play' }));
  button.append(figure, make('b', { textContent: title }), make('p', { textContent: text }));
  button.onclick = () => go('open', { name }, `Opening ${title} …`);
  return button;
}

/** Asks the server for a page, and goes there. */
async function go(path, body, words) {
  const cover = $('opening');
  const show = (text, failed) => { cover.hidden = false; cover.classList.toggle('failed', failed); cover.firstElementChild.textContent = text; };
  show(words, false);
  try {
    const answer = await fetch(`/start/${path}?${token.slice(1)}`, { method: 'POST', body: JSON.stringify(body) });
    if (!answer.ok) return show(await answer.text(), true);
    sessionStorage.removeItem('terrella-session');
    location.href = `/?open${token}`;
  } catch {
    show('The server does not answer. Start it again: terrella play', true);
  }
}

$('words').onsubmit = (event) => {
  event.preventDefault();
  const words = $('describe').value.trim() || $('describe').placeholder;
  go('build', { words }, 'Building the place …');
};
$('opening').onclick = () => { if ($('opening').classList.contains('failed')) $('opening').hidden = true; };
addEventListener('pageshow', () => { $('opening').hidden = true; });

const cards = await (await fetch(`/start/cards?${token.slice(1)}`)).json();
for (const one of cards) {
  $(one.section).hidden = false;
  $(one.section).querySelector('.cards').append(card(one));
}
$('none').hidden = cards.some(({ section }) => ['world', 'place', 'recording'].includes(section));
