// Pictures from the person: dropped on the page or chosen, cut and scaled here, so that only a few kilobytes travel.

const MOST_BYTES = 64 * 2 ** 20, MOST_SENT = 60000;

/** root: where files may be dropped; input: a file input; size(): [height, width] of the world; send(bytes, as a goal); say(text); isGoal(x): of what is dropped there. */
export function takePictures(root, input, size, send, say, isGoal) {
  const take = async (file, asGoal = false) => {
    try {
      if (!size()) return;
      if (file.size > MOST_BYTES) throw new Error('it is larger than 64 MB');
      send(await scaled(file, size()), asGoal);
    } catch (error) {
      const why = error instanceof DOMException ? 'the browser cannot read this image' : error.message;
      say(`No picture: ${why}.`);
    }
  };
  const carries = (event) => [...(event.dataTransfer?.types ?? [])].includes('Files');
  const dropping = (on) => root.classList.toggle('dropping', on);
  addEventListener('dragover', (event) => { if (carries(event)) { event.preventDefault(); dropping(true); root.classList.toggle('as-goal', isGoal(event.clientX)); } });
  addEventListener('dragleave', (event) => { if (!event.relatedTarget) dropping(false); });
  addEventListener('drop', (event) => {
    if (!carries(event)) return;
    event.preventDefault();
    dropping(false);
    if (event.dataTransfer.files.length) take(event.dataTransfer.files[0], isGoal(event.clientX));
  });
  input.addEventListener('change', () => {
    if (input.files.length) take(input.files[0]);
    input.value = '';
    input.blur();
  });
}

/** The middle of the image in the world's aspect, at most twice its size, as JPEG bytes. */
async function scaled(file, [height, width]) {
  const image = await createImageBitmap(file);
  const scale = Math.max(width / image.width, height / image.height), cutWidth = width / scale, cutHeight = height / scale;
  const times = Math.max(1, Math.min(2, 1 / scale)), canvas = new OffscreenCanvas(Math.round(times * width), Math.round(times * height));
  const paper = canvas.getContext('2d', { alpha: false });
  paper.fillStyle = '#28282c';
  paper.fillRect(0, 0, canvas.width, canvas.height);
  paper.imageSmoothingQuality = 'high';
  paper.drawImage(image, (image.width - cutWidth) / 2, (image.height - cutHeight) / 2, cutWidth, cutHeight, 0, 0, canvas.width, canvas.height);
  image.close();
  for (const quality of [0.95, 0.85, 0.7, 0.5, 0.3, 0.1]) {
    const bytes = await (await canvas.convertToBlob({ type: 'image/jpeg', quality })).arrayBuffer();
    if (bytes.byteLength <= MOST_SENT) return bytes;
  }
  throw new Error('it cannot be made small enough');
}
