// The list of objects, what is shown of them, and the details of the selected one.

import { byId, make } from './page.js';
import { addScaled } from './view_camera.js';
import { transformPoint } from './math.js';

/** @typedef {import('./types.js').Node} SceneNode */
/** @typedef {import('./types.js').Part} Part */
/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').Command} Command */

const EYE =
  'M8 3C4.5 3 2 6 1 8c1 2 3.5 5 7 5s6-3 7-5c-1-2-3.5-5-7-5zm0 1.5c2.4 0 4.3 2 5.3 3.5'
  + 'C12.3 9.5 10.4 11.5 8 11.5S3.7 9.5 2.7 8C3.7 6.5 5.6 4.5 8 4.5z';

/**
 * What a node is called.
 * @param {SceneNode} node
 * @returns {string}
 */
export function labelOf(node) {
  return node.label || node.name;
}

/**
 * Whether each node is shown.
 * @param {App['state']} state
 * @returns {boolean[]}
 */
export function shownNodes(state) {
  return state.hidden.map((hidden, i) => (state.isolated >= 0 ? i === state.isolated : !hidden));
}

/**
 * The point of a node whose path is drawn, local frame: its origin where that is near its box, else the
 * centre of the box.
 * @param {SceneNode} node
 * @returns {number[]}
 */
export function pivotOf(node) {
  const [low, high] = node.extent;
  const near = low.every(
    (value, i) => value - 0.5 * (high[i] - value) <= 0 && high[i] + 0.5 * (high[i] - value) >= 0,
  );
  return near ? [0, 0, 0] : low.map((value, i) => (value + high[i]) / 2);
}

/**
 * A whole number with separators.
 * @param {number} count
 * @returns {string}
 */
export function formatCount(count) {
  return count.toLocaleString('en-US');
}

/**
 * Lengths with a unit: centimetres or metres where the scale of the world is known.
 * @param {number[]} lengths World units.
 * @param {number | null} metersPerUnit
 * @param {string} [between]
 * @returns {string}
 */
export function formatLengths(lengths, metersPerUnit, between = ' x ') {
  if (!metersPerUnit) return `${lengths.map((value) => formatNumber(value)).join(between)} units`;
  const largest = Math.max(...lengths.map((value) => Math.abs(value))) * metersPerUnit;
  const [factor, unit] = largest >= 10 ? [metersPerUnit, 'm'] : [100 * metersPerUnit, 'cm'];
  return `${lengths.map((value) => (value * factor).toFixed(largest >= 10 ? 2 : 1)).join(between)} ${unit}`;
}

/**
 * About four digits, without an exponent where that is readable.
 * @param {number} value
 * @returns {string}
 */
export function formatNumber(value) {
  const size = Math.abs(value);
  if (size === 0) return '0';
  return size < 1e-4 || size >= 1e7 ? value.toExponential(3) : String(Number(value.toPrecision(4)));
}

/**
 * Range of a joint in degrees or lengths.
 * @param {NonNullable<Part['joint']>} joint
 * @param {number | null} metersPerUnit
 * @returns {string}
 */
export function formatRange(joint, metersPerUnit) {
  if (!joint.range) return 'does not move';
  if (joint.kind === 'prismatic') return formatLengths(joint.range, metersPerUnit, ' to ');
  return `${joint.range.map((value) => ((value * 180) / Math.PI).toFixed(1)).join(' to ')} degrees`;
}

/**
 * Poses of a node at every sample of the timeline.
 * @param {App} app
 * @param {number} node
 * @returns {string}
 */
export function posesAsCsv(app, node) {
  const { samples, per_second: rate } = app.scene.timeline;
  const rows = samples.map((code) =>
    [code, code / rate, ...Array.from(app.engine.pose(node, code))].join(','),
  );
  return ['time_code,seconds,x,y,z,qw,qx,qy,qz', ...rows, ''].join('\n');
}

/**
 * Saves a text as a file of the user.
 * @param {string} name
 * @param {string} text
 * @param {string} type
 */
export function saveFile(name, text, type) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([text], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/**
 * @param {string} text
 * @returns {Promise<boolean>} True when it was copied.
 */
async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = make('textarea', '', text);
    document.body.append(area);
    area.select();
    const copied = document.execCommand('copy');
    area.remove();
    return copied;
  }
}

/**
 * A square in the colour of a node.
 * @param {SceneNode} node
 * @returns {HTMLElement}
 */
function makeSwatch(node) {
  const swatch = make('span', 'swatch');
  swatch.style.backgroundColor = `rgb(${node.color.join(' ')})`;
  return swatch;
}

