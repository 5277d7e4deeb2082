// Puts the page together.

import { Engine } from './engine.js';
import { byId, loadScene, LOW_PASS, make, PageError, showFailure } from './page.js';
import { cameraAt, freeFocal, isCapture, resetCamera, resizeCamera, ViewCamera } from './view_camera.js';
import { cameraCommands, CameraControls } from './view_camera.js';
import { Player, playerCommands } from './player.js';
import { Details, formatCount, objectCommands, ObjectList } from './objects.js';
import { followObject, selectAt, shownNodes } from './objects.js';
import { compareCommands, Comparison, ViewIndex } from './compare.js';
import { Overlay, overlayCommands } from './overlay.js';
import { editCommands, Edits } from './edits.js';
import { LiveRun } from './live.js';

/** @typedef {import('./types.js').Camera} Camera */
/** @typedef {import('./types.js').Picked} Picked */
/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').State} State */
/** @typedef {import('./page.js').Command} Command */
/** @typedef {import('./page.js').SceneDocument} SceneDocument */

const LARGEST_RATIO = 2;
const TINT = 0.55;
const LONGEST_STEP = 0.1;
const NOTE_TIME = 2500;
const STATISTICS_INTERVAL = 250;
const LOOK_KEYS = ['mode', 'tint', 'hidden', 'isolated', 'selected', 'compare'];

/**
 * @param {SceneDocument} scene
 * @returns {State}
 */
function initialState(scene) {
  return {
    code: scene.timeline.samples[0] ?? scene.timeline.start,
    playing: false,
    speed: 1,
    loop: true,
    selected: -1,
    hidden: scene.nodes.map(() => false),
    isolated: -1,
    follow: false,
    mode: 'color',
    tint: false,
    box: true,
    path: true,
    axes: false,
    joints: true,
    cameras: isCapture(scene),
    grid: false,
    camera: -1,
    followTime: true,
    cameraCode: scene.timeline.start,
    compare: 'render',
    split: 0.5,
    gain: 1,
    brush: false,
    mask: false,
    maskOpacity: 0.6,
  };
}

/**
 * A page that shows a scene.
 * @implements {App}
 */
class ScenePage {
  /**
   * @param {SceneDocument} scene
   * @param {ArrayBuffer} bytes
   */
  constructor(scene, bytes) {
    this.scene = scene;
    this.state = initialState(scene);
    this.engine = new Engine(byId('canvas', HTMLCanvasElement), scene, bytes);
    this.viewCamera = new ViewCamera(scene.up, freeFocal(scene), 2 * this.engine.near());
    this.views = new ViewIndex(scene);
    this.stage = byId('stage', HTMLElement);
    this.picture = byId('picture', HTMLElement);
    this.note = byId('note', HTMLElement);
    /** @type {((changed: Set<string>) => void)[]} */
    this.listeners = [];
    /** @type {Command[]} */
    this.commands = [];
    /** @type {Edits | null} */
    this.edits = null;
    /** @type {(number | null)[]} */
    this.ratios = [];
    this.dirty = true;
    this.noteTimer = 0;
    this.lastTime = 0;
    this.statisticsTime = 0;
    byId('title', HTMLElement).textContent = scene.title;
    byId('title', HTMLElement).title = scene.title;
  }

  /** Sets up what depends on the size of the page, which must be shown. */
  start() {
    this.applyLook();
    resetCamera(this);
    this.overlay = new Overlay(this);
    this.player = new Player(this);
    this.controls = new CameraControls(this, this.picture, (x, y) => this.choose(x, y));
    followObject(this);
    new ObjectList(this);
    new Details(this);
    this.comparison = new Comparison(this, this.views);
    this.edits = this.scene.stage ? new Edits(this, this.scene.stage) : null;
    if (this.scene.live) new LiveRun(this);
    this.commands = [
      ...playerCommands(this, this.player),
      ...cameraCommands(this),
      ...objectCommands(this),
      ...this.lookCommands(),
      ...(this.edits ? editCommands(this) : []),
      ...compareCommands(this, this.comparison),
      ...overlayCommands(this),
      ...this.pageCommands(),
    ];
    this.connect();
    this.showCommands();
    requestAnimationFrame((time) => this.frame(time));
  }

