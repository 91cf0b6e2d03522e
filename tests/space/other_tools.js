// Opens a file of Gaussians with the loaders of other projects: each gives columns {means, colours, opacities, and quats (w x y z)
// with scales, or covariances (xx xy xz yy yz zz)} as lists, in the file's own axes.

const bytesOf = async (url) => (await fetch(url)).arrayBuffer();
const none = () => ({ means: [], colours: [], opacities: [], quats: [], scales: [] });

/** Spark: @sparkjsdev/spark. */
async function spark(url) {
  const { SplatMesh } = await import('@sparkjsdev/spark');
  const mesh = new SplatMesh({ fileBytes: await bytesOf(url), fileName: url.split('/').at(-1), extSplats: true }), found = none();
  await mesh.initialized;
  mesh.forEachSplat((k, at, size, turn, opacity, colour) => {
    found.means.push(at.x, at.y, at.z);
    found.colours.push(colour.r, colour.g, colour.b);
    found.opacities.push(opacity);
    found.quats.push(turn.w, turn.x, turn.y, turn.z);
    found.scales.push(size.x, size.y, size.z);
  });
  return found;
}

/** three's own loaders. */
async function three(url) {
  const ending = url.split('.').at(-1), data = await bytesOf(url);
  let geometry;
  if (ending === 'ply') {
    const { GaussianSplatPLYLoader } = await import('three/addons/loaders/GaussianSplatPLYLoader.js');
    geometry = new GaussianSplatPLYLoader().parse(data);
  } else if (ending === 'spz') {
    const { SPZLoader } = await import('three/addons/loaders/SPZLoader.js');
    geometry = await new SPZLoader().parse(data);
  } else {
    const { GLTFLoader } = await import('three/addons/loaders/GLTFLoader.js');
    const { GLTFGaussianSplatLoaderExtension } = await import('three/addons/loaders/GLTFGaussianSplatLoaderExtension.js');
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    (await loader.parseAsync(data, '')).scene.traverse((node) => { geometry ??= node.splatGeometry ?? (node.geometry?.getAttribute('covariance') && node.geometry); });
  }
  const list = (name) => Array.from(geometry.getAttribute(name).array), rgba = list('color').map((byte) => byte / 255);
  return { means: list('position'), covariances: list('covariance'), colours: rgba.filter((_, k) => k % 4 < 3), opacities: rgba.filter((_, k) => k % 4 === 3) };
}

/** PlayCanvas' parser of SPZ, which the engine keeps beside itself and which wants a decoder of zstd from whoever uses it. */
async function readsSpz(pc, app) {
  const { SpzParser } = await import('playcanvas/scripts/esm/parsers/spz-parser.mjs');
  const { ZSTDDecoder } = await import('three/addons/libs/zstddec.module.js'), zstd = new ZSTDDecoder();
  await zstd.init();
  window.ZstdDecoderModule = async () => ({ decompress: (packed, size) => zstd.decode(packed, size) });
  pc.WasmModule.setConfig('ZstdDecoderModule', { fallbackUrl: 'data:text/javascript,' });
  app.loader.getHandler('gsplat').addParser(new SpzParser(app));
}

/** The PlayCanvas engine; of SPZ without turns and scales, which only its shaders unpack. */
async function playcanvas(url) {
  const pc = await import('playcanvas'), canvas = document.createElement('canvas');
  const app = new pc.AppBase(canvas), options = new pc.AppOptions();
  options.graphicsDevice = new pc.WebglGraphicsDevice(canvas, {});
  options.componentSystems = [pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.GSplatHandler];
  app.init(options);
  if (url.endsWith('.spz')) await readsSpz(pc, app);
  const asset = new pc.Asset('file', 'gsplat', { url, filename: url.split('/').at(-1) });
  app.assets.add(asset);
  await new Promise((done, fail) => { asset.once('load', done); asset.once('error', (said) => fail(new Error(said))); app.assets.load(asset); });
  const whole = asset.resource.gsplatData;
  if (url.endsWith('.spz')) {
    const shade = (byte) => 0.5 + 0.28209479177387814 / 0.15 * (byte / 255 - 0.5);
    return { means: Array.from(whole.getCenters()), colours: Array.from(whole.colors, shade), opacities: Array.from(whole.alphas, (byte) => byte / 255) };
  }
  const data = whole.isCompressed || whole.isSog ? await whole.decompress() : whole, found = none();
  const prop = (name) => data.getProp(name);
  for (let k = 0; k < data.numSplats; k += 1) {
    found.means.push(...['x', 'y', 'z'].map((name) => prop(name)[k]));
    found.colours.push(...[0, 1, 2].map((a) => 0.5 + 0.28209479177387814 * prop(`f_dc_${a}`)[k]));
    found.opacities.push(1 / (1 + Math.exp(-prop('opacity')[k])));
    found.quats.push(...[0, 1, 2, 3].map((a) => prop(`rot_${a}`)[k]));
    found.scales.push(...[0, 1, 2].map((a) => Math.exp(prop(`scale_${a}`)[k])));
  }
  app.destroy();
  return found;
}

/** What Spark draws of a file from an eye at `place` along `ahead`, with `up`, `fov` degrees high: rgba bytes, the lowest row first. */
async function drawn(url, { place, ahead, up, fov, size }) {
  const THREE = await import('three'), { SparkRenderer, SplatMesh } = await import('@sparkjsdev/spark');
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true }), scene = new THREE.Scene();
  renderer.setSize(size[0], size[1], false);
  const camera = new THREE.PerspectiveCamera(fov, size[0] / size[1], 0.05, 100), sparkle = new SparkRenderer({ renderer });
  scene.add(sparkle);
  const mesh = new SplatMesh({ fileBytes: await bytesOf(url), fileName: url.split('/').at(-1) });
  await mesh.initialized;
  scene.add(mesh);
  camera.position.set(...place);
  camera.up.set(...up);
  camera.lookAt(...place.map((part, a) => part + ahead[a]));
  for (let k = 0; k < 12; k += 1) {  // it sorts in a worker
    renderer.render(scene, camera);
    await new Promise((done) => { setTimeout(done, 100); });
  }
  const gl = renderer.getContext(), data = new Uint8Array(4 * size[0] * size[1]);
  renderer.render(scene, camera);
  gl.readPixels(0, 0, size[0], size[1], gl.RGBA, gl.UNSIGNED_BYTE, data);
  return Array.from(data);
}

window.readers = { spark, three, playcanvas, drawn };
