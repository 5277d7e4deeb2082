// Recorded cameras, and images of the capture beside the render.

import { byId, context2d, LOW_PASS, nearestIndex } from './page.js';
import { isCapture, resizeCamera } from './view_camera.js';

/** @typedef {import('./types.js').View} View */
/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').Command} Command */
/** @typedef {App['state']['compare']} Compared */

const KEPT_IMAGES = 48;
const PSNR_DELAY = 300;
/** @type {null[]} */
const NO_RATIOS = [];
/** @type {Record<Compared, string>} */
const COMPARE_NAMES = {
  render: 'Render alone',
  split: 'Image on the left, render on the right',
  difference: 'Difference of image and render',
  image: 'Image alone',
};
/** @type {Compared[]} */
const COMPARISONS = ['render', 'split', 'difference', 'image'];

/** Views of each camera, ascending in time. */
export class ViewIndex {
  /** @param {App['scene']} scene */
  constructor(scene) {
    this.byCamera = scene.cameras.map(({ name }) =>
      scene.views.filter((view) => view.camera === name).sort((a, b) => a.code - b.code),
    );
    this.codes = this.byCamera.map((views) => views.map((view) => view.code));
    this.all = this.byCamera.flat();
  }

  /**
   * @param {number} camera
   * @param {number} code
   * @returns {View | null}
   */
  nearest(camera, code) {
    const views = this.byCamera[camera];
    return views?.length ? views[nearestIndex(this.codes[camera], code)] : null;
  }

  /**
   * The view that is compared, or whose mask is shown.
   * @param {App['state']} state
   * @returns {View | null}
   */
  shown(state) {
    return state.compare === 'render' && !state.mask ? null : this.nearest(state.camera, state.code);
  }

  /**
   * @param {View} view
   * @returns {number}
   */
  cameraOf(view) {
    return this.byCamera.findIndex((views) => views.includes(view));
  }
}

/** Images by address; the ones that were not used for longest are let go. */
class ImageStore {
  constructor() {
    /** @type {Map<string, Promise<HTMLImageElement>>} */
    this.images = new Map();
  }

  /**
   * @param {string} address
   * @returns {Promise<HTMLImageElement>}
   */
  load(address) {
    const image = this.images.get(address) ?? this.request(address);
    this.images.delete(address);
    this.images.set(address, image);
    const oldest = this.images.keys().next().value;
    if (this.images.size > KEPT_IMAGES && oldest !== undefined) this.images.delete(oldest);
    return image;
  }

  /**
   * @param {string} address
   * @returns {Promise<HTMLImageElement>}
   */
  async request(address) {
    const image = new Image();
    image.src = address;
    await image.decode();
    return image;
  }
}

/**
 * Peak signal-to-noise ratio of red, green and blue, decibels.
 * @param {ArrayLike<number>} a RGBA.
 * @param {ArrayLike<number>} b RGBA.
 * @returns {number}
 */
export function psnrOf(a, b) {
  let sum = 0;
  for (let i = 0; i < a.length; i += 4) {
    sum += (a[i] - b[i]) ** 2 + (a[i + 1] - b[i + 1]) ** 2 + (a[i + 2] - b[i + 2]) ** 2;
  }
  return 10 * Math.log10((255 * 255 * 0.75 * a.length) / sum);
}

/** Largest difference of a colour of a mask, which was drawn through, from that of its instance. */
const SAME_COLOR = 4;

/**
 * Peak signal-to-noise ratio over the pixels of each node in a mask, decibels; null where there are none.
 * @param {ArrayLike<number>} a RGBA.
 * @param {ArrayLike<number>} b RGBA.
 * @param {ArrayLike<number>} mask RGBA, in the colours of instances.
 * @param {import('./types.js').Node[]} nodes
 * @returns {(number | null)[]}
 */