  connect() {
    for (const command of this.commands) connectButtons(command);
    fillHelp(this.commands);
    setUpPanels(() => this.redraw());
    this.listen((changed) => {
      if (LOOK_KEYS.some((key) => changed.has(key))) this.applyLook();
      this.showCommands();
      this.redraw();
    });
    new ResizeObserver(() => this.redraw()).observe(this.stage);
    window.addEventListener('resize', () => this.redraw());
    document.addEventListener('keydown', (event) => this.keyDown(event));
    document.addEventListener('keyup', (event) => this.controls?.keyUp(event));
    releaseFocusAfterPointer();
  }

  /** @param {Partial<State>} patch */
  set(patch) {
    const before = { ...this.state };
    Object.assign(this.state, patch);
    const keys = /** @type {(keyof State)[]} */ (Object.keys(patch));
    const changed = new Set(keys.filter((key) => before[key] !== this.state[key]).map(String));
    if (changed.size) for (const listener of this.listeners) listener(changed);
  }

  /**
   * Calls the listeners for a change that the state does not hold.
   * @param {string} key
   */
  notify(key) {
    for (const listener of this.listeners) listener(new Set([key]));
  }

  /**
   * Shows the same objects and cameras with other splats.
   * @param {SceneDocument} scene
   * @param {ArrayBuffer} bytes
   */
  replace(scene, bytes) {
    this.scene = scene;
    this.engine.replace(scene, bytes);
    this.applyLook();
    this.notify('scene');
  }

  /** @param {(changed: Set<string>) => void} listener */
  listen(listener) {
    this.listeners.push(listener);
  }

  redraw() {
    this.dirty = true;
  }

  /** @returns {number} */
  code() {
    return this.views.shown(this.state)?.code ?? this.state.code;
  }

  /** @returns {Camera | null} The recorded camera, at the size of its images. */
  recorded() {
    const { state, scene } = this;
    if (state.camera < 0) return null;
    const code = state.followTime ? state.code : state.cameraCode;
    return this.views.shown(state) ?? cameraAt(scene.cameras[state.camera].samples, code);
  }

  /**
   * Place of the picture, CSS pixels.
   * @returns {{ left: number, top: number, width: number, height: number }}
   */
  area() {
    const { clientWidth: width, clientHeight: height } = this.stage;
    const recorded = this.recorded();
    if (!recorded) return { left: 0, top: 0, width, height };
    const scale = Math.min(width / recorded.size[0], height / recorded.size[1]);
    const fitted = [recorded.size[0] * scale, recorded.size[1] * scale];
    return {
      left: (width - fitted[0]) / 2,
      top: (height - fitted[1]) / 2,
      width: fitted[0],
      height: fitted[1],
    };
  }

  /** @returns {number} Device pixels per CSS pixel. */
  ratio() {
    return Math.min(window.devicePixelRatio, LARGEST_RATIO);
  }

  /** @returns {Camera} */
  shot() {
    const { width, height } = this.area();
    const size = [width, height].map((length) => Math.max(1, Math.round(length * this.ratio())));
    const recorded = this.recorded();
    return recorded ? resizeCamera(recorded, size[0], size[1]) : this.viewCamera.shot(size[0], size[1]);
  }

  /** @returns {number} */
  lowPass() {
    const captured = this.recorded() ?? this.scene.cameras[0]?.samples[0];
    return captured ? LOW_PASS * (this.shot().focal[1] / captured.focal[1]) ** 2 : LOW_PASS;
  }

  applyLook() {
    const { mode, tint, compare } = this.state;
    const selected = compare === 'render' ? this.state.selected : -1;
    this.engine.setLook({ mode, tint: tint ? TINT : 0, visible: shownNodes(this.state), selected });
  }