/** @returns {SVGElement} */
function makeEye() {
  const space = 'http://www.w3.org/2000/svg';
  const svg = document.createElementNS(space, 'svg');
  svg.setAttribute('viewBox', '0 0 16 16');
  svg.setAttribute('aria-hidden', 'true');
  const shapes = [
    ['', EYE],
    ['pupil', 'M8 5.8a2.2 2.2 0 1 1 0 4.4a2.2 2.2 0 1 1 0-4.4z'],
    ['strike', 'M2.5 1.5l12 12-1 1-12-12z'],
  ];
  for (const [name, data] of shapes) {
    const path = document.createElementNS(space, 'path');
    path.setAttribute('d', data);
    if (name) path.setAttribute('class', name);
    svg.append(path);
  }
  return svg;
}

/**
 * How many splats a node has.
 * @param {SceneNode} node
 * @returns {string}
 */
function countOf(node) {
  return `${formatCount(node.splats.count)} ${node.kind === 'points' ? 'points' : 'splats'}`;
}

/** The list of objects. */
export class ObjectList {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.list = byId('list', HTMLUListElement);
    this.search = byId('search', HTMLInputElement);
    this.count = byId('objects-count', HTMLElement);
    this.items = app.scene.nodes.map((node, i) => this.makeItem(node, i));
    this.empty = make('li', 'empty', 'No object matches.');
    this.list.append(...this.items, this.empty);
    this.search.addEventListener('input', () => this.filter());
    this.search.addEventListener('keydown', (event) => this.searchKey(event));
    this.list.addEventListener('keydown', (event) => this.moveFocus(event));
    app.listen((changed) => {
      if (['hidden', 'isolated', 'selected'].some((key) => changed.has(key))) this.show();
      if (changed.has('selected')) this.items[app.state.selected]?.scrollIntoView({ block: 'nearest' });
      if (changed.has('scene')) this.rename();
      if (changed.has('ratios')) this.showRatios();
    });
    this.filter();
    this.show();
  }

  /**
   * @param {SceneNode} node
   * @param {number} index
   * @returns {HTMLLIElement}
   */
  makeItem(node, index) {
    const facts = make('span', 'facts', '', [make('span', '', node.motion)]);
    if (node.parts.length) facts.append(make('span', '', `${node.parts.length} parts`));
    facts.append(
      make('span', 'count', countOf(node)),
      make('span', 'decibels'),
    );
    if (node.rotation) {
      const badge = make('span', 'badge', `rotation ${node.rotation}`);
      badge.dataset.evidence = node.rotation;
      facts.append(badge);
    }
    const category = make('span', 'category', node.category === labelOf(node) ? '' : node.category);
    const item = make('button', 'item', '', [
      makeSwatch(node),
      make('span', 'label', labelOf(node)),
      category,
      facts,
    ]);
    item.type = 'button';
    item.title = labelOf(node);
    item.addEventListener('click', () =>
      this.app.set({ selected: this.app.state.selected === index ? -1 : index }),
    );
    const eye = make('button', 'eye', '', [makeEye()]);
    eye.type = 'button';
    eye.setAttribute('aria-label', `Show ${labelOf(node)}`);
    eye.title = 'Show or hide';
    eye.addEventListener('click', () => toggleHidden(this.app, index));
    const made = make('li', '', '', [item, eye]);
    made.dataset.node = String(index);
    return made;
  }

  show() {
    const { state } = this.app;
    const shown = shownNodes(state);
    this.items.forEach((item, i) => {
      item.dataset.chosen = String(i === state.selected);
      item.dataset.shown = String(shown[i]);
      item.querySelector('.item')?.setAttribute('aria-pressed', String(i === state.selected));
      item.querySelector('.eye')?.setAttribute('aria-pressed', String(shown[i]));
    });
  }

  /** Takes labels and counts that were changed. */
  rename() {
    this.app.scene.nodes.forEach((node, i) => {
      const item = this.items[i];
      for (const [part, text] of [['.label', labelOf(node)], ['.count', countOf(node)]]) {
        const element = item.querySelector(part);
        if (element) element.textContent = text;
      }
      item.querySelector('.item')?.setAttribute('title', labelOf(node));
      item.querySelector('.eye')?.setAttribute('aria-label', `Show ${labelOf(node)}`);
    });
  }

  /** Shows how well each object agrees with the image that is compared. */
  showRatios() {
    const { ratios } = this.app;
    this.items.forEach((item, i) => {
      const ratio = ratios[i] ?? null;
      const element = item.querySelector('.decibels');
      if (element) element.textContent = ratio === null ? '' : `${ratio.toFixed(1)} dB`;
    });
  }

  filter() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const matches = this.app.scene.nodes.map((node) => {
      const text = `${node.label} ${node.category} ${node.name}`.toLowerCase();
      return words.every((word) => text.includes(word));
    });
    this.items.forEach((item, i) => {
      item.hidden = !matches[i];
    });
    const found = matches.filter(Boolean).length;
    this.empty.hidden = found > 0;
    this.count.textContent = words.length ? `${found} of ${matches.length}` : `${matches.length}`;
  }

  /** @param {KeyboardEvent} event */
  searchKey(event) {
    const first = this.items.find((item) => !item.hidden);
    if (event.key === 'Escape') {
      this.search.value = '';
      this.filter();
      this.search.blur();
    } else if (event.key === 'Enter' && first) {
      this.app.set({ selected: Number(first.dataset.node) });
    } else if (event.key === 'ArrowDown' && first) {
      first.querySelector('button')?.focus();
    } else {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
  }

  /** @param {KeyboardEvent} event */
  moveFocus(event) {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step || !(event.target instanceof Element)) return;
    const visible = this.items.filter((item) => !item.hidden);
    const at = visible.findIndex((item) => item.contains(document.activeElement));
    const next = visible[at + step];
    if (next) next.querySelector('button')?.focus();
    else if (step < 0) this.search.focus();
    event.preventDefault();
    event.stopPropagation();
  }
}