export function ratiosOf(a, b, mask, nodes) {
  const sums = nodes.map(() => 0);
  const counts = nodes.map(() => 0);
  for (let i = 0; i < mask.length; i += 4) {
    if (!mask[i + 3]) continue;
    const isNear = (/** @type {number} */ value, /** @type {number} */ k) =>
      Math.abs(value - mask[i + k]) <= SAME_COLOR;
    const node = nodes.findIndex(({ id, color }) => id !== null && color.every(isNear));
    if (node < 0) continue;
    sums[node] += (a[i] - b[i]) ** 2 + (a[i + 1] - b[i + 1]) ** 2 + (a[i + 2] - b[i + 2]) ** 2;
    counts[node] += 3;
  }
  return sums.map((sum, k) => (counts[k] ? 10 * Math.log10((255 * 255 * counts[k]) / sum) : null));
}

/** The panel of cameras, and the images over the picture. */
export class Comparison {
  /**
   * @param {App} app
   * @param {ViewIndex} views
   */
  constructor(app, views) {
    this.app = app;
    this.views = views;
    this.store = new ImageStore();
    this.image = byId('image', HTMLCanvasElement);
    this.mask = byId('mask', HTMLCanvasElement);
    /** @type {Map<View, string>} */
    this.ratios = new Map();
    /** By node. @type {Map<View, (number | null)[]>} */
    this.ratiosOfNodes = new Map();
    this.photo = document.createElement('canvas');
    this.psnr = byId('psnr', HTMLOutputElement);
    this.camera = byId('camera', HTMLSelectElement);
    this.requests = 0;
    this.shown = 0;
    this.timer = 0;
    /** @type {View | null} */
    this.view = null;
    /** @type {View | null} */
    this.drawn = null;
    this.setUp();
    app.listen((changed) => {
      const keys = [
        'code',
        'camera',
        'compare',
        'mask',
        'playing',
        'split',
        'gain',
        'maskOpacity',
        'followTime',
      ];
      const isEdited = changed.has('scene');
      if (isEdited) {
        this.ratios.clear();
        this.ratiosOfNodes.clear();
      }
      if (isEdited || keys.some((key) => changed.has(key))) this.show();
    });
    this.show();
  }

  setUp() {
    const { app, views } = this;
    const { cameras } = app.scene;
    byId('app', HTMLElement).dataset.views = cameras.length ? 'some' : 'none';
    byId('views', HTMLElement).hidden = !cameras.length;
    byId('compare', HTMLElement).hidden = !views.all.length;
    byId('psnr-field', HTMLElement).hidden = isCapture(app.scene);
    byId('mask-field', HTMLElement).hidden = !views.all.some((view) => view.mask);
    byId('follow-time-field', HTMLElement).hidden = !cameras.some((camera) => camera.samples.length > 1);
    byId('views-count', HTMLElement).textContent = views.all.length ? `${views.all.length} images` : '';
    this.camera.append(
      new Option('Free camera', '-1'),
      ...cameras.map(({ name }, i) => new Option(name, String(i))),
    );
    this.camera.addEventListener('change', () => this.lookThrough(Number(this.camera.value)));
    const followTime = byId('follow-time', HTMLInputElement);
    followTime.addEventListener('change', () => {
      app.set({ followTime: followTime.checked, cameraCode: app.state.code });
    });
    const split = byId('split', HTMLInputElement);
    split.addEventListener('input', () => app.set({ split: Number(split.value) }));
    const gain = byId('gain', HTMLSelectElement);
    gain.addEventListener('change', () => app.set({ gain: Number(gain.value) }));
    const opacity = byId('mask-opacity', HTMLInputElement);
    opacity.addEventListener('input', () => app.set({ maskOpacity: Number(opacity.value) }));
  }

  /** @param {number} camera Index, or -1 for the free camera. */
  lookThrough(camera) {
    const { app } = this;
    if (camera < 0) {
      app.leaveCamera();
      return;
    }
    const hasImages = this.views.byCamera[camera].length > 0;
    const { code, mask } = app.state;
    const compare = app.state.compare === 'render' && isCapture(app.scene) ? 'image' : app.state.compare;
    const patch = hasImages
      ? { compare, mask }
      : { compare: /** @type {Compared} */ ('render'), mask: false };
    app.set({ camera, cameraCode: code, ...patch });
  }

