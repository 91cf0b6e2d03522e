// The start page: cards of what can be opened. A click opens it on the server, and the page of it follows.

import { address, go, make } from './asking.js';

const $ = (id) => document.getElementById(id), MOST_PICTURE = 32 << 20;
const WORD = { place: 'Walk', recording: 'Look' };

function card({ name, title, section, text }) {
  const button = make('button', { className: 'card', type: 'button' }), figure = make('figure');
  const image = make('img', { alt: '', loading: 'lazy', src: address(`/start/thumbnail?name=${encodeURIComponent(name)}`) });
  image.onload = () => image.classList.add('there');
  figure.append(image, make('span', { textContent: WORD[section] ?? 'Play' }));
  button.append(figure, make('b', { textContent: title }), make('p', { textContent: text }));
  button.onclick = () => go('open', JSON.stringify({ name }), `Opening ${title} …`);
  return button;
}

$('words').onsubmit = (event) => {
  event.preventDefault();
  const words = $('describe').value.trim() || $('describe').placeholder;
  go('build', JSON.stringify({ words }), 'Building the place …');
};
/** Sends a picture, which becomes a place. */
function lift(file) {
  if (!file) return;
  if (file.size > MOST_PICTURE) $('wrong').textContent = `${file.name} has ${Math.round(file.size / (1 << 20))} MB; 32 is the most. Save it smaller.`;
  else go(`picture?name=${encodeURIComponent(file.name)}`, file, 'Estimating depth …');
}

$('picture').onchange = () => { lift($('picture').files[0]); $('picture').value = ''; };
addEventListener('dragover', (event) => { event.preventDefault(); $('drop').classList.add('over'); });
addEventListener('dragleave', (event) => { if (!event.relatedTarget) $('drop').classList.remove('over'); });
addEventListener('drop', (event) => { event.preventDefault(); $('drop').classList.remove('over'); lift(event.dataTransfer.files[0]); });
$('plan').href = address('/start/draw');

const cards = await (await fetch(address('/start/cards'))).json();
for (const one of cards) {
  $(one.section).hidden = false;
  $(one.section).querySelector('.cards').append(card(one));
}
$('none').hidden = cards.some(({ section }) => ['world', 'place', 'recording'].includes(section));
