// Asks the server; where it is gone, the error says so, and which command starts it again. And the way back to the start page.

export async function reach(address, command, options) {
  const answer = await fetch(address, options).catch(() => {
    throw new Error(`The server has stopped, or cannot be reached. ${command ? `\`${command}\` starts it again; then try once more.` : 'Start it again, then try once more.'}`);
  });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

/** Makes the mark a link to the start page, where the page was opened from one: its address then has `open`. */
export function linkBack() {
  const query = new URLSearchParams(location.search), brand = document.querySelector('.brand');
  if (!query.has('open')) return;
  query.delete('open');
  Object.assign(brand, { href: `/?${query}`, title: 'Back to the start page', ariaLabel: 'Back to the start page' });
  brand.querySelector('.wordmark').textContent = 'Start page';
}
