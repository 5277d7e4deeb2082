// Lines over the picture: box, path, axes and joints of the selected object, cameras and the ground.

import { rotate, toRotation, transformPoint, turnOf } from './math.js';
import { BRUSH_RADIUS, byId, context2d } from './page.js';
import { niceStep } from './player.js';
import { formatLengths, pivotOf } from './objects.js';
import { addScaled, boxCorners, cameraAt, cameraCentres } from './view_camera.js';
import { dotProduct, planeOf, sphereOf, sphereOfScene } from './view_camera.js';

/** @typedef {import('./types.js').Camera} Camera */
/** @typedef {import('./types.js').Pose} Pose */
/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').Command} Command */

const BOX_EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((corner) =>
  [1, 2, 4].filter((side) => !(corner & side)).map((side) => [corner, corner | side]),
);
const AXIS_COLORS = ['#ff5a52', '#6fd14b', '#5b9dff'];
const JOINT_COLOR = '#ffd23f';
const CAMERA_COLOR = '#ffb36b';
const GRID_COLOR = 'rgb(160 168 180 / 0.45)';
const PATH_POINTS = 600;
const GRID_CELLS = 10;

/** Lines in the world, drawn on a canvas as a camera sees them. */
class LineCanvas {
  /**
   * @param {CanvasRenderingContext2D} context
   * @param {Camera} camera
   * @param {number} near
   * @param {number} ratio Device pixels per CSS pixel.
   */
  constructor(context, camera, near, ratio) {
    this.context = context;
    this.camera = camera;
    this.near = near;
    this.ratio = ratio;
    this.rotation = toRotation(turnOf(camera.pose));
  }

  /**
   * A point in the frame of the camera.
   * @param {ArrayLike<number>} point
   * @returns {number[]}
   */
  see(point) {
    const { pose } = this.camera;
    const from = [point[0] - pose[0], point[1] - pose[1], point[2] - pose[2]];
    return [0, 1, 2].map((column) =>
      dotProduct(
        from,
        [0, 3, 6].map((row) => this.rotation[row + column]),
      ),
    );
  }

  /**
   * Pixel of a point in the frame of the camera.
   * @param {number[]} seen
   * @returns {number[]}
   */
  project(seen) {
    const { focal, principal } = this.camera;
    return [(focal[0] * seen[0]) / seen[2] + principal[0], (focal[1] * seen[1]) / seen[2] + principal[1]];
  }

  /**
   * Pixel of a point in the world; null behind the near plane.
   * @param {ArrayLike<number>} point
   * @returns {number[] | null}
   */
  pixel(point) {
    const seen = this.see(point);
    return seen[2] > this.near ? this.project(seen) : null;
  }

  /**
   * Lines between pairs of points, cut at the near plane.
   * @param {number[][][]} pairs
   * @param {string} color
   * @param {number} [width] CSS pixels.
   * @param {boolean} [outline] Draws a dark edge, so that the lines show on any picture.
   */
  lines(pairs, color, width = 1.5, outline = true) {
    const { context } = this;
    context.beginPath();
    for (const [from, to] of pairs) this.line(this.see(from), this.see(to));
    context.lineCap = 'round';
    if (outline) {
      context.strokeStyle = 'rgb(0 0 0 / 0.55)';
      context.lineWidth = (width + 1.5) * this.ratio;
      context.stroke();
    }
    context.strokeStyle = color;
    context.lineWidth = width * this.ratio;
    context.stroke();
  }

  /**
   * @param {number[]} from Frame of the camera.
   * @param {number[]} to Frame of the camera.
   */
  line(from, to) {
    if (from[2] <= this.near && to[2] <= this.near) return;
    const a = this.project(cutNear(from, to, this.near));
    const b = this.project(cutNear(to, from, this.near));
    this.context.moveTo(a[0], a[1]);
    this.context.lineTo(b[0], b[1]);
  }

  /**
   * @param {ArrayLike<number>} point
   * @param {string} color
   * @param {number} radius CSS pixels.
   */
  dot(point, color, radius) {
    const pixel = this.pixel(point);
    if (!pixel) return;
    const { context } = this;
    context.beginPath();
    context.arc(pixel[0], pixel[1], radius * this.ratio, 0, 2 * Math.PI);
    context.fillStyle = color;
    context.fill();
    context.strokeStyle = 'rgb(0 0 0 / 0.7)';
    context.lineWidth = this.ratio;
    context.stroke();
  }

