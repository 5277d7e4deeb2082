// Small edits of objects, saved as a layer over the stage that holds them.

import { BRUSH_RADIUS, byId } from './page.js';
import { saveFile } from './objects.js';

/** @typedef {import('./types.js').Node} SceneNode */
/** @typedef {import('./page.js').App} App */

/**
 * What was changed of an object.
 * @typedef {object} Edit
 * @property {string} label
 * @property {number[]} move World units.
 * @property {boolean} hidden Invisible in the stage.
 * @property {boolean} removed
 * @property {Set<number>} erased Places of splats.
 */

/**
 * An object that was changed.
 * @typedef {object} EditedNode
 * @property {SceneNode} node
 * @property {Edit} edit
 * @property {boolean} isRenamed
 * @property {{ code: number, values: Float32Array }[]} opacities By sample; empty where none changed.
 */

/**
 * Prims of a layer, by name.
 * @typedef {object} Over
 * @property {Map<string, Over>} children
 * @property {string[]} metadata
 * @property {string[]} attributes
 */

/** The edits of all objects, and the form of the selected one. */
export class Edits {
  /**
   * @param {App} app
   * @param {string} stage File name of the stage.
   */
  constructor(app, stage) {
    this.app = app;
    this.stage = stage;
    this.form = byId('edits', HTMLFormElement);
    this.label = byId('edit-label', HTMLInputElement);
    this.move = ['edit-x', 'edit-y', 'edit-z'].map((id) => byId(id, HTMLInputElement));
    this.hidden = byId('edit-hidden', HTMLInputElement);
    this.removed = byId('edit-removed', HTMLInputElement);
    /** As the scene had them. */
    this.original = app.scene.nodes.map((node) => ({
      label: node.label,
      poses: node.track.poses.map((pose) => [...pose]),
    }));
    /** @type {Map<number, Edit>} */
    this.edits = new Map();
    this.form.addEventListener('submit', (event) => event.preventDefault());
    this.form.addEventListener('change', () => this.take());
    byId('edit-undo', HTMLButtonElement).addEventListener('click', () => this.undo());
    byId('edits-save', HTMLButtonElement).addEventListener('click', () => this.save());
    app.listen((changed) => {
      if (changed.has('selected')) this.show();
    });
    this.show();
  }

  /**
   * @param {number} node
   * @returns {Edit}
   */
  of(node) {
    return this.edits.get(node) ?? this.none(node);
  }

  /**
   * @param {number} node
   * @returns {Edit}
   */
  none(node) {
    const { label } = this.original[node];
    return { label, move: [0, 0, 0], hidden: false, removed: false, erased: new Set() };
  }

  /**
   * Erases splats of the selected object, or brings them back.
   * @param {number} x CSS pixels of the picture.
   * @param {number} y
   * @param {boolean} isUndone
   */
  brushAt(x, y, isUndone) {
    const { app } = this;
    const node = app.state.selected;
    if (this.form.hidden || app.scene.nodes[node].parts.length) return;
    const shot = app.shot();
    const scale = shot.size[0] / byId('picture', HTMLElement).clientWidth;
    const near = app.engine.splatsNear(shot, node, [x * scale, y * scale], BRUSH_RADIUS * scale);
    const edit = this.of(node);
    const erased = new Set(edit.erased);
    for (const splat of near) {
      if (isUndone) erased.delete(splat);
      else erased.add(splat);
    }
    if (erased.size !== edit.erased.size) this.set(node, { ...edit, erased });
  }

  /** Shows the edit of the selected object, which only objects have. */
  show() {
    const { scene, state } = this.app;
    this.form.hidden = scene.nodes[state.selected]?.kind !== 'instance';
    byId('edits-saving', HTMLElement).hidden = this.edits.size === 0;
    const objects = this.edits.size === 1 ? '1 object' : `${this.edits.size} objects`;
    byId('edits-count', HTMLElement).textContent = `${objects} changed`;
    if (this.form.hidden) return;
    const edit = this.of(state.selected);
    this.label.value = edit.label;
    this.move.forEach((input, axis) => {
      input.value = String(edit.move[axis]);
    });
    this.hidden.checked = edit.hidden;
    this.removed.checked = edit.removed;
    const erased = edit.erased.size ? `${edit.erased.size} splats erased` : '';
    byId('edit-erased', HTMLElement).textContent = erased;
  }

