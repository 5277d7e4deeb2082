// A run that goes on: how far it is, the curve of its quality, and its scene as it learns.

import { byId, context2d, loadScene, make, request } from './page.js';
import { formatCount } from './objects.js';

/** @typedef {import('./page.js').App} App */
/** @typedef {import('./page.js').SceneDocument} SceneDocument */

/**
 * Status of a run, as the server has it.
 * @typedef {object} RunStatus
 * @property {number} revision Counts the states of the scene.
 * @property {'running' | 'stopping' | 'saved' | 'failed'} state
 * @property {string} phase
 * @property {number} done
 * @property {number} total 0 where it is not counted.
 * @property {number} seconds
 * @property {number | null} eta_s
 * @property {number | null} rate Steps per second.
 * @property {number | null} loss
 * @property {number | null} psnr
 * @property {number} gaussians
 * @property {number} showing_s Seconds that this page has cost.
 * @property {[number, number][]} curve Seconds and PSNR of training views.
 * @property {[number, number][]} held_out Seconds and PSNR of held-out frames.
 * @property {Record<string, number>} phases Seconds.
 */

const POLL_INTERVAL = 1000;
const KEPT_VIEW = 'cif-view';

/** @type {Record<RunStatus['state'], string>} */
const RUN_STATES = {
  running: 'Training',
  stopping: 'Stopping and saving',
  saved: 'Saved',
  failed: 'Training failed; the terminal says why',
};

/** Watches a run. */
export class LiveRun {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.revision = -1;
    byId('live', HTMLElement).hidden = false;
    const stop = byId('live-stop', HTMLButtonElement);
    stop.addEventListener('click', async () => {
      stop.disabled = true;
      await fetch('stop', { method: 'POST' }).catch(() => undefined);
    });
    this.restoreView();
    this.poll();
  }

  async poll() {
    const status = await this.ask();
    if (!status) {
      byId('live-state', HTMLElement).textContent = 'The run has ended.';
      byId('live-stop', HTMLElement).hidden = true;
      return;
    }
    this.show(status);
    if (status.revision !== this.revision) await this.load(status.revision);
    if (!isOver(status)) setTimeout(() => this.poll(), POLL_INTERVAL);
  }

  /** @returns {Promise<RunStatus | null>} Null when the server has gone. */
  async ask() {
    try {
      return await (await request('status.json')).json();
    } catch {
      return null;
    }
  }

  /** @param {number} revision */
  async load(revision) {
    if (this.revision < 0 && this.app.scene.nodes.length) {
      // The page has just been loaded with it.
      this.revision = revision;
      return;
    }
    try {
      const { scene, bytes } = await loadScene();
      this.revision = revision;
      if (namesOf(scene) === namesOf(this.app.scene)) this.app.replace(scene, bytes);
      else if (scene.nodes.length) this.reload();
    } catch {
      // The scene changed between its two parts; the next question finds it whole.
    }
  }

  /** Begins anew with other objects, from where the camera is. */
  reload() {
    const { viewCamera, state, scene } = this.app;
    const { distance } = viewCamera;
    const view = { pose: viewCamera.pose(), distance, code: state.code };
    if (scene.nodes.length) sessionStorage.setItem(KEPT_VIEW, JSON.stringify(view));
    location.reload();
  }

  restoreView() {
    const kept = sessionStorage.getItem(KEPT_VIEW);
    sessionStorage.removeItem(KEPT_VIEW);
    if (!kept) return;
    const { pose, distance, code } = JSON.parse(kept);
    this.app.viewCamera.look(pose, distance);
    this.app.set({ code });
  }

  /** @param {RunStatus} status */
  show(status) {
    const { phase, done, total } = status;
    const counted = total ? `${formatCount(done)} of ${formatCount(total)}` : '';
    const ended = isOver(status);
    byId('live-state', HTMLElement).textContent = ended
      ? RUN_STATES[status.state]
      : `${RUN_STATES[status.state]}: ${phase} ${counted}`;
    byId('live-stop', HTMLElement).hidden = ended;
    const progress = byId('live-progress', HTMLProgressElement);
    progress.hidden = ended;
    if (total) progress.value = done / total;
    else progress.removeAttribute('value');
    byId('live-facts', HTMLElement).textContent = factsOf(status).join(', ');
    drawCurve(byId('live-curve', HTMLCanvasElement), status);
    const phases = Object.entries(status.phases).sort((a, b) => b[1] - a[1]);
    byId('live-phases', HTMLElement).replaceChildren(
      ...phases.flatMap(([name, seconds]) => [make('dt', '', name), make('dd', '', duration(seconds))]),
    );
  }
}

/**
 * True after the last of a run.
 * @param {RunStatus} status
 * @returns {boolean}
 */
function isOver(status) {
  return status.state === 'saved' || status.state === 'failed';
}

/**
 * Objects and cameras of a scene, by which two of them are distinguished.
 * @param {SceneDocument} scene
 * @returns {string}
 */
function namesOf(scene) {
  const nodes = scene.nodes.map((node) => `${node.name} ${node.parts.length}`);
  const cameras = scene.cameras.map((camera) => `${camera.name} ${camera.samples.length}`);
  return JSON.stringify([nodes, cameras, scene.timeline.end]);
}

/**
 * @param {RunStatus} status
 * @returns {string[]}
 */
function factsOf(status) {
  const facts = [duration(status.seconds)];
  if (status.eta_s !== null) facts.push(`${duration(status.eta_s)} left`);
  if (status.rate !== null) facts.push(`${status.rate.toFixed(1)} steps/s`);
  if (status.gaussians) facts.push(`${formatCount(status.gaussians)} Gaussians`);
  if (status.psnr !== null) facts.push(`${status.psnr.toFixed(2)} dB on training views`);
  const held = status.held_out.at(-1);
  if (held) facts.push(`${held[1].toFixed(2)} dB held out`);
  facts.push(`${status.showing_s.toFixed(1)} s for this page`);
  return facts;
}

/**
 * @param {number} seconds
 * @returns {string}
 */
function duration(seconds) {
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  return `${Math.floor(seconds / 60)} min ${String(Math.floor(seconds % 60)).padStart(2, '0')} s`;
}

/**
 * PSNR over time: training views as a line, held-out frames as points.
 * @param {HTMLCanvasElement} canvas
 * @param {RunStatus} status
 */
function drawCurve(canvas, status) {
  const ratio = window.devicePixelRatio;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const values = [...status.curve, ...status.held_out].map((point) => point[1]);
  if (!width || values.length < 2) return;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = context2d(canvas);
  const style = getComputedStyle(canvas);
  context.scale(ratio, ratio);
  const low = Math.floor(Math.min(...values));
  const high = Math.max(Math.ceil(Math.max(...values)), low + 1);
  const last = Math.max(status.seconds, 1);
  const at = (/** @type {[number, number]} */ [seconds, psnr]) => [
    28 + ((width - 32) * seconds) / last,
    4 + ((height - 8) * (high - psnr)) / (high - low),
  ];
  context.font = '10px system-ui, sans-serif';
  context.fillStyle = style.color;
  context.fillText(`${high} dB`, 0, 10);
  context.fillText(`${low} dB`, 0, height - 2);
  context.strokeStyle = style.borderColor;
  context.beginPath();
  for (const point of status.curve) context.lineTo(at(point)[0], at(point)[1]);
  context.stroke();
  context.fillStyle = style.outlineColor;
  for (const point of status.held_out) context.fillRect(at(point)[0] - 2, at(point)[1] - 2, 4, 4);
}
