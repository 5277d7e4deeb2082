// What the parts of the page share: types, elements, and loading of the scene.

/** @typedef {import('./types.js').Document} SceneDocument */
/** @typedef {import('./types.js').Camera} Camera */
/** @typedef {import('./types.js').Picked} Picked */
/** @typedef {import('./engine.js').Engine} Engine */
/** @typedef {import('./view_camera.js').ViewCamera} ViewCamera */

/**
 * Everything that a user can change.
 * @typedef {object} State
 * @property {number} code Present time code.
 * @property {boolean} playing
 * @property {number} speed Factor of real time.
 * @property {boolean} loop
 * @property {number} selected Index of the selected node, or -1.
 * @property {boolean[]} hidden By node.
 * @property {number} isolated Index of the only node that is shown, or -1.
 * @property {boolean} follow The free camera moves with the selected object.
 * @property {'color' | 'instances' | 'depth'} mode
 * @property {boolean} tint
 * @property {boolean} box
 * @property {boolean} path
 * @property {boolean} axes
 * @property {boolean} joints
 * @property {boolean} cameras
 * @property {boolean} grid
 * @property {number} camera Index of the recorded camera that is looked through, or -1 for the free camera.
 * @property {boolean} followTime The recorded camera moves with time.
 * @property {number} cameraCode Where the recorded camera stays while it does not move with time.
 * @property {'render' | 'split' | 'difference' | 'image'} compare
 * @property {number} split Where the image ends and the render begins, 0 to 1.
 * @property {number} gain Factor of the difference.
 * @property {boolean} brush Drags of the picture erase splats of the selected object.
 * @property {boolean} mask
 * @property {number} maskOpacity
 */

/**
 * An action of the user: a key, and a button with the same `data-command`.
 * @typedef {object} Command
 * @property {string} id
 * @property {string} group
 * @property {string} name
 * @property {string} [key] KeyboardEvent.key in lower case, after `Shift+` where Shift is held.
 * @property {() => void} run
 * @property {() => boolean} [on] Whether what it switches is on.
 * @property {() => boolean} [enabled]
 */

/**
 * @typedef {object} App
 * @property {SceneDocument} scene
 * @property {Engine} engine
 * @property {State} state
 * @property {ViewCamera} viewCamera
 * @property {(patch: Partial<State>) => void} set Changes the state and calls the listeners.
 * @property {(listener: (changed: Set<string>) => void) => void} listen
 * @property {(key: string) => void} notify Calls listeners for a change outside the state: `scene`.
 * @property {(scene: SceneDocument, bytes: ArrayBuffer) => void} replace Other splats of the same objects.
 * @property {(number | null)[]} ratios PSNR of each node in the compared image, decibels; empty without one.
 * @property {() => void} redraw Draws in the next frame.
 * @property {() => Camera} shot The camera that is drawn, in device pixels.
 * @property {() => number} lowPass That of {@link App.shot}.
 * @property {() => number} code The time that is drawn.
 * @property {(x: number, y: number) => Picked} pick What is seen at CSS pixels of the picture.
 * @property {() => void} leaveCamera Goes to the free camera at the place of the present one.
 * @property {(x: number, y: number, isUndone: boolean) => void} brushAt Erases or brings back at CSS pixels.
 * @property {(text: string) => void} say Shows a short message.
 */

/** Dilation of splats at the resolution of a capture, px^2. */
export const LOW_PASS = 0.3;

/** Radius of the brush, CSS pixels. */
export const BRUSH_RADIUS = 18;

/** A failure with a text for the user. */
export class PageError extends Error {}

/**
 * The element of the page with an id.
 * @template {Element} T
 * @param {string} id
 * @param {new (...parameters: any[]) => T} type
 * @returns {T}
 */
export function byId(id, type) {
  const found = document.getElementById(id);
  if (!(found instanceof type)) throw new Error(`The page has no element "${id}".`);
  return found;
}

/**
 * A new element with a class, a text and children.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {string} [className]
 * @param {string} [text]
 * @param {Node[]} [children]
 * @returns {HTMLElementTagNameMap[K]}
 */
export function make(tag, className = '', text = '', children = []) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}

/**
 * The 2D context of a canvas.
 * @param {HTMLCanvasElement} canvas
 * @param {boolean} [isRead] True when its pixels are read often.
 * @returns {CanvasRenderingContext2D}
 */
export function context2d(canvas, isRead = false) {
  const context = canvas.getContext('2d', { willReadFrequently: isRead });
  if (!context) throw new Error('The browser offers no 2D canvas.');
  return context;
}