  /**
   * A camera that has images: the present one, else the first.
   * @returns {number}
   */
  cameraWithViews() {
    const { camera } = this.app.state;
    if (this.views.byCamera[camera]?.length) return camera;
    return this.views.byCamera.findIndex((views) => views.length > 0);
  }

  /** @param {Compared} compare */
  compare(compare) {
    const camera = this.cameraWithViews();
    if (camera >= 0) this.app.set({ compare, camera, cameraCode: this.app.state.code });
  }

  /** @param {number} count Views to go forward, through all cameras. */
  stepView(count) {
    const { all } = this.views;
    if (!all.length) return;
    const { state } = this.app;
    const present = this.views.nearest(state.camera, state.code);
    const next = present ? all[(all.indexOf(present) + count + all.length) % all.length] : all[0];
    this.app.set({
      camera: this.views.cameraOf(next),
      code: next.code,
      cameraCode: next.code,
      playing: false,
    });
  }

  show() {
    const { state } = this.app;
    this.camera.value = String(state.camera);
    byId('follow-time', HTMLInputElement).checked = state.followTime;
    byId('follow-time', HTMLInputElement).disabled = state.camera < 0;
    const view = this.views.nearest(state.camera, state.code);
    byId('view-name', HTMLOutputElement).textContent = view ? `${view.name} (${view.split})` : 'none';
    byId('view-name', HTMLOutputElement).title = view?.name ?? '';
    this.showLayers(this.views.shown(state));
    this.showRatio();
  }

  /** @param {View | null} view */
  showLayers(view) {
    const { state } = this.app;
    const compare = view ? state.compare : 'render';
    const split = compare === 'split';
    const loaded = view !== null && this.drawn?.camera === view.camera;
    this.image.hidden = compare === 'render' || !loaded;
    this.image.dataset.mode = compare;
    this.image.style.clipPath = split ? `inset(0 ${100 * (1 - state.split)}% 0 0)` : '';
    this.mask.hidden = !view?.mask || !state.mask || !loaded;
    this.mask.style.opacity = String(state.maskOpacity);
    const gain = compare === 'difference' ? state.gain : 1;
    byId('layers', HTMLElement).style.filter = gain > 1 ? `brightness(${gain})` : '';
    byId('picture', HTMLElement).dataset.split = String(split);
    byId('divider', HTMLElement).hidden = !split;
    byId('divider', HTMLElement).style.left = `${100 * state.split}%`;
    byId('split', HTMLInputElement).value = String(state.split);
    byId('split-field', HTMLElement).hidden = !split;
    byId('gain-field', HTMLElement).hidden = compare !== 'difference';
    this.showTags(compare);
    if (view !== this.view) this.load(view);
  }

  /** @param {Compared} compare */
  showTags(compare) {
    const left = byId('left-tag', HTMLElement);
    const right = byId('right-tag', HTMLElement);
    const names = { render: '', split: 'Image', difference: 'Difference', image: 'Image' };
    left.textContent = names[compare];
    left.hidden = compare === 'render';
    right.textContent = 'Render';
    right.hidden = compare !== 'split';
  }

  /** @param {View | null} view */
  async load(view) {
    this.view = view;
    if (!view) return;
    this.requests += 1;
    const request = this.requests;
    try {
      const [image, mask] = await Promise.all([
        this.store.load(view.image),
        view.mask && this.store.load(view.mask),
      ]);
      if (request < this.shown || this.view?.camera !== view.camera) return;
      this.shown = request;
      this.drawn = view;
      drawImage(this.image, image);
      if (mask) drawImage(this.mask, mask);
      this.show();
      this.loadNext(view);
    } catch {
      if (this.view === view) this.app.say(`The image "${view.name}" could not be loaded.`);
    }
  }

  /** @param {View} view */
  loadNext(view) {
    const { all } = this.views;
    const next = all[(all.indexOf(view) + 1) % all.length];
    for (const address of [next.image, next.mask]) if (address) this.store.load(address).catch(() => {});
  }

