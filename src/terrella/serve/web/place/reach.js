// Asks the server; where it is gone, the error says so, and which command starts it again. And the way back to the start page.

export async function reach(address, command, options) {
  const answer = await fetch(address, options).catch(() => {
    throw new Error(`The server has stopped, or cannot be reached. ${command ? `\`${command}\` starts it again; then try once more.` : 'Start it again, then try once more.'}`);
  });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

/** Makes the mark a link to the start page, where the page was opened from one. */
export function linkBack() {
  const start = location.protocol === 'file:' ? null : sessionStorage.getItem('terrella-start');
  if (start) document.querySelector('.brand').href = start;
}