/**
 * Index of the ascending number that is nearest; the first of two that are equally near.
 * @param {ArrayLike<number>} codes
 * @param {number} code
 * @returns {number}
 */
export function nearestIndex(codes, code) {
  let low = 0;
  let high = codes.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (codes[middle] < code) low = middle + 1;
    else high = middle;
  }
  return low > 0 && code - codes[low - 1] <= codes[low] - code ? low - 1 : low;
}

/**
 * Replaces the page by a message.
 * @param {string} title
 * @param {string} text
 */
export function showFailure(title, text) {
  document.documentElement.dataset.state = 'failed';
  byId('message-title', HTMLElement).textContent = title;
  byId('message-text', HTMLElement).textContent = text;
  byId('progress', HTMLElement).hidden = true;
  byId('app', HTMLElement).hidden = true;
  byId('message', HTMLElement).hidden = false;
}

/**
 * Scene of the page: from its own data scripts, else from the server.
 * @returns {Promise<{ scene: SceneDocument, bytes: ArrayBuffer }>}
 */
export async function loadScene() {
  const inside = document.getElementById('document');
  byId('message-text', HTMLElement).textContent = 'Reading the splats.';
  const scene = inside
    ? parseScene(inside.textContent ?? '')
    : parseScene(await (await request('scene.json')).text());
  const bytes = inside ? await unpackBytes() : await readWithProgress(await request('scene.bin'));
  if (bytes.byteLength !== scene.bytes) {
    throw new PageError('The splats do not belong to the description of the scene. Reload the page.');
  }
  return { scene, bytes };
}

/**
 * @param {string} text
 * @returns {SceneDocument}
 */
function parseScene(text) {
  let scene;
  try {
    scene = JSON.parse(text);
  } catch {
    throw new PageError('The description of the scene is not valid JSON. The page may be incomplete.');
  }
  if (scene?.version !== 1) {
    throw new PageError(
      `The scene has format version ${scene?.version}, and this page shows version 1. `
        + 'Make the page and the scene with the same release of cif.',
    );
  }
  return scene;
}

/**
 * @param {string} address
 * @returns {Promise<Response>}
 */
export async function request(address) {
  let response;
  try {
    response = await fetch(address);
  } catch {
    throw new PageError(`The server does not answer (${address}). Is "cif view" still running?`);
  }
  if (!response.ok) throw new PageError(`The server answered ${response.status} for ${address}.`);
  return response;
}

/**
 * @param {Response} response
 * @returns {Promise<ArrayBuffer>}
 */
async function readWithProgress(response) {
  const total = Number(response.headers.get('content-length') ?? 0);
  if (!response.body || !total || response.headers.has('content-encoding')) return response.arrayBuffer();
  const progress = byId('progress', HTMLProgressElement);
  const bytes = new Uint8Array(total);
  const reader = response.body.getReader();
  let filled = 0;
  for (;;) {
    const { done, value } = await reader.read().catch(() => {
      throw new PageError('The connection broke while the splats were read. Reload the page.');
    });
    if (done) break;
    if (filled + value.length > total) throw new PageError('The server sent more bytes than it announced.');
    bytes.set(value, filled);
    filled += value.length;
    progress.value = filled / total;
  }
  if (filled < total) throw new PageError('The server sent fewer bytes than it announced. Reload the page.');
  return bytes.buffer;
}

/** @returns {Promise<ArrayBuffer>} */
async function unpackBytes() {
  const text = document.getElementById('bytes')?.textContent?.replace(/\s+/g, '');
  if (!text) throw new PageError('The page holds no splats. It may be incomplete.');
  if (!('DecompressionStream' in window)) throw new PageError('The browser is too old for this page.');
  const packed = new Blob([...decodeBase64(text)]).stream();
  try {
    return await new Response(packed.pipeThrough(new DecompressionStream('gzip'))).arrayBuffer();
  } catch {
    throw new PageError('The splats in the page are damaged. It may be incomplete.');
  }
}

/**
 * Bytes of base64, in pieces that a browser decodes at once.
 * @param {string} text
 * @returns {Generator<Uint8Array<ArrayBuffer>>}
 */
function* decodeBase64(text) {
  const piece = 1 << 20;
  for (let at = 0; at < text.length; at += piece) {
    yield Uint8Array.from(atob(text.slice(at, at + piece)), (letter) => letter.charCodeAt(0));
  }
}
