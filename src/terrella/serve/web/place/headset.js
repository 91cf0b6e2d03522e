// WebXR: the place through a headset, a picture for each eye; the left stick walks, the right one turns.

import { NEAR } from './draw.js';

const MOST = 300000;  // Gaussians of a picture

/** Shows the button where there is a headset. */
export async function offerHeadset(button, page) {
  if (!(await navigator.xr?.isSessionSupported('immersive-vr').catch(() => false))) return;
  button.hidden = false;
  button.onclick = () => enter(page).catch((error) => console.error(error));
}

async function enter({ drawing, walker, hands, sorter, solid, redraw }) {
  const { gl } = drawing;
  await gl.makeXRCompatible();
  const session = await navigator.xr.requestSession('immersive-vr', { optionalFeatures: ['local-floor'] });
  session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl, { antialias: false }), depthNear: NEAR, depthFar: 1000 });
  const floor = await session.requestReferenceSpace('local-floor').catch(() => null), space = floor ?? (await session.requestReferenceSpace('local'));
  let last = 0;
  session.onend = redraw;
  session.requestAnimationFrame(function frame(time, now) {
    session.requestAnimationFrame(frame);
    const layer = session.renderState.baseLayer, pose = now.getViewerPose(space);
    walker.pass(solid(), wished(session, hands.wish), last ? (time - last) / 1000 : 0);
    last = time;
    if (!pose) return;
    const stand = { ...walker.eye, drop: floor ? walker.world.body.eye_m : 0 };
    drawing.clear(layer.framebuffer);
    for (const view of pose.views) {
      const { x, y, width, height } = layer.getViewport(view);
      drawing.paint({ view: inverseOf(view.transform, stand), projection: view.projectionMatrix }, [x, y, width, height], [], layer.framebuffer);
    }
    sorter.ask({ ...sightOf(pose.transform, stand), most: MOST });
  });
}

/** What the sticks of the controllers wish, beside what the keys do. */
function wished(session, wish) {
  for (const { gamepad, handedness } of session.inputSources) {
    const [, , x = 0, y = 0] = gamepad?.axes ?? [];
    if (handedness === 'left') { wish[0] -= y; wish[1] -= x; } else wish[2] -= x;
  }
  return wish;
}

/** A direction of the headset's room (y up, -z ahead) in the place (z up), for one who stands there. */
function turned([x, y, z], { heading }) {
  const c = Math.cos(heading), s = Math.sin(heading);
  return [-c * z + s * x, -s * z - c * x, y];
}

const columns = (matrix) => [0, 4, 8, 12].map((at) => [...matrix.slice(at, at + 3)]);

function placed(transform, stand) {
  const [right, up, back, at] = columns(transform.matrix).map((part) => turned(part, stand));
  return { right, up, back, place: at.map((part, a) => part + stand.place[a] - (a === 2 ? stand.drop : 0)) };
}

/** The view matrix of an eye of the headset. */
function inverseOf(transform, stand) {
  const { right, up, back, place } = placed(transform, stand), along = (way) => -(way[0] * place[0] + way[1] * place[1] + way[2] * place[2]);
  return [0, 1, 2].flatMap((a) => [right[a], up[a], back[a], 0]).concat([along(right), along(up), along(back), 1]);
}

/** What is in sight of both eyes, for sorting. */
function sightOf(transform, stand) {
  const { right, up, back, place } = placed(transform, stand);
  return { eye: place, ahead: back.map((part) => -part), right, up, wide: 1.6, tall: 1.6, near: NEAR };
}