  /** Takes what the form says of the selected object. */
  take() {
    const node = this.app.state.selected;
    const move = this.move.map((input) => (Number.isFinite(input.valueAsNumber) ? input.valueAsNumber : 0));
    const label = this.label.value.trim() || this.original[node].label;
    const { erased } = this.of(node);
    this.set(node, { label, move, hidden: this.hidden.checked, removed: this.removed.checked, erased });
  }

  undo() {
    const node = this.app.state.selected;
    this.set(node, this.none(node));
  }

  /**
   * @param {number} node
   * @param {Edit} edit
   */
  set(node, edit) {
    const { app } = this;
    const { label, poses } = this.original[node];
    const before = this.of(node);
    const wasHidden = before.hidden || before.removed;
    const moved = edit.move.some((distance) => distance !== 0);
    const isChanged = moved || edit.hidden || edit.removed || edit.label !== label || edit.erased.size > 0;
    if (isChanged) this.edits.set(node, edit);
    else this.edits.delete(node);
    const shown = app.scene.nodes[node];
    shown.label = edit.label;
    shown.track.poses = poses.map((pose) => pose.map((value, k) => (k < 3 ? value + edit.move[k] : value)));
    app.engine.refresh();
    app.engine.erase(node, edit.erased);
    // What is hidden for looking alone stays so.
    const isHidden = edit.hidden || edit.removed;
    if (isHidden !== wasHidden) {
      app.set({ hidden: app.state.hidden.map((hidden, i) => (i === node ? isHidden : hidden)) });
    }
    app.notify('scene');
    this.show();
  }

  save() {
    const nodes = [...this.edits].map(([node, edit]) => ({
      node: this.app.scene.nodes[node],
      edit,
      isRenamed: edit.label !== this.original[node].label,
      opacities: edit.erased.size ? opacitiesOf(this.app.engine, node) : [],
    }));
    const base = this.stage.replace(/\.[^.]*$/, '');
    saveFile(`${base}_edits.usda`, layerOf(this.stage, nodes), 'text/plain');
    const line = `cif import ${base}_edits.usda --base ${base}.cif -o ${base}_edited.cif`;
    this.app.say(`Put it beside ${this.stage}, then: ${line}`);
  }
}

/**
 * @param {App} app
 * @returns {import('./page.js').Command[]}
 */
export function editCommands(app) {
  const isBrushed = () => {
    const node = app.scene.nodes[app.state.selected];
    return node?.kind === 'instance' && !node.parts.length;
  };
  return [
    {
      id: 'brush',
      group: 'Edits',
      name: 'Erase splats of the selected object by dragging, with Shift bring them back',
      key: 'u',
      run: () => app.set({ brush: !app.state.brush }),
      on: () => app.state.brush,
      enabled: () => app.state.brush || isBrushed(),
    },
  ];
}

/**
 * A layer over a stage, USD text.
 * @param {string} stage
 * @param {EditedNode[]} nodes
 * @returns {string}
 */
export function layerOf(stage, nodes) {
  const root = emptyOver();
  for (const edited of nodes) {
    const { node } = edited;
    let over = root;
    for (const name of node.path.split('/').filter(Boolean)) {
      const child = over.children.get(name) ?? emptyOver();
      over.children.set(name, child);
      over = child;
    }
    fill(over, edited);
  }
  const first = [...root.children.keys()][0] ?? 'World';
  // Three of them hold a name with an @ inside.
  const at = stage.includes('@') ? '@@@' : '@';
  const facts = [`    defaultPrim = ${quoted(first)}`, `    subLayers = [${at}./${stage}${at}]`];
  const prims = [...root.children].flatMap(([name, over]) => overLines(name, over, ''));
  return ['#usda 1.0', '(', ...facts, ')', '', ...prims, ''].join('\n');
}