  /**
   * @param {ArrayLike<number>} point
   * @param {string} text
   * @param {string} color
   */
  text(point, text, color) {
    const pixel = this.pixel(point);
    if (!pixel) return;
    const { context } = this;
    context.font = `${11 * this.ratio}px system-ui, sans-serif`;
    context.lineWidth = 3 * this.ratio;
    context.lineJoin = 'round';
    context.strokeStyle = 'rgb(0 0 0 / 0.75)';
    context.fillStyle = color;
    const x = pixel[0] + 6 * this.ratio;
    const y = pixel[1] - 4 * this.ratio;
    context.strokeText(text, x, y);
    context.fillText(text, x, y);
  }
}

/**
 * A point, or where the line to another meets the near plane when it is behind it.
 * @param {number[]} point
 * @param {number[]} other
 * @param {number} near
 * @returns {number[]}
 */
function cutNear(point, other, near) {
  if (point[2] > near) return point;
  return addScaled(point, addScaled(other, point, -1), (near - point[2]) / (other[2] - point[2]));
}

/** The canvas over the picture. */
export class Overlay {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.canvas = byId('overlay', HTMLCanvasElement);
    this.context = context2d(this.canvas);
    /** @type {Map<number, number[][]>} */
    this.paths = new Map();
    /** Where the pointer is, CSS pixels. */
    this.pointer = [0, 0];
    app.listen((changed) => {
      if (changed.has('scene')) this.paths.clear();
    });
    byId('picture', HTMLElement).addEventListener('pointermove', (event) => {
      const area = byId('picture', HTMLElement).getBoundingClientRect();
      this.pointer = [event.clientX - area.left, event.clientY - area.top];
      if (app.state.brush) app.redraw();
    });
    /** @type {{ camera: number, outline: number[][] }[]} */
    this.frusta = [];
    const scene = sphereOfScene(app);
    const centres = cameraCentres(app);
    this.reach = scene.radius;
    this.frustum =
      0.1 * Math.min(scene.radius, centres.length > 1 ? sphereOf(centres).radius * 2 : scene.radius);
    this.ground = groundOf(app);
  }

  /**
   * @param {Camera} shot
   * @param {number} code
   * @param {number} ratio Device pixels per CSS pixel.
   */
  draw(shot, code, ratio) {
    const { state, engine } = this.app;
    const [width, height] = shot.size;
    if (this.canvas.width !== width || this.canvas.height !== height)
      Object.assign(this.canvas, { width, height });
    // Not clearRect, which alone leaves the last picture on the screen in Chromium 156.
    this.context.reset();
    const lines = new LineCanvas(this.context, shot, engine.near(), ratio);
    if (state.grid) this.drawGrid(lines);
    this.frusta = [];
    if (state.cameras) this.drawCameras(lines, code);
    if (state.brush) this.drawBrush(ratio);
    if (state.selected < 0) return;
    if (state.box && engine.isVisible(state.selected, code)) this.drawBox(lines, code);
    if (state.path) this.drawPath(lines, code);
    if (state.joints) this.drawJoints(lines, code);
    if (state.axes) this.drawAxes(lines, code);
  }

  /** @param {number} ratio Device pixels per CSS pixel. */
  drawBrush(ratio) {
    const { context, pointer } = this;
    context.beginPath();
    context.arc(pointer[0] * ratio, pointer[1] * ratio, BRUSH_RADIUS * ratio, 0, 2 * Math.PI);
    context.strokeStyle = 'white';
    context.lineWidth = ratio;
    context.stroke();
  }

  /**
   * @param {LineCanvas} lines
   * @param {number} code
   */
  drawBox(lines, code) {
    const { state, scene } = this.app;
    const corners = boxCorners(this.app, state.selected, code);
    const [red, green, blue] = scene.nodes[state.selected].color;
    lines.lines(
      BOX_EDGES.map(([a, b]) => [corners[a], corners[b]]),
      `rgb(${red} ${green} ${blue})`,
    );
  }

  /**
   * @param {LineCanvas} lines
   * @param {number} code
   */
  drawPath(lines, code) {
    const { state, scene, engine } = this.app;
    const { selected } = state;
    const pivot = pivotOf(scene.nodes[selected]);
    const codes = scene.timeline.samples;
    const points = this.paths.get(selected) ?? tracePath(this.app, selected, pivot);
    this.paths.set(selected, points);
    const moves = points.some((point) => Math.hypot(...addScaled(point, points[0], -1)) > 1e-4 * this.reach);
    if (!moves) return;
    const pairs = points.slice(1).map((point, i) => [points[i], point]);
    const every = (codes.length - 1) / (points.length - 1);
    const past = pairs.findIndex((_, i) => codes[Math.round(i * every)] > code);
    const split = past < 0 ? pairs.length : past;
    lines.lines(pairs.slice(split), 'rgb(255 255 255 / 0.55)', 1.5);
    lines.lines(pairs.slice(0, split), '#ffffff', 2);
    lines.dot(transformPoint(engine.pose(selected, code), pivot), '#ffffff', 4.5);
  }

  /**
   * @param {LineCanvas} lines
   * @param {number} code
   */
  drawAxes(lines, code) {
    const { state, engine } = this.app;
    const pose = engine.pose(state.selected, code);
    const length = 0.6 * sphereOf(boxCorners(this.app, state.selected, code)).radius;
    const origin = [pose[0], pose[1], pose[2]];
    AXIS_COLORS.forEach((color, axis) => {
      const end = addScaled(
        origin,
        rotate(
          turnOf(pose),
          [0, 1, 2].map((i) => Number(i === axis)),
        ),
        length,
      );
      lines.lines([[origin, end]], color, 2.5);
      lines.text(end, 'xyz'[axis], color);
    });
  }

  /**
   * @param {LineCanvas} lines
   * @param {number} code
   */
  drawJoints(lines, code) {
    const { state, scene, engine } = this.app;
    const half = 0.5 * sphereOf(boxCorners(this.app, state.selected, code)).radius;
    scene.nodes[state.selected].parts.forEach(({ name, joint }, part) => {
      if (!joint) return;
      const pose = engine.partPose(state.selected, part, code);
      const axis = rotate(turnOf(pose), joint.axis);
      const anchor = transformPoint(pose, joint.anchor);
      const ends = [addScaled(anchor, axis, -half), addScaled(anchor, axis, half)];
      lines.lines([ends], JOINT_COLOR, 2);
      lines.lines(jointMark(joint.kind, anchor, axis, ends, half), JOINT_COLOR, 1.5);
      lines.dot(anchor, JOINT_COLOR, 3.5);
      lines.text(ends[1], `${name}: ${joint.kind}`, JOINT_COLOR);
    });
  }

  /**
   * @param {LineCanvas} lines
   * @param {number} code
   */
  drawCameras(lines, code) {
    const { state, scene } = this.app;
    const few = scene.cameras.length <= 12;
    scene.cameras.forEach(({ name, samples }, camera) => {
      const centres = samples.map(({ pose }) => [pose[0], pose[1], pose[2]]);
      const track = centres.slice(1).map((centre, i) => [centres[i], centre]);
      if (camera !== state.camera) {
        lines.lines(track, 'rgb(255 179 107 / 0.5)', 1, false);
        this.drawFrustum(lines, camera, cameraAt(samples, code));
        if (few) lines.text(cameraAt(samples, code).pose, name, CAMERA_COLOR);
      }
    });
  }

  /**
   * @param {LineCanvas} lines
   * @param {number} camera
   * @param {Camera} shot
   */
  drawFrustum(lines, camera, shot) {
    const { size, focal, principal, pose } = shot;
    const depth = this.frustum;
    const corner = (/** @type {number} */ x, /** @type {number} */ y) =>
      transformPoint(pose, [
        (depth * (x - principal[0])) / focal[0],
        (depth * (y - principal[1])) / focal[1],
        depth,
      ]);
    const centre = [pose[0], pose[1], pose[2]];
    const corners = [corner(0, 0), corner(size[0], 0), corner(size[0], size[1]), corner(0, size[1])];
    const sides = corners.map((point, i) => [point, corners[(i + 1) % 4]]);
    const top = corner(size[0] / 2, -0.25 * size[1]);
    const roof = [
      [corners[0], top],
      [top, corners[1]],
    ];
    lines.lines([...sides, ...corners.map((point) => [centre, point]), ...roof], CAMERA_COLOR, 1.2);
    const outline = [centre, ...corners].map((point) => lines.pixel(point));
    const seen = /** @type {number[][]} */ (outline.filter((pixel) => pixel !== null));
    if (seen.length === outline.length) this.frusta.push({ camera, outline: seen });
  }

  /**
   * The recorded camera that is drawn at a device pixel; -1 where there is none.
   * @param {number} x
   * @param {number} y
   * @returns {number}
   */
  cameraAtPixel(x, y) {
    if (!this.app.state.cameras) return -1;
    const hit = this.frusta.find(({ outline: [centre, a, b, c, d] }) =>
      [
        [a, b, c],
        [a, c, d],
        [centre, a, b],
        [centre, b, c],
        [centre, c, d],
        [centre, d, a],
      ].some((triangle) => insideTriangle([x, y], triangle)),
    );
    return hit?.camera ?? -1;
  }

  /** @param {LineCanvas} lines */
  drawGrid(lines) {
    const { up } = this.app.scene;
    const [first, second] = planeOf(up);
    const { centre, step } = this.ground;
    const reach = GRID_CELLS * step;
    const pairs = Array.from({ length: 2 * GRID_CELLS + 1 }, (_, i) => (i - GRID_CELLS) * step).flatMap(
      (offset) => [
        [
          addScaled(addScaled(centre, first, offset), second, -reach),
          addScaled(addScaled(centre, first, offset), second, reach),
        ],
        [
          addScaled(addScaled(centre, second, offset), first, -reach),
          addScaled(addScaled(centre, second, offset), first, reach),
        ],
      ],
    );
    lines.lines(pairs, GRID_COLOR, 1, false);
    lines.text(addScaled(centre, first, reach), `grid ${this.gridStep()}`, 'rgb(225 229 235)');
  }

  /** @returns {string} Width of a cell of the ground grid. */
  gridStep() {
    return formatLengths([this.ground.step], this.app.scene.meters_per_unit);
  }
}