  leaveCamera() {
    if (this.state.camera < 0) return;
    this.viewCamera.look(this.shot().pose, this.viewCamera.distance);
    this.set({ camera: -1, compare: 'render', mask: false });
  }

  /**
   * Erases splats of the selected object, or brings them back.
   * @param {number} x CSS pixels.
   * @param {number} y CSS pixels.
   * @param {boolean} isUndone
   */
  brushAt(x, y, isUndone) {
    this.edits?.brushAt(x, y, isUndone);
  }

  /** @param {string} text */
  say(text) {
    this.note.textContent = text;
    clearTimeout(this.noteTimer);
    this.noteTimer = window.setTimeout(() => {
      this.note.textContent = '';
    }, NOTE_TIME);
  }

  /**
   * Looks through the camera that is drawn at a place of the picture, else selects what is there.
   * @param {number} x CSS pixels.
   * @param {number} y CSS pixels.
   */
  choose(x, y) {
    const scale = this.pixelScale();
    const camera = this.overlay?.cameraAtPixel(x * scale, y * scale) ?? -1;
    if (camera >= 0) this.comparison?.lookThrough(camera);
    else selectAt(this, x, y);
  }

  /** @returns {number} Pixels of the drawing per CSS pixel of the picture. */
  pixelScale() {
    return this.shot().size[0] / this.picture.clientWidth;
  }

  /**
   * What is seen at a place of the picture.
   * @param {number} x CSS pixels.
   * @param {number} y CSS pixels.
   * @returns {Picked}
   */
  pick(x, y) {
    const scale = this.pixelScale();
    this.engine.setTime(this.code());
    return this.engine.pick(this.shot(), this.lowPass(), x * scale, y * scale);
  }

  /** @param {number} time Milliseconds. */
  frame(time) {
    requestAnimationFrame((next) => this.frame(next));
    const seconds = this.lastTime ? (time - this.lastTime) / 1000 : 0;
    this.lastTime = time;
    this.player?.advance(seconds);
    this.controls?.fly(Math.min(seconds, LONGEST_STEP));
    if (this.dirty) this.draw(time);
  }

  /** @param {number} time Milliseconds. */
  draw(time) {
    this.dirty = false;
    const { left, top, width, height } = this.area();
    if (!width || !height) return;
    Object.assign(this.picture.style, {
      left: `${left}px`,
      top: `${top}px`,
      width: `${width}px`,
      height: `${height}px`,
    });
    const shot = this.shot();
    this.engine.setTime(this.code());
    this.engine.draw(shot, this.lowPass());
    this.overlay?.draw(shot, this.code(), this.ratio());
    this.showStatistics(time);
  }

  /** @param {number} time Milliseconds. */
  showStatistics(time) {
    if (this.state.playing && time - this.statisticsTime < STATISTICS_INTERVAL) return;
    this.statisticsTime = time;
    const { splats, drawn, sortMs } = this.engine.statistics();
    const kind = isCapture(this.scene) ? 'points' : 'splats';
    const text = `${formatCount(drawn)} of ${formatCount(splats)} ${kind}, sorted in ${sortMs.toFixed(1)} ms`;
    byId('statistics', HTMLElement).textContent = text;
  }

  showCommands() {
    for (const command of this.commands) showCommand(command);
    byId('play', HTMLButtonElement).setAttribute('aria-label', this.state.playing ? 'Pause' : 'Play');
  }

  /** @returns {Command[]} */
  lookCommands() {
    const group = 'Picture';
    /** @type {(mode: State['mode'], key: string, name: string) => Command} */
    const mode = (id, key, name) => ({
      id: `mode-${id}`,
      group,
      name,
      key,
      run: () => this.set({ mode: id }),
      on: () => this.state.mode === id,
    });
    return [
      mode('color', '1', 'Colour'),
      mode('instances', '2', 'Instances'),
      mode('depth', '3', 'Depth'),
      {
        id: 'tint',
        group,
        name: 'Tint by instance',
        key: 't',
        run: () => this.set({ tint: !this.state.tint }),
        on: () => this.state.tint,
      },
    ];
  }

