// Asks the server for a page, shows what it does meanwhile, and goes there.

const query = new URLSearchParams(location.search), token = query.get('token'), cover = document.getElementById('opening'), POLL_MS = 600;

export const make = (tag, fields = {}) => Object.assign(document.createElement(tag), fields);

/** An address of this server, with the token that this page was opened with. */
export const address = (path) => (token ? `${path}${path.includes('?') ? '&' : '?'}token=${encodeURIComponent(token)}` : path);

/** Posts to /start/PATH, and opens what comes of it. words: shown until the server says more. */
export async function go(path, body, words) {
  const began = performance.now(), show = (text, failed = false) => { cover.hidden = false; cover.classList.toggle('failed', failed); cover.firstElementChild.textContent = text; };
  show(words);
  const poll = setInterval(async () => {
    const doing = await fetch(address('/start/progress')).then((answer) => (answer.ok ? answer.text() : ''), () => '');
    if (!cover.hidden && !cover.classList.contains('failed')) show(`${doing || words} ${Math.round((performance.now() - began) / 1000)} s`);
  }, POLL_MS);
  const failed = (text) => { clearInterval(poll); show(text, true); };
  try {
    const answer = await fetch(address(`/start/${path}`), { method: 'POST', body });
    if (!answer.ok) { failed(await answer.text()); return; }
    clearInterval(poll);
    sessionStorage.removeItem('terrella-session');
    location.href = address('/?open');
  } catch {
    failed('The server does not answer. Start it again: terrella play');
  }
}

cover.onclick = () => { if (cover.classList.contains('failed')) cover.hidden = true; };
addEventListener('keydown', (event) => { if (event.key === 'Escape') cover.onclick(); });
addEventListener('pageshow', () => { cover.hidden = true; });
