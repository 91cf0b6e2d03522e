// Asks the server; where it is gone, the error says so, and which command starts it again.

export async function reach(address, command, options) {
  const answer = await fetch(address, options).catch(() => {
    throw new Error(`The server has stopped, or cannot be reached. ${command ? `\`${command}\` starts it again; then try once more.` : 'Start it again, then try once more.'}`);
  });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}
