// The free camera, recorded cameras, and their control with mouse, touch and keys.

import { fromRotation, rotate, slerp, transformPoint, turnOf } from './math.js';
import { nearestIndex } from './page.js';

/** @typedef {import('./types.js').Camera} Camera */
/** @typedef {import('./types.js').Shot} Shot */
/** @typedef {import('./types.js').Pose} Pose */
/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').Command} Command */
/** @typedef {{ centre: number[], radius: number }} Sphere */

const CLICK_DISTANCE = 4;
const ORBIT_PER_PIXEL = 0.006;
const ORBIT_PER_KEY = 0.06;
const FLY_KEYS = ['w', 'a', 's', 'd', 'q', 'e'];

/**
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @returns {number[]}
 */
export function crossProduct(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/**
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @returns {number}
 */
export function dotProduct(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/**
 * `a + factor * b`.
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @param {number} factor
 * @returns {number[]}
 */
export function addScaled(a, b, factor) {
  return [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
}

/**
 * Two unit vectors at right angles to a unit vector, so that `first x second = axis`.
 * @param {ArrayLike<number>} axis
 * @returns {number[][]}
 */
export function planeOf(axis) {
  const other = Math.abs(axis[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0];
  const first = addScaled(other, axis, -dotProduct(other, axis));
  const length = Math.hypot(...first);
  const unit = first.map((value) => value / length);
  return [unit, crossProduct(axis, unit)];
}

/** A camera that turns around a point and stays level, apart from the roll that it starts with. */
export class ViewCamera {
  /**
   * @param {number[]} up Unit vector.
   * @param {number} focal Focal length over the height of the picture.
   * @param {number} nearest Smallest distance from the point that it turns around.
   */
  constructor(up, focal, nearest) {
    this.up = up;
    this.focal = focal;
    this.nearest = nearest;
    this.plane = planeOf(up);
    this.target = [0, 0, 0];
    this.distance = 1;
    this.yaw = 0;
    this.pitch = 0;
    this.roll = 0;
  }

  /**
   * Takes a pose, and turns around the point at a distance in front of it.
   * @param {Pose} pose
   * @param {number} distance
   */
  look(pose, distance) {
    const turn = turnOf(pose);
    const forward = rotate(turn, [0, 0, 1]);
    const rise = dotProduct(forward, this.up);
    const steep = Math.abs(rise) > 0.9999;
    const level = steep ? rotate(turn, [0, Math.sign(rise), 0]) : forward;
    this.yaw = Math.atan2(dotProduct(level, this.plane[1]), dotProduct(level, this.plane[0]));
    this.pitch = Math.asin(Math.max(-1, Math.min(1, rise)));
    this.roll = 0;
    const [right, down] = this.directions();
    const across = rotate(turn, [1, 0, 0]);
    this.roll = Math.atan2(dotProduct(across, down), dotProduct(across, right));
    this.distance = Math.max(distance, this.nearest);
    this.target = addScaled([pose[0], pose[1], pose[2]], forward, this.distance);
  }

  /**
   * Right, down and forward of the camera in the world.
   * @returns {number[][]}
   */
  directions() {
    const heading = addScaled([0, 0, 0], this.plane[0], Math.cos(this.yaw));
    const ahead = addScaled(heading, this.plane[1], Math.sin(this.yaw));
    const right = crossProduct(ahead, this.up);
    const forward = addScaled(
      addScaled([0, 0, 0], ahead, Math.cos(this.pitch)),
      this.up,
      Math.sin(this.pitch),
    );
    const down = crossProduct(forward, right);
    const cosine = Math.cos(this.roll);
    const sine = Math.sin(this.roll);
    return [
      addScaled(addScaled([0, 0, 0], right, cosine), down, sine),
      addScaled(addScaled([0, 0, 0], down, cosine), right, -sine),
      forward,
    ];
  }

  /** @returns {number[]} `world_from_camera`. */
  pose() {
    const [x, y, z] = this.directions();
    const turn = fromRotation([x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]]);
    return [...addScaled(this.target, z, -this.distance), ...turn];
  }

  /**
   * @param {number} width
   * @param {number} height
   * @returns {Camera}
   */
  shot(width, height) {
    const focal = this.focal * height;
    return {
      size: [width, height],
      focal: [focal, focal],
      principal: [width / 2, height / 2],
      pose: this.pose(),
    };
  }

  /**
   * Turns around the target by angles to the right and down in the picture.
   * @param {number} right
   * @param {number} down
   */
  orbit(right, down) {
    const cosine = Math.cos(this.roll);
    const sine = Math.sin(this.roll);
    this.yaw -= right * cosine - down * sine;
    const pitch = this.pitch - (right * sine + down * cosine);
    this.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, pitch));
  }

  /**
   * Moves in the plane of the picture, by fractions of its height.
   * @param {number} right
   * @param {number} down
   */
  pan(right, down) {
    const [x, y] = this.directions();
    const scale = -this.distance / this.focal;
    this.target = addScaled(addScaled(this.target, x, right * scale), y, down * scale);
  }

  /** @param {number} factor Of the distance. */
  dolly(factor) {
    this.distance = Math.max(this.nearest, this.distance * factor);
  }

  /**
   * Moves by right, up and forward.
   * @param {number[]} step
   */
  move(step) {
    const [x, , z] = this.directions();
    this.target = addScaled(addScaled(addScaled(this.target, x, step[0]), this.up, step[1]), z, step[2]);
  }

  /**
   * Turns around another point, from the same place, looking at it.
   * @param {number[]} point
   */
  turnTo(point) {
    const eye = addScaled(this.target, this.directions()[2], -this.distance);
    const away = addScaled(point, eye, -1);
    const distance = Math.hypot(...away);
    if (distance < this.nearest) return;
    const level = addScaled(away, this.up, -dotProduct(away, this.up));
    if (Math.hypot(...level) > 1e-6 * distance) {
      this.yaw = Math.atan2(dotProduct(level, this.plane[1]), dotProduct(level, this.plane[0]));
    }
    this.pitch = Math.asin(Math.max(-1, Math.min(1, dotProduct(away, this.up) / distance)));
    this.distance = distance;
    this.target = point;
  }

  /**
   * Shows all of a sphere, from the present direction.
   * @param {Sphere} sphere
   * @param {number} aspect Width of the picture over its height.
   */
  frame(sphere, aspect) {
    const half = Math.atan((0.5 * Math.min(1, aspect)) / this.focal);
    this.target = sphere.centre;
    this.distance = Math.max(this.nearest, (1.05 * sphere.radius) / Math.sin(half));
  }
}

/**
 * Focal length over the height of the picture of the free camera.
 * @param {App['scene']} scene
 * @returns {number}
 */
export function freeFocal(scene) {
  const first = scene.cameras[0]?.samples[0];
  return first ? first.focal[1] / first.size[1] : 0.5 / Math.tan(Math.PI / 8);
}

/**
 * A recorded camera at a time: linear in its numbers and centre, spherical in rotation, held
 * outside its samples.
 * @param {Shot[]} samples
 * @param {number} code
 * @returns {Shot}
 */
export function cameraAt(samples, code) {
  const codes = samples.map((sample) => sample.code);
  const near = nearestIndex(codes, code);
  const from = codes[near] > code && near > 0 ? near - 1 : near;
  const a = samples[from];
  const b = samples[from + 1];
  if (!b || code <= a.code || String(a.size) !== String(b.size)) return samples[near];
  const fraction = (code - a.code) / (b.code - a.code);
  /** @type {(x: ArrayLike<number>, y: ArrayLike<number>, count: number) => number[]} */
  const mix = (x, y, count) => Array.from({ length: count }, (_, i) => x[i] + fraction * (y[i] - x[i]));
  return {
    code,
    size: a.size,
    focal: mix(a.focal, b.focal, 2),
    principal: mix(a.principal, b.principal, 2),
    pose: [...mix(a.pose, b.pose, 3), ...slerp(turnOf(a.pose), turnOf(b.pose), fraction)],
  };
}

/**
 * A camera for a picture of another size.
 * @param {Camera} camera
 * @param {number} width
 * @param {number} height
 * @returns {Camera}
 */
export function resizeCamera(camera, width, height) {
  const scale = [width / camera.size[0], height / camera.size[1]];
  return {
    size: [width, height],
    focal: [camera.focal[0] * scale[0], camera.focal[1] * scale[1]],
    principal: [camera.principal[0] * scale[0], camera.principal[1] * scale[1]],
    pose: camera.pose,
  };
}

/**
 * Corners of the box of a node in the world.
 * @param {App} app
 * @param {number} node
 * @param {number} code
 * @returns {number[][]}
 */
export function boxCorners(app, node, code) {
  const [low, high] = app.scene.nodes[node].extent;
  const pose = app.engine.pose(node, code);
  return Array.from({ length: 8 }, (_, i) =>
    transformPoint(pose, [i & 1 ? high[0] : low[0], i & 2 ? high[1] : low[1], i & 4 ? high[2] : low[2]]),
  );
}

/**
 * A sphere around points; that of radius 1 around the origin where there are none.
 * @param {number[][]} points
 * @returns {Sphere}
 */
export function sphereOf(points) {
  if (!points.length) return { centre: [0, 0, 0], radius: 1 };
  const centre = [0, 1, 2].map((axis) => {
    const values = points.map((point) => point[axis]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
  const radius = Math.max(...points.map((point) => Math.hypot(...addScaled(point, centre, -1))));
  return { centre, radius: radius || 1 };
}

/**
 * What `frame` shows: the selected object, else the objects, else everything, else the cameras.
 * @param {App} app
 * @param {number} [selected]
 * @returns {Sphere}
 */
export function sphereOfScene(app, selected = -1) {
  const filled = app.scene.nodes.map((_, i) => i).filter((i) => app.scene.nodes[i].splats.count > 0);
  const instances = filled.filter((i) => app.scene.nodes[i].kind === 'instance');
  const nodes = selected >= 0 ? [selected] : instances.length ? instances : filled;
  const corners = nodes.flatMap((node) => boxCorners(app, node, app.state.code));
  return sphereOf(corners.length ? corners : cameraCentres(app));
}

/**
 * @param {App} app
 * @returns {number[][]}
 */
export function cameraCentres(app) {
  return app.scene.cameras.flatMap((camera) => camera.samples.map(({ pose }) => [pose[0], pose[1], pose[2]]));
}

/**
 * Puts the free camera where the page starts.
 * @param {App} app
 */
export function resetCamera(app) {
  const { scene, engine, viewCamera } = app;
  const first = scene.cameras[0]?.samples[0];
  const sphere = sphereOfScene(app);
  const shot = app.shot();
  const aspect = shot.size[0] / shot.size[1];
  if (!first) {
    viewCamera.yaw = 0.6;
    viewCamera.pitch = -0.4;
    viewCamera.roll = 0;
    viewCamera.frame(sphere, aspect);
    return;
  }
  const start = [first.pose[0], first.pose[1], first.pose[2]];
  viewCamera.look(first.pose, Math.hypot(...addScaled(start, sphere.centre, -1)));
  if (isCapture(scene)) {
    viewCamera.pitch -= 0.25;
    viewCamera.roll = 0;
    viewCamera.frame(sphereOf([...boxesOfAll(app), ...cameraCentres(app)]), aspect);
    return;
  }
  engine.setTime(app.code());
  const small = viewCamera.shot(Math.round(240 * aspect), 240);
  const middle = engine.pick(small, app.lowPass(), small.size[0] / 2, small.size[1] / 2);
  if (middle.depth) viewCamera.look(first.pose, middle.depth);
}

/**
 * @param {App} app
 * @returns {number[][]}
 */
function boxesOfAll(app) {
  return app.scene.nodes.flatMap((node, i) => (node.splats.count ? boxCorners(app, i, app.state.code) : []));
}

/**
 * True for a capture that nothing was trained on yet.
 * @param {App['scene']} scene
 * @returns {boolean}
 */
export function isCapture(scene) {
  return scene.views.length > 0 && scene.nodes.every((node) => node.kind === 'points');
}

/** Mouse, touch and keys that move the camera. */
export class CameraControls {
  /**
   * @param {App} app
   * @param {HTMLElement} picture
   * @param {(x: number, y: number) => void} choose Called with CSS pixels of a click.
   */
  constructor(app, picture, choose) {
    this.app = app;
    this.picture = picture;
    this.choose = choose;
    /** @type {Map<number, { x: number, y: number }>} */
    this.pointers = new Map();
    /** @type {Set<string>} */
    this.keys = new Set();
    this.fast = false;
    this.moved = 0;
    this.panning = false;
    picture.addEventListener('pointerdown', (event) => this.press(event));
    picture.addEventListener('pointermove', (event) => this.drag(event));
    picture.addEventListener('pointerup', (event) => this.release(event, true));
    picture.addEventListener('pointercancel', (event) => this.release(event, false));
    picture.addEventListener('wheel', (event) => this.wheel(event), { passive: false });
    picture.addEventListener('dblclick', (event) => this.centre(event));
    picture.addEventListener('contextmenu', (event) => event.preventDefault());
    picture.addEventListener('keydown', (event) => this.turnByKey(event));
    window.addEventListener('blur', () => this.keys.clear());
  }

  /** True while an image is compared, so that the camera stays. */
  get held() {
    return this.app.state.camera >= 0 && this.app.state.compare !== 'render';
  }

  /** @param {() => void} change */
  change(change) {
    if (this.held) return;
    this.app.leaveCamera();
    change();
    this.app.redraw();
  }

  /** @param {PointerEvent} event */
  press(event) {
    event.preventDefault();
    if (document.activeElement instanceof HTMLElement) document.activeElement.blur();
    this.picture.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (this.pointers.size === 1) this.moved = 0;
    else this.moved = CLICK_DISTANCE;
    this.panning = event.button !== 0 || event.shiftKey;
    this.picture.dataset.drag = 'true';
  }

  /** @param {PointerEvent} event */
  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const right = event.clientX - last.x;
    const down = event.clientY - last.y;
    this.moved += Math.abs(right) + Math.abs(down);
    if (this.moved < CLICK_DISTANCE) return;
    const before = this.spread();
    last.x = event.clientX;
    last.y = event.clientY;
    if (this.app.state.brush && event.buttons === 1) this.brush(event);
    else if (this.held) this.dragSplit(event);
    else if (right || down) this.change(() => this.dragCamera(right, down, before));
  }

  /** @param {PointerEvent} event */
  brush(event) {
    const area = this.picture.getBoundingClientRect();
    this.app.brushAt(event.clientX - area.left, event.clientY - area.top, event.shiftKey);
  }

  /**
   * @param {number} right
   * @param {number} down
   * @param {number} before Distance between two fingers before the move.
   */
  dragCamera(right, down, before) {
    const { viewCamera } = this.app;
    const height = this.picture.clientHeight;
    const fingers = this.pointers.size;
    if (fingers > 1 || this.panning) viewCamera.pan(right / height / fingers, down / height / fingers);
    else viewCamera.orbit(right * ORBIT_PER_PIXEL, down * ORBIT_PER_PIXEL);
    if (fingers === 2 && before > 0) viewCamera.dolly(before / Math.max(1, this.spread()));
  }

  /** @param {MouseEvent} event */
  dragSplit(event) {
    if (this.app.state.compare !== 'split') return;
    const area = this.picture.getBoundingClientRect();
    this.app.set({ split: Math.max(0, Math.min(1, (event.clientX - area.left) / area.width)) });
  }

  /** @returns {number} Distance between two fingers, CSS pixels. */
  spread() {
    const [a, b] = [...this.pointers.values()];
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  }

  /**
   * @param {PointerEvent} event
   * @param {boolean} complete
   */
  release(event, complete) {
    if (!this.pointers.delete(event.pointerId)) return;
    if (!this.pointers.size) delete this.picture.dataset.drag;
    if (!complete || this.moved >= CLICK_DISTANCE || event.button !== 0) return;
    if (this.app.state.brush) {
      this.brush(event);
      return;
    }
    const area = this.picture.getBoundingClientRect();
    this.choose(event.clientX - area.left, event.clientY - area.top);
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 400 : 1;
    const rate = event.ctrlKey ? 0.01 : 0.0012;
    const factor = Math.exp(Math.max(-300, Math.min(300, event.deltaY * lines)) * rate);
    this.change(() => this.app.viewCamera.dolly(factor));
  }

  /**
   * Turns around the point that was clicked twice.
   * @param {MouseEvent} event
   */
  centre(event) {
    if (this.held) return;
    const { app } = this;
    const area = this.picture.getBoundingClientRect();
    const { point } = app.pick(event.clientX - area.left, event.clientY - area.top);
    if (point) this.change(() => app.viewCamera.turnTo(point));
  }

  /**
   * Keys of the picture while it has the focus.
   * @param {KeyboardEvent} event
   */
  turnByKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || (event.shiftKey && event.key.startsWith('Arrow')))
      return;
    const { viewCamera } = this.app;
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowLeft: () => viewCamera.orbit(-ORBIT_PER_KEY, 0),
      ArrowRight: () => viewCamera.orbit(ORBIT_PER_KEY, 0),
      ArrowUp: () => viewCamera.orbit(0, -ORBIT_PER_KEY),
      ArrowDown: () => viewCamera.orbit(0, ORBIT_PER_KEY),
      '+': () => viewCamera.dolly(0.9),
      '=': () => viewCamera.dolly(0.9),
      '-': () => viewCamera.dolly(1 / 0.9),
    };
    const act = keys[event.key];
    if (act) this.change(act);
    else if (event.key === 'Enter') this.choose(this.picture.clientWidth / 2, this.picture.clientHeight / 2);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  /**
   * Notes a key that flies the camera.
   * @param {KeyboardEvent} event
   * @returns {boolean} True when it is one.
   */
  keyDown(event) {
    this.fast = event.shiftKey;
    const key = event.key.toLowerCase();
    if (!FLY_KEYS.includes(key)) return false;
    this.keys.add(key);
    return true;
  }

  /** @param {KeyboardEvent} event */
  keyUp(event) {
    this.fast = event.shiftKey;
    this.keys.delete(event.key.toLowerCase());
  }

  /**
   * Moves by the keys that are held.
   * @param {number} seconds
   */
  fly(seconds) {
    if (!this.keys.size) return;
    /** @type {(plus: string, minus: string) => number} */
    const along = (plus, minus) => Number(this.keys.has(plus)) - Number(this.keys.has(minus));
    this.app.leaveCamera();
    const step = this.app.viewCamera.distance * (this.fast ? 3 : 0.75) * seconds;
    this.app.viewCamera.move([step * along('d', 'a'), step * along('e', 'q'), step * along('w', 's')]);
    this.app.redraw();
  }
}

/**
 * @param {App} app
 * @returns {Command[]}
 */
export function cameraCommands(app) {
  const frame = () => {
    app.leaveCamera();
    const { size } = app.shot();
    app.viewCamera.frame(sphereOfScene(app, app.state.selected), size[0] / size[1]);
    app.redraw();
  };
  const reset = () => {
    app.set({ camera: -1, compare: 'render', mask: false, follow: false });
    resetCamera(app);
    app.redraw();
  };
  const level = () => {
    app.leaveCamera();
    app.viewCamera.roll = 0;
    app.redraw();
  };
  return [
    { id: 'frame', group: 'Camera', name: 'Frame the selected object, or the scene', key: 'f', run: frame },
    { id: 'reset', group: 'Camera', name: 'Reset the camera', key: 'r', run: reset },
    { id: 'home', group: 'Camera', name: 'Reset the camera', key: 'Home', run: reset },
    { id: 'level', group: 'Camera', name: 'Level the horizon', key: 'l', run: level },
  ];
}