  /** @returns {Command[]} */
  pageCommands() {
    return [
      { id: 'theme', group: 'Page', name: 'Dark or light', run: () => this.switchTheme() },
      {
        id: 'help',
        group: 'Page',
        name: 'Keys and mouse',
        key: '?',
        run: () => byId('help-dialog', HTMLDialogElement).showModal(),
      },
    ];
  }

  switchTheme() {
    const root = document.documentElement;
    const dark = root.dataset.theme
      ? root.dataset.theme === 'dark'
      : matchMedia('(prefers-color-scheme: dark)').matches;
    root.dataset.theme = dark ? 'light' : 'dark';
    this.player?.drawTicks();
  }

  /** @param {KeyboardEvent} event */
  keyDown(event) {
    const graph = event.getModifierState('AltGraph');
    if (event.defaultPrevented || event.metaKey || ((event.ctrlKey || event.altKey) && !graph)) return;
    if (byId('help-dialog', HTMLDialogElement).open || takesKey(event.target, event.key)) return;
    if (this.controls?.keyDown(event)) return;
    const name = keyName(event);
    const command = this.commands.find(({ key }) => key === name);
    if (!command) return;
    event.preventDefault();
    if (command.enabled?.() ?? true) command.run();
  }
}

/**
 * The name of a key as commands have it.
 * @param {KeyboardEvent} event
 * @returns {string}
 */
function keyName(event) {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  return event.shiftKey && /^([a-z]|.{2,})$/.test(key) ? `Shift+${key}` : key;
}

/**
 * Whether an element takes text.
 * @param {EventTarget | null} target
 * @returns {boolean}
 */
function isText(target) {
  return target instanceof HTMLInputElement && /^(search|text|number)$/.test(target.type);
}

/**
 * Whether an element has its own use for a key.
 * @param {EventTarget | null} target
 * @param {string} key
 * @returns {boolean}
 */
function takesKey(target, key) {
  if (isText(target)) return true;
  if (target instanceof HTMLSelectElement) return key !== 'Escape';
  if (target instanceof HTMLInputElement && target.type === 'range') {
    return target.id !== 'scrub' && /^(Arrow|Home|End|Page)/.test(key);
  }
  const pressed = target instanceof HTMLButtonElement || target instanceof HTMLInputElement;
  return pressed && (key === ' ' || key === 'Enter');
}

/** Gives keys back to the page after a control was used with a pointer. */
function releaseFocusAfterPointer() {
  let pointer = false;
  const release = (/** @type {Event} */ event) => {
    const control = event.target instanceof Element ? event.target.closest('button, select, input') : null;
    if (pointer && !isText(control) && control instanceof HTMLElement) control.blur();
  };
  document.addEventListener(
    'pointerdown',
    () => {
      pointer = true;
    },
    true,
  );
  document.addEventListener(
    'keydown',
    () => {
      pointer = false;
    },
    true,
  );
  document.addEventListener('change', release);
  document.addEventListener('click', (event) => {
    if (!(event.target instanceof HTMLSelectElement)) release(event);
  });
}

/**
 * How a key is written for the user.
 * @param {string} key
 * @returns {string}
 */
function keyLabel(key) {
  /** @type {Record<string, string>} */
  const names = { ' ': 'Space', ArrowLeft: 'Left', ArrowRight: 'Right', Escape: 'Esc' };
  const label = (/** @type {string} */ part) =>
    names[part] ?? (part.length === 1 ? part.toUpperCase() : part);
  return key.split('+').map(label).join(' + ');
}