/**
 * Opacities of the splats of a node at each of their samples, with 0 for those that were erased.
 * @param {App['engine']} engine
 * @param {number} node
 * @returns {{ code: number, values: Float32Array }[]}
 */
function opacitiesOf(engine, node) {
  const samples = engine.opacities(node);
  const erased = engine.placement.erased.get(node) ?? [];
  for (const { values } of samples) for (const splat of erased) values[splat] = 0;
  return samples;
}

/**
 * Lines of a variant that holds opacities: other levels of detail have other splats.
 * @param {SceneNode} node
 * @param {{ code: number, values: Float32Array }[]} opacities
 * @returns {string[]}
 */
function opacityLines(node, opacities) {
  const list = (/** @type {Float32Array} */ values) =>
    `[${Array.from(values, (value) => Number(value.toPrecision(9))).join(', ')}]`;
  const attribute =
    opacities.length === 1
      ? [`float[] opacities = ${list(opacities[0].values)}`]
      : [
          'float[] opacities.timeSamples = {',
          ...opacities.map(({ code, values }) => `    ${code}: ${list(values)},`),
          '}',
        ];
  return [
    'variantSet "lod" = {',
    '    "full" {',
    `        over ${quoted(`${node.name}_splats`)}`,
    '        {',
    ...attribute.map((line) => `            ${line}`),
    '        }',
    '    }',
    '}',
  ];
}

/** @returns {Over} */
function emptyOver() {
  return { children: new Map(), metadata: [], attributes: [] };
}

/**
 * @param {Over} over
 * @param {EditedNode} edited
 */
function fill(over, { node, edit, isRenamed, opacities }) {
  if (edit.removed) {
    over.metadata.push('active = false');
    return;
  }
  if (isRenamed) {
    const label = quoted(edit.label);
    const labels = [...new Set([node.category, edit.label])].filter(Boolean).map(quoted);
    over.metadata.push(`displayName = ${label}`);
    over.attributes.push(
      `uniform string cif:label = ${label}`,
      `token[] semantics:labels:class = [${labels.join(', ')}]`,
      `custom string userProperties:label = ${label}`,
    );
  }
  if (opacities.length) {
    over.metadata.push('variants = {', '    string lod = "full"', '}', 'prepend variantSets = ["lod"]');
    over.attributes.push(...opacityLines(node, opacities));
  }
  if (edit.hidden) over.attributes.push('token visibility = "invisible"');
  if (edit.move.some((distance) => distance !== 0)) {
    const operations = ['xformOp:translate:edit', 'xformOp:translate', 'xformOp:orient'].map(quoted);
    over.attributes.push(
      `double3 xformOp:translate:edit = (${edit.move.join(', ')})`,
      `uniform token[] xformOpOrder = [${operations.join(', ')}]`,
    );
  }
}

/**
 * @param {string} name
 * @param {Over} over
 * @param {string} indent
 * @returns {string[]}
 */
function overLines(name, over, indent) {
  const inner = `${indent}    `;
  const head = over.metadata.length
    ? [`${indent}over ${quoted(name)} (`, ...over.metadata.map((line) => inner + line), `${indent})`]
    : [`${indent}over ${quoted(name)}`];
  const children = [...over.children].flatMap(([child, below]) => overLines(child, below, inner));
  return [...head, `${indent}{`, ...over.attributes.map((line) => inner + line), ...children, `${indent}}`];
}

/**
 * A string of USD text, without control characters.
 * @param {string} text
 * @returns {string}
 */
function quoted(text) {
  const plain = [...text].filter((letter) => letter >= ' ').join('');
  return `"${plain.replaceAll('\\', '\\\\').replaceAll('"', '\\"')}"`;
}
