// Follows a place while it is being fitted: fetches its newest state as soon as there is one.

const PAUSE_MS = 700;

/** on: newer(about, columns in gzip) -> promise, over(). Ends when the server does. */
export async function follow(address, on) {
  const query = new URLSearchParams(location.search);
  for (let number = 0; ;) {
    query.set('after', number);
    const answer = await fetch(`${address}?${query}`).catch(() => null);
    if (!answer?.ok) { on.over(); return; }
    if (answer.status === 200) {
      const bytes = new Uint8Array(await answer.arrayBuffer()), long = new DataView(bytes.buffer).getUint32(0, true);
      const about = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + long)));
      number = about.number;
      await on.newer(about, bytes.subarray(4 + long));
    }
    await new Promise((done) => { setTimeout(done, PAUSE_MS); });
  }
}