  /** Shows the ratio of the present view, which is measured when nothing has changed for a while. */
  showRatio() {
    clearTimeout(this.timer);
    const { view } = this;
    const known = view && this.ratios.get(view);
    this.psnr.dataset.value = known ? 'some' : 'none';
    this.psnr.textContent = known ?? this.missingRatio();
    const ratios = (known && view && this.ratiosOfNodes.get(view)) || NO_RATIOS;
    if (ratios !== this.app.ratios) {
      this.app.ratios = ratios;
      this.app.notify('ratios');
    }
    const ready = view && view === this.drawn && !known && !this.app.state.playing;
    if (ready && !isCapture(this.app.scene))
      this.timer = window.setTimeout(() => this.measure(view), PSNR_DELAY);
  }

  /** @returns {string} Why there is no ratio. */
  missingRatio() {
    if (!this.view) return 'choose a comparison';
    if (this.app.state.playing) return 'when paused';
    return this.view === this.drawn ? 'measuring' : 'no image yet';
  }

  /** @param {View} view */
  measure(view) {
    const { engine } = this.app;
    const photo = this.read(this.image);
    if (photo) {
      engine.setTime(view.code);
      const shot = resizeCamera(view, photo.width, photo.height);
      const render = engine.pixels(shot, LOW_PASS * (photo.height / view.size[1]) ** 2, true);
      this.ratios.set(view, `${psnrOf(render, photo.data).toFixed(2)} dB`);
      const mask = view.mask && this.read(this.mask);
      if (mask && mask.width === photo.width && mask.height === photo.height) {
        this.ratiosOfNodes.set(view, ratiosOf(render, photo.data, mask.data, this.app.scene.nodes));
      }
    } else {
      this.ratios.set(view, 'not for local files');
    }
    this.showRatio();
  }

  /**
   * Pixels of a canvas; null where the page may not read them.
   * @param {HTMLCanvasElement} canvas
   * @returns {ImageData | null}
   */
  read(canvas) {
    const { width, height } = canvas;
    Object.assign(this.photo, { width, height });
    const context = context2d(this.photo, true);
    context.drawImage(canvas, 0, 0);
    try {
      return context.getImageData(0, 0, width, height);
    } catch {
      return null;
    }
  }
}

/**
 * @param {HTMLCanvasElement} canvas
 * @param {HTMLImageElement} image
 */
function drawImage(canvas, image) {
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  context2d(canvas).drawImage(image, 0, 0);
}

/**
 * @param {App} app
 * @param {Comparison} comparison
 * @returns {Command[]}
 */
export function compareCommands(app, comparison) {
  const { state } = app;
  const group = 'Images';
  const some = () => comparison.views.all.length > 0;
  const next = () => {
    comparison.compare(COMPARISONS[(COMPARISONS.indexOf(state.compare) + 1) % COMPARISONS.length]);
  };
  const toggleMask = () => {
    const camera = comparison.cameraWithViews();
    if (camera >= 0) app.set({ mask: !state.mask, camera, cameraCode: state.code });
  };
  return [
    {
      id: 'previous-view',
      group,
      name: 'Previous image',
      key: '[',
      run: () => comparison.stepView(-1),
      enabled: some,
    },
    {
      id: 'next-view',
      group,
      name: 'Next image',
      key: ']',
      run: () => comparison.stepView(1),
      enabled: some,
    },
    {
      id: 'compare-next',
      group,
      name: 'Render, split, difference or image',
      key: 'v',
      run: next,
      enabled: some,
    },
    ...COMPARISONS.map((compare) => ({
      id: `compare-${compare}`,
      group: '',
      name: COMPARE_NAMES[compare],
      run: () => comparison.compare(compare),
      on: () => state.compare === compare,
    })),
    {
      id: 'mask',
      group,
      name: 'Mask over the picture',
      key: 'm',
      run: toggleMask,
      enabled: some,
      on: () => state.mask,
    },
  ];
}