/**
 * Points of a path over the timeline.
 * @param {App} app
 * @param {number} node
 * @param {number[]} pivot
 * @returns {number[][]}
 */
function tracePath(app, node, pivot) {
  const { samples } = app.scene.timeline;
  const count = Math.min(samples.length, PATH_POINTS);
  return Array.from({ length: count }, (_, i) => {
    const code = samples[count > 1 ? Math.round((i * (samples.length - 1)) / (count - 1)) : 0];
    return transformPoint(app.engine.pose(node, code), pivot);
  });
}

/**
 * A circle around the axis of a revolute joint; arrows at the ends of others.
 * @param {string} kind
 * @param {number[]} anchor
 * @param {number[]} axis
 * @param {number[][]} ends
 * @param {number} half
 * @returns {number[][][]}
 */
function jointMark(kind, anchor, axis, ends, half) {
  const [first, second] = planeOf(axis);
  if (kind !== 'revolute') {
    return ends.flatMap((end, i) =>
      [-1, 1].map((side) => [
        end,
        addScaled(addScaled(end, axis, (i ? -0.2 : 0.2) * half), first, side * 0.1 * half),
      ]),
    );
  }
  const points = Array.from({ length: 25 }, (_, i) => {
    const angle = (i * 2 * Math.PI) / 24;
    const across = addScaled(anchor, first, 0.25 * half * Math.cos(angle));
    return addScaled(across, second, 0.25 * half * Math.sin(angle));
  });
  return points.slice(1).map((point, i) => [points[i], point]);
}