/** The details of the selected object. */
export class Details {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.body = byId('details-body', HTMLElement);
    this.actions = byId('object-actions', HTMLElement);
    this.position = make('dd', 'mono');
    this.position.id = 'position';
    this.turn = make('dd', 'mono');
    this.turn.id = 'turn';
    this.now = make('dd', '');
    byId('csv', HTMLButtonElement).addEventListener('click', () => this.save());
    app.listen((changed) => {
      if (changed.has('selected') || changed.has('scene')) this.show();
      else if (changed.has('code') || changed.has('compare') || changed.has('camera')) this.showPose();
    });
    this.show();
  }

  show() {
    const { scene, state } = this.app;
    const node = scene.nodes[state.selected];
    this.actions.hidden = !node;
    this.body.replaceChildren(node ? this.makeNode(node) : this.makeScene());
    this.showPose();
  }

  /** @returns {HTMLElement} */
  makeScene() {
    const { scene } = this.app;
    const { timeline, nodes } = scene;
    const splats = nodes.reduce((sum, node) => sum + node.splats.count, 0);
    /** @type {[string, string][]} */
    const rows = [
      ['Objects', formatCount(nodes.filter((node) => node.kind === 'instance').length)],
      [nodes.every((node) => node.kind === 'points') ? 'Points' : 'Splats', formatCount(splats)],
      [
        'Times',
        timeline.samples.length > 1
          ? `${formatCount(timeline.samples.length)} samples, ${formatNumber(timeline.per_second)} per second`
          : 'one',
      ],
      ['Cameras', formatCount(scene.cameras.length)],
      ['Images', formatCount(scene.views.length)],
      ['Unit', scene.meters_per_unit ? `${formatNumber(scene.meters_per_unit)} m` : 'not known'],
    ];
    const list = make(
      'dl',
      '',
      '',
      rows.flatMap(([name, text]) => [make('dt', '', name), make('dd', '', text)]),
    );
    return make('div', 'details', '', [
      list,
      make('p', 'empty', 'Select an object in the list or in the picture.'),
    ]);
  }

  /**
   * @param {SceneNode} node
   * @returns {HTMLElement}
   */
  makeNode(node) {
    const { scene } = this.app;
    const size = addScaled(node.extent[1], node.extent[0], -1);
    const path = make('span', 'mono', node.path);
    const copy = make('button', 'copy', 'Copy');
    copy.type = 'button';
    copy.id = 'path-copy';
    copy.setAttribute('aria-label', 'Copy the prim path');
    copy.addEventListener('click', async () => {
      this.app.say((await copyText(node.path)) ? 'Path copied.' : 'The browser did not allow to copy.');
    });
    /** @type {[string, string | HTMLElement][]} */
    const rows = [
      ['Class', node.category || 'none'],
      ['Id', node.id === null ? 'none' : String(node.id)],
      ['Prim path', make('dd', '', '', [path, copy])],
      ['Motion', node.motion],
      ['Rotation', node.rotation ?? 'not known'],
      [node.kind === 'points' ? 'Points' : 'Splats', formatCount(node.splats.count)],
      ['Size', formatLengths(size, scene.meters_per_unit)],
      ['Position', this.position],
      ['Quaternion', this.turn],
      ['Now', this.now],
    ];
    const list = make(
      'dl',
      '',
      '',
      rows.flatMap(([name, value]) => [
        make('dt', '', name),
        typeof value === 'string' ? make('dd', '', value) : value,
      ]),
    );
    const title = make('div', 'name', '', [makeSwatch(node), make('span', '', labelOf(node))]);
    const made = make('div', 'details', '', [title, list]);
    if (node.parts.length) made.append(this.makeParts(node));
    return made;
  }

  /**
   * @param {SceneNode} node
   * @returns {HTMLElement}
   */
  makeParts(node) {
    const head = make(
      'tr',
      '',
      '',
      ['Part', 'Joint', 'Range'].map((name) => make('th', '', name)),
    );
    const rows = node.parts.map((part) =>
      make('tr', '', '', [
        make('td', '', part.name),
        make('td', '', part.joint ? `${part.joint.kind} on ${part.joint.base}` : 'none'),
        make('td', '', part.joint ? formatRange(part.joint, this.app.scene.meters_per_unit) : ''),
      ]),
    );
    return make('section', '', '', [make('h3', '', 'Parts'), make('table', '', '', [head, ...rows])]);
  }

  showPose() {
    const { engine, state } = this.app;
    if (state.selected < 0) return;
    const code = this.app.code();
    const pose = Array.from(engine.pose(state.selected, code));
    const write = (/** @type {number[]} */ values) => values.map((value) => value.toFixed(3)).join(' ');
    this.position.textContent = write(pose.slice(0, 3));
    this.turn.textContent = write(pose.slice(3));
    this.now.textContent = engine.isVisible(state.selected, code) ? 'visible' : 'not visible';
  }

  save() {
    const { scene, state } = this.app;
    const node = scene.nodes[state.selected];
    if (node) saveFile(`${node.name}_poses.csv`, posesAsCsv(this.app, state.selected), 'text/csv');
  }
}