/** @param {Command} command */
function connectButtons(command) {
  const title = command.key ? `${command.name} (${keyLabel(command.key)})` : command.name;
  for (const button of commandButtons(command)) {
    button.title = title;
    button.addEventListener('click', () => command.run());
  }
}

/**
 * @param {Command} command
 * @returns {HTMLButtonElement[]}
 */
function commandButtons(command) {
  return [...document.querySelectorAll('button')].filter((button) => button.dataset.command === command.id);
}

/** @param {Command} command */
function showCommand(command) {
  for (const button of commandButtons(command)) {
    if (command.on) button.setAttribute('aria-pressed', String(command.on()));
    if (command.enabled) button.disabled = !command.enabled();
  }
}

/** @param {Command[]} commands */
function fillHelp(commands) {
  const mouse = [
    ['Drag', 'Orbit'],
    ['Right, middle or Shift + drag', 'Pan'],
    ['Wheel or pinch', 'Zoom'],
    ['Click', 'Select, or look through a camera'],
    ['Double click', 'Orbit around this point'],
    ['W A S D Q E', 'Fly, faster with Shift'],
    ['Arrows, + and -', 'Orbit and zoom while the picture has the focus'],
  ];
  const body = byId('help-body', HTMLElement);
  body.append(helpSection('Mouse, touch and flying', mouse));
  for (const group of new Set(commands.filter(({ key }) => key).map((command) => command.group))) {
    /** @type {Map<string, string[]>} */
    const keys = new Map();
    for (const { name, key, group: own } of commands) {
      if (key && own === group) keys.set(name, [...(keys.get(name) ?? []), keyLabel(key)]);
    }
    body.append(
      helpSection(
        group,
        [...keys].map(([name, list]) => [list.join(' or '), name]),
      ),
    );
  }
  const dialog = byId('help-dialog', HTMLDialogElement);
  byId('help-close', HTMLButtonElement).addEventListener('click', () => dialog.close());
  dialog.addEventListener('click', (event) => {
    if (event.target === dialog) dialog.close();
  });
}

/**
 * @param {string} title
 * @param {string[][]} rows Keys and what they do.
 * @returns {HTMLElement}
 */
function helpSection(title, rows) {
  const lines = rows.map(([keys, name]) =>
    make('div', '', '', [make('span', '', name), make('kbd', '', keys)]),
  );
  return make('section', '', '', [make('h3', '', title), ...lines]);
}

/**
 * Panels of a small page, of which at most one is open.
 * @param {() => void} redraw
 */
function setUpPanels(redraw) {
  const narrow = matchMedia('(max-width: 700px)');
  const tabs = [...document.querySelectorAll('button')].filter((button) => button.dataset.panel);
  const show = (/** @type {string} */ open) => {
    for (const tab of tabs) {
      const panel = byId(tab.dataset.panel ?? '', HTMLElement);
      panel.dataset.open = String(panel.id === open);
      tab.setAttribute('aria-expanded', panel.dataset.open);
      tab.hidden = panel.hidden;
    }
    redraw();
  };
  for (const tab of tabs) {
    const { panel = '' } = tab.dataset;
    tab.addEventListener('click', () => {
      show(narrow.matches && tab.getAttribute('aria-expanded') === 'true' ? '' : panel);
    });
  }
  const start = () => show(narrow.matches ? '' : 'objects');
  narrow.addEventListener('change', start);
  start();
}

async function openPage() {
  try {
    const { scene, bytes } = await loadScene();
    const page = new ScenePage(scene, bytes);
    byId('app', HTMLElement).hidden = false;
    byId('message', HTMLElement).hidden = true;
    page.start();
    const { engine, state } = page;
    Object.assign(window, { cif: { engine, state, shot: () => page.shot(), ready: true } });
    document.documentElement.dataset.state = 'ready';
  } catch (error) {
    const text = error instanceof Error ? error.message : String(error);
    if (!(error instanceof PageError)) console.warn(error);
    showFailure('The scene cannot be shown', text);
  }
}

openPage();