/**
 * Middle and width of cells of the ground grid: under the lowest object at the start, else under everything.
 * @param {App} app
 * @returns {{ centre: number[], step: number }}
 */
function groundOf(app) {
  const { up, nodes, timeline } = app.scene;
  const sphere = sphereOfScene(app);
  const instances = nodes.some((node) => node.kind === 'instance');
  const heights = nodes.flatMap((node, i) =>
    node.splats.count && (node.kind === 'instance' || !instances)
      ? boxCorners(app, i, timeline.start).map((corner) => dotProduct(corner, up))
      : [],
  );
  const lowest = heights.length ? Math.min(...heights) : dotProduct(sphere.centre, up) - sphere.radius;
  const centre = addScaled(sphere.centre, up, lowest - dotProduct(sphere.centre, up));
  return { centre, step: niceStep(sphere.radius / 5) };
}

/**
 * @param {number[]} point
 * @param {number[][]} triangle
 * @returns {boolean}
 */
function insideTriangle(point, triangle) {
  const sides = triangle.map((corner, i) => {
    const next = triangle[(i + 1) % 3];
    return (next[0] - corner[0]) * (point[1] - corner[1]) - (next[1] - corner[1]) * (point[0] - corner[0]);
  });
  return sides.every((side) => side >= 0) || sides.every((side) => side <= 0);
}

/**
 * @param {App} app
 * @returns {Command[]}
 */
export function overlayCommands(app) {
  const { state } = app;
  /** @typedef {'box' | 'path' | 'axes' | 'joints' | 'cameras' | 'grid'} Drawn */
  /** @type {(id: Drawn, key: string, name: string) => Command} */
  const toggle = (id, key, name) => ({
    id,
    group: 'Drawn over the picture',
    name,
    key,
    run: () => app.set({ [id]: !state[id] }),
    on: () => state[id],
  });
  return [
    toggle('box', 'b', 'Box of the selected object'),
    toggle('path', 'p', 'Path of the selected object'),
    toggle('axes', 'x', 'Axes of the selected object'),
    toggle('joints', 'j', 'Joints of the selected object'),
    { ...toggle('cameras', 'c', 'Recorded cameras'), enabled: () => app.scene.cameras.length > 0 },
    toggle('grid', 'n', 'Ground grid'),
  ];
}