/**
 * @param {App} app
 * @param {number} index
 */
function toggleHidden(app, index) {
  const shown = shownNodes(app.state);
  shown[index] = !shown[index];
  app.set({ hidden: shown.map((value) => !value), isolated: -1 });
}

/**
 * Selects what is seen at a place of the picture.
 * @param {App} app
 * @param {number} x CSS pixels.
 * @param {number} y CSS pixels.
 */
export function selectAt(app, x, y) {
  const { node } = app.pick(x, y);
  app.set({ selected: app.scene.nodes[node]?.kind === 'background' ? -1 : node });
}

/**
 * Moves the free camera with the selected object.
 * @param {App} app
 */
export function followObject(app) {
  let node = -1;
  let last = [0, 0, 0];
  app.listen(() => {
    const { state, scene } = app;
    const next = state.follow && state.camera < 0 ? state.selected : -1;
    if (next >= 0) {
      const { extent } = scene.nodes[next];
      const middle = addScaled(extent[0], addScaled(extent[1], extent[0], -1), 0.5);
      const place = transformPoint(app.engine.pose(next, state.code), middle);
      if (next === node)
        app.viewCamera.target = addScaled(app.viewCamera.target, addScaled(place, last, -1), 1);
      last = place;
    }
    node = next;
  });
}

/**
 * @param {App} app
 * @returns {Command[]}
 */
export function objectCommands(app) {
  const { state } = app;
  const group = 'Objects';
  const chosen = () => state.selected >= 0;
  const all = () => app.set({ hidden: state.hidden.map(() => false), isolated: -1 });
  const isolate = () => app.set({ isolated: state.isolated === state.selected ? -1 : state.selected });
  const leave = () => {
    if (state.camera >= 0) app.set({ camera: -1, compare: 'render', mask: false });
    else app.set({ selected: -1, follow: false });
  };
  const follow = () => {
    app.leaveCamera();
    app.set({ follow: !state.follow });
  };
  return [
    {
      id: 'search',
      group,
      name: 'Find an object',
      key: '/',
      run: () => byId('search', HTMLInputElement).focus(),
    },
    {
      id: 'hide',
      group,
      name: 'Hide the selected object',
      key: 'h',
      enabled: chosen,
      run: () => toggleHidden(app, state.selected),
      on: () => chosen() && !shownNodes(state)[state.selected],
    },
    {
      id: 'show-all',
      group,
      name: 'Show all objects',
      key: 'Shift+h',
      run: all,
      enabled: () => state.isolated >= 0 || state.hidden.includes(true),
    },
    {
      id: 'isolate',
      group,
      name: 'Show only the selected object',
      key: 'i',
      enabled: chosen,
      run: isolate,
      on: () => chosen() && state.isolated === state.selected,
    },
    {
      id: 'follow',
      group,
      name: 'Camera moves with the selected object',
      key: 'g',
      enabled: chosen,
      run: follow,
      on: () => chosen() && state.follow,
    },
    { id: 'leave', group, name: 'Leave the recorded camera, or select nothing', key: 'Escape', run: leave },
  ];
}
